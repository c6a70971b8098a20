"""compare: what changed beyond noise between two runs of one study, and what cannot be compared."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from tqdm import tqdm

from ..errors import InputError
from ..evaluate.statistics import Interval, mean_interval, paired_difference
from ..plugins import unknown
from .manifest import Manifest, read
from .parse import assignments, parse
from .results import SEED, Results, ego_by_run
from .style import label, words
from .tables import Entry, Table

DRAW = ["ego", "run", SEED]
"""Columns that name one draw of the noise and of the training; the same draw in both runs makes a pair."""
SAME = 1e-9
"""Relative difference up to which two numbers are the same: processors and libraries round differently."""


@dataclass(frozen=True)
class Comparison:
    """Tables of what differs: settings and versions, the metric, and cells that only one run has; None if nothing."""

    settings: Table | None
    changes: Table
    cells: Table | None

    def render(self, form: str) -> str:
        """The tables, one after another, in a format of `coopoc.study.tables.FORMATS`."""
        shown = [self.settings, self.changes, self.cells]
        return "\n\n".join(table.render(form).rstrip("\n") for table in shown if table is not None)


def compare(
    a: str | Path, b: str | Path, value: str = "rt_le_m", by: Sequence[str] = (), where: Sequence[str] = ()
) -> Comparison:
    """Mean of a metric in two runs of one study, and B - A with its 95 % interval, for each combination of parameters.

    Runs of the same noise seed are compared draw by draw (ego, run, training seed): what they share cancels. Others
    are compared mean by mean, with the interval of Zou and Donner, Statistics in Medicine 27, 2008: with the
    means' intervals [l, u], B - A lies between -sqrt((B - l_B)^2 + (u_A - A)^2) and +sqrt((u_B - B)^2 + (A - l_A)^2).
    Intervals are over egos, then runs; means are over training seeds, whose spread has a column of its own.

    Args:
        a, b: folders of the study. value: the metric.
        by: columns beside the parameters that tell rows apart, such as "round".
        where: "method=okf,kalman": rows and cells to compare.

    Raises:
        InputError: folders of two studies or of none, an unknown column, a metric that is no number, or several rows of
            one draw.
    """
    folders = Path(a), Path(b)
    one, two = read(folders[0]), read(folders[1])
    if one["study"] != two["study"]:
        held = f"hold different studies, {one['study']} and {two['study']}"
        raise InputError("folders", f"{a} and {b}", held, "Compare two runs of one study.")
    names = list(dict.fromkeys((*one["axes"], *two["axes"])))
    runs = Results.load(folders[0]), Results.load(folders[1])
    frames = [_frame(results, [*names, *by], value) for results in runs]
    chosen = _chosen(frames, where)
    rows = [_kept(frame, chosen) for frame in frames]
    if where and not any(map(len, rows)):
        raise InputError("where", " ".join(where), "must have a row in one of the runs", "Name fewer values.")
    paired = one["settings"].get("seed") == two["settings"].get("seed")
    changes = _changes(rows, [name for name in (*names, *by) if name != SEED], value, paired, folders)
    return Comparison(_settings(one, two, names), changes, _cells((one, two), runs, names, chosen))


def _frame(results: Results, names: Sequence[str], value: str) -> pd.DataFrame:
    """Rows with every parameter: one that is a setting of this run, and an axis of the other, has its one value."""
    frame = results.frame
    for name in names if len(frame) else ():
        if name not in frame and name not in results.settings:
            raise unknown("column", name, frame.columns)
    if len(frame) and value not in frame:
        raise unknown("metric", value, frame.columns)
    if len(frame) and not pd.api.types.is_numeric_dtype(frame[value].dropna()) and frame[value].notna().any():
        raise InputError("metric", repr(value), "must be a column of numbers", "It names or lists things.")
    absent = {name: results.settings.get(name) for name in names if name not in frame}
    frame = frame.assign(**absent, **{name: 0 for name in DRAW if name not in (*frame, *absent)})
    frame = frame.assign(**{SEED: frame[SEED].astype(float)})  # None and NaN are one seed: none
    twice = frame.duplicated([*names, *(name for name in DRAW if name not in names)])
    if twice.any():
        allowed = "has several rows per ego, run and training seed"
        raise InputError("folder", results.study, allowed, "Name the column that tells them apart, as in --by round.")
    return frame


def _chosen(frames: Sequence[pd.DataFrame], where: Sequence[str]) -> dict[str, tuple[Any, ...]]:
    found = {}
    for name, text in assignments(where).items():
        known = [frame[name].dropna() for frame in frames if name in frame]
        if not known:
            raise unknown("column", name, [column for frame in frames for column in frame.columns])
        found[name] = parse(name, text, tuple(pd.concat(known).iloc[:1].tolist()))
    return found


def _kept(frame: pd.DataFrame, chosen: Mapping[str, tuple[Any, ...]]) -> pd.DataFrame:
    for name, values in chosen.items():
        frame = frame[[_plain(v) in values for v in frame[name]]] if name in frame else frame[:0]
    return frame


def _groups(frame: pd.DataFrame, names: Sequence[str]) -> dict[tuple[Any, ...], pd.DataFrame]:
    if frame.empty:
        return {}
    return {tuple(map(_plain, key)): group for key, group in frame.groupby(list(names), sort=False, dropna=False)}


def _plain(value: Any) -> Any:
    return None if value is None or value is pd.NA or (isinstance(value, float) and math.isnan(value)) else value


@dataclass(frozen=True)
class _Change:
    """One group: means, difference, egos left out; pairs, values without partner, and the ends over training seeds."""

    a: float
    b: float
    difference: Interval
    missing: int
    pairs: int = 0
    alone: int = 0
    same: bool = False
    seeds: tuple[float, float] | None = None

    @property
    def verdict(self) -> str:
        if self.same:
            return "same"
        if math.isnan(self.difference.low):
            return "no interval"
        return "higher" if self.difference.low > 0 else "lower" if self.difference.high < 0 else "within noise"


def _change(a: pd.DataFrame, b: pd.DataFrame, value: str, paired: bool) -> _Change | None:
    """The change of one group; None if one of the two has no finite value."""
    both = a[[*DRAW, value]].merge(b[[*DRAW, value]], on=DRAW, suffixes=("_a", "_b"))
    if not paired or both.empty:
        (first, lost), (second, gone) = ego_by_run(a, value), ego_by_run(b, value)
        if not first.size or not second.size:
            return None
        one, two = mean_interval(first), mean_interval(second)
        return _Change(one.mean, two.mean, unpaired(one, two), lost + gone)
    finite = both[[f"{value}_a", f"{value}_b"]].notna().all(axis=1)
    (first, missing), (second, _) = (
        ego_by_run(both.assign(**{name: both[name].where(finite)}), name) for name in (f"{value}_a", f"{value}_b")
    )
    if not first.size:
        return None
    apart = (both[f"{value}_b"] - both[f"{value}_a"]).groupby(both[SEED]).mean()
    seeds = (float(apart.min()), float(apart.max())) if len(apart) > 1 else None
    return _Change(
        float(first.mean()), float(second.mean()), paired_difference(second, first), missing, len(both),
        len(a) + len(b) - 2 * len(both), bool(np.allclose(first, second, rtol=SAME, atol=0)), seeds,
    )  # fmt: skip


def unpaired(a: Interval, b: Interval) -> Interval:
    """Interval of b - a from the intervals of two independent means (Zou and Donner, 2008).

    >>> print(unpaired(Interval(1.0, 0.7, 1.3, 30), Interval(2.0, 1.6, 2.4, 30)))
    1 [0.5, 1.5]
    """
    mean = b.mean - a.mean
    low, high = math.hypot(b.mean - b.low, a.high - a.mean), math.hypot(b.high - b.mean, a.mean - a.low)
    return Interval(mean, mean - low, mean + high, a.n + b.n)


def _changes(
    rows: Sequence[pd.DataFrame], names: Sequence[str], value: str, paired: bool, folders: tuple[Path, Path]
) -> Table:
    one, two = (_groups(frame, names) for frame in rows)
    shared = tqdm([key for key in one if key in two], desc="compare", unit="group", leave=False, delay=2)
    found = {key: _change(one[key], two[key], value, paired) for key in shared}
    real = [change for change in found.values() if change is not None]
    seeds = any(change.seeds for change in real)
    body = []
    for key, change in found.items():
        numbers: list[Entry] = [None] * 3 if change is None else [change.a, change.b, change.difference]
        numbers += [_range(change)] if seeds else []
        verdict = "no finite value" if change is None else change.verdict
        body.append((*map(label, names, key), *numbers, verdict))
    header = (*map(words, names), "A", "B", "B - A", *(["Over training seeds"] if seeds else []), "Change")
    pairs = sum(change.pairs > 0 for change in real)
    how = f"paired by ego, run and training seed in {pairs} of {len(real)} groups" if paired else (
        "not paired, as the noise seeds differ")  # fmt: skip
    caption = f"{words(value)} in A = {folders[0]} and B = {folders[1]}; B - A with its 95 % interval, {how}."
    return Table(header, tuple(body), caption, decimals=3, notes=tuple(_notes(real)))


def _range(change: _Change | None) -> str:
    return "" if change is None or change.seeds is None else f"{change.seeds[0]:.3f} to {change.seeds[1]:.3f}"


def _notes(changes: Sequence[_Change]) -> Iterator[str]:
    verdicts = [change.verdict for change in changes]
    tested = len(verdicts) - verdicts.count("no interval") - verdicts.count("same")
    beyond = verdicts.count("higher") + verdicts.count("lower")
    yield (f"{beyond} of {len(verdicts)} groups changed beyond noise (their interval excludes 0); "
           f"by chance alone about {0.05 * tested:.1f} would.")  # fmt: skip
    if any(change.seeds for change in changes):
        yield "The intervals are over egos and runs; what another training does is in the column over training seeds."
    if alone := sum(change.alone for change in changes):
        yield f"{alone} values that only one of the two has (another run, ego or training seed) are left out."
    if missing := sum(change.missing for change in changes):
        yield f"{missing} egos are left out because a run of theirs is missing or not finite."


def _settings(one: Manifest, two: Manifest, names: Sequence[str]) -> Table | None:
    rows = [(name, *(str(m["settings"].get(name, "–")) for m in (one, two)))
            for name in {**one["settings"], **two["settings"]} if name not in names]  # fmt: skip
    rows += [(name, *(m["environment"].get(name, "–") for m in (one, two)))
             for name in {**one["environment"], **two["environment"]}]  # fmt: skip
    differ = tuple(row for row in rows if row[1] != row[2])
    return Table(("Setting", "A", "B"), differ, "Settings and versions that differ.") if differ else None


def _cells(
    manifests: tuple[Manifest, Manifest],
    runs: tuple[Results, Results],
    names: Sequence[str],
    chosen: Mapping[str, tuple[Any, ...]],
) -> Table | None:
    """Cells that are not finished in both runs, each with what became of it."""
    states: list[dict[tuple[Any, ...], str]] = [{}, {}]
    for state, manifest, results in zip(states, manifests, runs, strict=True):
        done = set(results.frame["cell"]) if len(results.frame) else set()
        failed = dict(zip(results.failures["cell"], results.failures["reason"], strict=True)) if results.failed else {}
        for cell in manifest["cells"]:
            p = {**manifest["settings"], **cell["params"]}
            if all(p[name] in values for name, values in chosen.items() if name in p):
                reason = failed.get(cell["name"])
                became = "finished" if cell["name"] in done else f"failed: {reason}" if reason else "not computed"
                state[tuple(p.get(name) for name in names)] = became
    rows = []
    for key in dict.fromkeys((*states[0], *states[1])):
        both = [state.get(key, "not in the grid") for state in states]
        if both != ["finished", "finished"]:
            rows.append((*map(label, names, key), *both))
    return Table((*map(words, names), "A", "B"), tuple(rows), "Cells that cannot be compared.") if rows else None

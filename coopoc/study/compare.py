"""compare: changes beyond noise between two runs of one study, and the cells that cannot be compared."""

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
from ..file_names import given_path
from ..plugins import unknown
from . import changes
from .changes import NAN, Change, plain
from .manifest import Manifest, read
from .results import SEED, Results, check_metric, ego_by_run, parsed
from .style import label, words
from .tables import Table

DRAW = ["ego", "run", SEED]
"""Columns that name one draw of the noise and of the training; the same draw in both runs makes a pair."""
SAME = 1e-9
"""Relative difference up to which two numbers are the same: processors and libraries round differently."""


@dataclass(frozen=True)
class Comparison:
    """Tables of the differences between two runs.

    Args:
        settings: settings and versions that differ; None if none does.
        changes: the metric in both runs.
        cells: cells that only one run has; None if there are none.
    """

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

    Runs of the same noise seed are compared draw by draw (ego, run, training seed), so that common noise cancels.
    Others are compared mean by mean: with the means' intervals [l, u], B - A lies between
    -sqrt((B - l_B)^2 + (u_A - A)^2) and +sqrt((u_B - B)^2 + (A - l_A)^2). Intervals are over egos, then runs; means are
    over training seeds, whose range has a column of its own.

    Args:
        a: folder of the study.
        b: folder of the same study.
        value: the metric.
        by: columns beside the parameters that identify a row, such as "round".
        where: "method=okf,kalman": rows and cells to compare.

    Raises:
        InputError: folders of two studies or of none, an unknown column, a metric that is no number, or several rows of
            one draw.

    References:
        Zou and Donner, Statistics in Medicine 27, 2008.
    """
    folders = given_path(a), given_path(b)
    one, two = read(folders[0]), read(folders[1])
    if one.study != two.study:
        allowed = f"hold different studies, {one.study} and {two.study}"
        raise InputError("folders", f"{a} and {b}", allowed, "Compare two runs of one study.")
    names = list(dict.fromkeys((*one.axes, *two.axes)))
    runs = Results.load(folders[0]), Results.load(folders[1])
    frames = [_frame(results, [*names, *by], value) for results in runs]
    chosen = parsed(frames, where)
    rows = [_select(frame, chosen) for frame in frames]
    if where and not any(map(len, rows)):
        raise InputError("where", " ".join(where), "must have a row in one of the runs", "Name fewer values.")
    paired = one.settings.get("seed") == two.settings.get("seed")
    found = _changes(rows, [name for name in (*names, *by) if name != SEED], value, paired, folders)
    return Comparison(_settings(one, two, names), found, _cells((one, two), runs, names, chosen))


def _frame(results: Results, names: Sequence[str], value: str) -> pd.DataFrame:
    """Rows with every parameter; a setting of this run that is an axis of the other becomes a column."""
    frame = results.frame
    for name in names if len(frame) else ():
        if name not in frame and name not in results.settings:
            raise unknown("column", name, frame.columns)
    if len(frame):
        check_metric(frame, value)
    absent = {name: results.settings.get(name) for name in names if name not in frame}
    frame = frame.assign(**absent, **{name: 0 for name in DRAW if name not in (*frame, *absent)})
    frame = frame.assign(**{SEED: frame[SEED].astype(float)})  # None and NaN both mean that nothing was trained
    twice = frame.duplicated([*names, *(name for name in DRAW if name not in names)])
    if twice.any():
        allowed = "has several rows per ego, run and training seed"
        raise InputError("folder", results.study, allowed, "Name the column that identifies them, as in --by round.")
    return frame


def _select(frame: pd.DataFrame, chosen: Mapping[str, tuple[Any, ...]]) -> pd.DataFrame:
    for name, values in chosen.items():
        frame = frame[[plain(v) in values for v in frame[name]]] if name in frame else frame[:0]
    return frame


def _groups(frame: pd.DataFrame, names: Sequence[str]) -> dict[tuple[Any, ...], pd.DataFrame]:
    if frame.empty:
        return {}
    return {tuple(map(plain, key)): group for key, group in frame.groupby(list(names), sort=False, dropna=False)}


def _change(at: Mapping[str, Any], a: pd.DataFrame, b: pd.DataFrame, value: str, paired: bool) -> Change:
    both = a[[*DRAW, value]].merge(b[[*DRAW, value]], on=DRAW, suffixes=("_a", "_b"))
    if not paired or both.empty:
        (first, lost), (second, gone) = ego_by_run(a, value), ego_by_run(b, value)
        if not first.size or not second.size:
            return Change(at, value, math.nan, math.nan, NAN)
        one, two = mean_interval(first), mean_interval(second)
        return Change(at, value, one.mean, two.mean, unpaired(one, two), missing=lost + gone)
    finite = both[[f"{value}_a", f"{value}_b"]].notna().all(axis=1)
    (first, missing), (second, _) = (
        ego_by_run(both.assign(**{name: both[name].where(finite)}), name) for name in (f"{value}_a", f"{value}_b")
    )
    if not first.size:
        return Change(at, value, math.nan, math.nan, NAN)
    per_seed = (both[f"{value}_b"] - both[f"{value}_a"]).groupby(both[SEED]).mean()
    return Change(
        at,
        value,
        float(first.mean()),
        float(second.mean()),
        paired_difference(second, first),
        same=bool(np.allclose(first, second, rtol=SAME, atol=0)),
        seeds=(float(per_seed.min()), float(per_seed.max())) if len(per_seed) > 1 else None,
        pairs=len(both),
        alone=len(a) + len(b) - 2 * len(both),
        missing=missing,
    )


def unpaired(a: Interval, b: Interval) -> Interval:
    """Interval of b - a from the intervals of two independent means.

    References:
        Zou and Donner, Statistics in Medicine 27, 2008.

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
    found = [_change(dict(zip(names, key, strict=True)), one[key], two[key], value, paired) for key in shared]
    real = [change for change in found if change.verdict != "no finite value"]
    pairs = f"paired by ego, run and training seed in {sum(c.pairs > 0 for c in real)} of {len(real)} groups"
    how = pairs if paired else "not paired, as the noise seeds differ"
    caption = f"{words(value)} in A = {folders[0]} and B = {folders[1]}; B - A with its 95 % interval, {how}."
    return changes.table(found, "A", "B", caption, names, 3, tuple(_notes(real)))


def _notes(found: Sequence[Change]) -> Iterator[str]:
    verdicts = [change.verdict for change in found]
    tested = len(verdicts) - verdicts.count("no interval") - verdicts.count("same")
    beyond = verdicts.count("higher") + verdicts.count("lower")
    yield (
        f"{beyond} of {len(verdicts)} groups changed beyond noise (their interval excludes 0); "
        f"by chance alone about {0.05 * tested:.1f} would."
    )
    if any(change.seeds for change in found):
        yield "The intervals are over egos and runs; the column over training seeds shows the effect of the training."
    if alone := sum(change.alone for change in found):
        yield f"{alone} values that only one of the two has (another run, ego or training seed) are left out."
    if missing := sum(change.missing for change in found):
        yield f"{missing} egos are left out because a run of theirs is missing or not finite."


def _settings(one: Manifest, two: Manifest, names: Sequence[str]) -> Table | None:
    pairs = [(one.settings, two.settings), (one.environment, two.environment)]
    rows = [(name, *(str(m.get(name, "–")) for m in (a, b))) for a, b in pairs for name in {**a, **b}]
    differ = tuple(row for row in rows if row[1] != row[2] and row[0] not in names)
    return Table(("Setting", "A", "B"), differ, "Settings and versions that differ.") if differ else None


def _cells(
    manifests: tuple[Manifest, Manifest],
    runs: tuple[Results, Results],
    names: Sequence[str],
    chosen: Mapping[str, tuple[Any, ...]],
) -> Table | None:
    """Cells that are not finished in both runs, each with its state."""
    states: list[dict[tuple[Any, ...], str]] = [{}, {}]
    for state, manifest, results in zip(states, manifests, runs, strict=True):
        done = set(results.frame["cell"]) if len(results.frame) else set()
        failed = dict(zip(results.failures["cell"], results.failures["reason"], strict=True)) if results.failed else {}
        for name, params in manifest.cells.items():
            p = {**manifest.settings, **params}
            if all(p[axis] in values for axis, values in chosen.items() if axis in p):
                became = "finished" if name in done else f"failed: {failed[name]}" if name in failed else "not computed"
                state[tuple(p.get(axis) for axis in names)] = became
    rows = []
    for key in dict.fromkeys((*states[0], *states[1])):
        both = [state.get(key, "not in the grid") for state in states]
        if both != ["finished", "finished"]:
            rows.append((*map(label, names, key), *both))
    return Table((*map(words, names), "A", "B"), tuple(rows), "Cells that cannot be compared.") if rows else None

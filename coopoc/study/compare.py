"""compare: changes beyond noise between two runs of one study; the verdicts that reference values use, too."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pandas as pd

from ..errors import InputError, unknown
from ..evaluate.statistics import Interval, mean_interval, paired_difference
from ..file_names import given_path
from .manifest import Manifest, read
from .results import NOTHING, SEED, Results, check_metric, ego_by_run, parsed
from .style import label, words
from .tables import Entry, Table

Direction: TypeAlias = str | float
"""Of a metric: "lower" or "higher" is better, or the value that is best."""
DRAW = ["ego", "run", SEED]
"""Columns that name one draw of the noise and of the training; the same draw in both runs makes a pair."""
SAME = 1e-9
"""Relative difference up to which two numbers are the same: processors and libraries round differently."""


@dataclass(frozen=True)
class Change:
    """A number in A and in B; it has changed if the interval of B - A excludes 0.

    Args:
        at: parameter -> value.
        metric: name of the number.
        a: in A.
        b: in B.
        difference: B - A with the interval that noise, or a tolerance, leaves it.
        better: direction of the metric, if it is known.
        same: A and B agree but for rounding.
        pairs: number of draws that A and B share.
        missing: number of egos that are left out.
    """

    at: Mapping[str, Any]
    metric: str
    a: float
    b: float
    difference: Interval
    better: Direction | None = None
    same: bool = False
    pairs: int = 0
    missing: int = 0

    @property
    def verdict(self) -> str:
        """same, within noise, higher, lower, better or worse; or why there is none.

        >>> Change({}, "rt_le_m", 1.0, 1.2, Interval(0.2, 0.1, 0.3, 30), "lower").verdict
        'worse'
        """
        if self.same:
            return "same"
        if math.isnan(self.a) or math.isnan(self.b):
            return "no finite value"
        if math.isnan(self.difference.low):
            return "no interval"
        if self.difference.low <= 0 <= self.difference.high:
            return "within noise"
        rises = self.difference.mean > 0
        if self.better is None:
            return "higher" if rises else "lower"
        if isinstance(self.better, str):
            return "better" if rises == (self.better == "higher") else "worse"
        return "better" if abs(self.b - self.better) < abs(self.a - self.better) else "worse"


def change_table(
    changes: Sequence[Change],
    sides: tuple[str, str],
    caption: str,
    names: Sequence[str],
    decimals: int,
    notes: Sequence[str] = (),
) -> Table:
    """Table of changes, one per row.

    Args:
        changes: to show.
        sides: titles over A and B.
        caption: under the table.
        names: parameters that label the rows; "metric" is the metric.
        decimals: of the numbers.
        notes: sentences under the caption.
    """
    body: list[tuple[Entry, ...]] = []
    for change in changes:
        at = {"metric": change.metric, **change.at}
        labels = (label(name, at.get(name)) for name in names)
        body.append((*labels, change.a, change.b, change.difference, change.verdict))
    header = (*map(words, names), *sides, f"{sides[1]} - {sides[0]}", "Change")
    return Table(header, tuple(body), caption, decimals=decimals, notes=tuple(notes))


@dataclass(frozen=True)
class Comparison:
    """Tables of the differences between two runs.

    Args:
        settings: settings and versions that differ; None if none does.
        changes: the metric in both runs.
    """

    settings: Table | None
    changes: Table

    def render(self, form: str) -> str:
        """The tables, one after another, in a format of `coopoc.study.tables.FORMATS`."""
        shown = [self.settings, self.changes]
        return "\n\n".join(table.render(form).rstrip("\n") for table in shown if table is not None)


def compare(
    a: str | Path, b: str | Path, value: str = "rt_le_m", by: Sequence[str] = (), where: Sequence[str] = ()
) -> Comparison:
    """Mean of a metric in two runs of one study, and B - A with its 95 % interval, for each combination of parameters.

    Runs of the same noise seed are compared draw by draw (ego, run, training seed), so that common noise cancels.
    Others are compared mean by mean, see `unpaired`. Intervals are over egos, then runs; means are over training seeds.

    Args:
        a: folder of the study.
        b: folder of the same study.
        value: the metric.
        by: columns beside the parameters that identify a row, such as "round".
        where: "method=okf,kalman": rows to compare.

    Raises:
        InputError: folders of two studies or of none, an unknown column, a metric that is no number, or several rows of
            one draw.
    """
    folders = given_path(a), given_path(b)
    one, two = read(folders[0]), read(folders[1])
    if one.study != two.study:
        allowed = f"hold different studies, {one.study} and {two.study}"
        raise InputError("folders", f"{a} and {b}", allowed, "Compare two runs of one study.")
    names = list(dict.fromkeys((*one.axes, *two.axes)))
    frames = [_frame(Results.load(folder), [*names, *by], value) for folder in folders]
    chosen = parsed(frames, where)
    for name, values in chosen.items():
        frames = [frame[[plain(v) in values for v in frame[name]]] if name in frame else frame[:0] for frame in frames]
    if where and not any(map(len, frames)):
        raise InputError("where", " ".join(where), "must have a row in one of the runs", "Name fewer values.")
    labels = [name for name in (*names, *by) if name != SEED]
    first, second = (_groups(frame, labels) for frame in frames)
    paired = one.settings.get("seed") == two.settings.get("seed")
    shared = [key for key in first if key in second]
    changes = [_change(dict(zip(labels, key, strict=True)), first[key], second[key], value, paired) for key in shared]
    how = "paired by ego, run and training seed" if paired else "not paired, as the noise seeds differ"
    caption = f"{words(value)} in A = {folders[0]} and B = {folders[1]}; B - A with its 95 % interval, {how}."
    notes = _notes(changes, len(first.keys() ^ second.keys()))
    return Comparison(_settings(one, two, names), change_table(changes, ("A", "B"), caption, labels, 3, notes))


def _frame(results: Results, names: Sequence[str], value: str) -> pd.DataFrame:
    """Rows with every parameter; a setting of this run that is an axis of the other becomes a column."""
    frame = results.frame
    if frame.empty:
        return frame
    for name in names:
        if name not in frame and name not in results.settings:
            raise unknown("column", name, frame.columns)
    check_metric(frame, value)
    absent = {name: results.settings.get(name) for name in names if name not in frame}
    frame = frame.assign(**absent, **{name: 0 for name in DRAW if name not in (*frame, *absent)})
    frame = frame.assign(**{SEED: frame[SEED].astype(float)})  # None and NaN both mean that nothing was trained
    if frame.duplicated(list(dict.fromkeys((*names, *DRAW)))).any():
        allowed = "has several rows per ego, run and training seed"
        raise InputError("folder", results.study, allowed, "Name the column that identifies them, as in --by round.")
    return frame


def _groups(frame: pd.DataFrame, names: Sequence[str]) -> dict[tuple[Any, ...], pd.DataFrame]:
    if frame.empty:
        return {}
    return {tuple(map(plain, key)): group for key, group in frame.groupby(list(names), sort=False, dropna=False)}


def _change(at: Mapping[str, Any], a: pd.DataFrame, b: pd.DataFrame, value: str, paired: bool) -> Change:
    both = a[[*DRAW, value]].merge(b[[*DRAW, value]], on=DRAW, suffixes=("_a", "_b"))
    if paired and len(both):
        finite = both[[f"{value}_a", f"{value}_b"]].notna().all(axis=1)
        both = both.assign(**{f"{value}{side}": both[f"{value}{side}"].where(finite) for side in ("_a", "_b")})
        (first, missing), (second, _) = (ego_by_run(both, f"{value}{side}") for side in ("_a", "_b"))
    else:
        both = both[:0]
        (first, lost), (second, gone) = ego_by_run(a, value), ego_by_run(b, value)
        missing = lost + gone
    if not first.size or not second.size:
        return Change(at, value, math.nan, math.nan, NOTHING)
    if both.empty:
        gap, same = unpaired(mean_interval(first), mean_interval(second)), False
    else:
        gap, same = paired_difference(second, first), bool(np.allclose(first, second, rtol=SAME, atol=0))
    means = float(first.mean()), float(second.mean())
    return Change(at, value, *means, gap, same=same, pairs=len(both), missing=missing)


def unpaired(a: Interval, b: Interval) -> Interval:
    """Interval of b - a from the intervals of two independent means.

    With [l, u] of each mean, b - a lies between -sqrt((b - l_b)^2 + (u_a - a)^2) and +sqrt((u_b - b)^2 + (a - l_a)^2).

    References:
        Zou and Donner, Statistics in Medicine 27, 2008.

    >>> print(unpaired(Interval(1.0, 0.7, 1.3, 30), Interval(2.0, 1.6, 2.4, 30)))
    1 [0.5, 1.5]
    """
    mean = b.mean - a.mean
    low, high = math.hypot(b.mean - b.low, a.high - a.mean), math.hypot(b.high - b.mean, a.mean - a.low)
    return Interval(mean, mean - low, mean + high, a.n + b.n)


def _notes(changes: Sequence[Change], single: int) -> list[str]:
    verdicts = [change.verdict for change in changes if change.verdict != "no finite value"]
    tested = len(verdicts) - verdicts.count("no interval") - verdicts.count("same")
    beyond = verdicts.count("higher") + verdicts.count("lower")
    notes = [
        f"{beyond} of {len(verdicts)} groups changed beyond noise (their interval excludes 0); "
        f"by chance alone about {0.05 * tested:.1f} would."
    ]
    if single:
        notes.append(f"{single} groups have finished in one of the two runs only.")
    if missing := sum(change.missing for change in changes):
        notes.append(f"{missing} egos are left out because a run of theirs is missing or not finite.")
    return notes


def _settings(one: Manifest, two: Manifest, names: Sequence[str]) -> Table | None:
    pairs = [(one.settings, two.settings), (one.environment, two.environment)]
    rows = [(name, *(str(m.get(name, "–")) for m in (a, b))) for a, b in pairs for name in {**a, **b}]
    differ = tuple(row for row in rows if row[1] != row[2] and row[0] not in names)
    return Table(("Setting", "A", "B"), differ, "Settings and versions that differ.") if differ else None


def plain(value: Any) -> Any:
    """A parameter as JSON has it: Python's own number, None for NaN, a list for a tuple."""
    value = value.item() if isinstance(value, np.generic) else value
    if value is pd.NA or (isinstance(value, float) and math.isnan(value)):
        return None
    return list(value) if isinstance(value, tuple) else value

"""compare: changes beyond noise between two runs of one study; the verdicts that reference values use, too."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pandas as pd

from ..errors import InputError, unknown
from ..evaluate.statistics import Interval, paired_difference
from ..file_names import given_path
from .manifest import different, read
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
        missing: number of egos that are left out.
    """

    at: Mapping[str, Any]
    metric: str
    a: float
    b: float
    difference: Interval
    better: Direction | None = None
    same: bool = False
    missing: int = 0

    @property
    def verdict(self) -> str:
        """same, within noise, higher, lower, better or worse; or why there is none.

        >>> Change({}, "rt_le_m", 1.0, 1.2, Interval(0.2, 0.1, 0.3, 30), "lower").verdict
        'worse'
        >>> Change({}, "rt_le_m", math.nan, 1.2, Interval(0.2, 0.1, 0.3, 30)).verdict
        'no finite value'
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


def compare(
    a: str | Path, b: str | Path, value: str = "rt_le_m", by: Sequence[str] = (), where: Sequence[str] = ()
) -> Table:
    """Mean of a metric in two runs of one study, and B - A with its 95 % interval, for each combination of parameters.

    Draws (ego, run, training seed) that both have are compared one by one, so that common noise cancels. Intervals are
    over egos, then runs; means are over training seeds. A note names settings and versions that differ.

    Args:
        a: folder of the study.
        b: folder of the same study.
        value: the metric.
        by: columns beside the parameters that identify a row, such as "round".
        where: "method=okf,kalman": rows to compare.

    Raises:
        InputError: folders of two studies or of none, or of other noise seeds, an unknown column, a metric that is no
            number, or several rows of one draw.
    """
    folders = given_path(a), given_path(b)
    first, second = map(read, folders)
    seeds = [manifest.settings.get("seed") for manifest in (first, second)]
    if first.study != second.study or seeds[0] != seeds[1]:
        texts = [f"{m.study} with noise seed {seed}" for m, seed in zip((first, second), seeds, strict=True)]
        allowed = f"must be one study of one noise seed, not {texts[0]} and {texts[1]}"
        raise InputError("folders", f"{a} and {b}", allowed, "Compare two runs of one study, with one seed.")
    names = list(dict.fromkeys((*first.axes, *second.axes)))
    frames = [_frame(Results.load(folder), [*names, *by], value) for folder in folders]
    chosen = parsed(frames, where)
    for name, values in chosen.items():
        frames = [frame[[plain(v) in values for v in frame[name]]] if name in frame else frame[:0] for frame in frames]
    if where and not any(map(len, frames)):
        raise InputError("where", " ".join(where), "must have a row in one of the runs", "Name fewer values.")
    labels = [name for name in (*names, *by) if name != SEED]
    before, after = (_groups(frame, labels) for frame in frames)
    shared = [key for key in before if key in after]
    changes = [_change(dict(zip(labels, key, strict=True)), before[key], after[key], value) for key in shared]
    caption = f"{words(value)} in A = {folders[0]} and B = {folders[1]}; B - A with its 95 % interval, draw by draw."
    whole = (replace(m, settings={**m.settings, **m.environment}, cells={}, axes=()) for m in (first, second))
    differ = [text for text in different(*whole) if text.split(" (")[0] not in names]
    notes = _notes(changes, len(before.keys() ^ after.keys()))
    notes += [f"A and B differ in {', '.join(differ)}."] if differ else []
    return change_table(changes, ("A", "B"), caption, labels, 3, notes)


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


def _change(at: Mapping[str, Any], a: pd.DataFrame, b: pd.DataFrame, value: str) -> Change:
    both = a[[*DRAW, value]].merge(b[[*DRAW, value]], on=DRAW, suffixes=("_a", "_b"))
    sides = [f"{value}_a", f"{value}_b"]
    both[sides] = both[sides].where(both[sides].notna().all(axis=1))
    (first, missing), (second, _) = (ego_by_run(both, side) for side in sides)
    if not first.size:
        return Change(at, value, math.nan, math.nan, NOTHING)
    same = bool(np.allclose(first, second, rtol=SAME, atol=0))
    gap = paired_difference(second.T, first.T)
    return Change(at, value, float(first.mean()), float(second.mean()), gap, same=same, missing=missing)


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


def plain(value: Any) -> Any:
    """A parameter as JSON has it: Python's own number, None for NaN, a list for a tuple."""
    value = value.item() if isinstance(value, np.generic) else value
    if value is pd.NA or (isinstance(value, float) and math.isnan(value)):
        return None
    return list(value) if isinstance(value, tuple) else value

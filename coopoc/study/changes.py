"""Changes between two sets of numbers, A and B: the one verdict of `compare` and of `reference`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import pandas as pd

from ..evaluate.statistics import Interval
from .style import label, words
from .tables import Entry, Table

Direction: TypeAlias = str | float
"""Of a metric: "lower" or "higher" is better, or the value that is best."""
NAN = Interval(math.nan, math.nan, math.nan, 0)


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
        seeds: least and largest difference over training seeds.
        pairs: number of draws that A and B share.
        alone: number of draws that only one of them has.
        missing: number of egos that are left out.
    """

    at: Mapping[str, Any]
    metric: str
    a: float
    b: float
    difference: Interval
    better: Direction | None = None
    same: bool = False
    seeds: tuple[float, float] | None = None
    pairs: int = 0
    alone: int = 0
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


def table(
    found: Sequence[Change],
    a: str,
    b: str,
    caption: str,
    names: Sequence[str],
    decimals: int,
    notes: Sequence[str] = (),
) -> Table:
    """Table of changes, one per row.

    Args:
        found: the changes.
        a: title over A.
        b: title over B.
        caption: under the table.
        names: parameters that label the rows; "metric" is the metric.
        decimals: of the numbers.
        notes: sentences under the caption.
    """
    seeds = any(change.seeds for change in found)
    header = (*map(words, names), a, b, f"{b} - {a}", *(["Over training seeds"] if seeds else []), "Change")
    body: list[tuple[Entry, ...]] = []
    for change in found:
        at = {"metric": change.metric, **change.at}
        over = ["{:.3f} to {:.3f}".format(*change.seeds) if change.seeds else ""] if seeds else []
        numbers = (change.a, change.b, change.difference)
        body.append((*(label(name, at.get(name)) for name in names), *numbers, *over, change.verdict))
    return Table(header, tuple(body), caption, decimals=decimals, notes=tuple(notes))


def plain(value: Any) -> Any:
    """A parameter as JSON has it: Python's own number, None for NaN, a list for a tuple."""
    value = value.item() if isinstance(value, np.generic) else value
    if value is pd.NA or (isinstance(value, float) and math.isnan(value)):
        return None
    return list(value) if isinstance(value, tuple) else value

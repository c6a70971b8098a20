"""Links: which vehicle measured which at each step."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..arrays import Ints, checked, number, refuse


@dataclass(frozen=True, eq=False)
class Links:
    """Which vehicle measured which, the same in all runs, sorted by (step, observer, distance).

    Args:
        step: (L,) step of the link.
        observer: (L,) column of the Recording that measures.
        neighbour: (L,) column that is measured.

    Raises:
        InputError: arrays of other lengths or kinds, a negative index, rows out of order, a vehicle that measures
            itself or measures another twice in a step.

    >>> Links([0, 0], [0, 1], [1, 0])
    Links(2 of 2 observers)
    """

    step: Ints
    observer: Ints
    neighbour: Ints

    def __post_init__(self) -> None:
        size = -1
        for name in ("step", "observer", "neighbour"):
            column = checked(f"links.{name}", getattr(self, name), "(L,)", (size,), int)
            size = len(column)
            object.__setattr__(self, name, column)
            refuse(f"links.{name}", column, column < 0, "must be >= 0", "Count steps and columns from 0.")
        forward, aside = (np.diff(column, prepend=column[:1]) for column in (self.step, self.observer))
        late = (forward < 0) | ((forward == 0) & (aside < 0))
        refuse("links.step", self.step, late, "must be sorted by step, then observer", "Sort with numpy.lexsort.")
        itself = self.neighbour == self.observer
        refuse("links.neighbour", self.neighbour, itself, "must differ from the observer", "Drop the link.")
        pair = np.cumsum((forward != 0) | (aside != 0)) * (self.neighbour.max(initial=0) + 1) + self.neighbour
        order, twice = np.argsort(pair), np.zeros(len(pair), dtype=bool)
        twice[order[1:]] = np.diff(pair[order]) == 0
        allowed = "must stand once for each step and observer"
        refuse("links.neighbour", self.neighbour, twice, allowed, "Keep one measurement of a pair in a step.")

    def of(self, observer: int) -> Ints:
        """Indices of the links of one observer, in time order and nearest first within a step."""
        number("observer", observer, -(2**62), 2**62, kind=int, allowed="a column", hint="Count columns from 0.")
        order, start = self._by_observer
        if not 0 <= observer < len(start) - 1:
            return np.empty(0, dtype=np.int64)
        return order[start[observer] : start[observer + 1]]

    @cached_property
    def _by_observer(self) -> tuple[Ints, Ints]:
        """Links in the order of their observers, and the first of each observer, which spares a search per observer."""
        order = np.argsort(self.observer, kind="stable")
        last = int(self.observer.max(initial=-1))
        return order, np.searchsorted(self.observer[order], np.arange(last + 2))

    def __len__(self) -> int:
        return len(self.step)

    def __repr__(self) -> str:
        return f"Links({len(self)} of {len(np.unique(self.observer))} observers)"

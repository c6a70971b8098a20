"""Recording: all that vehicles may see of a drive, in R noise realisations. It holds no truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..arrays import Bools, Floats, Ints, frozen
from ..errors import InputError
from .sensors import Sensors
from .v2x import V2X


@dataclass(frozen=True, eq=False)
class Links:
    """Who measured whom, the same in all runs, sorted by (step, observer, distance).

    Args:
        step: (L,) step of the link. observer, neighbour: (L,) columns of the Recording.
    """

    step: Ints
    observer: Ints
    neighbour: Ints

    def of(self, observer: int) -> Ints:
        """Indices of the links of one observer, in time order and nearest first within a step."""
        order, start = self._by_observer
        if not 0 <= observer < len(start) - 1:
            return np.empty(0, dtype=np.int64)
        return order[start[observer] : start[observer + 1]]

    @cached_property
    def _by_observer(self) -> tuple[Ints, Ints]:
        """Links in the order of their observers, and where each one's begin: a search of all links for every observer
        would make a fleet's cost per vehicle grow with the fleet."""
        order = np.argsort(self.observer, kind="stable")
        last = int(self.observer.max(initial=-1))
        return order, np.searchsorted(self.observer[order], np.arange(last + 2))

    def __len__(self) -> int:
        return len(self.step)


@dataclass(frozen=True, eq=False)
class Recording:
    """Measurements of N vehicles over T steps in R runs, in the local east-north-up frame.

    Args:
        ids: (N,) names. t: (T,) s.
        gnss: (R, T, N, 3) m. velocity: (R, T, N, 3) m/s, with x_t ~ x_{t-1} + dt u_t; both NaN where absent, a fix
            alone where it is missing.
        links: L directed links; `observers` are the columns whose links were recorded.
        relative: (R, L, 3) range m, world azimuth rad, inclination rad of the neighbour as the observer sees it.
        broadcasts: (T, N) True where a vehicle broadcasts.
        arrival: (R, L) step at which the neighbour's broadcast of the link's step arrives, -1 if lost or not sent.
        sensors, v2x: what a method may know (the bias is not among it).
        notes: labels that every table and figure carries (what is simulated, what uses truth).
    """

    ids: tuple[str, ...]
    t: Floats
    gnss: Floats
    velocity: Floats
    links: Links
    relative: Floats
    broadcasts: Bools
    arrival: Ints
    sensors: Sensors
    v2x: V2X
    observers: tuple[int, ...]
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in ("t", "gnss", "velocity", "relative"):
            object.__setattr__(self, name, frozen(getattr(self, name)))
        self.sensors.check_assumed()

    @property
    def dt(self) -> float:
        """Sampling interval, s."""
        return round(float((self.t[-1] - self.t[0]) / (len(self.t) - 1)), 9)

    @property
    def runs(self) -> int:
        """R."""
        return int(self.gnss.shape[0])

    def of_runs(self, runs: slice | Ints) -> Recording:
        """The same drive in some of its runs; a slice of them copies nothing.

        >>> from coopoc import Fleet, Sensors, observe
        >>> fleet = Fleet(("a",), [0, 0.1], np.zeros((2, 1, 3)), np.zeros((2, 1, 3)))
        >>> observe(fleet, Sensors(), runs=5).of_runs(slice(1, 4)).runs
        3
        """
        parts = {name: getattr(self, name)[runs] for name in ("gnss", "velocity", "relative", "arrival")}
        found = replace(self, **parts)
        return found.known_complete() if self.complete else found

    def known_complete(self) -> Recording:
        """Itself, told that it is `complete` by who knows without a look through all runs."""
        vars(self)["complete"] = True
        return self

    @cached_property
    def complete(self) -> bool:
        """Whether every vehicle has a fix wherever it is."""
        return bool((np.isfinite(self.gnss) | np.isnan(self.velocity)).all())

    @cached_property
    def _observing(self) -> frozenset[int]:
        return frozenset(self.observers)

    def require_complete(self) -> None:
        """InputError, which names the vehicle and the step, if a fix is missing."""
        if not self.complete:
            _, step, column, _ = np.argwhere(np.isnan(self.gnss) & np.isfinite(self.velocity))[0]
            raise InputError("gnss", f"none of {self.ids[column]} at step {step}", "must be there at every step here",
                             "Take a filter, a learned gain or the joint filter, which do without.")  # fmt: skip

    def neighbours(self, ego: int) -> Ints:
        """(T,) how many neighbours the ego had at each step: the actual number, at most `v2x.max_neighbours`."""
        return np.bincount(self.links.step[self.links.of(ego)], minlength=len(self.t)).astype(np.int64)

    def columns(self, egos: Sequence[int | str], missing: bool = False) -> list[int]:
        """Columns of the egos; InputError if one is unknown, no observer of this recording, or absent at times.

        Args:
            missing: whether fixes may be missing (NaN) after the first one while the vehicle drives on.
        """
        cols = []
        for ego in egos:
            col = self.ids.index(ego) if isinstance(ego, str) and ego in self.ids else ego
            if isinstance(col, str) or not 0 <= col < len(self.ids):
                known = f"0..{len(self.ids) - 1} or an id"
                raise InputError("egos", repr(ego), f"must be one of {known}", "See recording.ids.")
            if col not in self._observing:
                raise InputError("egos", repr(ego), f"has no links here, only {list(self.observers)} have",
                                 "Name it in observe(..., observers=[...]).")  # fmt: skip
            cols.append(int(col))
        moves, seen = (np.isfinite(values.take(cols, axis=2)) for values in (self.velocity, self.gnss))
        if moves.all() and (seen[:, 0] if missing else seen).all():
            return cols
        there: Bools = np.asarray(moves.all(axis=(0, 1, 3)))
        fixes: Bools = np.asarray(seen.all(axis=(0, 3)))
        for ego, present, fix in zip(egos, there, fixes.T, strict=True):
            if not present:
                mend = "Choose another ego or cut the drive with fleet.between(...)."
                raise InputError("egos", repr(ego), "is absent at some steps", mend)
            if not (fix[0] if missing else fix.all()):
                step = int(np.argmin(fix))
                mend = "Cut the drive with fleet.between(...)." if step == 0 else "Take a method that does without."
                raise InputError("egos", repr(ego), f"has no fix at step {step}, where this method needs one", mend)
        return cols

    def __repr__(self) -> str:
        return (
            f"Recording({self.runs} runs x {len(self.t)} steps x {len(self.ids)} vehicles, {len(self.links)} links, "
            f"K <= {self.v2x.max_neighbours})"
        )

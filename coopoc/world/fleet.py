"""Fleet: the ground truth of N vehicles that drive."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Bools, Floats, checked, number, refuse
from ..errors import InputError
from .axes import FARTHEST, FASTEST, check_texts, clock, column, columns, interval, names, plausible


@dataclass(frozen=True, eq=False)
class Fleet:
    """Ground truth of N vehicles over T steps in a local east-north-up frame.

    Positions obey x_t = x_{t-1} + dt u_t for the bundled fleets, u being `velocity`.
    A vehicle that is absent at a step has NaN in all six numbers of that step.

    Args:
        ids: (N,) unique names.
        t: (T,) seconds, equally spaced.
        position: (T, N, 3) metres.
        velocity: (T, N, 3) metres per second.
        name: where it comes from, for cards and reports.
        source: where it comes from, for cards and reports.
        licence: where it comes from, for cards and reports.
        heading: (T, N) rad from +x, anticlockwise, NaN where absent or unknown; None where it is the course.

    Raises:
        InputError: shapes, time steps, ids or NaN patterns that no filter could use.

    >>> Fleet(("a",), [0, 0.1], np.zeros((2, 1, 3)), np.zeros((2, 1, 3))).dt
    0.1
    """

    ids: tuple[str, ...]
    t: Floats
    position: Floats
    velocity: Floats
    name: str = ""
    source: str = ""
    licence: str = ""
    heading: Floats | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "ids", names(self.ids))
        check_texts(self, "name", "source", "licence")
        object.__setattr__(self, "t", clock(self.t))
        for field in ("position", "velocity"):
            values = checked(field, getattr(self, field), "(T, N, 3)", (len(self.t), len(self.ids), 3))
            object.__setattr__(self, field, values)
        if self.heading is not None:
            heading = checked("heading", self.heading, "(T, N)", self.position.shape[:2])
            refuse("heading", heading, np.isinf(heading), "must be finite, or NaN where unknown", "Replace it by NaN.")
            object.__setattr__(self, "heading", heading)
        _check_gaps(self)
        plausible("position", self.position, FARTHEST)
        plausible("velocity", self.velocity, FASTEST)

    @property
    def dt(self) -> float:
        """Sampling interval, s."""
        return interval(self.t)

    @property
    def present(self) -> Bools:
        """(T, N) True where the vehicle exists."""
        return np.isfinite(self.position[..., 0])

    @property
    def digest(self) -> str:
        """SHA-256 of ids, time and truth: the same numbers give the same digest."""
        sha = hashlib.sha256("\n".join(self.ids).encode())
        for array in (self.t, self.position, self.velocity, *(() if self.heading is None else (self.heading,))):
            sha.update(np.ascontiguousarray(array).tobytes())
        return sha.hexdigest()

    def require(self, ids: Sequence[str], t: Floats) -> None:
        """InputError unless the fleet has these vehicles in this order, and its steps are at times t (T,) s.

        >>> fleet = Fleet(("a",), [0, 0.1], np.zeros((2, 1, 3)), np.zeros((2, 1, 3)))
        >>> fleet.require(("b",), fleet.t)
        Traceback (most recent call last):
        coopoc.errors.InputError: fleet = Fleet(unnamed: 1 vehicles x 2 steps, dt 0.1 s): ids and times differ from \
those that were recorded. Give the fleet that was observed, its vehicles in the same order.
        """
        if tuple(ids) != self.ids or len(t) != len(self.t) or np.abs(t - self.t).max() > 0.01 * self.dt:
            hint = "Give the fleet that was observed, its vehicles in the same order."
            raise InputError("fleet", repr(self), "ids and times differ from those that were recorded", hint)

    def index(self, vehicle: str | int) -> int:
        """Column of a vehicle given by its id or its index; InputError if there is none."""
        return column("vehicle", vehicle, self.ids)

    def select(self, vehicles: Sequence[str | int]) -> Fleet:
        """The same drive with these vehicles only."""
        cols = columns("vehicles", vehicles, self.ids)
        parts = {name: getattr(self, name)[:, cols] for name in self._arrays}
        return replace(self, ids=tuple(self.ids[c] for c in cols), **parts)

    def between(self, start: int, stop: int) -> Fleet:
        """Steps start..stop-1 of the drive; negative ones count from the end. InputError if one is no whole number."""
        for name, step in (("start", start), ("stop", stop)):
            number(name, step, -(2**62), 2**62, kind=int, allowed="a step", hint="Count steps from 0.")
        return replace(self, t=self.t[start:stop], **{name: getattr(self, name)[start:stop] for name in self._arrays})

    @property
    def _arrays(self) -> tuple[str, ...]:
        return ("position", "velocity", *(() if self.heading is None else ("heading",)))

    def __repr__(self) -> str:
        return f"Fleet({self.name or 'unnamed'}: {len(self.ids)} vehicles x {len(self.t)} steps, dt {self.dt:g} s)"


def _check_gaps(fleet: Fleet) -> None:
    numbers = np.concatenate([fleet.position, fleet.velocity], axis=2)
    bad = np.isinf(numbers).any(axis=2) | (np.isnan(numbers).any(axis=2) & ~np.isnan(numbers).all(axis=2))
    if bad.any():
        step, vehicle = np.argwhere(bad)[0]
        raise InputError(
            "position/velocity",
            f"{numbers[step, vehicle]} of vehicle {fleet.ids[vehicle]} at step {step}",
            "must be finite, or NaN in all six numbers where the vehicle is absent",
            "Interpolate the gap or drop the row.",
        )

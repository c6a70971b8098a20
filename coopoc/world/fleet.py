"""Fleet: the ground truth of N vehicles that drive."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Bools, Floats, frozen
from ..errors import InputError


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
        name, source, licence: where it comes from, for cards and reports.

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

    def __post_init__(self) -> None:
        object.__setattr__(self, "ids", tuple(str(i) for i in self.ids))
        for field in ("t", "position", "velocity"):
            object.__setattr__(self, field, frozen(getattr(self, field)))
        _check(self)

    @property
    def dt(self) -> float:
        """Sampling interval, s."""
        return round(float((self.t[-1] - self.t[0]) / (len(self.t) - 1)), 9)

    @property
    def present(self) -> Bools:
        """(T, N) True where the vehicle exists."""
        return np.isfinite(self.position[..., 0])

    @property
    def digest(self) -> str:
        """SHA-256 of ids, time and truth: the same numbers give the same digest."""
        sha = hashlib.sha256("\n".join(self.ids).encode())
        for array in (self.t, self.position, self.velocity):
            sha.update(np.ascontiguousarray(array).tobytes())
        return sha.hexdigest()

    def index(self, vehicle: str | int) -> int:
        """Column of a vehicle given by its id or its index; InputError if there is none."""
        if isinstance(vehicle, str) and vehicle in self.ids:
            return self.ids.index(vehicle)
        if not isinstance(vehicle, str) and 0 <= int(vehicle) < len(self.ids):
            return int(vehicle)
        known = ", ".join(self.ids[:8]) + (", ..." if len(self.ids) > 8 else "")
        raise InputError(
            "vehicle",
            repr(vehicle),
            f"must be an index in 0..{len(self.ids) - 1} or one of the ids {known}",
            "List them with fleet.ids.",
        )

    def select(self, vehicles: Sequence[str | int]) -> Fleet:
        """The same drive with these vehicles only."""
        cols = [self.index(v) for v in vehicles]
        return replace(
            self, ids=tuple(self.ids[c] for c in cols), position=self.position[:, cols], velocity=self.velocity[:, cols]
        )

    def between(self, start: int, stop: int) -> Fleet:
        """Steps start..stop-1 of the drive."""
        return replace(
            self, t=self.t[start:stop], position=self.position[start:stop], velocity=self.velocity[start:stop]
        )

    def __repr__(self) -> str:
        return f"Fleet({self.name or 'unnamed'}: {len(self.ids)} vehicles x {len(self.t)} steps, dt {self.dt:g} s)"


def _check(fleet: Fleet) -> None:
    steps, vehicles = len(fleet.t), len(fleet.ids)
    if steps < 2:
        raise InputError("t", f"{steps} steps", "needs at least 2", "Check that the file holds a drive.")
    if len(set(fleet.ids)) != vehicles:
        twice = sorted({i for i in fleet.ids if fleet.ids.count(i) > 1})
        raise InputError("ids", twice[:3], "must be unique", "Rename the vehicles that share an id.")
    for field in ("position", "velocity"):
        if getattr(fleet, field).shape != (steps, vehicles, 3):
            raise InputError(
                field,
                getattr(fleet, field).shape,
                f"must have shape (T, N, 3) = ({steps}, {vehicles}, 3)",
                "Axis order is time, vehicle, component.",
            )
    gaps = np.diff(fleet.t)
    if not np.all(gaps > 0):
        raise InputError(
            "dt",
            f"{gaps.min():g} s at step {int(np.argmin(gaps)) + 1}",
            "must be > 0",
            "Sort the rows by time and drop repeated stamps.",
        )
    if np.ptp(gaps) > 1e-3 * gaps.mean() + 1e-6:
        raise InputError(
            "t",
            f"steps between {gaps.min():g} and {gaps.max():g} s",
            "must be equally spaced",
            "Resample first: coopoc data convert --dt 0.1.",
        )
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

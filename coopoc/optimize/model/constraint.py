"""Constraint: bounds on the same formulas as are measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...arrays import Bools, Floats, Ints, frozen
from ...errors import InputError
from .inputs import check_constants, check_nodes, fitting, numbers
from .measurements import Measurement, lookup


@dataclass(frozen=True, eq=False)
class Constraint:
    """lower <= h(x) <= upper for M rows of nodes, h the formula of a kind; equal bounds make an equality.

    A bound on a coordinate is one of kind "position"; a lane, a road surface or a top speed are kinds too ("speed", or
    a formula of one's own).

    Args:
        kind: a registered measurement that is no comparison of poses.
        nodes: (M, arity).
        lower: (M, size), (size,) or a number: m, rad, m/s; -inf, inf leave a side open.
        upper: as `lower`.
        constants: as in Factor.

    Raises:
        InputError: shapes, NaN, lower > upper, all sides open.

    >>> Constraint("speed", [[0, 1]], 0.0, 30.0, constants=[0.1])
    Constraint(0.0 <= speed <= 30.0 x 1)
    """

    kind: str
    nodes: Ints
    lower: Floats
    upper: Floats
    constants: Floats | None = None

    def __post_init__(self) -> None:
        known = self.measurement
        if known.compares_poses:
            raise InputError("kind", repr(self.kind), "compares poses and cannot bound them", "Hold the node instead.")
        object.__setattr__(self, "kind", known.name)
        object.__setattr__(self, "nodes", check_nodes(known, self.nodes))
        object.__setattr__(self, "constants", check_constants(known, self.constants, len(self.nodes)))
        given = {name: numbers(name, getattr(self, name)) for name in ("lower", "upper")}
        sizes = [side.shape[-1] for side in given.values() if side.ndim]
        size = max(sizes, default=known.size())
        fitting(known, size)
        for name, side in given.items():
            try:
                object.__setattr__(self, name, frozen(np.broadcast_to(side, (len(self.nodes), size))))
            except ValueError:
                allowed = f"must have shape ({len(self.nodes)}, {size}), ({size},) or ()"
                raise InputError(name, side.shape, allowed, "Give one bound per component.") from None
        if np.isnan(self.lower).any() or np.isnan(self.upper).any() or (self.lower > self.upper).any():
            bad = np.argwhere(~(self.lower <= self.upper))[0]
            bad_row = f"[{self.lower[tuple(bad)]}, {self.upper[tuple(bad)]}] in row {bad[0]}"
            raise InputError(f"bounds of {self.kind}", bad_row, "must have lower <= upper", "No point can satisfy it.")
        if np.isinf(self.lower).all() and np.isinf(self.upper).all():
            raise InputError(f"bounds of {self.kind}", "none", "must bound something", "Leave the constraint out.")

    @property
    def measurement(self) -> Measurement:
        """The measurement that the constraint bounds."""
        return lookup(self.kind)

    @property
    def dimension(self) -> int | None:
        """2 or 3, or None if the kind looks the same in both."""
        return fitting(self.measurement, self.lower.shape[-1])

    @property
    def equality(self) -> Bools:
        """(M, size) True where lower = upper."""
        return np.asarray(self.lower == self.upper)

    def violation(self, value: Floats) -> Floats:
        """(M, size) how far h (M, size) lies outside."""
        return np.maximum(np.maximum(self.lower - value, value - self.upper), 0.0)

    def __repr__(self) -> str:
        return f"Constraint({self.lower.min()} <= {self.kind} <= {self.upper.max()} x {len(self.nodes)})"


def values(
    known: Measurement, constraint: Constraint, vector: Floats, rotation: Floats | None
) -> tuple[Floats, Floats]:
    """h (B, M, size) and its derivative by what is seen, of a constraint; angles are not wrapped."""
    nothing: npt.NDArray[np.float64] = np.zeros((len(constraint.nodes), constraint.lower.shape[-1]))
    assert constraint.constants is not None
    return known.differentiate(vector, rotation, nothing, constraint.constants)


def bounded(constraint: Constraint) -> Bools:
    """(M, size) True where a side is finite."""
    return np.asarray(np.isfinite(constraint.lower) | np.isfinite(constraint.upper))


def steerable(constraint: Constraint, movable: Bools | None) -> Bools:
    """(M, size) True where a side is finite and a node can move, `movable` (n, dof): the rows that a solver gets."""
    if movable is None:
        return bounded(constraint)
    moves = np.asarray(movable[constraint.nodes].any(axis=(1, 2)))
    return np.asarray(bounded(constraint) & moves[:, None])

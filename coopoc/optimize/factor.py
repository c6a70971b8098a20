"""Factor: M measurements of one kind between points, with how far each is trusted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..arrays import Bools, Floats, Ints, frozen
from ..errors import InputError
from .measurements import Measurement, lookup


@dataclass(frozen=True, eq=False)
class Factor:
    """M measurements z of one kind; each adds 1/2 |W (h(x) - z)|^2 to the cost, angles wrapped.

    Args:
        kind: a registered measurement.
        nodes: (M, arity) points; of two, the first observes the second.
        z: (M, size) or (B, M, size) for B noise realisations: m, rad.
        std: size, (size,), (M, size) or (B, M, size) standard deviations, W = diag(1/std); infinite: no information
            (a measurement that this realisation lacks).
        sqrt_information: instead of std, (size, size), (M, size, size) or (B, M, size, size), W^T W = cov^-1.

    Raises:
        InputError: shapes, a point paired with itself, z that is not finite, a distance <= 0, an angle beyond 2 pi
            (degrees), a std that is not positive or an angle's that exceeds pi.

    >>> Factor("range", [[0, 1]], [[5.0]], std=0.1)
    Factor(range x 1)
    """

    kind: str
    nodes: Ints
    z: Floats
    std: Floats | None = None
    sqrt_information: Floats | None = None

    def __post_init__(self) -> None:
        known = self.measurement
        object.__setattr__(self, "nodes", _nodes(known, self.nodes))
        object.__setattr__(self, "z", _values(known, self.z, len(self.nodes)))
        if (self.std is None) == (self.sqrt_information is None):
            given = "neither" if self.std is None else "both"
            raise InputError("std", given, "or sqrt_information must be given, one of the two", "Give std=.")
        if self.std is not None:
            object.__setattr__(self, "std", _std(known, self.std, self.z.shape))
        else:
            assert self.sqrt_information is not None
            object.__setattr__(self, "sqrt_information", _root(known, self.sqrt_information, self.z.shape))

    @property
    def measurement(self) -> Measurement:
        """What the factor measures."""
        return lookup(self.kind)

    @property
    def batch(self) -> int | None:
        """B, or None for a single realisation."""
        sizes = {len(a) for a, rank in ((self.z, 3), (self.std, 3), (self.sqrt_information, 4))
                 if a is not None and a.ndim == rank}  # fmt: skip
        if len(sizes - {1}) > 1:
            raise InputError("std", f"for {sorted(sizes)} realisations", "must agree with z", "Give one axis B.")
        return max(sizes) if sizes else None

    @property
    def informative(self) -> Bools:
        """(M,) or (B, M) True where the measurement says anything at all."""
        weight = np.abs(self.root).sum(axis=-1)
        says: Bools = np.broadcast_to((weight > 0).any(axis=-1), (*weight.shape[:-2], len(self.nodes)))
        return says

    @property
    def root(self) -> Floats:
        """W as (M, size, size), or (B, M, size, size)."""
        size = self.measurement.size
        if self.std is not None:
            wide = np.broadcast_to(self.std, (*self.std.shape[:-2], len(self.nodes), size))
            return np.eye(size) / wide[..., None]
        assert self.sqrt_information is not None
        return np.broadcast_to(self.sqrt_information, (*self.sqrt_information.shape[:-3], len(self.nodes), size, size))

    def whiten(self, residual: Floats, slope: Floats | None = None) -> tuple[Floats, Floats | None]:
        """W residual (B, M, size) and W slope (B, M, size, 3)."""
        if self.std is not None:
            weight = 1.0 / self.std
            return weight * residual, None if slope is None else weight[..., None] * slope
        assert self.sqrt_information is not None
        root = self.sqrt_information
        return (root @ residual[..., None])[..., 0], None if slope is None else root @ slope

    def pick(self, which: Ints | int) -> Factor:
        """The realisations `which` of B; an int gives a single one."""
        chosen = {name: None if (a := getattr(self, name)) is None else _pick(a, rank, which)
                  for name, rank in (("z", 3), ("std", 3), ("sqrt_information", 4))}  # fmt: skip
        factor = object.__new__(Factor)  # what is picked from checked arrays need not be checked again
        for name, value in {"kind": self.kind, "nodes": self.nodes, **chosen}.items():
            object.__setattr__(factor, name, value)
        return factor

    def __repr__(self) -> str:
        return f"Factor({self.kind} x {len(self.nodes)}{'' if self.batch is None else f', {self.batch} realisations'})"


def _pick(array: Floats, rank: int, which: Ints | int) -> Floats:
    if array.ndim < rank:
        return array
    if len(array) == 1:
        return array[0] if isinstance(which, int) else array
    return array[which]


def numbers(field: str, values: npt.ArrayLike) -> Floats:
    """Read-only array of what a user gave; InputError if it is no array of numbers."""
    try:
        return frozen(values)
    except (TypeError, ValueError):
        mend = "Rows must be equally long and hold numbers only."
        raise InputError(field, repr(values)[:60], "must be an array of numbers", mend) from None


def _nodes(known: Measurement, nodes: npt.ArrayLike) -> Ints:
    given = np.asarray(nodes)
    if given.size and given.dtype.kind not in "iu":
        mend = "Problem.add takes names; a Factor takes indices."
        raise InputError("nodes", repr(nodes)[:60], "must be whole numbers", mend)
    array = frozen(nodes, np.int64)
    if array.ndim != 2 or array.shape[1] != known.arity:
        mend = "Give one row per measurement."
        raise InputError("nodes", array.shape, f"must have shape (M, {known.arity}) for {known.name}", mend)
    if known.arity == 2 and (same := array[:, 0] == array[:, 1]).any():
        mend = "A vehicle does not measure itself."
        raise InputError("nodes", array[same][0].tolist(), "must be two different points", mend)
    return array


def _values(known: Measurement, z: npt.ArrayLike, count: int) -> Floats:
    array = numbers(f"z of {known.name}", z)
    if array.ndim not in (2, 3) or array.shape[-2:] != (count, known.size):
        shape = f"must have shape ({count}, {known.size}) or (B, {count}, {known.size}) for {known.name}"
        raise InputError("z", array.shape, shape, "One row per row of nodes.")
    if not np.isfinite(array).all():
        bad = np.argwhere(~np.isfinite(array))[0]
        mend = "Drop the measurement, or give it std = inf and any finite z."
        raise InputError(f"z of {known.name}", f"{array[tuple(bad)]} at {bad.tolist()}", "must be finite", mend)
    for k, component in enumerate(known.components):
        column = array[..., k]
        if component == "distance" and (column <= 0).any():
            mend = "Coincident vehicles have no direction: drop the pair."
            raise InputError(f"z of {known.name}", column.min(), "must be a distance > 0 m", mend)
        if component == "angle" and (np.abs(column) > 2 * np.pi).any():
            mend = "This looks like degrees: use np.deg2rad."
            raise InputError(f"z of {known.name}", np.abs(column).max(), "must be within 2 pi rad", mend)
    return array


def _std(known: Measurement, std: npt.ArrayLike, shape: tuple[int, ...]) -> Floats:
    array = numbers(f"std of {known.name}", std)
    wide = np.broadcast_to(array, (known.size,)) if array.ndim < 2 and array.size in (1, known.size) else array
    wide = wide[None] if wide.ndim == 1 else wide
    fits = wide.ndim in (2, 3) and wide.shape[-1] == known.size and wide.shape[-2] in (1, shape[-2])
    if not fits:
        allowed = f"must have shape ({known.size},) or {(shape[-2], known.size)} or (B, M, {known.size})"
        raise InputError("std", array.shape, allowed, "One standard deviation per component.")
    if not (wide > 0).all():
        mend = "Give standard deviations; infinity means no information."
        raise InputError(f"std of {known.name}", array[~(array > 0)][0], "must be > 0", mend)
    angles = wide[..., known.angles]
    if (np.isfinite(angles) & (angles > np.pi)).any():
        raise InputError(f"std of {known.name}", angles.max(), "must be <= pi rad", "Angles are in radians.")
    return frozen(wide)


def _root(known: Measurement, root: npt.ArrayLike, shape: tuple[int, ...]) -> Floats:
    array = numbers("sqrt_information", root)
    array = array[None] if array.ndim == 2 else array
    size = known.size
    if array.ndim not in (3, 4) or array.shape[-2:] != (size, size) or array.shape[-3] not in (1, shape[-2]):
        allowed = f"must have shape ({size}, {size}), (M, {size}, {size}) or (B, M, {size}, {size})"
        raise InputError("sqrt_information", array.shape, allowed, "W with W^T W = cov^-1.")
    if not np.isfinite(array).all():
        raise InputError("sqrt_information", "not finite", "must be finite", "Invert a positive definite covariance.")
    return frozen(array)

"""Factor: M measurements of one kind between points, with how far each is trusted."""

from __future__ import annotations

from dataclasses import InitVar, dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from ..arrays import Bools, Floats, Ints, frozen
from ..errors import InputError
from .losses import Loss
from .measurements import Measurement, lookup
from .space import Space


@dataclass(frozen=True, eq=False)
class Factor:
    """M measurements z of one kind; each adds 1/2 rho(|W (h(x) - z)|^2) to the cost, angles wrapped.

    Args:
        kind: a registered measurement.
        nodes: (M, arity); of two, the first observes the second.
        z: (M, k) or (B, M, k) for B noise realisations: m, rad; kinds that compare poses have k = d + d^2 (see `pose`).
        std: size, (size,), (M, size) or (B, M, size) standard deviations, W = diag(1/std); infinite: no information
            (a measurement that this realisation lacks).
        sqrt_information: instead of std, (size, size), (M, size, size) or (B, M, size, size), W^T W = cov^-1.
        constants: (M, c) or (c,) known numbers of the kind, such as dt s of a speed.
        loss: rho, None for least squares.
        cov: instead of std, covariances shaped as sqrt_information.

    Raises:
        InputError: shapes, a node paired with itself, z that is not finite, a distance <= 0, an angle beyond 2 pi
            (degrees), a rotation that is none, a std that is not positive or an angle's that exceeds pi, a covariance
            that is not positive definite.

    >>> Factor("range", [[0, 1]], [[5.0]], std=0.1)
    Factor(range x 1)
    """

    kind: str
    nodes: Ints
    z: Floats
    std: Floats | None = None
    sqrt_information: Floats | None = None
    constants: Floats | None = None
    loss: Loss | None = None
    cov: InitVar[npt.ArrayLike | None] = None

    def __post_init__(self, cov: npt.ArrayLike | None) -> None:
        known = self.measurement
        object.__setattr__(self, "nodes", check_nodes(known, self.nodes))
        object.__setattr__(self, "z", _values(known, self.z, len(self.nodes)))
        object.__setattr__(self, "constants", check_constants(known, self.constants, len(self.nodes)))
        given = [name for name, v in (("std", self.std), ("sqrt_information", self.sqrt_information), ("cov", cov))
                 if v is not None]  # fmt: skip
        if len(given) != 1:
            allowed = "exactly one of std, cov and sqrt_information must be given"
            raise InputError("std", " and ".join(given) or "nothing", allowed, "Give std=.")
        shape = (*self.z.shape[:-1], self.size)
        if self.std is not None:
            object.__setattr__(self, "std", _std(known, self.std, shape))
        else:
            root = whitening(known.name, cov) if cov is not None else self.sqrt_information
            assert root is not None
            object.__setattr__(self, "sqrt_information", _root(known, root, shape))

    @property
    def measurement(self) -> Measurement:
        """What the factor measures."""
        return lookup(self.kind)

    @property
    def dimension(self) -> int | None:
        """2 or 3, or None if the kind's z looks the same in both."""
        return fitting(self.measurement, self.z.shape[-1])

    @property
    def size(self) -> int:
        """Residuals per measurement."""
        return self.measurement.size(self.dimension or 3)

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
        size = self.size
        if self.std is not None:
            wide = np.broadcast_to(self.std, (*self.std.shape[:-2], len(self.nodes), size))
            return np.eye(size) / wide[..., None]
        assert self.sqrt_information is not None
        return np.broadcast_to(self.sqrt_information, (*self.sqrt_information.shape[:-3], len(self.nodes), size, size))

    def whiten(self, residual: Floats) -> Floats:
        """W residual (..., M, size)."""
        if self.std is not None:
            return residual / self.std
        assert self.sqrt_information is not None
        return np.asarray((self.sqrt_information @ residual[..., None])[..., 0])

    def whiten_slope(self, slope: Floats) -> Floats:
        """W slope (..., M, size, D)."""
        if self.std is not None:
            return slope / self.std[..., None]
        assert self.sqrt_information is not None
        return np.asarray(self.sqrt_information @ slope)

    def pick(self, which: Ints | int) -> Factor:
        """The realisations `which` of B; an int gives a single one."""
        chosen = {name: None if (a := getattr(self, name)) is None else _pick(a, rank, which)
                  for name, rank in (("z", 3), ("std", 3), ("sqrt_information", 4))}  # fmt: skip
        return unchecked(self, **chosen)

    def __repr__(self) -> str:
        return f"Factor({self.kind} x {len(self.nodes)}{'' if self.batch is None else f', {self.batch} realisations'})"


def unchecked(factor: Factor, **changes: Any) -> Factor:
    """The factor with changes that come from checked arrays and need not be checked again."""
    changed = object.__new__(Factor)
    for field in fields(Factor):
        object.__setattr__(changed, field.name, changes.get(field.name, getattr(factor, field.name)))
    return changed


def _pick(array: Floats, rank: int, which: Ints | int) -> Floats:
    if array.ndim < rank:
        return array
    if len(array) == 1:
        return array[0] if isinstance(which, int) else array
    return array[which]


def whitening(kind: str, cov: npt.ArrayLike) -> Floats:
    """W with W^T W = cov^-1 of covariances (..., size, size): the inverse of their Cholesky factor.

    Raises:
        InputError: not square, not finite, not symmetric, not positive definite; it names the first that is bad.

    >>> whitening("range", [[4.0]])
    array([[0.5]])
    """
    array = numbers("cov", cov)
    if array.ndim < 2 or array.shape[-1] != array.shape[-2]:
        raise InputError("cov", array.shape, "must be square matrices", "Give variances on the diagonal, m^2 or rad^2.")
    flat = array.reshape(-1, *array.shape[-2:])
    mirrored = np.isclose(flat, np.swapaxes(flat, 1, 2), rtol=1e-6, atol=1e-300) & np.isfinite(flat)
    least = np.full(len(flat), np.nan)
    symmetric: Bools = np.asarray(mirrored.all(axis=(1, 2)))
    least[symmetric] = np.linalg.eigvalsh(flat[symmetric])[:, 0]
    if not (least > 0).all():
        k = int(np.flatnonzero(~(least > 0))[0])
        why = f"smallest eigenvalue {least[k]:.3g}" if symmetric[k] else "not symmetric or not finite"
        mend = "Give a covariance, not an information matrix, with no exact direction."
        raise InputError(f"cov of {kind}", f"number {k}: {why}", "must be symmetric positive definite", mend)
    return np.asarray(np.linalg.inv(np.linalg.cholesky(array)))


def fitting(known: Measurement, given: int) -> int | None:
    """The dimension whose z has `given` numbers; None if both have; InputError if none has."""
    fits = [d for d in (2, 3) if (d == 3 or known.plane is not None) and known.given(d) == given]
    if not fits:
        allowed = sorted({known.given(d) for d in (2, 3) if d == 3 or known.plane is not None})
        mend = "Write poses with coopoc.optimize.pose." if known.compares_poses else "Give one per component."
        words = f"must have {' or '.join(map(str, allowed))}"
        raise InputError(f"z of {known.name}", f"{given} numbers per row", words, mend)
    return fits[0] if len(fits) == 1 else None


def numbers(field: str, values: npt.ArrayLike) -> Floats:
    """Read-only array of what a user gave; InputError if it is no array of numbers."""
    try:
        return frozen(values)
    except (TypeError, ValueError):
        mend = "Rows must be equally long and hold numbers only."
        raise InputError(field, repr(values)[:60], "must be an array of numbers", mend) from None


def check_nodes(known: Measurement, nodes: npt.ArrayLike) -> Ints:
    """(M, arity) whole numbers, no node paired with itself."""
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


def check_constants(known: Measurement, constants: npt.ArrayLike | None, count: int) -> Floats:
    """(M, c) finite numbers, as many as the kind has."""
    given = numbers(f"constants of {known.name}", [] if constants is None else constants)
    if known.constants == given.size == 0:
        return frozen(np.empty((count, 0)))
    fits = (
        given.ndim in (1, 2)
        and given.shape[-1] == known.constants
        and given.size in (known.constants, count * known.constants)
    )
    if not fits or not np.isfinite(given).all():
        mend = "Give them as constants=, such as constants=[0.1] for the dt of a speed."
        raise InputError(
            "constants", given.tolist(), f"must be {known.constants} finite numbers for {known.name}", mend
        )
    return frozen(np.broadcast_to(given, (count, known.constants)))


def _values(known: Measurement, z: npt.ArrayLike, count: int) -> Floats:
    array = numbers(f"z of {known.name}", z)
    if array.ndim not in (2, 3) or array.shape[-2] != count:
        given = known.given()
        shape = f"must have shape ({count}, {given}) or (B, {count}, {given}) for {known.name}"
        raise InputError("z", array.shape, shape, "One row per row of nodes.")
    dimension = fitting(known, array.shape[-1]) or 3
    if not np.isfinite(array).all():
        bad = np.argwhere(~np.isfinite(array))[0]
        mend = "Drop the measurement, or give it std = inf and any finite z."
        raise InputError(f"z of {known.name}", f"{array[tuple(bad)]} at {bad.tolist()}", "must be finite", mend)
    if known.compares_poses:
        _check_rotations(known, Space(dimension, turning=True).rotation(array))
        return array
    for k, component in enumerate(known.kept(dimension)):
        _check_component(known, known.components[component], array[..., k])
    return array


def _check_component(known: Measurement, component: str, column: Floats) -> None:
    if component == "distance" and (column <= 0).any():
        mend = "Coincident vehicles have no direction: drop the pair."
        raise InputError(f"z of {known.name}", column.min(), "must be a distance > 0 m", mend)
    if component == "angle" and (np.abs(column) > 2 * np.pi).any():
        mend = "This looks like degrees: use np.deg2rad."
        raise InputError(f"z of {known.name}", np.abs(column).max(), "must be within 2 pi rad", mend)


def _check_rotations(known: Measurement, rotation: Floats) -> None:
    error = np.abs(rotation @ np.swapaxes(rotation, -1, -2) - np.eye(rotation.shape[-1])).max(axis=(-1, -2))
    if (error > 1e-6).any() or (np.linalg.det(rotation) < 0).any():
        raise InputError(f"z of {known.name}", f"a rotation off by {error.max():.1g}", "must hold rotation matrices",
                         "Make it with coopoc.optimize.pose(position, angle).")  # fmt: skip


def _std(known: Measurement, std: npt.ArrayLike, shape: tuple[int, ...]) -> Floats:
    array, size = numbers(f"std of {known.name}", std), shape[-1]
    wide = np.broadcast_to(array, (size,)) if array.ndim < 2 and array.size in (1, size) else array
    wide = wide[None] if wide.ndim == 1 else wide
    fits = wide.ndim in (2, 3) and wide.shape[-1] == size and wide.shape[-2] in (1, shape[-2])
    if not fits:
        allowed = f"must have shape ({size},) or {(shape[-2], size)} or (B, M, {size})"
        raise InputError("std", array.shape, allowed, "One standard deviation per component.")
    if not (wide > 0).all():
        mend = "Give standard deviations; infinity means no information."
        raise InputError(f"std of {known.name}", array[~(array > 0)][0], "must be > 0", mend)
    kept = known.kept(3 if size == len(known.components) else 2)
    angles = wide[..., [known.components[k] in ("angle", "turn") for k in kept]]
    if (np.isfinite(angles) & (angles > np.pi)).any():
        raise InputError(f"std of {known.name}", angles.max(), "must be <= pi rad", "Angles are in radians.")
    return frozen(wide)


def _root(known: Measurement, root: npt.ArrayLike, shape: tuple[int, ...]) -> Floats:
    array, size = numbers("sqrt_information", root), shape[-1]
    array = array[None] if array.ndim == 2 else array
    if array.ndim not in (3, 4) or array.shape[-2:] != (size, size) or array.shape[-3] not in (1, shape[-2]):
        allowed = f"must have shape ({size}, {size}), (M, {size}, {size}) or (B, M, {size}, {size})"
        raise InputError(f"sqrt_information of {known.name}", array.shape, allowed, "W with W^T W = cov^-1.")
    if not np.isfinite(array).all():
        raise InputError("sqrt_information", "not finite", "must be finite", "Invert a positive definite covariance.")
    return frozen(array)

"""Nodes, values and standard deviations as users give them, checked."""

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from ...arrays import Floats, Ints, checked, frozen, refuse
from ...errors import InputError
from .measurements import Measurement


def whitening(kind: str, cov: npt.ArrayLike) -> Floats:
    """W with W^T W = cov^-1 of covariances (..., size, size): the inverse of their Cholesky factor.

    Raises:
        InputError: not square, not finite, not symmetric, not positive definite; it names the first that is bad.

    >>> whitening("range", [[4.0]])
    array([[0.5]])
    """
    array = checked("cov", cov)
    if array.ndim < 2 or array.shape[-1] != array.shape[-2]:
        raise InputError("cov", array.shape, "must be square matrices", "Give variances on the diagonal, m^2 or rad^2.")
    flat = array.reshape(-1, *array.shape[-2:])
    mirrored = np.isclose(flat, np.swapaxes(flat, 1, 2), rtol=1e-6, atol=1e-300) & np.isfinite(flat)
    least = np.full(len(flat), np.nan)
    symmetric = np.asarray(mirrored.all(axis=(1, 2)))
    least[symmetric] = np.linalg.eigvalsh(flat[symmetric])[:, 0]
    if not (least > 0).all():
        k = int(np.flatnonzero(~(least > 0))[0])
        why = f"smallest eigenvalue {least[k]:.3g}" if symmetric[k] else "not symmetric or not finite"
        hint = "Give a covariance, not an information matrix, with no exact direction."
        raise InputError(f"cov of {kind}", f"number {k}: {why}", "must be symmetric positive definite", hint)
    return np.linalg.inv(np.linalg.cholesky(array))


@lru_cache(maxsize=256)
def fitting(measurement: Measurement, width: int) -> int | None:
    """The dimension whose z has `width` numbers; None if both have; InputError if none has."""
    widths = {d: measurement.width(d) for d in (2, 3) if d == 3 or measurement.plane is not None}
    fits = [d for d, own in widths.items() if own == width]
    if not fits:
        hint = "Write poses with coopoc.optimize.pose." if measurement.compares_poses else "Give one per component."
        words = f"must have {' or '.join(map(str, sorted({*widths.values()})))}"
        raise InputError(f"z of {measurement.name}", f"{width} numbers per row", words, hint)
    return fits[0] if len(fits) == 1 else None


def check_nodes(measurement: Measurement, nodes: npt.ArrayLike) -> Ints:
    """(M, arity) whole numbers, no node paired with itself."""
    array = checked("nodes", nodes, dtype=int)
    if array.ndim != 2 or array.shape[1] != measurement.arity:
        hint = "Give one row per measurement."
        raise InputError("nodes", array.shape, f"must have shape (M, {measurement.arity}) for {measurement.name}", hint)
    refuse("nodes", array, array < 0, "must be an index >= 0", "Problem.add takes names; a Factor takes indices.")
    ordered = np.sort(array)
    if (same := (ordered[:, 1:] == ordered[:, :-1]).any(axis=1)).any():
        hint = "A vehicle does not measure itself."
        raise InputError("nodes", array[same][0].tolist(), "must be different points", hint)
    return array


def check_constants(measurement: Measurement, constants: npt.ArrayLike | None, count: int) -> Floats:
    """(M, c) finite numbers, as many as the kind has."""
    values = checked(f"constants of {measurement.name}", [] if constants is None else constants)
    fits = (
        values.ndim in (1, 2)
        and values.shape[-1] == measurement.constants
        and values.size in (measurement.constants, count * measurement.constants)
    )
    if not fits or not np.isfinite(values).all():
        hint = "Give them as constants=, such as constants=[0.1] for the dt of a speed."
        raise InputError(
            "constants", values.tolist(), f"must be {measurement.constants} finite numbers for {measurement.name}", hint
        )
    return frozen(np.full((count, measurement.constants), values))


def check_values(measurement: Measurement, z: npt.ArrayLike, count: int) -> Floats:
    """z as (M, k): finite, distances > 0, angles in radians, rotations that are some."""
    field = f"z of {measurement.name}"
    array = checked(field, z)
    if array.ndim != 2 or len(array) != count:
        shape = f"must have shape ({count}, {measurement.width()}) for {measurement.name}"
        raise InputError("z", array.shape, shape, "One row per row of nodes; a problem for each run.")
    dimension = fitting(measurement, array.shape[-1]) or 3
    hint = "Drop the measurement, or give it std = inf and any finite z."
    refuse(field, array, ~np.isfinite(array), "must be finite", hint)
    if measurement.compares_poses:
        check_rotations(field, array[:, dimension:].reshape(-1, dimension, dimension))
        return array
    for column, kept in zip(array.T, measurement.kept(dimension), strict=False):
        component = measurement.components[kept]
        if component == "distance":
            hint = "Coincident vehicles have no direction: drop the pair."
            refuse(field, column, column <= 0, "must be a distance > 0 m", hint)
        if component == "angle":
            hint = "This looks like degrees: use np.deg2rad."
            refuse(field, column, np.abs(column) > 2 * np.pi, "must be within 2 pi rad", hint)
    return array


def check_rotations(field: str, rotation: Floats) -> None:
    """InputError unless matrices (..., d, d) are rotations."""
    error = np.abs(rotation @ np.swapaxes(rotation, -1, -2) - np.eye(rotation.shape[-1])).max(axis=(-1, -2))
    if (error > 1e-6).any() or (np.linalg.det(rotation) < 0).any():
        hint = "Make it with coopoc.optimize.pose(position, angle)."
        if (rotation == 0).all(axis=(-2, -1)).any():
            hint = "Zeros are none: points and anchors among poses need a rotation, too: co.pose(anchor, 0)."
        raise InputError(field, f"a rotation off by {error.max():.1g}", "must hold rotation matrices", hint)


def check_std(measurement: Measurement, std: npt.ArrayLike | float, shape: tuple[int, int]) -> Floats:
    """std as (M or 1, size): > 0, angles at most pi."""
    field, size = f"std of {measurement.name}", shape[-1]
    array = checked(field, std)
    wide = np.full((1, size), array) if array.ndim < 2 and array.size in (1, size) else array
    if wide.ndim != 2 or wide.shape[1] != size or len(wide) not in (1, shape[0]):
        allowed = f"must have shape ({size},) or {shape}"
        raise InputError("std", array.shape, allowed, "One standard deviation per component.")
    refuse(field, wide, ~(wide > 0), "must be > 0", "Give standard deviations; infinity means no information.")
    kept = measurement.kept(3 if size == len(measurement.components) else 2)
    angles = wide[:, [measurement.components[k] in ("angle", "turn") for k in kept]]
    refuse(field, angles, np.isfinite(angles) & (angles > np.pi), "must be <= pi rad", "Angles are in radians.")
    return frozen(wide)


def check_root(measurement: Measurement, root: npt.ArrayLike, shape: tuple[int, int]) -> Floats:
    """sqrt_information as (M or 1, size, size), finite."""
    array, size = checked("sqrt_information", root), shape[-1]
    array = array[None] if array.ndim == 2 else array
    if array.ndim != 3 or array.shape[1:] != (size, size) or len(array) not in (1, shape[0]):
        allowed = f"must have shape ({size}, {size}) or (M, {size}, {size})"
        raise InputError(f"sqrt_information of {measurement.name}", array.shape, allowed, "W with W^T W = cov^-1.")
    hint = "Invert a positive definite covariance."
    refuse("sqrt_information", array, ~np.isfinite(array), "must be finite", hint)
    return frozen(array)

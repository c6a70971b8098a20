"""Errors of trajectories whose frame is free: Umeyama alignment, absolute (APE) and relative (RPE) pose error."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..arrays import Floats, Ints, checked, instance, number
from ..errors import InputError
from ..plugins import one_of
from ..short_repr import short_repr

Unit = Literal["steps", "m"]


@dataclass(frozen=True, eq=False)
class Alignment:
    """x -> scale R x + t.

    Args:
        rotation: (..., d, d).
        translation: (..., d) m.
        scale: (...,), 1 where it was not estimated.
    """

    rotation: Floats
    translation: Floats
    scale: Floats

    __repr__ = short_repr

    def apply(self, position: Floats) -> Floats:
        """(..., T, d) positions in the other frame, m."""
        turned = np.einsum("...ij,...tj->...ti", self.rotation, position)
        return np.asarray(self.scale[..., None, None] * turned + self.translation[..., None, :])


def align(estimate: Floats, truth: Floats, *, scale: bool = False) -> Alignment:
    """The motion of SE(2) or SE(3), with scale of Sim(d), that brings an estimate nearest to the truth.

    min over R, t, s of sum_k |y_k - (s R x_k + t)|^2, closed form by the singular values of the covariance of y and x
    (Umeyama, IEEE PAMI 13(4), 1991, equations 39 to 43).

    Args:
        estimate: (..., T, d) m, d = 2 or 3; leading axes, such as runs, are aligned one by one.
        truth: as `estimate`.
        scale: estimate s as well, for a monocular estimate; else s = 1.

    Raises:
        InputError: other shapes, numbers that are not finite, or positions that leave the rotation open: all in one
            place, or in 3-D all on one line.

    >>> x = np.array([[0.0, 0], [1, 0], [2, 1]])
    >>> align(x, x + 5.0).translation
    array([5., 5.])
    """
    instance("scale", scale, bool, "Give True or False.")
    x, y = _pair(estimate, truth)
    mean_x, mean_y = x.mean(axis=-2, keepdims=True), y.mean(axis=-2, keepdims=True)
    cov = np.einsum("...ti,...tj->...ij", y - mean_y, x - mean_x) / x.shape[-2]
    u, size, vt = np.linalg.svd(cov)
    _determined(size)
    proper = np.ones_like(size)
    proper[..., -1] = np.where(np.linalg.det(u) * np.linalg.det(vt) < 0, -1, 1)
    rotation = (u * proper[..., None, :]) @ vt
    grown = np.ones(size.shape[:-1])
    if scale:
        grown = np.asarray((size * proper).sum(axis=-1) / ((x - mean_x) ** 2).sum(axis=-1).mean(axis=-1))
    turned = np.einsum("...ij,...tj->...ti", rotation, mean_x)
    return Alignment(rotation, (mean_y - grown[..., None, None] * turned)[..., 0, :], grown)


@dataclass(frozen=True, eq=False)
class AbsoluteError:
    """Absolute position error (APE, also ATE) of a trajectory: (..., T) m, and its rmse, mean and max, (...,) m."""

    error: Floats

    __repr__ = short_repr

    @property
    def rmse(self) -> Floats:
        """sqrt(mean_t e_t^2), m."""
        return np.asarray(np.sqrt((self.error**2).mean(axis=-1)))

    @property
    def mean(self) -> Floats:
        """Mean over time, m."""
        return np.asarray(self.error.mean(axis=-1))

    @property
    def max(self) -> Floats:
        """Largest over time, m."""
        return np.asarray(self.error.max(axis=-1))


def absolute_error(estimate: Floats, truth: Floats, *, aligned: bool = True, scale: bool = False) -> AbsoluteError:
    """e_t = |truth_t - (s R x_t + t)|, after the best alignment unless the frame is known.

    Args:
        estimate: (..., T, d) m at the same instants, d = 2 or 3.
        truth: (..., T, d) m at the same instants, d = 2 or 3.
        aligned: align first; False compares in the frame given.
        scale: estimate the scale as well.

    Raises:
        InputError: what `align` raises, or a scale without an alignment.

    Source: Sturm et al., IROS 2012 (absolute trajectory error); evo's "APE, translation part" is the same number.

    >>> x = np.array([[0.0, 0], [1, 0], [2, 1]])
    >>> absolute_error(x, x + [3.0, 4], aligned=False).rmse
    array(5.)
    """
    if scale and not aligned:
        raise InputError("scale", scale, "must be False without an alignment", "Set aligned=True.")
    x, y = _pair(estimate, truth)
    if aligned:
        x = align(x, y, scale=scale).apply(x)
    return AbsoluteError(np.linalg.norm(y - x, axis=-1))


def relative_error(
    estimate: tuple[Floats, Floats], truth: tuple[Floats, Floats], delta: float = 1.0, unit: Unit = "steps"
) -> Floats:
    """(n,) m, |E_k| of E_k = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j), translation part, over pairs i, j that are `delta` apart.

    Args:
        estimate: positions (T, 3) m and rotations (T, 3, 3), body to frame.
        truth: the same at the same instants.
        delta: from i to j, and from there to the next; a whole number of steps.
        unit: "steps", or "m" along the estimated path.

    Raises:
        InputError: other shapes, a part of a step, or a drive shorter than `delta`.

    Source: Sturm et al., IROS 2012, equation 2; evo's "RPE, translation part" is the same number.

    >>> still = (np.zeros((3, 3)), np.tile(np.eye(3), (3, 1, 1)))
    >>> moved = (np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]), still[1])
    >>> relative_error(moved, still)
    array([1., 1.])
    """
    one_of("unit", unit, ("steps", "m"))
    x, r = (checked("estimate", part) for part in estimate)
    y, q = (checked("truth", part) for part in truth)
    if not (x.shape == y.shape == (len(x), 3) and r.shape == q.shape == (len(x), 3, 3)):
        given = f"shapes {x.shape}, {r.shape}, {y.shape}, {q.shape}"
        raise InputError("estimate, truth", given, "must be (T, 3) and (T, 3, 3)", "Take both at the same instants.")
    at = ends(x, delta, unit)
    i, j = at[:-1], at[1:]
    if not len(i):
        raise InputError("delta", f"{delta:g} {unit}", "must fit into the drive once", "Take a smaller one.")
    moved = np.einsum("kab,ka->kb", r[i], x[j] - x[i])
    wanted = np.einsum("kab,ka->kb", q[i], y[j] - y[i])
    return np.asarray(np.linalg.norm(moved - wanted, axis=1))


def ends(x: Floats, delta: float, unit: Unit) -> Ints:
    """(n + 1,) steps between which the motions of a path x (T, 3) are compared.

    Raises:
        InputError: `delta` is not positive, or a part of a step.

    >>> ends(np.zeros((7, 3)), 3, "steps")
    array([0, 3, 6])
    """
    if unit == "steps":
        steps = number("delta", delta, 1, allowed="a whole number of steps, >= 1")
        if steps % 1:
            raise InputError("delta", delta, "must be a whole number of steps", 'For a length, set unit to "m".')
        return np.arange(0, len(x), int(steps))
    delta = number("delta", delta, 1e-12, allowed="> 0")
    found, gone = [0], 0.0
    for k, step in enumerate(np.linalg.norm(np.diff(x, axis=0), axis=1).tolist(), 1):
        gone += step
        if gone >= delta:
            found.append(k)
            gone = 0.0
    return np.array(found, dtype=np.int64)


def _pair(estimate: Floats, truth: Floats) -> tuple[Floats, Floats]:
    x, y = checked("estimate", estimate), checked("truth", truth)
    if x.shape != y.shape or x.ndim < 2 or x.shape[-1] not in (2, 3) or not x.shape[-2]:
        raise InputError(
            "estimate, truth",
            f"shapes {x.shape} and {y.shape}",
            "must be equal, (..., T, 2) or (..., T, 3)",
            "Take both at the same instants.",
        )
    for name, values in (("estimate", x), ("truth", y)):
        if not np.isfinite(values).all():
            where = np.argwhere(~np.isfinite(values))[0].tolist()
            raise InputError(
                f"{name}{where}", "not finite", "must be finite", "Leave out the instants without a position."
            )
    return x, y


def _determined(size: Floats) -> None:
    """InputError if fewer than d - 1 singular values differ from zero: Umeyama's condition for a single optimum."""
    open_ = size[..., -2] <= 1e-14 * np.maximum(size[..., 0], np.finfo(float).tiny)
    if open_.any():
        raise InputError(
            "estimate, truth",
            f"singular values {size[open_][0].tolist()} m^2",
            f"at least {size.shape[-1] - 1} must differ from zero, or the rotation is open",
            "A straight drive has no frame of its own: compare it in the frame given, or align x and y alone.",
        )

"""Range, azimuth and inclination of a vector: its polar form, their residuals, and their information about it.

Azimuth is atan2(y, x), inclination is measured from +z. A polar form is `Five` numbers, a measurement eight: behind
them the three standard deviations, infinite for a missing component, which hence has no information. With the unit
vectors e_r, e_a, e_i along which the three grow, the rows of the Jacobian are e_r^T, e_a^T / (r sin i) and e_i^T / r.
"""

from collections.abc import Sequence
from math import atan2, cos, inf, isnan, sin, sqrt
from typing import Any, TypeAlias

import numpy as np
from numba.extending import overload

from ..arrays import Floats, Ints
from .compiling.compile import as_written, inner, inside
from .compiling.small import add, apply, choose_each, from_upper, scale, store, subtract, vector_at
from .compiling.vectors import Batched, Lanes, choose, lane, less, pack, plus

Five: TypeAlias = tuple[float, float, float, float, float]
Numbers: TypeAlias = tuple[float, ...]
"""A vector or a matrix; each number a float, or one of LANES runs side by side."""


@as_written
def components(relative: Floats, links: Ints) -> Floats:
    """(R, M, 5) `five` numbers of some of (R, L, 3) measurements."""
    measured = np.empty((relative.shape[0], len(links), 5))
    for run in range(len(measured)):
        for k in range(len(links)):
            d, azimuth, inclination = relative[run, links[k]]
            store(measured[run, k], 0, five(d, azimuth, inclination))
    return measured


@inside
def five(d: float, azimuth: float, inclination: float) -> Five:
    """Range m, sine and cosine of azimuth and of inclination; a missing range is -1, sine and cosine of a missing
    angle are 0."""
    return (
        or_else(d, -1.0),
        or_else(sin(azimuth), 0.0),
        or_else(cos(azimuth), 0.0),
        or_else(sin(inclination), 0.0),
        or_else(cos(inclination), 0.0),
    )


@inside
def or_else(value: float, missing: float) -> float:
    """Another number for NaN."""
    return missing if isnan(value) else value


@inside
def with_std(measured: Sequence[float] | Floats, std: Sequence[float] | Floats) -> Numbers:
    """A measurement of `five` numbers and standard deviations; what is missing points east, its deviation infinite."""
    d, sa, ca, si, ci = measured[0], measured[1], measured[2], measured[3], measured[4]
    a, b, c = std[0], std[1], std[2]
    if d < 0.0:
        d, a = 0.0, inf
    if sa == 0.0 and ca == 0.0:
        ca, b = 1.0, inf
    if si == 0.0 and ci == 0.0:
        si, c = 1.0, inf
    return d, sa, ca, si, ci, a, b, c


@inside
def submatrix(p: Floats, i: int, j: int) -> Numbers:
    """The 3 x 3 block of a matrix whose first number is (i, j)."""
    return *vector_at(p[i, j:], 0), *vector_at(p[i + 1, j:], 0), *vector_at(p[i + 2, j:], 0)


@inner
def vector(polar: Numbers) -> Numbers:
    """(r sin i cos a, r sin i sin a, r cos i) m."""
    ground = polar[0] * polar[3]
    return ground * polar[2], ground * polar[1], polar[0] * polar[4]


@inner
def direction(gap: Numbers) -> Five:
    """Polar form of a vector: length, sine and cosine of azimuth and of inclination, 0 and 1 along z."""
    x, y, z = gap
    flat2 = plus(x * x, y, y)
    flat, d = sqrt(flat2), sqrt(plus(flat2, z, z))
    o, over, over_d = 0.0 * d, 1.0 / flat, 1.0 / d
    sine, cosine = choose(flat, y * over, o), choose(flat, x * over, o + 1.0)
    return d, sine, cosine, choose(d, flat * over_d, o), choose(d, z * over_d, o + 1.0)


@as_written
def angle(sine: float, cosine: float) -> float:
    """atan2; within 14 degrees by its Taylor series, whose 13 terms are exact to the last bit there."""
    return series(sine, cosine) if abs(sine) <= 0.25 * cosine else atan2(sine, cosine)


@inner
def series(sine: float, cosine: float) -> Lanes:
    """atan2 of a small angle."""
    t = sine / cosine
    s = t * t
    tail = less(1 / 17, s, less(1 / 19, s, less(1 / 21, s, less(1 / 23, s, 1 / 25))))
    tail = less(1 / 9, s, less(1 / 11, s, less(1 / 13, s, less(1 / 15, s, tail))))
    return t * less(1.0, s, less(1 / 3, s, less(1 / 5, s, less(1 / 7, s, tail))))


@inner
def one_angle(sine: float, cosine: float, k: int) -> float:
    """The `angle` of one run."""
    y, x = lane(sine, k), lane(cosine, k)
    return series(y, x) if abs(y) <= 0.25 * x else atan2(y, x)


@overload(atan2)
def _of_several_runs(sine: Any, cosine: Any) -> Any:
    """Where not all are small, one by one."""
    if not isinstance(sine, Batched):
        return None

    def each(sine: Any, cosine: Any) -> Any:
        return pack(
            one_angle(sine, cosine, 0),
            one_angle(sine, cosine, 1),
            one_angle(sine, cosine, 2),
            one_angle(sine, cosine, 3),
        )

    return each


@inside
def axes(polar: Numbers) -> tuple[Numbers, Numbers, Numbers]:
    """e_r, e_a and e_i."""
    _, sa, ca, si, ci = polar
    return (si * ca, si * sa, ci), (-sa, ca, 0.0 * sa), (ci * ca, ci * sa, -si)


@inside
def spread(polar: Numbers, a: float, b: float, c: float) -> Lanes:
    """a e_r e_r^T + b e_a e_a^T + c e_i e_i^T: a covariance from variances along them, or information from theirs."""
    _, sa, ca, si, ci = polar
    flat, cross = plus(a * si * si, c * ci, ci), (a - c) * si * ci
    xx, yy, zz = plus(flat * ca * ca, b * sa, sa), plus(flat * sa * sa, b * ca, ca), plus(a * ci * ci, c * si, si)
    return from_upper((xx, (flat - b) * sa * ca, cross * ca, yy, cross * sa, zz))


@inside
def metres(polar: Numbers, std: Numbers | Floats, least: float) -> Numbers:
    """Standard deviations along the axes m: of range, r sin i times that of azimuth, r times that of inclination.

    The range counts as at least `least` m, the sine as at least 1e-3.
    """
    reach, level = max(polar[0], least), max(abs(polar[3]), 1e-3)
    return std[0], std[1] * level * reach, std[2] * reach


@inner
def converted(gap: Numbers, measured: Numbers, unit: bool, least: float) -> tuple[Numbers, Numbers]:
    """C^-1 and C^-1 (measured vector - gap), weighted by the geometry of the vector `gap`, or by 1 m along each axis if
    `unit`; components that are missing are those of `gap`."""
    polar = direction(gap)
    a, b, c = measured[5:] if unit else metres(polar, measured[5:], least)
    weight = spread(polar, 1.0 / (a * a), 1.0 / (b * b), 1.0 / (c * c))
    return weight, apply(weight, subtract(vector(completed(measured, polar)), gap))


@inside
def residuals(measured: Numbers, polar: Numbers) -> Numbers:
    """Measured less predicted range m, azimuth and inclination rad: the angles between two directions, which need no
    wrapping."""
    d, sa, ca, si, ci = polar
    turned = angle(less(measured[1] * ca, measured[2], sa), plus(measured[2] * ca, measured[1], sa))
    raised = angle(less(measured[3] * ci, measured[4], si), plus(measured[4] * ci, measured[3], si))
    return measured[0] - d, turned, raised


@inner
def exact(gap: Numbers, measured: Numbers, least: float) -> tuple[Numbers, Numbers]:
    """J^T J and J^T r of the whitened range, azimuth and inclination at the vector `gap`; an angle weighs no more than
    at `least` m."""
    polar = direction(gap)
    (ray, right, down), (longer, turned, raised) = axes(polar), residuals(measured, polar)
    d, reach = polar[0], max(polar[0], least)
    a, b, c = 1.0 / measured[5], 1.0 / measured[6], 1.0 / measured[7]
    flat = max(abs(polar[3]), 1e-3) * reach
    side, up = b * d * polar[3] / (flat * flat), c * d / (reach * reach)
    across = add(scale(right, side * b * turned), scale(down, up * c * raised))
    return spread(polar, a * a, side * side, up * up), add(scale(ray, a * a * longer), across)


@inside
def missing(measured: Numbers) -> float:
    """Positive where a component is missing, else negative."""
    return measured[5] + measured[6] + measured[7] - (0.0 * measured[0] + 1e300)


@inside
def incomplete(measured: Numbers) -> bool:
    """True if any of these runs lacks a component."""
    return not missing(measured) <= 0.0 * measured[0]


@inside
def whole(measured: Numbers) -> Lanes:
    """1 where all components were measured, else 0."""
    o = 0.0 * measured[0]
    return choose(missing(measured), o, o + 1.0)


@inner
def completed(measured: Numbers, polar: Numbers) -> Five:
    """The measurement, its missing components those of another vector."""
    limit = 0.0 * polar[0] + 1e300
    reach, azimuth, inclination = limit - measured[5], limit - measured[6], limit - measured[7]
    return (
        choose(reach, measured[0], polar[0]),
        *choose_each(azimuth, measured[1:3], polar[1:3]),
        *choose_each(inclination, measured[3:5], polar[3:5]),
    )

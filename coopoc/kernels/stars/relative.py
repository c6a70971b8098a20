"""A relative measurement as information about the vector to the neighbour: converted, or linear in range and angles.

A missing component has an infinite standard deviation, hence no information.
"""

from __future__ import annotations

import math
from typing import Any, TypeAlias

import numpy as np
from numba.extending import overload

from ...arrays import Floats, Ints
from ..compiling.compile import as_written, inner, inside
from ..compiling.vectors import Batched, choose, lane, less, pack, plus

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
            for i, value in enumerate(five(d, azimuth, inclination)):
                measured[run, k, i] = value
    return measured


@inside
def five(d: float, azimuth: float, inclination: float) -> Five:
    """Range m, sine and cosine of azimuth and of inclination; a missing range is -1, sine and cosine of a missing
    angle are 0."""
    return (
        or_else(d, -1.0),
        or_else(math.sin(azimuth), 0.0),
        or_else(math.cos(azimuth), 0.0),
        or_else(math.sin(inclination), 0.0),
        or_else(math.cos(inclination), 0.0),
    )


@inside
def or_else(value: float, missing: float) -> float:
    """Another number for NaN."""
    return missing if math.isnan(value) else value


@inner
def vector(measured: Numbers) -> Numbers:
    """The measured vector, m."""
    ground = measured[0] * measured[3]
    return ground * measured[2], ground * measured[1], measured[0] * measured[4]


@as_written
def angle(sine: float, cosine: float) -> float:
    """atan2; within 14 degrees by its Taylor series, whose 13 terms are exact to the last bit there."""
    return series(sine, cosine) if abs(sine) <= 0.25 * cosine else math.atan2(sine, cosine)


@inner
def series(sine: float, cosine: float) -> float:
    """atan2 of a small angle."""
    t = sine / cosine
    s = t * t
    tail = less(1 / 17, s, less(1 / 19, s, less(1 / 21, s, less(1 / 23, s, 1 / 25))))
    tail = less(1 / 9, s, less(1 / 11, s, less(1 / 13, s, less(1 / 15, s, tail))))
    small: float = t * less(1.0, s, less(1 / 3, s, less(1 / 5, s, less(1 / 7, s, tail))))
    return small


@inner
def one_angle(sine: float, cosine: float, k: int) -> float:
    """The `angle` of one run."""
    y, x = lane(sine, k), lane(cosine, k)
    return series(y, x) if abs(y) <= 0.25 * x else math.atan2(y, x)


@overload(math.atan2)
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


@inner
def converted(x: float, y: float, z: float, std: Numbers, least: float) -> Numbers:
    """Information, upper triangle, of a converted measurement along (x, y, z): C^-1 of `vector_cov`, whose axes are
    those of range, azimuth and inclination."""
    flat2 = plus(x * x, y, y)
    r2 = plus(flat2, z, z)
    d = max(math.sqrt(r2), least)
    along = 1.0 / (std[0] * std[0] * r2)
    turn, raise_ = std[1] * d, std[2] * d
    side = r2 / (flat2 * flat2 * turn * turn)
    up = 1.0 / (r2 * flat2 * raise_ * raise_)
    level, tilt = plus(along, up * z, z), less(along, up, flat2)
    return (
        plus(level * x * x, side * y, y),
        (level - side) * x * y,
        tilt * x * z,
        plus(level * y * y, side * x, x),
        tilt * y * z,
        plus(along * z * z, up * flat2, flat2),
    )


@inside
def gram(a: Numbers, bx: float, by: float, c: Numbers) -> Numbers:
    """J^T J, upper triangle, of the whitened rows a of range, (bx, by, 0) of azimuth and c of inclination."""
    return (
        dot(a[0], a[0], bx, bx, c[0], c[0]),
        dot(a[0], a[1], bx, by, c[0], c[1]),
        plus(a[0] * a[2], c[0], c[2]),
        dot(a[1], a[1], by, by, c[1], c[1]),
        plus(a[1] * a[2], c[1], c[2]),
        plus(a[2] * a[2], c[2], c[2]),
    )


@inner
def exact(x: float, y: float, z: float, measured: Numbers, std: Numbers, least: float) -> Numbers:
    """J^T J, upper triangle, and J^T r of the whitened range, azimuth and inclination at the vector (x, y, z).

    An angle's residual is that between the measured direction and the vector's, which never needs wrapping.
    """
    flat2 = plus(x * x, y, y)
    flat, r = math.sqrt(flat2), math.sqrt(plus(flat2, z, z))
    turned = angle(less(measured[1] * x, measured[2], y), plus(measured[2] * x, measured[1], y))
    raised = angle(less(measured[3] * z, measured[4], flat), plus(measured[4] * z, measured[3], flat))
    d = max(r, least)
    ground = max(flat, 1e-3 * d)
    a, b, c = 1.0 / (r * std[0]), 1.0 / (ground * ground * std[1]), 1.0 / (ground * d * d * std[2])
    along, bx, by, raise_ = (a * x, a * y, a * z), -b * y, b * x, (c * x * z, c * y * z, -c * ground * ground)
    ar, br, cr = (measured[0] - r) / std[0], turned / std[1], raised / std[2]
    return (
        *gram(along, bx, by, raise_),
        dot(along[0], ar, bx, br, raise_[0], cr),
        dot(along[1], ar, by, br, raise_[1], cr),
        plus(along[2] * ar, raise_[2], cr),
    )


@inner
def dot(a: float, x: float, b: float, y: float, c: float, z: float) -> float:
    """a x + b y + c z."""
    total: float = plus(plus(a * x, b, y), c, z)
    return total


@inside
def incomplete(measured: Numbers) -> bool:
    """True if any of these runs lacks a component; `measured` with the three standard deviations behind."""
    return not measured[5] + measured[6] + measured[7] <= 0.0 * measured[0] + 1e300


@inner
def completed(measured: Numbers, gap: Numbers) -> Five:
    """The measurement, its missing components (of infinite deviation) those of the vector `gap`."""
    d, sa, ca, si, ci = direction(gap[0], gap[1], gap[2])
    limit = 0.0 * d + 1e300
    reach, azimuth, inclination = limit - measured[5], limit - measured[6], limit - measured[7]
    return (
        choose(reach, measured[0], d),
        choose(azimuth, measured[1], sa),
        choose(azimuth, measured[2], ca),
        choose(inclination, measured[3], si),
        choose(inclination, measured[4], ci),
    )


@inner
def direction(x: float, y: float, z: float) -> Five:
    """Length of a vector, sine and cosine of its azimuth and of its inclination."""
    flat2 = plus(x * x, y, y)
    flat, d = math.sqrt(flat2), math.sqrt(plus(x * x + y * y, z, z))
    o, one = 0.0 * d, 0.0 * d + 1.0
    sine, cosine = choose(flat, y / flat, o), choose(flat, x / flat, one)
    return d, sine, cosine, choose(d, flat / d, o), choose(d, z / d, one)

"""A relative measurement as information about the vector to the neighbour: converted, or linear in range and angles.

A missing component has an infinite standard deviation, hence no information.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba.extending import overload
from numpy import uint64

from ...arrays import AnyArray, Floats, Ints
from ..compiling.compile import as_written, inner, inside
from ..compiling.vectors import LANES, Batched, choose, lane, less, pack, plus, put

QUARTER = (math.pi / 2, 6.123233995736766e-17)
"""Of a turn, rad: the nearest number, and what it lacks."""


@as_written
def components(relative: AnyArray, links: Ints) -> Floats:
    """(R, M, 5) range m, sine and cosine of azimuth and of inclination, of some of (R, L, 3) measurements.

    A missing range is -1, sine and cosine of a missing angle are 0. LANES links side by side.
    """
    seen, found = np.empty((relative.shape[0], len(links), 5)), np.empty(4 * LANES)
    for run in range(len(seen)):
        for k in range(0, len(links), LANES):
            last = len(links) - 1
            a, b, c, d = links[k], links[min(k + 1, last)], links[min(k + 2, last)], links[min(k + 3, last)]
            for angle in range(2):
                turn = pack(
                    relative[run, a, angle + 1],
                    relative[run, b, angle + 1],
                    relative[run, c, angle + 1],
                    relative[run, d, angle + 1],
                )
                sine, cosine = sine_and_cosine(turn)
                put(found, uint64(2 * angle), sine)
                put(found, uint64(2 * angle + 1), cosine)
            for j in range(min(LANES, last + 1 - k)):
                seen[run, k + j, 0] = or_else(relative[run, links[k + j], 0], -1.0)
                for i in range(4):
                    seen[run, k + j, i + 1] = or_else(found[LANES * i + j], 0.0)
    return seen


@inside
def or_else(value: float, missing: float) -> float:
    """Another number for NaN."""
    return missing if math.isnan(value) else value


@as_written
def sine_and_cosine(turn: Any) -> Any:
    """By their Taylor series within an eighth of a turn of a multiple of a quarter, exact to the last bit there."""
    quarters = 1.0 * math.floor(turn * (2.0 / math.pi) + 0.5)
    x = less(less(turn, quarters, QUARTER[0]), quarters, QUARTER[1])
    s = x * x
    sine = less(1 / 6227020800, s, less(1 / 1307674368000, s, 1 / 355687428096000))
    sine = less(1 / 6, s, less(1 / 120, s, less(1 / 5040, s, less(1 / 362880, s, less(1 / 39916800, s, sine)))))
    cosine = less(1 / 479001600, s, less(1 / 87178291200, s, 1 / 20922789888000))
    cosine = less(1 / 24, s, less(1 / 720, s, less(1 / 40320, s, less(1 / 3628800, s, cosine))))
    sine, cosine = less(x, x * s, sine), less(1.0, s, less(0.5, s, cosine))
    rest = quarters - 4.0 * math.floor(0.25 * quarters)
    odd = 0.5 - abs(abs(rest - 2.0) - 1.0)
    one, other = choose(odd, cosine, sine), choose(odd, sine, cosine)
    return choose(rest - 1.5, -one, one), choose(1.0 - abs(rest - 1.5), -other, other)


@inner
def vector(seen: Any) -> Any:
    """The measured vector, m."""
    ground = seen[0] * seen[3]
    return ground * seen[2], ground * seen[1], seen[0] * seen[4]


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
def one_angle(sine: Any, cosine: Any, which: int) -> float:
    """The `angle` of one run."""
    y, x = lane(sine, which), lane(cosine, which)
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
def converted(x: float, y: float, z: float, std: Any, least: float) -> Any:
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


@inner
def at_measurement(seen: Any, std: Any, least: float) -> Any:
    """The information of `exact`, upper triangle, at the measured vector itself; its distance is at least `least`."""
    d, level = max(seen[0], least), max(abs(seen[3]), 1e-3)
    a, b, c = 1.0 / std[0], seen[3] / (level * level * d * std[1]), 1.0 / (level * d * std[2])
    ax, ay, az, bx, by = a * seen[3] * seen[2], a * seen[3] * seen[1], a * seen[4], -b * seen[1], b * seen[2]
    tilt = c * seen[3] * seen[4]
    cx, cy, cz = tilt * seen[2], tilt * seen[1], -c * level * level
    return (
        dot(ax, ax, bx, bx, cx, cx),
        dot(ax, ay, bx, by, cx, cy),
        plus(ax * az, cx, cz),
        dot(ay, ay, by, by, cy, cy),
        plus(ay * az, cy, cz),
        plus(az * az, cz, cz),
    )


@inner
def exact(x: float, y: float, z: float, seen: Any, std: Any, least: float) -> Any:
    """J^T J, upper triangle, and J^T r of the whitened range, azimuth and inclination at the vector (x, y, z).

    An angle's residual is that between the measured direction and the vector's, which never needs wrapping.
    """
    flat2 = plus(x * x, y, y)
    flat, r = math.sqrt(flat2), math.sqrt(plus(flat2, z, z))
    turned = angle(less(seen[1] * x, seen[2], y), plus(seen[2] * x, seen[1], y))
    raised = angle(less(seen[3] * z, seen[4], flat), plus(seen[4] * z, seen[3], flat))
    d = max(r, least)
    ground = max(flat, 1e-3 * d)
    a = 1.0 / (r * std[0])
    ax, ay, az, ar = a * x, a * y, a * z, (seen[0] - r) / std[0]
    b = 1.0 / (ground * ground * std[1])
    bx, by, br = -b * y, b * x, turned / std[1]
    c = 1.0 / (ground * d * d * std[2])
    cx, cy, cz, cr = c * x * z, c * y * z, -c * ground * ground, raised / std[2]
    return (
        dot(ax, ax, bx, bx, cx, cx),
        dot(ax, ay, bx, by, cx, cy),
        plus(ax * az, cx, cz),
        dot(ay, ay, by, by, cy, cy),
        plus(ay * az, cy, cz),
        plus(az * az, cz, cz),
        dot(ax, ar, bx, br, cx, cr),
        dot(ay, ar, by, br, cy, cr),
        plus(az * ar, cz, cr),
    )


@inner
def dot(a: float, x: float, b: float, y: float, c: float, z: float) -> float:
    """a x + b y + c z."""
    total: float = plus(plus(a * x, b, y), c, z)
    return total


@inside
def incomplete(seen: Any) -> bool:
    """True if any of these runs lacks a component; `seen` with the three standard deviations behind."""
    return not seen[5] + seen[6] + seen[7] <= 0.0 * seen[0] + 1e300


@inner
def completed(seen: Any, gap: Any) -> Any:
    """The measurement, its missing components (of infinite deviation) those of the vector `gap`."""
    x, y, z = gap
    flat = math.sqrt(plus(x * x, y, y))
    d = math.sqrt(plus(x * x + y * y, z, z))
    limit = 0.0 * d + 1e300
    reach, azimuth, inclination = limit - seen[5], limit - seen[6], limit - seen[7]
    return (
        choose(reach, seen[0], d),
        choose(azimuth, seen[1], y / flat),
        choose(azimuth, seen[2], x / flat),
        choose(inclination, seen[3], flat / d),
        choose(inclination, seen[4], z / d),
    )


@inner
def converted_cov(seen: Any, std: Any, least: float) -> Any:
    """Covariance m^2, upper triangle, of a converted measurement at its own geometry: `vector_cov`.

    Args:
        seen: range m, sine and cosine of azimuth and of inclination.
        std: 1e3 at most, so that a missing component has a variance beyond any other.
    """
    d, sa, ca, si, ci = seen[0], seen[1], seen[2], seen[3], seen[4]
    d = max(d, least)
    a, b, c = min_of(std[0]), min_of(std[1]) * d * si, min_of(std[2]) * d
    a, b, c = a * a, b * b, c * c
    flat, cross = a * si * si + c * ci * ci, (a - c) * si * ci
    return (
        flat * ca * ca + b * sa * sa,
        (flat - b) * sa * ca,
        cross * ca,
        flat * sa * sa + b * ca * ca,
        cross * sa,
        a * ci * ci + c * si * si,
    )


@inside
def min_of(std: Any) -> Any:
    """At most 1e3."""
    return -max(-std, -1e3)

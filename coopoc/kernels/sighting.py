"""A sighting of a neighbour as information about the vector to it: converted, or linear in range and angles."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..arrays import AnyArray, Floats, Ints
from .compile import compiled


def unfolded(relative: Floats, links: Ints | None = None) -> Floats:
    """(R, M, 5) range, sin and cos of azimuth and of inclination, of (R, L, 3) measurements, all or those of M links.

    No angle is met twice.
    """
    found = unfold(relative, np.arange(relative.shape[1]) if links is None else links)
    return np.asarray(found)


@compiled
def unfold(relative: AnyArray, links: AnyArray) -> Floats:
    """`unfolded`."""
    out = np.empty((relative.shape[0], len(links), 5))
    for run in range(relative.shape[0]):
        for k in range(len(links)):
            out[run, k, 0] = relative[run, links[k], 0]
            out[run, k, 1], out[run, k, 2] = sine_cosine(relative[run, links[k], 1])
            out[run, k, 3], out[run, k, 4] = sine_cosine(relative[run, links[k], 2])
    return out


@compiled
def sine_cosine(x: float) -> Any:
    """Sine and cosine by their Taylor series around the nearest multiple of pi/2, to the last bit but one.

    Within 3.9 rad, so that pi/2 and what its number lacks can be subtracted without loss.
    """
    if not abs(x) < 3.9:
        return math.sin(x), math.cos(x)
    quarter = np.rint(x * (2 / math.pi))
    r = (x - quarter * (math.pi / 2)) - quarter * 6.123233995736766e-17
    z = r * r
    s = 1 - z * (1 / 156) * (1 - z * (1 / 210) * (1 - z * (1 / 272) * (1 - z * (1 / 342))))
    s = r * (1 - z * (1 / 6) * (1 - z * (1 / 20) * (1 - z * (1 / 42) * (1 - z * (1 / 72) * (1 - z * (1 / 110) * s)))))
    c = 1 - z * (1 / 132) * (1 - z * (1 / 182) * (1 - z * (1 / 240) * (1 - z * (1 / 306))))
    c = 1 - z * (1 / 2) * (1 - z * (1 / 12) * (1 - z * (1 / 30) * (1 - z * (1 / 56) * (1 - z * (1 / 90) * c))))
    even = 1.0 - abs(quarter)
    return quarter * c if even == 0.0 else even * s, -quarter * s if even == 0.0 else even * c


@compiled
def vector(seen: Any) -> Any:
    """The measured vector, m."""
    ground = seen[0] * seen[3]
    return ground * seen[2], ground * seen[1], seen[0] * seen[4]


@compiled
def angle(sine: float, cosine: float) -> float:
    """atan2; within 14 degrees by its Taylor series, whose 13 terms are exact to the last bit there."""
    if not abs(sine) <= 0.25 * cosine:
        return math.atan2(sine, cosine)
    t = sine / cosine
    s = t * t
    tail = 1 / 17 - s * (1 / 19 - s * (1 / 21 - s * (1 / 23 - s * (1 / 25))))
    tail = 1 / 9 - s * (1 / 11 - s * (1 / 13 - s * (1 / 15 - s * tail)))
    return t * (1.0 - s * (1 / 3 - s * (1 / 5 - s * (1 / 7 - s * tail))))


@compiled
def converted(x: float, y: float, z: float, std: Any, least: float) -> Any:
    """Information, upper triangle, of a converted sighting along (x, y, z): C^-1 of `vector_cov`, whose axes are the
    range's, the azimuth's and the inclination's."""
    flat2 = x * x + y * y
    r2 = flat2 + z * z
    d = max(math.sqrt(r2), least)
    along = 1.0 / (std[0] * std[0] * r2)
    side = r2 / (flat2 * flat2 * (std[1] * d) ** 2)
    up = 1.0 / (r2 * flat2 * (std[2] * d) ** 2)
    tilt = up * z * z
    return (along * x * x + side * y * y + tilt * x * x, (along - side + tilt) * x * y, (along - up * flat2) * x * z,
            along * y * y + side * x * x + tilt * y * y, (along - up * flat2) * y * z,
            along * z * z + up * flat2 * flat2)  # fmt: skip


@compiled
def exact(x: float, y: float, z: float, seen: Any, std: Any, least: float) -> Any:
    """J^T J, upper triangle, and J^T r of the whitened range, azimuth and inclination at the vector (x, y, z).

    An angle's residual is that between the measured direction and the vector's, which never needs wrapping.
    """
    flat2 = x * x + y * y
    flat, r = math.sqrt(flat2), math.sqrt(flat2 + z * z)
    turned = angle(seen[1] * x - seen[2] * y, seen[2] * x + seen[1] * y)
    raised = angle(seen[3] * z - seen[4] * flat, seen[4] * z + seen[3] * flat)
    d = max(r, least)
    ground = max(flat, 1e-3 * d)
    a = 1.0 / (r * std[0])
    ax, ay, az, ar = a * x, a * y, a * z, (seen[0] - r) / std[0]
    b = 1.0 / (ground * ground * std[1])
    bx, by, br = -b * y, b * x, turned / std[1]
    c = 1.0 / (ground * d * d * std[2])
    cx, cy, cz, cr = c * x * z, c * y * z, -c * ground * ground, raised / std[2]
    return (ax * ax + bx * bx + cx * cx, ax * ay + bx * by + cx * cy, ax * az + cx * cz, ay * ay + by * by + cy * cy,
            ay * az + cy * cz, az * az + cz * cz,
            ax * ar + bx * br + cx * cr, ay * ar + by * br + cy * cr, az * ar + cz * cr)  # fmt: skip

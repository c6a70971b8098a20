"""A sighting of a neighbour as information about the vector to it: converted, or linear in range and angles."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..arrays import Floats
from .compile import compiled


def unfolded(relative: Floats) -> Floats:
    """(..., 5) range, sin and cos of azimuth and of inclination, of (..., 3) measurements: no angle is met twice."""
    d, azimuth, inclination = np.moveaxis(relative, -1, 0)
    parts = [d, np.sin(azimuth), np.cos(azimuth), np.sin(inclination), np.cos(inclination)]
    return np.stack(parts, axis=-1)


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

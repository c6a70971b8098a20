"""NEES of a track, e^T P^-1 e by P = L D L^T, and covariances that are none, in one pass each."""

from __future__ import annotations

import math

import numpy as np

from ..arrays import Floats
from .compiling.compile import compiled, part

LIMIT = 1.0 + 1e-9
"""A squared covariance over the product of its variances, at most, with what rounding adds."""


@compiled
def unsound(cov: Floats) -> int:
    """Number of covariances (n, 3, 3) that are not finite, symmetric and positive semidefinite to a share of 1e-9."""
    found = 0
    for p in cov:
        a, b, c, d, e, f = p[0, 0], p[1, 1], p[2, 2], p[1, 0], p[2, 0], p[2, 1]
        skew = max(abs(p[0, 1] - d), abs(p[0, 2] - e), abs(p[1, 2] - f))
        det = a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)
        sides = d * d <= LIMIT * a * b and e * e <= LIMIT * a * c and f * f <= LIMIT * b * c
        sound = sides and a >= 0.0 and b >= 0.0 and c >= 0.0 and det >= (1.0 - LIMIT) * a * b * c
        if not (sound and skew <= (LIMIT - 1.0) * max(a, b, c) and math.isfinite(a + b + c)):
            found += 1
    return found


@part
def less(a: Floats, b: Floats) -> tuple[float, float, float]:
    """a - b, three numbers."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@compiled
def normalised(x: Floats, truth: Floats, cov: Floats) -> tuple[Floats, bool]:
    """e^T P^-1 e (R, T, E) by P = L D L^T, NaN where P is zero or the truth is unknown, and whether every other
    P could be inverted, but for a height without error."""
    found, sound = np.empty(x.shape[:3]), True
    for run in range(len(x)):
        for t in range(x.shape[1]):
            for e in range(x.shape[2]):
                p = cov[run, t, e]
                a, b, c = less(x[run, t, e], truth[t, e])
                first, second = p[0, 1] / p[0, 0], p[0, 2] / p[0, 0]
                yy, yz, zz = p[1, 1] - first * p[0, 1], p[1, 2] - first * p[0, 2], p[2, 2] - second * p[0, 2]
                third, b = yz / yy, b - first * a
                zz, c = zz - third * yz, c - second * a - third * b
                value = a * a / p[0, 0] + b * b / yy + (c * c / zz if c != 0.0 else 0.0)
                if not math.isfinite(value):
                    sound &= math.isnan(a) or not p.any()
                    value = np.nan
                found[run, t, e] = value
    return found, sound

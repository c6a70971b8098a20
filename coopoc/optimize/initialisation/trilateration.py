"""A point from ranges to it: by linear least squares and from both sides of where the places lie, then by descent."""

from __future__ import annotations

import numpy as np

from ...arrays import Floats

STEPS = 50
"""Of each descent."""
TOLERANCE = 1e-6
"""m, a step that ends it."""


def located(places: Floats, ranges: Floats) -> Floats:
    """(d,) minimum of sum (|l - p_k| - r_k)^2, the lowest of those that three guesses lead to.

    2 p_k . l - |l|^2 = |p_k|^2 - r_k^2 is linear in l and |l|^2. Where the places nearly lie in a plane (on a line),
    how far l is from it follows from the ranges, and on which side from the descents.

    Args:
        places: (K, d) m; with K <= d one of the points that the ranges allow is returned.
        ranges: (K,) m.

    >>> located(np.array([[0.0, 0], [8, 0], [4, 1]]), np.array([5.0, 5, 2])).round(6)
    array([4., 3.])
    """
    d, middle = places.shape[1], places.mean(axis=0)
    p = places - middle
    if len(p) <= d:
        return np.asarray(places[0] + ranges[0] * np.eye(d)[0])
    matrix = np.concatenate([2.0 * p, np.ones((len(p), 1))], axis=1)
    guess = np.linalg.lstsq(matrix, np.square(p).sum(axis=1) - ranges**2, rcond=None)[0][:d]
    normal = np.linalg.eigh(p.T @ p)[1][:, 0]
    flat = guess - normal * (guess @ normal)
    height = np.sqrt(max(float(np.mean(ranges**2 - np.square(p - flat).sum(axis=1))), 0.0))

    ends = [_descended(p, ranges, at) for at in (guess, flat + height * normal, flat - height * normal)]
    return np.asarray(min(ends, key=lambda end: end[0])[1] + middle)


def _descended(p: Floats, ranges: Floats, at: Floats) -> tuple[float, Floats]:
    """Cost and place of a minimum from `at`, by Levenberg-Marquardt steps."""
    mu, (cost, residual, jacobian) = 1e-3, _linear(p, ranges, at)
    for _ in range(STEPS):
        hessian = jacobian.T @ jacobian
        damping = mu * np.maximum(hessian.diagonal(), 1e-9)
        dx = -np.linalg.solve(hessian + np.diag(damping), jacobian.T @ residual)
        trial = _linear(p, ranges, at + dx)
        if trial[0] < cost:
            at, (cost, residual, jacobian), mu = at + dx, trial, 0.1 * mu
        else:
            mu *= 10.0
        if float(dx @ dx) < TOLERANCE**2:
            break
    return cost, at


def _linear(p: Floats, ranges: Floats, at: Floats) -> tuple[float, Floats, Floats]:
    """Cost, residuals (K,) and Jacobian (K, d) at a place."""
    gap = at - p
    distance = np.sqrt(np.square(gap).sum(axis=1))
    residual = distance - ranges
    return float(residual @ residual), residual, gap / np.maximum(distance, 1e-12)[:, None]

"""A point from ranges to it: by linear least squares and from both sides of where the places lie, then by descent."""

from __future__ import annotations

import numpy as np

from ..arrays import Floats


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
    from scipy.optimize import least_squares

    d, middle = places.shape[1], places.mean(axis=0)
    p = places - middle
    if len(p) <= d:
        return np.asarray(places[0] + ranges[0] * np.eye(d)[0])
    matrix = np.concatenate([2.0 * p, np.ones((len(p), 1))], axis=1)
    guess = np.linalg.lstsq(matrix, np.square(p).sum(axis=1) - ranges**2, rcond=None)[0][:d]
    normal = np.linalg.eigh(p.T @ p)[1][:, 0]
    flat = guess - normal * (guess @ normal)
    height = np.sqrt(max(float(np.mean(ranges**2 - np.square(p - flat).sum(axis=1))), 0.0))

    def residual(at: Floats) -> Floats:
        return np.asarray(np.linalg.norm(at - p, axis=1) - ranges)

    def jacobian(at: Floats) -> Floats:
        gap = at - p
        return np.asarray(gap / np.maximum(np.linalg.norm(gap, axis=1, keepdims=True), 1e-12))

    guesses = (guess, flat + height * normal, flat - height * normal)
    ends = [least_squares(residual, at, jacobian, method="lm", max_nfev=30) for at in guesses]
    return np.asarray(min(ends, key=lambda end: float(end.cost)).x + middle)

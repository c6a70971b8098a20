"""Kalman and running-mean adaptive filters of one vehicle on one axis, as loops over time."""

import numpy as np

from coopoc.arrays import Floats


def kalman(z: Floats, u: Floats, q: Floats, r: float, dt: float, x0: float | None = None) -> tuple[Floats, Floats]:
    """Mean and variance (T,) of x_t = x_{t-1} + dt u_t + w, z_t = x_t + v; a z of NaN is no fix, a u of NaN absence."""
    x, p = (z[0], r) if x0 is None else (x0, 0.0)
    estimates = [(x, p)]
    for t in range(1, len(z)):
        x, p = x + dt * u[t], p + q[t]
        if np.isnan(x):
            x, p = z[t], r
        elif not np.isnan(z[t]):
            s = p + r
            x, p = x + p / s * (z[t] - x), p * r / s
        estimates.append((x, p))
    mean, variance = np.array(estimates).T
    return mean, variance


def adaptive(z: Floats, u: Floats, q: Floats, r: float, dt: float, n: float, window: float) -> tuple[Floats, Floats]:
    """Mean (T,) and estimated variance of the fixes (T,): r <- r + (v^2 - p - r) / n, n <- min(n + 1, window).

    p = a r + b is kept as (a, b), so that a revised r rereads the past.
    """
    x, a, b, estimates = z[0], 1.0, 0.0, [(z[0], r)]
    for t in range(1, len(z)):
        x, b = x + dt * u[t], b + q[t]
        if not np.isnan(z[t]):
            v, n = z[t] - x, min(n + 1, window)
            r = max(r + (v**2 - (a * r + b) - r) / n, 1e-4)
            k = (a * r + b) / (a * r + b + r)
            x, a, b = x + k * v, (1 - k) ** 2 * a + k**2, (1 - k) ** 2 * b
        estimates.append((x, r))
    mean, variance = np.array(estimates).T
    return mean, variance

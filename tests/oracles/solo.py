"""The Kalman filter of one vehicle on one axis, as a loop over time."""

import numpy as np
from filterpy.kalman import KalmanFilter

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


def filterpys(x: Floats, cov: Floats, dt: float) -> KalmanFilter:
    """filterpy's filter of a position (3,) that velocities move, at its first fix of covariance `cov`."""
    peer = KalmanFilter(dim_x=3, dim_z=3, dim_u=3)
    peer.x, peer.P, peer.R, peer.H, peer.B = x, cov, cov, np.eye(3), dt * np.eye(3)
    return peer

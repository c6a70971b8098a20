"""The solo Kalman filter of every run, vehicle and axis over a whole drive, one number after the other in time."""

from __future__ import annotations

import math

from ..arrays import AnyArray
from .compile import compiled


@compiled
def follow(
    gnss: AnyArray, velocity: AnyArray, process: AnyArray, noise: AnyArray, dt: float, x: AnyArray, p: AnyArray
) -> None:  # fmt: skip
    """Fill x m and p m^2 (R, T, N, 3) from step 1 on, as `coopoc.methods.kalman.solo_filter` does.

    Args:
        gnss, velocity, process: (R, T, N, 3) m, m/s, m^2. noise: (3,) m^2, the variance of a fix. dt: s.
    """
    runs, steps, vehicles = gnss.shape[0], gnss.shape[1], gnss.shape[2]
    for run in range(runs):
        for t in range(1, steps):
            for n in range(vehicles):
                for c in range(3):
                    fix, r = gnss[run, t, n, c], noise[c]
                    prior = x[run, t - 1, n, c] + dt * velocity[run, t, n, c]
                    spread = p[run, t - 1, n, c] + process[run, t, n, c]
                    if math.isnan(prior):
                        x[run, t, n, c], p[run, t, n, c] = fix, r
                    elif math.isnan(fix):
                        x[run, t, n, c], p[run, t, n, c] = prior, spread
                    else:
                        gain = spread / (spread + r)
                        x[run, t, n, c] = prior + gain * (fix - prior)
                        p[run, t, n, c] = (1.0 - gain) * (1.0 - gain) * spread + gain * gain * r

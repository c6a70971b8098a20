"""Process noise of a motion dt u, constant or a share of the pace: of the velocities measured before."""

from collections.abc import Sequence
from math import inf, isnan, nan
from typing import NamedTuple, TypeAlias

import numpy as np

from ..arrays import AnyArray, Floats
from .compiling.compile import compiled, inside

Vector: TypeAlias = Sequence[float] | Floats
PACE = 0.5
"""s, time constant with which the pace forgets velocities."""
SWIFT = 10.0
"""m/s^2, beyond what vehicles accelerate."""


class MotionNoise(NamedTuple):
    """Process noise of one step: q = dt / interval (base^2 + (interval max(ratio s, floor))^2) m^2 per axis.

    s is the pace on the axis, or of the whole velocity. A step of 0.2 s is as uncertain as two of 0.1 s if
    `interval` is 0.1 s, and has the error of one velocity, twice as large, if each step is its own interval.

    The pace s^2 is the mean square of the velocities measured before, which forgets within PACE seconds; at first it is
    the velocity's own. A share of a step's own velocity would be small where the error makes that slow: slow readings
    would weigh more, and estimates fall behind.

    Attributes:
        base: (3,) m per step of `interval`.
        ratio: (3,) share of the speed.
        floor: m/s.
        of_speed: 1.0 for a share of the whole speed, 0.0 for one of each axis.
        interval: s; 0 for the dt of each step, whose velocity is then one measurement.
    """

    base: Floats
    ratio: Floats
    floor: float
    of_speed: float
    interval: float


@inside
def process_variance(noise: MotionNoise, square: Floats, velocity: Vector, dt: float, q: Floats) -> None:
    """Write the variances (3,) m^2 of dt u on the three axes.

    Args:
        noise: of the motion.
        square: (3,) m^2/s^2, of the pace; NaN before the first velocity, whose own it becomes.
        velocity: u, m/s.
        dt: s.
        q: out.
    """
    for c in range(3):
        if isnan(square[c]):
            square[c] = velocity[c] * velocity[c]
    speed, interval = square[0] + square[1] + square[2], noise.interval if noise.interval > 0.0 else dt
    for c in range(3):
        std = noise.ratio[c] * interval
        moved = std * std * (speed if noise.of_speed > 0.0 else square[c])
        q[c] = dt / interval * (noise.base[c] ** 2 + max(moved, (interval * noise.floor) ** 2))


@inside
def keep_pace(square: Floats, velocity: Vector, dt: float) -> None:
    """The pace after a velocity m/s has stood for dt s.

    One beyond twice the pace counts as no more than that and what SWIFT allows: a wrong velocity would leave all later
    ones without weight.
    """
    size = velocity[0] ** 2 + velocity[1] ** 2 + velocity[2] ** 2
    most = 4.0 * (square[0] + square[1] + square[2]) + (SWIFT * dt) ** 2
    for c in range(3):
        own = velocity[c] ** 2 * (most / size if size > most else 1.0)
        square[c] += dt / (dt + PACE) * (own - square[c])


UNUSED, RECEIVED, HELD = range(3)
"""Velocities: of no message, of one that arrives, of one that is the newest until the next."""


def own_variances(noise: MotionNoise, velocity: Floats, dt: float, first: int = 0) -> Floats:
    """Process noise (R, T, N, 3) m^2 of steps of dt s with velocities (R, T, N, 3) m/s, for a filter that begins at
    step `first`."""
    use = np.full(velocity.shape[:3], HELD, np.uint8)
    use[:, :first] = UNUSED
    return process_variances(noise, np.ascontiguousarray(velocity), use, inf, dt)


@compiled
def process_variances(noise: MotionNoise, velocity: Floats, use: AnyArray, longest: float, dt: float) -> Floats:
    """Process noise (R, T, N, 3) m^2 of vehicles, by those velocities of each that one vehicle knows; 0 of UNUSED ones.

    Args:
        noise: of the motion.
        velocity: (R, T, N, 3) m/s, each until the next; NaN for an absent vehicle, which begins anew.
        use: (R, T, N) UNUSED, RECEIVED or HELD.
        longest: s without a velocity, after which the pace begins anew.
        dt: s.
    """
    variance, square, own = np.zeros(velocity.shape), np.empty(velocity.shape[2:]), np.empty(3)
    last = np.zeros(len(square), np.int64)
    runs, steps, vehicles = use.shape
    for run in range(runs):
        square[:], last[:] = nan, 0
        for t in range(steps):
            for n in range(vehicles):
                if use[run, t, n] == UNUSED:
                    continue
                since = (t - last[n]) * dt
                for c in range(3):
                    own[c] = square[n, c] if since <= longest + 1e-9 else nan
                keep_pace(own, velocity[run, last[n], n], since)
                process_variance(noise, own, velocity[run, t, n], dt, variance[run, t, n])
                if use[run, t, n] == HELD:
                    last[n] = t
                    for c in range(3):
                        square[n, c] = own[c]
    return variance

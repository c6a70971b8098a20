"""Process noise of a motion dt u, constant or a share of the measured velocity."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..arrays import Floats
from .compiling.compile import inside


class MotionNoise(NamedTuple):
    """Process noise of one step: q = dt / interval (base^2 + (interval max(ratio s, floor))^2) m^2 per axis.

    s is the measured speed on the axis, or of the whole velocity. So a step of 0.2 s is as uncertain as two of 0.1 s if
    `interval` is 0.1 s, and has the error of one velocity, twice as large, if each step is its own interval.

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


NO_MOTION_NOISE = MotionNoise(np.zeros(3), np.zeros(3), 0.0, 0.0, 0.0)
"""Where the process noise of every step is given otherwise."""


@inside
def process_variance(noise: MotionNoise, velocity: Sequence[float] | Floats, dt: float) -> tuple[float, float, float]:
    """Variances m^2 of dt u on the three axes, of numbers or of vectors of them."""
    u, v, w = velocity[0], velocity[1], velocity[2]
    a, b, c = abs(u), abs(v), abs(w)
    if noise.of_speed > 0.0:
        a = b = c = math.sqrt(u * u + v * v + w * w)
    interval = noise.interval if noise.interval > 0.0 else dt
    share, floor = dt / interval, noise.floor
    moved_x = interval * max(noise.ratio[0] * a, floor)
    moved_y = interval * max(noise.ratio[1] * b, floor)
    moved_z = interval * max(noise.ratio[2] * c, floor)
    return (
        share * (noise.base[0] * noise.base[0] + moved_x * moved_x),
        share * (noise.base[1] * noise.base[1] + moved_y * moved_y),
        share * (noise.base[2] * noise.base[2] + moved_z * moved_z),
    )

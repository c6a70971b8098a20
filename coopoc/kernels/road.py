"""Solo filter on roads: position, error of the heading and scale of the odometry, robust against wrong fixes.

The state of a vehicle is x = (x m, y m, heading error rad, scale error) with its covariance, and the height beside it,
whose motion no heading turns. Fixes err together for a while; wrong ones count less the farther they are away.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..arrays import Floats
from .compiling.compile import compiled, part
from .motion import MotionNoise, keep_pace, process_variance
from .solo import SoloMeasurements

Z, Z_VARIANCE, SINCE, LEVEL, SCALE, FIXES = range(6)
"""Places in `RoadState.more`: height m, its variance m^2, s since the last fix, factor of a fix's variance, factor of
the whole covariance, number of fixes."""


SUDDEN, LOUDEST = 5.0, 400.0
"""Most d^2 that raises the variance of fixes, and the most that it is raised to, as a multiple."""
MOST_SCALE, BELIEVED = 4.0, 2.0
"""Most of the factor of the covariance, and the fixes that its start counts as."""


class RoadNoise(NamedTuple):
    """What is assumed beside the noise of the motion.

    Attributes:
        fix: (3,) m^2, of a fix.
        correlation: s, for which its error lasts.
        gate: standard deviations per axis from which a fix counts less.
        heading: rad, standard deviation of the heading's error.
        scale: of the scale's error.
        lasts: s, correlation time of both.
        window: fixes, over which the variance of a fix is raised to what innovations show.
        least: of the factor of the covariance, which innovations show; from 1 on there is none.
    """

    fix: Floats
    correlation: float
    gate: float
    heading: float
    scale: float
    lasts: float
    window: float
    least: float


class RoadState(NamedTuple):
    """State of one vehicle, in arrays that a step overwrites; x[0] is NaN before the first fix.

    Attributes:
        x: (4,).
        p: (4, 4).
        gain: (4, 2), memory.
        more: (6,).
    """

    x: Floats
    p: Floats
    gain: Floats
    more: Floats


@part
def begin(state: RoadState, noise: RoadNoise, fix: Floats, late: Floats) -> None:
    """Start at a fix m, which is `late` m^2 less certain than others."""
    x, p, more = state.x, state.p, state.more
    for i in range(4):
        x[i] = fix[i] if i < 2 else 0.0
        for j in range(4):
            p[i, j] = 0.0
    p[0, 0], p[1, 1] = noise.fix[0] + late[0], noise.fix[1] + late[1]
    p[2, 2], p[3, 3] = noise.heading * noise.heading, noise.scale * noise.scale
    more[Z], more[Z_VARIANCE], more[SINCE], more[LEVEL] = fix[2], noise.fix[2] + late[2], 0.0, 1.0
    more[SCALE], more[FIXES] = 1.0, BELIEVED


@part
def predict(state: RoadState, noise: RoadNoise, moved: Floats, q: Floats, dt: float) -> None:
    """x += (1 + s) R(b) dt u with the noise q m^2; heading error b and scale error s fade towards none."""
    x, p, more = state.x, state.p, state.more
    c, s, scale = math.cos(x[2]), math.sin(x[2]), 1.0 + x[3]
    east, north = c * moved[0] - s * moved[1], s * moved[0] + c * moved[1]
    x[0] += scale * east
    x[1] += scale * north
    keep = math.exp(-dt / noise.lasts)
    x[2] *= keep
    x[3] *= keep
    for j in range(4):
        p[0, j] += -scale * north * p[2, j] + east * p[3, j]
        p[1, j] += scale * east * p[2, j] + north * p[3, j]
        p[2, j] *= keep
        p[3, j] *= keep
    for i in range(4):
        p[i, 0] += -scale * north * p[i, 2] + east * p[i, 3]
        p[i, 1] += scale * east * p[i, 2] + north * p[i, 3]
        p[i, 2] *= keep
        p[i, 3] *= keep
    p[0, 0] += q[0]
    p[1, 1] += q[1]
    p[2, 2] += (1.0 - keep * keep) * noise.heading * noise.heading
    p[3, 3] += (1.0 - keep * keep) * noise.scale * noise.scale
    more[Z] += moved[2]
    more[Z_VARIANCE] += q[2]
    more[SINCE] += dt


@part
def correct(state: RoadState, noise: RoadNoise, fix: Floats, late: Floats) -> None:
    """Take a fix whose variance is w r (1 + rho) / (1 - rho), in Joseph's form.

    w = max(1, d / k)^2 with the gate k and d^2 half the squared normalised innovation in the plane; the height has one
    of its own. r follows the innovations: it is multiplied by 1 + (d^2 - 1) / window, and is at least what is assumed.
    Errors that last make a mean of fixes (1 + rho) / (1 - rho) times as uncertain as white ones do, rho = exp(-dt /
    correlation), which counts in the weight and not in d. Heading and scale learn 1 / w of what a fix says of them.
    """
    x, p, k, more = state.x, state.p, state.gain, state.more
    rho = math.exp(-more[SINCE] / noise.correlation) if noise.correlation > 0.0 else 0.0
    lasting, level = 1.0 + 2.0 * rho / max(1.0 - rho, 1e-6), more[LEVEL]
    a, b, c = p[0, 0] + level * noise.fix[0] + late[0], p[1, 1] + level * noise.fix[1] + late[1], p[0, 1]
    e, n = fix[0] - x[0], fix[1] - x[1]
    square = 0.5 * (b * e * e - 2.0 * c * e * n + a * n * n) / (a * b - c * c)
    w = max(1.0, square / (noise.gate * noise.gate))
    r, s = w * (level * lasting * noise.fix[0] + late[0]), w * (level * lasting * noise.fix[1] + late[1])
    a, b = p[0, 0] + r, p[1, 1] + s
    for i in range(4):
        share = (1.0 if i < 2 else 1.0 / w) / (a * b - c * c)
        k[i, 0], k[i, 1] = share * (p[i, 0] * b - p[i, 1] * c), share * (p[i, 1] * a - p[i, 0] * c)
    for i in range(4):
        x[i] += k[i, 0] * e + k[i, 1] * n
    for j in range(4):
        east, north = p[0, j], p[1, j]
        for i in range(4):
            p[i, j] -= k[i, 0] * east + k[i, 1] * north
    for i in range(4):
        east, north = p[i, 0], p[i, 1]
        for j in range(4):
            p[i, j] += k[i, 0] * r * k[j, 0] + k[i, 1] * s * k[j, 1] - k[j, 0] * east - k[j, 1] * north
    up, q = fix[2] - more[Z], more[Z_VARIANCE]
    w = max(1.0, up * up / ((q + level * noise.fix[2] + late[2]) * noise.gate * noise.gate))
    r = w * (level * lasting * noise.fix[2] + late[2])
    g = q / (q + r)
    more[Z] += g * up
    more[Z_VARIANCE] = (1.0 - g) * (1.0 - g) * q + g * g * r
    more[SINCE] = 0.0
    more[FIXES] = min(more[FIXES] + 1.0, noise.window)
    if noise.least < 1.0:
        scale = more[SCALE]
        scale += (min(square, SUDDEN * scale) - scale) / more[FIXES]
        more[SCALE] = min(max(scale, noise.least), MOST_SCALE)
    more[LEVEL] = min(max(level * (1.0 + (min(square, SUDDEN) - 1.0) / noise.window), 1.0), LOUDEST)


@compiled
def road_step(
    state: RoadState, noise: RoadNoise, moved: Floats, q: Floats, dt: float, fix: Floats, late: Floats
) -> None:
    """One step of a stream: motion m and its variance m^2, then the fix, NaN for none, `late` m^2 less certain."""
    if not math.isnan(state.x[0]):
        predict(state, noise, moved, q, dt)
        if not math.isnan(fix[0]):
            correct(state, noise, fix, late)
    elif not math.isnan(fix[0]):
        begin(state, noise, fix, late)


@compiled
def road_motion(motion: MotionNoise, square: Floats, velocity: Floats, dt: float, moved: Floats, q: Floats) -> None:
    """Write a step's motion m and its variance m^2 (3,), and keep the pace."""
    process_variance(motion, square, velocity, dt, q)
    keep_pace(square, velocity, dt)
    for c in range(3):
        moved[c] = dt * velocity[c]


@compiled
def run_road(measurements: SoloMeasurements, noise: RoadNoise, x: Floats, cov: Floats, errors: Floats) -> None:
    """Fill the estimates of all runs and E vehicles, each alone.

    Args:
        measurements: the vehicles and their measurements.
        noise: that is assumed.
        x: (R, T, E, 3) m.
        cov: (R, T, E, 3, 3) m^2.
        errors: (R, T, E, 4) heading error rad, its standard deviation, scale error, its standard deviation.
    """
    runs, steps, vehicles = x.shape[:3]
    state = RoadState(np.empty(4), np.empty((4, 4)), np.empty((4, 2)), np.zeros(6))
    moved, q, late = np.empty(3), np.empty(3), np.zeros(3)
    cov[:] = 0.0
    for run in range(runs):
        for e in range(vehicles):
            n = measurements.columns[e]
            state.x[0] = math.nan
            for t in range(steps):
                for c in range(3):
                    moved[c] = measurements.dt * measurements.velocity[run, t, n, c]
                    q[c] = measurements.process[run, t, e, c]
                road_step(state, noise, moved, q, measurements.dt, measurements.gnss[run, t, n], late)
                scale = state.more[SCALE]
                x[run, t, e, 0], x[run, t, e, 1], x[run, t, e, 2] = state.x[0], state.x[1], state.more[Z]
                for i in range(2):
                    for j in range(2):
                        cov[run, t, e, i, j] = scale * state.p[i, j]
                    errors[run, t, e, 2 * i] = state.x[2 + i]
                    errors[run, t, e, 2 * i + 1] = math.sqrt(scale * state.p[2 + i, 2 + i])
                cov[run, t, e, 2, 2] = scale * state.more[Z_VARIANCE]

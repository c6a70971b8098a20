"""Process noise of a motion dt u, constant or a share of the pace: of the velocities measured before."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..arrays import Floats, Ints
from .compiling.compile import compiled, inside

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
def process_variance(noise: MotionNoise, square: Sequence[float] | Floats, dt: float) -> tuple[float, float, float]:
    """Variances m^2 of dt u on the three axes, at the squares (3,) m^2/s^2 of the pace."""
    a, b, c, base, ratio = square[0], square[1], square[2], noise.base, noise.ratio
    if noise.of_speed > 0.0:
        a = b = c = a + b + c
    interval = noise.interval if noise.interval > 0.0 else dt
    share, whole, least = dt / interval, interval * interval, noise.floor * noise.floor
    return (
        share * (base[0] * base[0] + whole * max(ratio[0] * ratio[0] * a, least)),
        share * (base[1] * base[1] + whole * max(ratio[1] * ratio[1] * b, least)),
        share * (base[2] * base[2] + whole * max(ratio[2] * ratio[2] * c, least)),
    )


@inside
def begin_pace(square: Floats, velocity: Floats) -> None:
    """The pace at a first velocity m/s is its own; NaN before."""
    for c in range(3):
        if math.isnan(square[c]):
            square[c] = velocity[c] * velocity[c]


@inside
def keep_pace(square: Floats, velocity: Sequence[float] | Floats, seconds: float, share: float) -> None:
    """The pace after a velocity m/s has stood for some seconds, and has replaced that share of it.

    One beyond twice the pace counts as no more than that and what SWIFT allows: a wrong velocity would leave all later
    ones without weight.
    """
    for c in range(3):
        own, most = velocity[c] * velocity[c], 4.0 * square[c] + (SWIFT * seconds) * (SWIFT * seconds)
        square[c] += share * ((most if own > most else own) - square[c])


@inside
def forgotten(seconds: float) -> float:
    """Share of the pace that is forgotten in that time."""
    return -math.expm1(-seconds / PACE)


@compiled
def own_variances(noise: MotionNoise, velocity: Floats, columns: Ints, first: int, dt: float) -> Floats:
    """Process noise (R, T, E, 3) m^2 of each step of some vehicles.

    Args:
        noise: of the motion.
        velocity: (R, T, N, 3) m/s, NaN for an absent vehicle, which begins anew.
        columns: (E,) of the vehicles.
        first: step at which they begin; what was before is not known.
        dt: s.
    """
    (runs, steps), vehicles = velocity.shape[:2], len(columns)
    variance, square, share = np.empty((runs, steps, vehicles, 3)), np.empty((vehicles, 3)), forgotten(dt)
    for run in range(runs):
        for t in range(steps):
            for e in range(vehicles):
                if t <= first:
                    square[e] = math.nan
                u, q = velocity[run, t, columns[e]], variance[run, t, e]
                begin_pace(square[e], u)
                q[0], q[1], q[2] = process_variance(noise, square[e], dt)
                keep_pace(square[e], u, dt, share)
    return variance


@compiled
def received_variances(
    noise: MotionNoise,
    velocity: Floats,
    ego: int,
    step: Ints,
    neighbour: Ints,
    arrival: Ints,
    newest: Ints,
    oldest: float,
    dt: float,
) -> Floats:
    """Process noise (R, T, N, 3) m^2 of the ego, and of each message at the step at which it was sent.

    The pace of a neighbour is that of the messages that the ego has held: each velocity stands until the next one.

    Args:
        noise: of the motion.
        velocity: (R, T, N, 3) m/s.
        ego: column.
        step: (M,) of each link of the ego.
        neighbour: (M,) column.
        arrival: (R, M) step at which the message of the link arrives, -1 for never.
        newest: (R, M) step of the newest message held, -1 for none.
        oldest: s between messages of a neighbour, after which its pace begins anew.
        dt: s.
    """
    runs, steps, vehicles = velocity.shape[:3]
    variance, square, share = np.zeros(velocity.shape), np.empty((vehicles, 3)), forgotten(dt)
    held, own = np.empty(vehicles, np.int64), np.empty(3)
    for run in range(runs):
        square[:], held[:] = math.nan, -1
        for t in range(steps):
            u, q = velocity[run, t, ego], variance[run, t, ego]
            begin_pace(square[ego], u)
            q[0], q[1], q[2] = process_variance(noise, square[ego], dt)
            keep_pace(square[ego], u, dt, share)
        for link in range(len(step)):
            if newest[run, link] >= 0:
                variance[run, newest[run, link], neighbour[link], 0] = -1.0
        for link in range(len(step)):
            t, j = step[link], neighbour[link]
            if arrival[run, link] < 0:
                continue
            u, q, gap = velocity[run, t, j], variance[run, t, j], t - held[j]
            own[:] = square[j]
            if held[j] < 0 or gap * dt > oldest + 1e-9:
                own[:] = math.nan
            else:
                keep_pace(own, velocity[run, held[j], j], gap * dt, share if gap == 1 else forgotten(gap * dt))
            begin_pace(own, u)
            if q[0] < 0.0:
                square[j], held[j] = own, t
            q[0], q[1], q[2] = process_variance(noise, own, dt)
    return variance

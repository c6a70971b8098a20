"""Calibration of MR.CLAM's sensors against the truth of the first part of a log: noise that knows its correlation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from coopoc.arrays import Floats, Ints, robust_std
from coopoc.errors import InputError
from coopoc.world.frames import midway, turned
from coopoc.world.sensors import Sensors
from coopoc.world.spherical import wrap

from .mrclam import MrclamLog
from .rows import interpolate

LAGS = np.arange(0.0, 0.525, 0.025)
"""s, that are tried."""
WINDOW = 5.0
"""s, over which errors are summed. Of 1, 2, 5, 10, 20 and 30 s it makes the true poses of the first 300 s of set 6 most
likely (docs/real.md)."""
PLANE_STD = 0.01
"""rad, assumed for the inclination, which is pi/2 since the robots drive on one floor."""
LASTING = 60.0
"""s, after which scale and bias of odometry are taken as others."""
FEWEST = 100
"""Measurements that a calibration takes."""
ROBUST = 5.0
"""Robust standard deviations of an innovation beyond which it is an outlier."""


class Calibration(NamedTuple):
    """What is known of a log's sensors.

    Attributes:
        sensors: standard deviations of white noise that leads as far astray as the real errors do.
        lag: s, by which the robots follow their odometry.
        speed: (N,) true over logged speed.
        turn: (N,) true over logged turn rate.
    """

    sensors: Sensors
    lag: float
    speed: Floats
    turn: Floats


def calibrate(log: MrclamLog, until: float) -> Calibration:
    """Calibration on the first `until` seconds.

    The lag minimises the residual of the turn rate; the scales are least squares, per robot. Errors that last are
    noise whose sums grow faster than those of white noise, n s^2: the s here is that of the sums over WINDOW, of the
    odometry's errors, and of those of all that a robot measures in that time.

    Args:
        log: of read_mrclam.
        until: s.

    Raises:
        InputError: too little truth in that time.

    Source: the variance of batch means, Conway, Some tactical problems in digital simulation, Man. Sci. 10(1), 1963.
    """
    steps = int(until / log.fleet.dt)
    if not 10 * WINDOW <= until < log.fleet.t[-1]:
        allowed = f"must be {10 * WINDOW:g} s or more and end before the log, {log.fleet.t[-1]:g} s"
        raise InputError("calibrate_s", f"{until:g} s", allowed, "Leave a part to score.")
    velocity = turned(log.fleet.velocity, -midway(log.heading))[1:steps]
    rate = np.diff(log.heading, axis=0)[: steps - 1] / log.fleet.dt
    lag = min(LAGS, key=lambda lag: float(np.nanvar(rate - delayed(log, log.turn_rate, lag)[1:steps])))
    wheel, turning = (delayed(log, values, lag)[1:steps] for values in (log.speed, log.turn_rate))
    speed, turn = (_slope(true, logged) for true, logged in ((velocity[..., 0], wheel), (rate, turning)))
    window = int(WINDOW / log.fleet.dt)
    ahead, turned_off = velocity[..., 0] - speed * wheel, rate - turn * turning
    forward = _summed(ahead, window)
    ranges, bearings = _relative(log, until)
    sensors = Sensors(
        velocity_std_ratio=forward / float(np.sqrt(np.mean((speed * wheel) ** 2))),
        velocity_floor=_summed(velocity[..., 1], window),
        yaw_rate_std=_summed(turned_off, window),
        range_std=ranges,
        azimuth_std=bearings,
        inclination_std=PLANE_STD,
        compass=False,
        speed_scale_std=_in_blocks(ahead, speed * wheel, log.fleet.dt),
        yaw_rate_bias_std=_in_blocks(turned_off, np.ones(rate.shape), log.fleet.dt),
        odometry_error_time=LASTING,
        min_range=0.0,
    )
    return Calibration(sensors, float(lag), speed, turn)


def delayed(log: MrclamLog, values: Floats, lag: float) -> Floats:
    """(T, N) as they were `lag` s before, those of the first instant before it."""
    return np.column_stack([np.interp(log.fleet.t - lag, log.fleet.t, column) for column in values.T])


def _slope(true: Floats, logged: Floats) -> Floats:
    known = np.isfinite(true)
    return np.asarray((np.where(known, true, 0) * logged).sum(axis=0) / (known * logged**2).sum(axis=0))


def _in_blocks(error: Floats, regressor: Floats, dt: float) -> float:
    """Rms over robots and blocks of LASTING of the factor of a regressor (T, N) that explains errors (T, N) best."""
    steps = int(LASTING / dt)
    starts = range(0, len(error) - steps + 1, steps)
    found = [_slope(error[first : first + steps], regressor[first : first + steps]) for first in starts]
    return float(np.sqrt(np.nanmean(np.square(found))))


def _summed(error: Floats, window: int) -> float:
    """Standard deviation of white noise whose sums over a window are as large as those of the errors (T, N)."""
    whole = error[: len(error) // window * window].reshape(-1, window, error.shape[1])
    return float(np.sqrt(np.nanmean(whole.sum(axis=1) ** 2) / window))


def _relative(log: MrclamLog, until: float) -> tuple[float, float]:
    """Standard deviations m and rad of white noise as informative as the ranges and bearings are."""
    marks = log.sightings[log.sightings[:, 2] >= 0]
    place = log.landmarks[marks[:, 2].astype(np.int64), 1:]
    own = _poses(log, marks[:, 0], marks[:, 1].astype(np.int64))
    dx, dy = (place - own[:, :2]).T
    true_range, true_bearing = np.hypot(dx, dy), np.arctan2(dy, dx) - own[:, 2]
    t = np.concatenate([log.time, marks[:, 0]])
    observer = np.concatenate([log.observer, marks[:, 1]])
    reach = np.concatenate([log.range - log.true_range, marks[:, 3] - true_range])
    angle = wrap(np.concatenate([log.bearing - log.true_bearing, marks[:, 4] - true_bearing]))
    known = np.isfinite(reach) & (t >= 0) & (t < until)
    if known.sum() < FEWEST:
        allowed = f"must be {FEWEST} or more"
        raise InputError("calibrate_s", f"{known.sum()} measurements in {until:g} s", allowed, "Take longer.")
    ranges, bearings = (_grouped(error[known], observer[known], t[known]) for error in (reach, angle))
    return ranges, bearings


def _grouped(error: Floats, observer: Ints, t: Floats) -> float:
    """Standard deviation of white noise whose sums over what a robot measures in a window are as large as those of the
    errors (M,), outliers aside."""
    spread = robust_std(error)
    inlier = np.abs(error - np.median(error)) <= ROBUST * spread
    group = np.unique(observer[inlier] * 10**6 + np.floor(t[inlier] / WINDOW), return_inverse=True)[1]
    sums = np.bincount(group, error[inlier])
    return float(np.sqrt((sums**2).sum() / inlier.sum()))


def _poses(log: MrclamLog, t: Floats, robot: Ints) -> Floats:
    """(M, 3) m, m, rad of robots at times s by Vicon, NaN in gaps."""
    found = np.full((len(t), 3), np.nan)
    for column in range(len(log.fleet.ids)):
        mine = robot == column
        path = np.column_stack([log.fleet.position[:, column, :2], log.heading[:, column]])
        inside = mine & (t >= 0) & (t <= log.fleet.t[-1])
        known = np.isfinite(path[:, 0])
        found[inside] = interpolate(log.fleet.t[known], path[known], t[inside], 2 * log.fleet.dt)
    return found

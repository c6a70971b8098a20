"""MR.CLAM in body frames with nothing simulated: noise calibrated on the first part of a log, and its Recording."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from coopoc.arrays import Floats, Ints, robust_std
from coopoc.errors import InputError
from coopoc.world.body_frames import midway, turned
from coopoc.world.links import wrap
from coopoc.world.recording import Recording
from coopoc.world.sensors import Sensors
from coopoc.world.v2x import V2X

from .assemble import interpolate
from .mrclam import MrclamLog, kept
from .planar import PLANE_STD, nearest, planar_recording, steps_of

LAGS = np.arange(0.0, 0.525, 0.025)
"""s, that are tried."""
WINDOW = 5.0
"""s, over which errors are summed. Of 1, 2, 5, 10, 20 and 30 s it makes the true poses of the first 300 s of set 6 most
likely (docs/real.md)."""
LASTING = 60.0
"""s, after which scale and bias of odometry are taken as others."""
FEWEST = 100
"""Measurements that a calibration takes."""
ROBUST = 5.0
"""Robust standard deviations of an innovation beyond which it is an outlier."""


class Calibration(NamedTuple):
    """Noise, delay and scales of a log's sensors.

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


def pose_recording(log: MrclamLog, v2x: V2X, calibration: Calibration) -> Recording:
    """Recording of the robots' own measurements, one run: odometry, range and bearing of robots and landmarks.

    There are no fixes and no compass. Inclinations are pi/2: the robots drive on one floor. Of several measurements of
    a subject in a step the one nearest to the step's instant is kept; at most K robots, nearest first by measured
    range, and all landmarks.

    Args:
        log: of read_mrclam.
        v2x: K, radius and channel.
        calibration: of its sensors: odometry is scaled and delayed by it, since it is a record of commands.

    Raises:
        InputError: a folder without positions of landmarks.
    """
    robots, marks = log.fleet.ids, surveyed(log)
    forward = calibration.speed * _delayed(log, log.speed, calibration.lag)
    index = kept(log, v2x)
    others = [getattr(log, name)[index] for name in ("step", "observer", "subject", "range", "bearing")]
    t, observer, mark, reach, bearing = log.sightings.T
    step, late = steps_of(t, log.fleet.dt, len(log.fleet.t))
    sightings = np.column_stack([step, observer, len(robots) + mark, reach, bearing])
    sightings = sightings[nearest(late, step, observer, mark)]
    return planar_recording(
        (*robots, *(f"landmark{int(subject)}" for subject in marks[:, 0])),
        log.fleet.t,
        forward[..., None] * [1.0, 0.0],
        calibration.turn * _delayed(log, log.turn_rate, calibration.lag),
        marks[:, 1:],
        np.vstack([np.column_stack(others), sightings]),
        calibration.sensors,
        v2x,
        "odometry, ranges and bearings are real; no fix, no compass, nothing simulated",
    )


def surveyed(log: MrclamLog) -> Floats:
    """(M, 3) subject, x m, y m of the landmarks; InputError if there is none."""
    if not len(log.landmarks):
        raise InputError("folder", log.fleet.name, "has no Landmark_Groundtruth.dat", "Unpack the set again.")
    return log.landmarks


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
    dt = log.fleet.dt
    first, window, block = slice(1, int(until / dt)), int(WINDOW / dt), int(LASTING / dt)
    if not 10 * WINDOW <= until < log.fleet.t[-1]:
        allowed = f"must be {10 * WINDOW:g} s or more and end before the log, {log.fleet.t[-1]:g} s"
        raise InputError("calibrate_s", f"{until:g} s", allowed, "Leave a part to score.")
    velocity = turned(log.fleet.velocity, -midway(log.heading))[first]
    rate = np.diff(log.heading, axis=0)[: len(velocity)] / dt
    lag = min(LAGS, key=lambda lag: float(np.nanvar(rate - _delayed(log, log.turn_rate, lag)[first])))
    wheel, turning = (_delayed(log, values, lag)[first] for values in (log.speed, log.turn_rate))
    speed, turn = (_slope(true, logged) for true, logged in ((velocity[..., 0], wheel), (rate, turning)))
    ahead, aside, off = velocity[..., 0] - speed * wheel, velocity[..., 1], rate - turn * turning
    forward, side, yaw = (summed(error, window) for error in (ahead, aside, off))
    ranges, bearings = _relative(log, until)
    sensors = Sensors(
        velocity_std_ratio=forward / float(np.sqrt(np.mean((speed * wheel) ** 2))),
        velocity_floor=side,
        yaw_rate_std=yaw,
        range_std=ranges,
        azimuth_std=bearings,
        inclination_std=PLANE_STD,
        compass=False,
        speed_scale_std=_in_blocks(ahead, speed * wheel, block),
        yaw_rate_bias_std=_in_blocks(off, np.ones(rate.shape), block),
        odometry_error_time=LASTING,
        min_range=0.0,
    )
    return Calibration(sensors, float(lag), speed, turn)


def _delayed(log: MrclamLog, values: Floats, lag: float) -> Floats:
    """(T, N) as they were `lag` s before, those of the first instant before it."""
    return np.column_stack([np.interp(log.fleet.t - lag, log.fleet.t, column) for column in values.T])


def _slope(true: Floats, logged: Floats) -> Floats:
    """(N,) least-squares factor of the logged values (T, N) on the true ones, NaN where these are unknown."""
    return np.asarray(np.nansum(true * logged, axis=0) / (np.isfinite(true) * logged**2).sum(axis=0))


def _in_blocks(error: Floats, regressor: Floats, steps: int) -> float:
    """Rms over robots and blocks of steps of the factor of a regressor (T, N) that explains errors (T, N) best."""
    starts = range(0, len(error) - steps + 1, steps)
    factors = [_slope(error[first : first + steps], regressor[first : first + steps]) for first in starts]
    return float(np.sqrt(np.nanmean(np.square(factors))))


def summed(error: Floats, window: int) -> float:
    """Standard deviation of white noise whose sums over a window are as large as those of the errors (T, N)."""
    whole = error[: len(error) // window * window].reshape(-1, window, error.shape[1])
    return float(np.sqrt(np.nanmean(whole.sum(axis=1) ** 2) / window))


def grouped(error: Floats, observer: Ints, t: Floats) -> float:
    """Standard deviation of white noise whose sums over what a robot measures in a window are as large as those of the
    errors (M,), outliers aside."""
    inlier = np.abs(error - np.median(error)) <= ROBUST * robust_std(error)
    group = np.unique(observer[inlier] * 10**6 + np.floor(t[inlier] / WINDOW), return_inverse=True)[1]
    sums = np.bincount(group, error[inlier])
    return float(np.sqrt((sums**2).sum() / inlier.sum()))


def _relative(log: MrclamLog, until: float) -> tuple[float, float]:
    """Standard deviations m and rad of white noise as informative as the ranges and bearings are."""
    marks = log.sightings[log.sightings[:, 2] >= 0]
    own, end = np.full((len(marks), 3), np.nan), log.fleet.t[-1]
    for column in range(len(log.fleet.ids)):  # poses by Vicon, NaN in gaps
        path = np.column_stack([log.fleet.position[:, column, :2], log.heading[:, column]])
        inside = (marks[:, 1] == column) & (marks[:, 0] >= 0) & (marks[:, 0] <= end)
        present = log.fleet.present[:, column]
        own[inside] = interpolate(log.fleet.t[present], path[present], marks[inside, 0], 2 * log.fleet.dt)
    dx, dy = (log.landmarks[marks[:, 2].astype(np.int64), 1:] - own[:, :2]).T
    t, observer = np.append(log.time, marks[:, 0]), np.append(log.observer, marks[:, 1])
    reach = np.append(log.range - log.true_range, marks[:, 3] - np.hypot(dx, dy))
    angle = wrap(np.append(log.bearing - log.true_bearing, marks[:, 4] - (np.arctan2(dy, dx) - own[:, 2])))
    used = np.isfinite(reach) & (t >= 0) & (t < until)
    if used.sum() < FEWEST:
        given, allowed = f"{used.sum()} measurements in {until:g} s", f"must be {FEWEST} or more"
        raise InputError("calibrate_s", given, allowed, "Take longer.")
    ranges, bearings = (grouped(error[used], observer[used], t[used]) for error in (reach, angle))
    return ranges, bearings

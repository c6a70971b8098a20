"""UTIAS MR.CLAM: reader, noise calibrated against Vicon on the first part, and the Recording in body frames."""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy import inf, nan

from coopoc import Fleet, InputError, Recording, Sensors
from coopoc.arrays import Bools, Floats, Ints, robust_std
from coopoc.formats.values import MAX_NUMBER, read_table, read_words
from coopoc.paths import given_path
from coopoc.text import short_repr
from coopoc.world.body_frames import midway, turned
from coopoc.world.links import wrap

from .assemble import (
    PLANE_STD,
    backward_difference,
    check_intervals,
    check_size,
    check_time,
    interpolate,
    planar_recording,
)
from .log.frames import RATE_BIAS_STD, SCALE_STD
from .log.heading import Signal, between, step_means

MAX_GAP = 0.5
"""s without truth that is interpolated; longer gaps are NaN."""
MAX_BEARING_RAD = 2 * np.pi + 1e-6
LAGS = np.arange(0.0, 0.525, 0.025)
"""s, that are tried."""
ERROR_SECONDS = 5.0
"""s, over which errors are summed. Of 1, 2, 5, 10, 20 and 30 s it makes the true poses of the first 300 s of set 6 most
likely (docs/real.md)."""
LASTING_SECONDS = 60.0
"""s, after which scale and bias of odometry are taken as others."""
CALIBRATING_COUNT = 100
"""Measurements that a calibration takes."""
ROBUST = 5.0
"""Robust standard deviations of an innovation beyond which it is an outlier."""
DATASET_PAPER = "Leung et al., The UTIAS Multi-Robot Cooperative Localization and Mapping Dataset, IJRR 30(8) 2011"


@dataclass(frozen=True, eq=False)
class MrclamLog:
    """Measurements of N robots, and Vicon's truth.

    Args:
        fleet: Vicon truth on the steps, z = 0, headings unwrapped; NaN in gaps of Vicon.
        speed: (T, N) m/s, wheel odometry averaged over the step that ends at t.
        turn_rate: (T, N) rad/s, as `speed`.
        landmarks: (L, 3) subject, x m, y m of the landmarks.
        relative: (M, 5) time s on the fleet's clock, observer (column), what it measured (column of a robot, N + row of
            `landmarks`, -1 if it has no position), range m, bearing rad in the observer's body frame.
        true: (M, 2) range m and bearing rad, from Vicon at that time; NaN in gaps.
    """

    fleet: Fleet
    speed: Floats
    turn_rate: Floats
    landmarks: Floats
    relative: Floats
    true: Floats

    @property
    def heading(self) -> Floats:
        """(T, N) rad, Vicon, unwrapped, NaN in gaps."""
        return self.fleet.heading  # type: ignore[return-value]

    __repr__ = short_repr


def read_mrclam(folder: str | Path, *, dt: float = 0.1, max_gap: float = MAX_GAP) -> MrclamLog:
    """Read RobotN_Groundtruth, _Odometry, _Measurement (of the robots that are there) and Barcodes.dat.

    Measurements of barcodes in no list, and of robots whose files are not there, are left out.

    The fleet covers the interval in which every robot has truth and odometry. Gaps of truth up to `max_gap` are
    interpolated. The second column of a measurement is a barcode, though the header of the file says subject.

    Args:
        folder: with the .dat files.
        dt: s, step of the fleet.
        max_gap: s without truth that is interpolated; in longer gaps a robot is absent.

    Raises:
        InputError: a missing file; with the line, words that are not numbers, times out of order, angles beyond a turn,
            a range that is not positive, a barcode that stands twice, a robot that measures itself; robots that share
            no interval; dt <= 0.

    Source: Leung, Halpern, Barfoot, Liu, IJRR 30(8) 2011.
    """
    check_intervals(dt=dt)
    folder = given_path(folder)
    numbers = [n for n in range(1, 10) if (folder / f"Robot{n}_Groundtruth.dat").exists()] or [1]
    truths = [_read(folder / f"Robot{n}_Groundtruth.dat", "time x y heading", strictly=True) for n in numbers]
    wheels = [_read(folder / f"Robot{n}_Odometry.dat", "time speed turn_rate") for n in numbers]
    for table in truths:
        table[:, 3] = np.unwrap(table[:, 3])
    start, end = max(a[0, 0] for a in truths + wheels), min(a[-1, 0] for a in truths + wheels)
    if not end - start >= dt:
        raise InputError(
            "folder",
            folder.name,
            "the robots' files must share an interval with truth and odometry",
            "Check the times in the .dat files.",
        )
    check_size((end - start) / dt, len(numbers), sum(map(len, truths + wheels)), dt, folder.name)
    t = dt * np.arange(int((end - start) / dt) + 1)
    vicon, logged = ([Signal(a[:, 0] - start, a[:, 1:]) for a in tables] for tables in (truths, wheels))
    poses = np.stack([interpolate(*robot, t, max_gap) for robot in vicon], 1)
    odometry = np.stack([step_means(robot, t) for robot in logged], axis=1)
    file = folder / "Landmark_Groundtruth.dat"
    marks = _read(file, "subject x y x_std y_std")[:, :3] if file.is_file() else np.empty((0, 3))
    table = _measurements(folder, numbers)
    table[:, 0] -= start
    member = {n: k for k, n in enumerate([*numbers, *marks[:, 0].tolist()])}
    table[:, 2] = [member.get(subject, -1) for subject in table[:, 2].tolist()]
    exact = [interpolate(*robot, table[:, 0], max_gap) for robot in vicon]
    at = [np.broadcast_to([x, y, nan], (len(table), 3)) for x, y in marks[:, 1:].tolist()]
    every = np.stack([*exact, *at, np.full((len(table), 3), nan)])
    here, there = (every[table[:, k].astype(int), np.arange(len(table))] for k in (1, 2))
    dx, dy = (there - here)[:, :2].T
    position = np.dstack([poses[..., :2], 0 * poses[..., 0]])
    ids = tuple(f"robot{n}" for n in numbers)
    fleet = Fleet(
        ids,
        t,
        position,
        backward_difference(t, position, ids),
        name=folder.name.lower(),
        source=f"UTIAS MR.CLAM, Vicon truth, z = 0 ({DATASET_PAPER})",
        licence="none stated: read, not redistributed",
        heading=poses[..., 2],
    )
    true = np.column_stack([np.hypot(dx, dy), wrap(np.arctan2(dy, dx) - here[:, 2])])
    return MrclamLog(fleet, odometry[..., 0], odometry[..., 1], marks, table, true)


class Calibration(NamedTuple):
    """Noise, delay and scales of a log's sensors.

    Attributes:
        sensors: standard deviations of white noise that leads as far astray as the real errors do.
        lag: s, by which the robots follow their odometry.
        speed: (N,) true over logged speed, straight ahead.
        slip: (N,) s/rad, share of it that is lost in a turn of 1 rad/s.
        turn: (N,) true over logged turn rate.
    """

    sensors: Sensors
    lag: float
    speed: Floats
    slip: Floats
    turn: Floats


def pose_recording(log: MrclamLog, calibration: Calibration) -> Recording:
    """Recording of the robots' own measurements, one run: odometry, range and bearing of robots and landmarks.

    There are no fixes and no compass. Inclinations are pi/2: the robots drive on one floor. `data.log.links.under`
    chooses a channel.

    Args:
        log: of read_mrclam.
        calibration: of its sensors: odometry is scaled and delayed by it, since it is a record of commands.

    Raises:
        InputError: a folder without positions of landmarks.
    """
    t, marks = log.fleet.t, surveyed(log)
    wheel, turning = (between(Signal(t, each), t - calibration.lag) for each in (log.speed, log.turn_rate))
    return planar_recording(
        (*log.fleet.ids, *(f"landmark{int(subject)}" for subject in marks[:, 0])),
        t,
        _driven(calibration.speed, calibration.slip, wheel, turning)[..., None] * [1.0, 0.0],
        calibration.turn * turning,
        marks[:, 1:],
        log.relative,
        calibration.sensors,
        "odometry, ranges and bearings are real; no fix, no compass, nothing simulated",
    )


def surveyed(log: MrclamLog) -> Floats:
    """(M, 3) subject, x m, y m of the landmarks; InputError if there is none."""
    if not len(log.landmarks):
        raise InputError("folder", log.fleet.name, "has no Landmark_Groundtruth.dat", "Unpack the set again.")
    return log.landmarks


def calibrate(log: MrclamLog, until: float) -> Calibration:
    """Calibration on the first `until` seconds.

    The lag minimises the residual of the turn rate; scales and slip are least squares, per robot, over sums of
    ERROR_SECONDS: of single steps they would be too small, because the robots follow their commands gradually. The sums
    of time-correlated errors grow faster than those of white noise, n s^2: the s here is that of the sums over
    ERROR_SECONDS, of the odometry's errors, and of those of all that a robot measures in that time.

    Args:
        log: of read_mrclam.
        until: s.

    Raises:
        InputError: too little truth in that time.

    Source: the variance of batch means, Conway, Some tactical problems in digital simulation, Man. Sci. 10(1), 1963.
    """
    t, dt = log.fleet.t, log.fleet.dt
    first, window = slice(1, int(until / dt)), int(ERROR_SECONDS / dt)
    if not 10 * ERROR_SECONDS <= until < t[-1]:
        raise InputError(
            "calibrate_s",
            f"{until:g} s",
            f"must be {10 * ERROR_SECONDS:g} s or more and end before the log, {t[-1]:g} s",
            "Leave a part to score.",
        )
    velocity = turned(log.fleet.velocity, -midway(log.heading))[first]
    rate = np.diff(log.heading, axis=0)[: len(velocity)] / dt
    logged = Signal(t, log.speed), Signal(t, log.turn_rate)
    lag = min(LAGS, key=lambda lag: np.nanvar(rate - between(logged[1], t - lag)[first]))
    wheel, turning = (between(each, t - lag)[first] for each in logged)
    speed, lost = _factors(window, velocity[..., 0], wheel, wheel * abs(turning))
    (turn,), slip = _factors(window, rate, turning), -lost / speed
    driven = _driven(speed, slip, wheel, turning)
    ahead, aside, off = velocity[..., 0] - driven, velocity[..., 1], rate - turn * turning
    t, robot = np.broadcast_arrays(t[first, None][: len(rate)], np.arange(len(log.fleet.ids)))
    forward, side, yaw = (grouped(e[there := np.isfinite(e)], robot[there], t[there]) for e in (ahead, aside, off))
    ranges, bearings = _relative(log, until)
    sensors = Sensors(
        velocity_std_ratio=forward / np.sqrt(np.mean(driven**2)),
        velocity_floor=side,
        yaw_rate_std=yaw,
        range_std=ranges,
        azimuth_std=bearings,
        inclination_std=PLANE_STD,
        compass=False,
        speed_scale_std=SCALE_STD,
        yaw_rate_bias_std=RATE_BIAS_STD,
        odometry_error_time=LASTING_SECONDS,
        min_range=0.0,
    )
    return Calibration(sensors, float(lag), speed, slip, turn)


def _driven(speed: Floats, slip: Floats, wheel: Floats, turning: Floats) -> Floats:
    """(T, N) m/s, forward speed of what was logged."""
    return np.asarray(speed * wheel * np.maximum(1.0 - slip * abs(turning), 0.0))


def _factors(window: int, true: Floats, *logged: Floats) -> Floats:
    """(regressors, N) least-squares factors of logged values (T, N) on true ones, over sums of a window, where the true
    ones are known."""
    finite = np.isfinite(true)
    parts = (np.where(finite, values, 0.0)[: len(true) // window * window] for values in (true, *logged))
    sums = [part.reshape(-1, window, true.shape[1]).sum(1).T for part in parts]
    pairs = zip(np.stack(sums[1:], -1), sums[0], strict=True)
    return np.array([np.linalg.lstsq(left, right)[0] for left, right in pairs]).T


def grouped(error: Floats, observer: Floats | Ints, t: Floats, gate: float = inf) -> float:
    """Standard deviation of white noise whose sums over what a robot measures in a window are as large as those of the
    errors (M,), those beyond a gate of robust standard deviations aside."""
    inlier = abs(error - np.median(error)) <= gate * robust_std(error)
    group = np.unique(observer[inlier] * 10**6 + np.floor(t[inlier] / ERROR_SECONDS), return_inverse=True)[1]
    return float(np.sqrt((np.bincount(group, error[inlier]) ** 2).sum() / inlier.sum()))


def _relative(log: MrclamLog, until: float) -> tuple[float, float]:
    """Standard deviations m and rad of white noise as informative as the ranges and bearings are."""
    t, observer = log.relative[:, :2].T
    reach, angle = (log.relative[:, 3:] - log.true).T
    used = np.isfinite(reach) & (t >= 0) & (t < until)
    if used.sum() < CALIBRATING_COUNT:
        raise InputError(
            "calibrate_s",
            f"{used.sum()} measurements in {until:g} s",
            f"must be {CALIBRATING_COUNT} or more",
            "Take longer.",
        )
    ranges, bearings = (grouped(error[used], observer[used], t[used], ROBUST) for error in (reach, wrap(angle)))
    return ranges, bearings


def _measurements(folder: Path, numbers: list[int]) -> Floats:
    """(M, 5) unix time s, observer (column), subject (0: in no list), range m, bearing rad, by time."""
    file = folder / "Barcodes.dat"
    codes = _read(file, "subject barcode")
    for column, what in ((1, "barcode"), (0, "subject")):
        twice = pd.Series(codes[:, column]).duplicated().to_numpy()
        _refuse(file, twice, f"must give each {what} once", "Remove the line that repeats it.")
    subjects, barcodes = codes.T
    subject_of = pd.Series(subjects, barcodes)
    parts = []
    for column, robot in enumerate(numbers):
        file = folder / f"Robot{robot}_Measurement.dat"
        table = _read(file, "time barcode range bearing")
        subject = subject_of.reindex(table[:, 1], fill_value=0.0).to_numpy()
        _refuse(
            file,
            subject == robot,
            "must be another's: a robot does not measure itself",
            "Check Barcodes.dat, or remove the line.",
        )
        _refuse(file, table[:, 2] <= 0, "must have a range > 0 m", "Remove the line.")
        parts.append(np.column_stack([table[:, 0], np.full(len(table), column), subject, table[:, 2:]]))
    rows = np.vstack(parts)
    return rows[np.argsort(rows[:, 0], kind="stable")]


def _read(file: Path, form: str, *, strictly: bool = False) -> Floats:
    """(M, C) numbers of a file; a column time increases, the last column, an angle or its rate, is within a turn."""
    if not file.is_file():
        raise InputError(
            "folder", file.parent, f"has no {file.name}", "Point at a folder MRCLAM_DatasetN with its .dat files."
        )
    try:
        table = pd.read_csv(file, sep=r"\s+", comment="#", header=None, dtype=float).to_numpy()
    except (ValueError, OverflowError):  # those of pandas for text, empty files and bytes among them
        table = np.empty((0, 0))
    if table.shape[1:] != (len(form.split()),) or not (abs(table) <= MAX_NUMBER).all():
        table = read_table(file, form)[1]  # slow; names the line
    if form.startswith("time"):
        check_time(table[:, 0], file.name)
        gap = np.diff(table[:, 0], prepend=-inf)
        order = f"must {'increase' if strictly else 'not decrease'} in time from line to line"
        _refuse(file, gap <= 0 if strictly else gap < 0, order, "Correct or remove the stamp that is out of order.")
        angle = f"must have a {form.rpartition(' ')[2]} within a turn (a second), in rad"
        _refuse(file, abs(table[:, -1]) > MAX_BEARING_RAD, angle, "Convert degrees to radians.")
    return np.array(table)


def _refuse(file: Path, wrong: Bools, allowed: str, hint: str) -> None:
    """InputError with the first line that is wrong."""
    if wrong.any():
        line, words = list(read_words(file))[int(np.argmax(wrong))]
        raise InputError(f"{file.name}: line {line}", " ".join(words)[:80], allowed, hint)

"""Reader of UTIAS MR.CLAM: up to five real robots with wheel odometry, range and bearing, and Vicon truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from coopoc.arrays import Floats, Ints, robust_std
from coopoc.errors import InputError
from coopoc.file_names import given_path
from coopoc.short_repr import short_repr
from coopoc.world.fleet import Fleet
from coopoc.world.spherical import wrap

from . import mrclam_files as files
from .nearest import steps_of
from .rows import backward_difference, interpolate
from .scale import check_size

MAX_GAP = 0.5
"""s without truth that is interpolated; longer gaps are NaN."""
PAPER = "Leung et al., The UTIAS Multi-Robot Cooperative Localization and Mapping Dataset, IJRR 30(8) 2011"


@dataclass(frozen=True, eq=False)
class MrclamLog:
    """Measurements of N robots, and Vicon's truth.

    Args:
        fleet: Vicon truth on the steps, z = 0, NaN in gaps of Vicon.
        heading: (T, N) rad, Vicon, unwrapped, NaN in gaps.
        speed: (T, N) m/s, wheel odometry averaged over the step that ends at t.
        turn_rate: (T, N) rad/s, as `speed`.
        time: (M,) s on the fleet's clock, of every robot-to-robot measurement.
        step: (M,) nearest step, -1 outside the fleet's interval.
        observer: (M,) columns of the fleet.
        subject: (M,) columns of the fleet.
        range: (M,) m.
        bearing: (M,) rad in the observer's body frame.
        true_range: (M,) m, from Vicon at `time`; NaN in gaps.
        true_bearing: (M,) rad, from Vicon at `time`; NaN in gaps.
        observer_heading: (M,) rad, Vicon at `time`.
        landmarks: (L, 3) subject, x m, y m of the landmarks.
        sightings: (S, 5) time s on the fleet's clock, observer (column), landmark (row of `landmarks`, -1 if it has no
            position), range m, bearing rad, of every measurement of a landmark.
        unknown: number of measurements of barcodes in no list, which are not among the M.
        absent: number of measurements of robots whose files are not in the folder, which are not among the M.
    """

    fleet: Fleet
    heading: Floats
    speed: Floats
    turn_rate: Floats
    time: Floats
    step: Ints
    observer: Ints
    subject: Ints
    range: Floats
    bearing: Floats
    true_range: Floats
    true_bearing: Floats
    observer_heading: Floats
    landmarks: Floats
    sightings: Floats
    unknown: int
    absent: int = 0

    __repr__ = short_repr


@dataclass(frozen=True, eq=False)
class Innovations:
    """Residuals of the real measurements against Vicon: range (M,) m, bearing (M,) rad."""

    range: Floats
    bearing: Floats

    @property
    def range_std(self) -> float:
        """m, robust: 1.4826 times the median absolute deviation."""
        return robust_std(self.range)

    @property
    def bearing_std(self) -> float:
        """rad, robust."""
        return robust_std(self.bearing)

    def rows(self) -> list[dict[str, float | str]]:
        """Table: quantity, measurements, median, robust std, the value stated for the set, share beyond 5 std."""
        stated = (("range", "m", self.range, 0.095), ("bearing", "rad", self.bearing, 0.007))
        return [
            {
                "quantity": name,
                "unit": unit,
                "measurements": len(r),
                "median": float(np.median(r)),
                "robust_std": robust_std(r),
                "stated_std": value,
                "beyond_5_std": float(np.mean(np.abs(r - np.median(r)) > 5 * robust_std(r))),
            }
            for name, unit, r, value in stated
        ]


def innovations(log: MrclamLog) -> Innovations:
    """Measured minus true range and bearing, where Vicon saw both robots."""
    seen = np.isfinite(log.true_range)
    return Innovations((log.range - log.true_range)[seen], wrap(log.bearing - log.true_bearing)[seen])


def read_mrclam(folder: str | Path, *, dt: float = 0.1, max_gap: float = MAX_GAP) -> MrclamLog:
    """Read RobotN_Groundtruth, _Odometry, _Measurement (of the robots that are there) and Barcodes.dat.

    The fleet covers the interval in which every robot has truth and odometry. Gaps of truth up to `max_gap` are
    interpolated.

    Args:
        folder: with the .dat files.
        dt: s, step of the fleet.
        max_gap: s without truth that is interpolated; in longer gaps a robot is absent.

    Raises:
        InputError: a missing file; with the line, words that are not numbers, times out of order, and what
            `mrclam_files.measurements` refuses; robots that share no interval; dt <= 0.

    Source: Leung, Halpern, Barfoot, Liu, IJRR 30(8) 2011.
    """
    if not dt > 0:
        raise InputError("dt", f"{dt} s", "must be > 0", "Give the sampling interval in seconds.")
    folder = given_path(folder)
    numbers = files.robots(folder)
    truths = [files.truth(folder, n) for n in numbers]
    wheels = [files.odometry(folder, n) for n in numbers]
    start, end = max(a[0, 0] for a in truths + wheels), min(a[-1, 0] for a in truths + wheels)
    if not end - start >= dt:
        allowed = "must share an interval with truth and odometry"
        raise InputError("folder", folder.name, f"the robots' files {allowed}", "Check the times in the .dat files.")
    rows = sum(map(len, truths + wheels))
    check_size((end - start) / dt, len(numbers), rows, dt, folder.name)
    t = dt * np.arange(int((end - start) / dt) + 1)
    poses = np.stack([interpolate(a[:, 0] - start, a[:, 1:], t, max_gap) for a in truths], axis=1)
    odometry = np.stack([_step_means(a[:, 0] - start, a[:, 1:], t) for a in wheels], axis=1)
    found = files.measurements(folder, numbers)
    seen = found.rows - [start, 0, 0, 0, 0]
    step, _ = steps_of(seen[:, 0], dt, len(t))
    marks, sightings = files.landmarks(folder), found.landmarks - [start, 0, 0, 0, 0]
    row = {subject: k for k, subject in enumerate(marks[:, 0].tolist())}
    sightings[:, 2] = [row.get(subject, -1) for subject in sightings[:, 2].tolist()]
    true_range, true_bearing, heading = _true(seen, truths, start, max_gap)
    return MrclamLog(
        fleet=_fleet(folder, numbers, t, poses),
        heading=poses[..., 2],
        speed=odometry[..., 0],
        turn_rate=odometry[..., 1],
        time=seen[:, 0],
        step=step,
        observer=seen[:, 1].astype(np.int64),
        subject=seen[:, 2].astype(np.int64),
        range=seen[:, 3],
        bearing=seen[:, 4],
        true_range=true_range,
        true_bearing=true_bearing,
        observer_heading=heading,
        landmarks=marks,
        sightings=sightings,
        unknown=found.unknown,
        absent=found.absent,
    )


def _fleet(folder: Path, numbers: tuple[int, ...], t: Floats, poses: Floats) -> Fleet:
    ids = tuple(f"robot{n}" for n in numbers)
    xy = poses[..., :2]
    position = np.concatenate([xy, np.where(np.isnan(xy[..., :1]), np.nan, 0.0)], axis=2)
    return Fleet(
        ids,
        t,
        position,
        backward_difference(t, position, ids),
        name=folder.name.lower(),
        source=f"UTIAS MR.CLAM, Vicon truth, z = 0 ({PAPER})",
        licence="none stated: read, not redistributed",
        heading=poses[..., 2],
    )


def _step_means(t: Floats, values: Floats, grid: Floats) -> Floats:
    """(T, C) mean over the step that ends at each instant: difference of the trapezoidal integral."""
    integral = np.vstack([0 * values[:1], np.cumsum(np.diff(t)[:, None] * (values[1:] + values[:-1]) / 2, axis=0)])
    at = np.column_stack([np.interp(grid, t, column) for column in integral.T])
    mean = np.diff(at, axis=0) / np.diff(grid)[:, None]
    return np.vstack([mean[:1], mean])


def _true(seen: Floats, truths: list[Floats], start: float, max_gap: float) -> tuple[Floats, Floats, Floats]:
    poses = np.stack([interpolate(a[:, 0] - start, a[:, 1:], seen[:, 0], max_gap) for a in truths])
    rows = np.arange(len(seen))
    here, there = poses[seen[:, 1].astype(int), rows], poses[seen[:, 2].astype(int), rows]
    dx, dy = (there - here)[:, :2].T
    return np.hypot(dx, dy), wrap(np.arctan2(dy, dx) - here[:, 2]), here[:, 2]

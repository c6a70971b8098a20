"""Reader of UTIAS MR.CLAM: wheel odometry, range and bearing of real robots, and Vicon's truth."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from coopoc.arrays import Bools, Floats, Ints
from coopoc.errors import InputError
from coopoc.file_names import given_path
from coopoc.formats.values import LARGEST, read_table, read_words
from coopoc.short_repr import short_repr
from coopoc.world.fleet import Fleet
from coopoc.world.links import wrap
from coopoc.world.v2x import V2X

from .assemble import backward_difference, check_size, check_time, interpolate
from .planar import first_of_each, nearest, steps_of

MAX_GAP = 0.5
"""s without truth that is interpolated; longer gaps are NaN."""
SUBJECTS = 5
"""Subjects 1 to 5 are robots, those beyond are landmarks."""
TURN = 2 * np.pi + 1e-6
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
    landmarks: Floats
    sightings: Floats
    unknown: int
    absent: int

    __repr__ = short_repr


def read_mrclam(folder: str | Path, *, dt: float = 0.1, max_gap: float = MAX_GAP) -> MrclamLog:
    """Read RobotN_Groundtruth, _Odometry, _Measurement (of the robots that are there) and Barcodes.dat.

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
    if not dt > 0:
        raise InputError("dt", f"{dt} s", "must be > 0", "Give the sampling interval in seconds.")
    folder = given_path(folder)
    named = [re.fullmatch(r"Robot([1-9])_Groundtruth\.dat", file.name) for file in folder.glob("Robot*")]
    numbers = sorted(int(match[1]) for match in named if match) or [1]
    truths = [_read(folder / f"Robot{n}_Groundtruth.dat", "time x y heading", strictly=True) for n in numbers]
    wheels = [_read(folder / f"Robot{n}_Odometry.dat", "time speed turn_rate") for n in numbers]
    for table in truths:
        table[:, 3] = np.unwrap(table[:, 3])
    start, end = max(a[0, 0] for a in truths + wheels), min(a[-1, 0] for a in truths + wheels)
    if not end - start >= dt:
        allowed = "the robots' files must share an interval with truth and odometry"
        raise InputError("folder", folder.name, allowed, "Check the times in the .dat files.")
    check_size((end - start) / dt, len(numbers), sum(map(len, truths + wheels)), dt, folder.name)
    t = dt * np.arange(int((end - start) / dt) + 1)
    poses = np.stack([interpolate(a[:, 0] - start, a[:, 1:], t, max_gap) for a in truths], axis=1)
    odometry = np.stack([_step_means(a[:, 0] - start, a[:, 1:], t) for a in wheels], axis=1)
    file = folder / "Landmark_Groundtruth.dat"
    marks = _read(file, "subject x y x_std y_std")[:, :3] if file.is_file() else np.empty((0, 3))
    table = _measurements(folder, numbers)
    table[:, 0] -= start
    subject = table[:, 2]
    robot_column = {number: k for k, number in enumerate(numbers)}
    others = table[np.isin(subject, numbers)]
    observer, other = others[:, 1].astype(np.int64), np.array([robot_column[n] for n in others[:, 2]], dtype=np.int64)
    sightings = table[subject > SUBJECTS]
    row = {number: k for k, number in enumerate(marks[:, 0].tolist())}
    sightings[:, 2] = [row.get(number, -1) for number in sightings[:, 2].tolist()]
    exact = np.stack([interpolate(a[:, 0] - start, a[:, 1:], others[:, 0], max_gap) for a in truths])
    here, there = exact[observer, np.arange(len(others))], exact[other, np.arange(len(others))]
    dx, dy = (there - here)[:, :2].T
    position = np.dstack([poses[..., :2], 0 * poses[..., 0]])
    ids = tuple(f"robot{n}" for n in numbers)
    fleet = Fleet(
        ids,
        t,
        position,
        backward_difference(t, position, ids),
        name=folder.name.lower(),
        source=f"UTIAS MR.CLAM, Vicon truth, z = 0 ({PAPER})",
        licence="none stated: read, not redistributed",
        heading=poses[..., 2],
    )
    return MrclamLog(
        fleet=fleet,
        heading=poses[..., 2],
        speed=odometry[..., 0],
        turn_rate=odometry[..., 1],
        time=others[:, 0],
        step=steps_of(others[:, 0], dt, len(t))[0],
        observer=observer,
        subject=other,
        range=others[:, 3],
        bearing=others[:, 4],
        true_range=np.hypot(dx, dy),
        true_bearing=wrap(np.arctan2(dy, dx) - here[:, 2]),
        landmarks=marks,
        sightings=sightings,
        unknown=int((subject == 0).sum()),
        absent=int(((subject > 0) & (subject <= SUBJECTS)).sum()) - len(others),
    )


def kept(log: MrclamLog, v2x: V2X) -> Ints:
    """Indices of the measurements that become links, by step, observer and range.

    Args:
        log: of read_mrclam.
        v2x: K and radius.
    """
    late = np.abs(log.time - log.fleet.t[log.step])
    unique = nearest(late, log.step, log.observer, log.subject)
    near = unique[log.range[unique] <= v2x.radius]
    near = near[np.lexsort((log.range[near], log.observer[near], log.step[near]))]
    return near[first_of_each(v2x.max_neighbours, log.step[near], log.observer[near])]


def _step_means(t: Floats, values: Floats, grid: Floats) -> Floats:
    """(T, C) mean over the step that ends at each instant: difference of the trapezoidal integral."""
    integral = np.vstack([0 * values[:1], np.cumsum(np.diff(t)[:, None] * (values[1:] + values[:-1]) / 2, axis=0)])
    on_grid = np.column_stack([np.interp(grid, t, column) for column in integral.T])
    mean = np.diff(on_grid, axis=0) / np.diff(grid)[:, None]
    return np.vstack([mean[:1], mean])


def _measurements(folder: Path, numbers: list[int]) -> Floats:
    """(M, 5) unix time s, observer (column), subject (0: in no list), range m, bearing rad, by time."""
    file = folder / "Barcodes.dat"
    codes = _read(file, "subject barcode")
    for column, what in ((1, "barcode"), (0, "subject")):
        twice = np.ones(len(codes), dtype=bool)
        twice[np.unique(codes[:, column], return_index=True)[1]] = False
        _refuse(file, twice, f"must give each {what} once", "Remove the line that repeats it.")
    _refuse(file, (codes != np.rint(codes)).any(axis=1), "must have whole numbers", "Unpack the set again.")
    subject_of = {code: subject for subject, code in codes.tolist()}
    parts = []
    for column, robot in enumerate(numbers):
        file = folder / f"Robot{robot}_Measurement.dat"
        table = _read(file, "time barcode range bearing")
        subject = np.array([subject_of.get(code, 0) for code in table[:, 1].tolist()])
        hint = "Check Barcodes.dat, or remove the line."
        _refuse(file, subject == robot, "must be another's: a robot does not measure itself", hint)
        _refuse(file, table[:, 2] <= 0, "must have a range > 0 m", "Remove the line.")
        parts.append(np.column_stack([table[:, 0], np.full(len(table), column), subject, table[:, 2:]]))
    rows = np.vstack(parts)
    return rows[np.argsort(rows[:, 0], kind="stable")]


def _read(file: Path, form: str, *, strictly: bool = False) -> Floats:
    """(M, C) numbers of a file; a column time increases, the last column, an angle or its rate, is within a turn."""
    import pandas as pd

    if not file.is_file():
        hint = "Point at a folder MRCLAM_DatasetN with its .dat files."
        raise InputError("folder", file.parent, f"has no {file.name}", hint)
    try:
        table = pd.read_csv(file, sep=r"\s+", comment="#", header=None, dtype=float).to_numpy()
    except (ValueError, OverflowError):  # those of pandas for text, empty files and bytes among them
        table = np.empty((0, 0))
    if table.shape[1:] != (len(form.split()),) or not (np.abs(table) <= LARGEST).all():
        table = read_table(file, form)[1]  # slow; names the line
    if form.startswith("time"):
        check_time(table[:, 0], file.name)
        gap = np.diff(table[:, 0], prepend=-np.inf)
        order = f"must {'increase' if strictly else 'not decrease'} in time from line to line"
        _refuse(file, gap <= 0 if strictly else gap < 0, order, "Mend or remove the stamp that is out of order.")
        angle = f"must have a {form.rpartition(' ')[2]} within a turn (a second), in rad"
        _refuse(file, np.abs(table[:, -1]) > TURN, angle, "Convert degrees to radians.")
    return np.array(table)


def _refuse(file: Path, wrong: Bools, allowed: str, hint: str) -> None:
    """InputError with the first line that is wrong."""
    if wrong.any():
        line, words = list(read_words(file))[int(np.argmax(wrong))]
        raise InputError(f"{file.name}: line {line}", " ".join(words)[:80], allowed, hint)

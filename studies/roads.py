"""CL-Bench's real drives: methods alone on a log with a truth, whose fixes are thinned and cut off alike for all; and
convoys of vehicles that drive together, pieces of one drive, whose ranges are drawn.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from coopoc import V2X, Fleet, InputError, Method, Recording, Sensors, observe, read_log
from coopoc.arrays import last_true
from coopoc.data.log.links import under
from coopoc.data.log.read import is_log
from coopoc.data.log.residuals import in_space, plane
from coopoc.data.source import split
from coopoc.study.cell import Row
from coopoc.world.recording import NOTHING_SIMULATED

from .pose_drives import BLOCK_SECONDS, CALIBRATION_SHARE, MIN_BLOCKS, hashed
from .tasks import blocks_of, costs, located, planar, rounded

FIX_EVERY, OUTAGE_SECONDS, PERIOD_SECONDS = 10, 30.0, 180.0
"""One fix in so many is kept, and none in the last s of every period of s."""
ROADS = {
    "f9k": ("ublox_f9k.nmea", "span_truth.gga"),
    "kitti": ("KITTI_00_ORB.txt", "KITTI_00_gt.txt"),
    "comma2k19": ("comma2k19",),
}
"""Task -> files of the measurements and of the truth, or a folder of both."""
PUBLISHED = {"nclt": ("test.pt",), "nclt-val": ("val.pt",)}
"""Task of drives that a net was published with -> the file, which is scored with all its fixes and steps."""
EVERY_ROAD = {**ROADS, **PUBLISHED}
COMMA_STEP = 0.1
"""s, of comma2k19, whose speeds come every 0.01 s."""


def roads(data: Path | None) -> Mapping[str, tuple[str, ...]]:
    """The tasks of a folder of data or of what was fetched, or the one of a log of one's own."""
    if data is not None:
        path = Path(split(str(data))[0])
        if path.exists() and is_log(path) and not any(holds(path, task) for task in EVERY_ROAD):
            return {path.stem: ()}
    return EVERY_ROAD


def holds(path: Path, task: str) -> bool:
    """Whether the first file of a task is below a folder, or is the folder."""
    first = EVERY_ROAD[task][0]
    return path.name == first or any(path.rglob(first))


@lru_cache(maxsize=2)
def thinned(task: str, data: Path | None) -> tuple[Recording, Fleet]:
    """Measurements with thinned fixes, and the truth.

    Raises:
        InputError: a file that is missing, a log without a truth.
    """
    files = [located(data, name) for name in roads(data)[task]]
    if task == "kitti":  # poses 3x4 of a camera (x right, z ahead) in the plane, and fixes of 2.5 m that are drawn once
        ways = [np.insert(pose[:, [11, 3]], 2, 0.0, axis=1)[:, None] for pose in map(np.loadtxt, files)]
        measured, motion = (np.diff(way, axis=0, prepend=way[:1]) / 0.1037 for way in ways)
        truth = Fleet(("car",), 0.1037 * np.arange(len(motion)), ways[1], motion, name="KITTI 00")
        drawn = observe(truth, Sensors(gnss_std=(2.5, 2.5, 0.01)), V2X(max_neighbours=0), seed=2026)
        recording = replace(
            drawn, velocity=measured[None], sensors=Sensors(), notes=(f"odometry: {NOTHING_SIMULATED}",)
        )
    else:
        options = {"truth": files[1]} if files[1:] else {"dt": COMMA_STEP} if files and task in ROADS else {}
        log = read_log(files[0] if files else str(data), **options)
        if log.truth is None:
            raise InputError("data", str(data), "must hold a truth", 'Name its file: "LOG?truth=FILE".')
        recording, truth = log.recording, log.truth
    if task in PUBLISHED:
        return recording, truth
    clock, gnss = (recording.t - recording.t[0]) % PERIOD_SECONDS, recording.gnss.copy()
    for column in range(len(recording.ids)):
        kept = np.flatnonzero(np.isfinite(gnss[0, :, column, 0]))[::FIX_EVERY]
        starts = [start for start, _ in recording.stretches(column)]
        gone = np.setdiff1d(np.arange(len(clock)), [*kept[clock[kept] < PERIOD_SECONDS - OUTAGE_SECONDS], *starts])
        gnss[:, gone, column] = np.nan
    return under(replace(recording, gnss=gnss), V2X(max_neighbours=0)), truth


def road_row(task: str, data: Path | None, made: Method) -> Row:
    """RT-LE m in the plane with its interval over vehicles and blocks of time, root mean square of an axis m of each
    vehicle, NEES of (x, y), us of a step: of the last 60 % of a drive, or of all of published ones.

    Args:
        task: that is run.
        data: folder of the data, None for those that were fetched, or a log.
        made: a method.
    """
    recording, truth = thinned(task, data)
    start, column = int(CALIBRATION_SHARE * len(recording.t)) * (task not in PUBLISHED), recording.observers[0]
    begin, _ = recording.stretches(column)[0]
    made(recording.between(begin, begin + 3), [column])  # compiles
    files = [located(data, name) for name in roads(data)[task]] or [Path(split(str(data))[0])]
    blocks, ratios, seconds, axis = [], [], 0.0, {}
    size = min(BLOCK_SECONDS / recording.dt, (len(recording.t) - start) / MIN_BLOCKS)
    for column in recording.observers:
        squares = np.full(len(recording.t), np.nan)
        for begin, stop in recording.stretches(column):
            if stop <= start:
                continue
            track = made(recording.between(begin, stop), [column])
            gap, nees = planar(track, truth.between(begin, stop))
            squares[begin:stop], seconds = np.square(gap[0, :, 0]).sum(-1), seconds + track.seconds
            ratios.append(nees[0, max(start - begin, 0) :, 0])
        blocks += blocks_of(np.sqrt(squares)[:, None], start, size).ravel().tolist()
        axis[recording.ids[column]] = round(float(np.sqrt(np.nanmean(squares[start:]) / 2)), 4)
    row: Row = {"task": task, "data": hashed(*files), "rt_le_m": rounded(np.array(blocks)), "axis_rms_m": axis}
    row["blocks_m"] = np.round(blocks, 4).tolist()
    if np.isfinite(nees := np.concatenate(ratios)).any():
        row["nees"] = round(np.nanmean(nees), 2)
    step = round(1e6 * seconds / len(recording.t), 2)
    return row | {"microseconds_per_step": step, "received_bytes_per_second": 0}


CONVOYS = {f"convoy-{road}": road for road in ROADS}
"""Task -> road whose drive is cut."""
PIECES, SHORTEST_PIECE, START_SPREAD, RUNS, SEED = 4, 25.0, 25.0, 4, 2026
"""Vehicles at most; s of a piece at least; m within which they start; draws of ranges and angles, and their seed."""
MIN_COURSE_SPEED = 1.0
"""m/s, below which a course is noise: the odometry errs as it did before."""


@lru_cache(maxsize=4)
def convoy(task: str, data: Path | None, neighbours: int = 6) -> tuple[Recording, Fleet]:
    """Measurements and truth of vehicles on the route of the first piece, side by side, as far apart as they start.

    A vehicle's fixes err by as many metres east and north as those of its piece, its odometry by the same factor and
    turn of the motion, $u' = (u_{measured} / u_{true}) u_{route}$ in complex numbers. All runs have the same fixes and
    odometry; ranges and angles are drawn.

    Args:
        task: one of CONVOYS.
        data: folder of the data, None for those that were fetched.
        neighbours: that a vehicle measures at most.

    Raises:
        InputError: a file that is missing.
    """
    recording, truth = thinned(CONVOYS[task], data)
    column, dt = recording.observers[0], recording.dt
    starts, length = _pieces(recording, column)
    there = np.isfinite(truth.position[:, column, 0])
    now = np.arange(len(there))
    path = np.interp(now, now[there], plane(truth.position[there, column]))
    motion = np.diff(path, prepend=path[0])
    measured = plane(recording.velocity[0, :, column]) * dt
    fast = (abs(motion) > MIN_COURSE_SPEED * dt) & np.isfinite(measured)
    last = np.maximum(last_true(fast), np.argmax(fast))  # where the vehicle is slow, the ratio is as before
    times = (np.where(fast, measured, 1.0) / np.where(fast, motion, 1.0))[last]
    ratio = np.clip(abs(times), 0.5, 2.0) * np.exp(1j * np.clip(np.angle(times), -0.5, 0.5))
    error = plane(recording.gnss[0, :, column]) - path
    route, rows = slice(starts[0], starts[0] + length), np.array(starts) + np.arange(length)[:, None]
    offset = START_SPREAD * np.random.default_rng(SEED).uniform(-1, 1, (len(starts), 2)) @ [1, 1j] / np.sqrt(2)
    true = (path[route] - path[starts[0]])[:, None] + offset
    driven = np.repeat(motion[route, None], len(starts), axis=1)
    ids, t = tuple(f"v{k}" for k in range(len(starts))), recording.t[:length] - recording.t[0]
    fleet = Fleet(ids, t, in_space(true), in_space(driven) / dt, name=task)
    drawn = observe(fleet, recording.sensors, V2X(max_neighbours=neighbours, radius=150.0), runs=RUNS, seed=SEED)
    gnss, velocity = (
        np.tile(each, (RUNS, 1, 1, 1)) for each in (in_space(true + error[rows]), in_space(ratio[rows] * driven) / dt)
    )
    return replace(
        drawn, gnss=gnss, velocity=velocity, notes=(f"errors of fixes and odometry: {NOTHING_SIMULATED}",)
    ), fleet


def _pieces(recording: Recording, column: int) -> tuple[list[int], int]:
    """First steps of pieces, each with a fix, and their length in steps: PIECES of SHORTEST_PIECE s, or fewer."""
    fixes = np.flatnonzero(np.isfinite(recording.gnss[0, :, column, 0]))
    count = int(np.clip((len(recording.t) - fixes[0]) * recording.dt / SHORTEST_PIECE, 1, PIECES))
    wanted = np.linspace(fixes[0], len(recording.t), count + 1)[:-1]
    starts = [int(fixes[np.searchsorted(fixes, np.ceil(first))]) for first in wanted]
    return starts, int(np.diff([*starts, len(recording.t)]).min())


def convoy_row(task: str, data: Path | None, method: Method) -> Row:
    """RT-LE m in the plane with its interval over vehicles and blocks of time, NEES of (x, y), bytes and us of a step.

    Args:
        task: that is run.
        data: folder of the data, None for those that were fetched.
        method: any of positions, alone or cooperative.
    """
    recording, fleet = convoy(task, data)
    egos = list(range(len(recording.ids)))
    method(recording.between(0, 3), egos)  # compiles
    track = method(recording, egos)
    gap, nees = planar(track, fleet)
    size = min(BLOCK_SECONDS, len(recording.t) * recording.dt / MIN_BLOCKS) / recording.dt
    blocks = blocks_of(np.sqrt(np.vecdot(gap, gap).mean(0)), 0, size).T
    row: Row = {"task": task, "data": hashed(*(located(data, name) for name in ROADS[CONVOYS[task]]))}
    row |= {"rt_le_m": rounded(blocks), "blocks_m": blocks.round(4).tolist()}
    if track.covariance is not None:
        row["nees"] = round(np.nanmean(nees), 2)
    return row | costs(track, recording, method)

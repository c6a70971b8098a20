"""CL-Bench's real roads: methods alone on a log with a truth, whose fixes are thinned and cut off alike for all."""

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from coopoc import V2X, Fleet, InputError, Method, Recording, Sensors, observe, read_log
from coopoc.data.log.read import is_log
from coopoc.data.source import split
from coopoc.study.study import Row
from coopoc.world.recording import NOTHING_SIMULATED

from .pose_drives import BLOCK_SECONDS, CALIBRATION_SHARE, MIN_BLOCKS, hashed
from .tasks import blocks_of, located, planar, rounded

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
    if task in PUBLISHED:
        return published(files[0])
    if task == "kitti":  # poses 3x4 of a camera (x right, z ahead) in the plane, and fixes of 2.5 m that are drawn once
        poses = map(np.loadtxt, files)
        ways = [np.column_stack([pose[:, 11], pose[:, 3], 0.0 * pose[:, 3]])[:, None] for pose in poses]
        measured, motion = (np.diff(way, axis=0, prepend=way[:1]) / 0.1037 for way in ways)
        truth = Fleet(("car",), 0.1037 * np.arange(len(motion)), ways[1], motion, name="KITTI 00")
        drawn = observe(truth, Sensors(gnss_std=(2.5, 2.5, 0.01)), V2X(max_neighbours=0), seed=2026)
        notes = (f"odometry: {NOTHING_SIMULATED}",)
        recording = replace(drawn, velocity=measured[None], sensors=Sensors(), notes=notes)
    else:
        options = {"truth": files[1]} if files[1:] else {"dt": COMMA_STEP} if files else {}
        log = read_log(files[0] if files else str(data), **options)
        if log.truth is None:
            raise InputError("data", str(data), "must hold a truth", 'Name its file: "LOG?truth=FILE".')
        recording, truth = log.recording, log.truth
    clock, gnss = (recording.t - recording.t[0]) % PERIOD_SECONDS, recording.gnss.copy()
    for column in range(len(recording.ids)):
        kept = np.flatnonzero(np.isfinite(gnss[0, :, column, 0]))[::FIX_EVERY]
        starts = [start for start, _ in recording.stretches(column)]
        gone = np.setdiff1d(np.arange(len(clock)), [*kept[clock[kept] < PERIOD_SECONDS - OUTAGE_SECONDS], *starts])
        gnss[:, gone, column] = np.nan
    return replace(recording, gnss=gnss), truth


def published(file: Path) -> tuple[Recording, Fleet]:
    """Drives with all their fixes, and their truth."""
    log = read_log(file)
    assert log.truth is not None
    return log.recording, log.truth


def road_row(task: str, data: Path | None, made: Method) -> Row:
    """Error of the last 60 % of a drive, or of all of published ones.

    Args:
        task: that is run.
        data: folder of the data, None for those that were fetched, or a log.
        made: a method.
    """
    recording, truth = thinned(task, data)
    start, column = int(CALIBRATION_SHARE * len(recording.t)) * (task not in PUBLISHED), recording.observers[0]
    begin, _ = recording.stretches(column)[0]
    made(recording.between(begin, begin + 3), [column])  # compiles
    files = [located(data, name) for name in roads(data)[task]]
    row = {"task": task, "data": hashed(*files)}
    row |= _scored(made, recording, truth, start)
    return row | {"received_bytes_per_second": 0}


def _scored(method: Method, recording: Recording, truth: Fleet, start: int) -> Row:
    """RT-LE m in the plane with its interval over vehicles and blocks of time, root mean square of an axis m of each
    vehicle, NEES of (x, y), us of a step."""
    blocks, ratios, seconds, axis = [], [], 0.0, {}
    size = min(BLOCK_SECONDS / recording.dt, (len(recording.t) - start) / MIN_BLOCKS)
    for column in recording.observers:
        squares = np.full(len(recording.t), np.nan)
        for begin, stop in recording.stretches(column):
            if stop <= start:
                continue
            track = method(recording.between(begin, stop), [column])
            gap, nees = planar(track, truth.between(begin, stop))
            squares[begin:stop], seconds = np.square(gap[0, :, 0]).sum(axis=-1), seconds + track.seconds
            ratios.append(nees[0, max(start - begin, 0) :, 0])
        blocks += blocks_of(np.sqrt(squares)[:, None], start, size).ravel().tolist()
        axis[recording.ids[column]] = round(float(np.sqrt(np.nanmean(squares[start:]) / 2)), 4)
    row = {"rt_le_m": rounded(np.array(blocks)), "axis_rms_m": axis, "blocks_m": np.round(blocks, 4).tolist()}
    if np.isfinite(nees := np.concatenate(ratios)).any():
        row["nees"] = round(np.nanmean(nees), 2)
    return row | {"microseconds_per_step": round(1e6 * seconds / len(recording.t), 2)}

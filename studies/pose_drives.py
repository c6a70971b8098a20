"""Real drives whose headings are estimated: measurements, first poses, truth, and the part that is scored."""

import hashlib
import sys
from collections.abc import Callable, Mapping
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from coopoc import V2X, Fleet, InputError, Recording, pose_start
from coopoc.arrays import Floats, number
from coopoc.data.fetch import bring
from coopoc.data.log.links import under, with_links
from coopoc.data.log.read import Log
from coopoc.data.log.residuals import GATE_STDS, begin_of, together
from coopoc.data.mrclam import calibrate, pose_recording, read_mrclam, surveyed
from coopoc.data.registry import kind_of, read_log
from coopoc.data.source import split, while_unchanged
from coopoc.study.cell import Params
from coopoc.world.storage import digest

LONGEST_CALIBRATION, CALIBRATION_SHARE = 300.0, 0.4
"""s at most, and share of the drive, that calibrate and train where the settings leave it open."""
BLOCK_SECONDS, MIN_BLOCKS = 30.0, 4
"""s of a block of time, over which errors are averaged, and the least number of blocks."""

POSES: Mapping[str, Mapping[str, Any]] = {
    "pose-solo": {"unit": "solo"},
    "pose-plain": {"unit": "solo", "exact": False, "robust": False, "lasting": False},
    "pose-fleet": {"unit": "fleet"},
    "pose-intersection": {"unit": "fleet", "fusion": "intersection"},
    "pose-naive": {"unit": "fleet", "fusion": "naive"},
}
"""Pose filters by name: their options."""


class Drive(NamedTuple):
    """One run of real measurements in body frames.

    Attributes:
        recording: with all its landmarks.
        begin: first poses (1, N, 4) m and rad, None where first fixes and compasses give them.
        truth: on the steps of the recording, None if there is none.
        lasting: whether scale and bias of the odometry, and the offset of ranges, are states.
        spread: m, m, m and rad of the first poses; None as of PoseFilter.
    """

    recording: Recording
    begin: Floats | None
    truth: Fleet | None
    lasting: bool
    spread: tuple[float, ...] | None = None

    @property
    def ids(self) -> tuple[str, ...]:
        """Of those that move."""
        return tuple(self.recording.ids[k] for k in self.recording.vehicles)


class Source(NamedTuple):
    """Real measurements of a drive.

    Attributes:
        seconds: length of the part in which all vehicles are there.
        vehicles: their number.
        landmarks: their number.
        posed: whether true poses are known, from which noise is learned.
        digests: of all that the numbers of a drive are made of.
        drive: s of the first part, K, radius and channel -> all that was measured, under that channel.
        check: s of the first part -> InputError if the drive cannot be followed, before any cell.
        text: what was measured, and where its noise comes from, for captions, with braces for a name and for the s.
    """

    seconds: float
    vehicles: int
    landmarks: int
    posed: bool
    digests: Mapping[str, str]
    drive: Callable[[float, V2X], Drive]
    check: Callable[[float], object]
    text: Callable[[], str]


@while_unchanged
def source(data: str) -> Source:
    """The measurements of a folder of MR.CLAM, whose first part calibrates its sensors, or of a log in body frames,
    which states them.

    Raises:
        InputError: anything else.
    """
    name, kind = split(data)[0], kind_of(data)
    if kind == "mrclam":
        return _mrclam(Path(name))
    if kind not in ("log", "pyfg", "recording"):
        hint = "Check it; a log may hold what vehicles measured (docs/your_data.md), a folder a set of MR.CLAM."
        allowed = "must be the path of measurements, not only of drives"
        raise InputError("data", repr(data), allowed, hint if Path(name).exists() else bring(name, hint))
    log = read_log(data)
    if log.recording.body is None:
        hint = f"Take coopoc run side_by_side --data {data!r}."
        raise InputError("data", repr(data), "is a log in the world's frame, and filters here estimate headings", hint)
    return _logged(*together(log))


def _mrclam(folder: Path) -> Source:
    log = read_mrclam(folder)
    calibration = lru_cache(maxsize=2)(partial(calibrate, log))

    def drive(until: float, v2x: V2X) -> Drive:
        recording = under(pose_recording(log, calibration(until)), v2x, logged=False)
        return Drive(recording, pose_start(recording, gate=GATE_STDS), log.fleet, True)

    text = "Wheel odometry, ranges and bearings of {}; no fix, no compass. The first {:.3g} s calibrate the noise."
    seconds, made = float(np.ptp(log.fleet.t)), lru_cache(maxsize=2)(drive)
    marks, digests = len(surveyed(log)), {"log": hashed(folder)}
    return Source(seconds, len(log.fleet.ids), marks, True, digests, made, calibration, lambda: text)


def _logged(log: Log, span: str) -> Source:
    """Of a log in body frames its longest part in which all vehicles are there, and where that is in words."""
    recording, truth = log.recording, log.truth
    stated, marks = recording.sensors, len(recording.landmarks)
    begun = cache(lambda: begin_of(log))

    def drive(until: float, v2x: V2X) -> Drive:
        begin, spread, _ = begun()
        lasting = max(stated.speed_scale_std, stated.yaw_rate_bias_std, stated.range_offset_std) > 0
        return Drive(under(recording, v2x, logged=log.messages), begin, truth, lasting, spread)

    def text() -> str:
        where = "" if span == "throughout" else f" {span},"
        return (
            f"What {{}} holds ({', '.join(f'{number} {what}' for what, number in log.summary.read.items() if number)}),"
            f"{where} with the noise that it states{begun()[2]}; the first {{:.3g}} s are not scored."
        )

    posed = truth is not None and truth.heading is not None
    digests = {"log": digest(recording), "truth": truth.digest if truth else ""}
    seconds, made = float(np.ptp(recording.t)), lru_cache(maxsize=2)(drive)
    return Source(seconds, len(recording.vehicles), marks, posed, digests, made, lambda until: begun(), text)


def near(k: int, loss: float = 0.0) -> V2X:
    """The K nearest vehicles that were seen, and the losses of their messages."""
    return V2X(max_neighbours=k, radius=float("inf"), loss=loss)


def calibrated(p: Params) -> float:
    """s of the first part, which calibrates and starts: of the settings, else 40 % of the drive, 300 s at most.

    Raises:
        InputError: nothing is left to be scored.
    """
    length = source(p["data"]).seconds
    usual = min(LONGEST_CALIBRATION, CALIBRATION_SHARE * length)
    return _set(p, "calibrate_s", usual, np.nextafter(length, 0.0), f"Leave a part of the {length:g} s to score.")


def left(p: Params) -> float:
    """s of the rest, which is scored."""
    return source(p["data"]).seconds - calibrated(p)


def block(p: Params) -> float:
    """s of a block of time, which errors are averaged over: 30 s, a quarter of the rest at most."""
    return min(BLOCK_SECONDS, left(p) / MIN_BLOCKS)


def driven(p: Params) -> float:
    """s of the drive that the bytes are for: set, else the part that is scored."""
    return _set(p, "drive_s", left(p))


def _set(p: Params, name: str, usual: float, most: float = sys.float_info.max, hint: str = "Give seconds.") -> float:
    """A setting in s, or what is usual where there is none; InputError unless it is in 0..most."""
    return float(number(name, usual if p[name] is None else p[name], 0.0, most, hint=hint))


def hashed(*paths: Path) -> str:
    """First 12 hex digits of the SHA-256 of files, or of all in folders."""
    sha = hashlib.sha256()
    for path in paths:
        for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
            sha.update(file.read_bytes() if file.is_file() else b"")
    return sha.hexdigest()[:12]


def thinned(recording: Recording, landmarks: int, start: int) -> Recording:
    """The recording with some of its landmarks from a step on, spread over those that there are.

    Args:
        recording: in body frames.
        landmarks: how many stay, at most.
        start: step.
    """
    marks = np.array(recording.landmarks, int)
    landmarks = min(landmarks, len(marks))
    chosen = marks[(len(marks) / max(landmarks, 1) * np.arange(landmarks)).astype(int)]
    links = recording.links
    gone = np.isin(links.neighbour, marks) & ~np.isin(links.neighbour, chosen) & (links.step >= start)
    return with_links(recording, ~gone)

"""Real drives whose headings are estimated: measurements, first poses, truth, and the part that is scored."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from coopoc import V2X, Fleet, InputError, Links, Recording, pose_start
from coopoc.arrays import Floats
from coopoc.data.fetch import bring
from coopoc.data.log.links import under
from coopoc.data.log.read import Log
from coopoc.data.log.residuals import begin_of, together
from coopoc.data.mrclam import Calibration, MrclamLog, calibrate, pose_recording, read_mrclam, surveyed
from coopoc.data.registry import kind_of, load_log
from coopoc.data.source import split
from coopoc.methods.poses.pose_inputs import SPREAD
from coopoc.study.study import Params
from coopoc.world.storage import digest

LONGEST_CALIBRATION, CALIBRATION_SHARE = 300.0, 0.4
"""s, and share of the drive, that calibrate where the settings leave it open."""
BLOCK, BLOCKS = 30.0, 4
"""s of a block of time, and the least number of blocks, where the settings leave it open."""

POSES: Mapping[str, Mapping[str, Any]] = {
    "pose-solo": {"unit": "solo"},
    "pose-plain": {"unit": "solo", "exact": False, "robust": False, "lasting": False},
    "pose-fleet": {"unit": "fleet"},
    "pose-intersection": {"unit": "fleet", "fusion": "intersection"},
    "pose-naive": {"unit": "fleet", "fusion": "naive"},
}
"""Pose filters by name: their options."""
GATE = 5.0
"""Standard deviations, of all pose filters."""


@dataclass(frozen=True, eq=False)
class Drive:
    """One run of real measurements in body frames.

    Args:
        recording: with all its landmarks.
        begin: first poses (1, N, 4) m and rad, None where first fixes and compasses give them.
        truth: on the steps of the recording, None if there is none.
        lasting: whether scale and bias of the odometry, and the offset of ranges, are states.
        spread: m, m, m and rad of the first poses.
    """

    recording: Recording
    begin: Floats | None
    truth: Fleet | None
    lasting: bool
    spread: tuple[float, ...] = SPREAD

    @property
    def ids(self) -> tuple[str, ...]:
        """Of those that move."""
        return tuple(name for k, name in enumerate(self.recording.ids) if k not in self.recording.landmarks)


def calibrated(p: Params) -> float:
    """s of the first part, which calibrates and starts: of the settings, else 40 % of the drive, 300 s at most.

    Raises:
        InputError: nothing is left to be scored.
    """
    seconds = length(p["data"])
    until = (
        min(LONGEST_CALIBRATION, CALIBRATION_SHARE * seconds) if p["calibrate_s"] is None else float(p["calibrate_s"])
    )
    if not 0 <= until < seconds:
        allowed = f"must be 0 or more and end before the drive, {seconds:g} s"
        raise InputError("calibrate_s", f"{until:g} s", allowed, "Leave a part to score.")
    return until


def block(p: Params) -> float:
    """s of a block of time, which errors are averaged over: set, else 30 s, a quarter of the rest at most."""
    left = length(p["data"]) - calibrated(p)
    return min(BLOCK, left / BLOCKS) if p["block_s"] is None else float(p["block_s"])


def length(data: str) -> float:
    """s of the part of a drive in which all vehicles are there."""
    log = _part(data)
    t = log.fleet.t if isinstance(log, MrclamLog) else log.recording.t
    return float(t[-1] - t[0])


def counts(data: str) -> tuple[int, int]:
    """Numbers of vehicles and of landmarks."""
    log = _part(data)
    if isinstance(log, MrclamLog):
        return len(log.fleet.ids), len(surveyed(log))
    marks = len(log.recording.landmarks)
    return len(log.recording.ids) - marks, marks


def has_true_poses(data: str) -> bool:
    """Whether true poses are known, from which noise is learned."""
    log = _part(data)
    return isinstance(log, MrclamLog) or (log.truth is not None and log.truth.heading is not None)


def check(data: str, until: float) -> None:
    """Read all that cells share.

    Args:
        data: as of `drive`.
        until: as of `drive`.

    Raises:
        InputError: as of `drive`.
    """
    log = _part(data)
    if isinstance(log, MrclamLog):
        surveyed(log), _calibration(data, until)
    else:
        _begin(data)


@lru_cache(maxsize=2)
def drive(data: str, until: float, v2x: V2X) -> Drive:
    """All that was measured, under a channel.

    Args:
        data: a folder of MR.CLAM, whose first part calibrates its sensors, or a log in body frames, which states them.
        until: s, of that part.
        v2x: K, radius and channel.

    Raises:
        InputError: a log that cannot be followed.
    """
    log = _part(data)
    if isinstance(log, MrclamLog):
        recording = under(pose_recording(log, _calibration(data, until)), v2x, logged=False)
        return Drive(recording, pose_start(recording, gate=GATE), log.fleet, True)
    recording = under(log.recording, v2x, logged=log.messages)
    stated = recording.sensors
    lasting = max(stated.speed_scale_std, stated.yaw_rate_bias_std, stated.range_offset_std) > 0
    begin, spread, _ = _begin(data)
    return Drive(recording, begin, log.truth, lasting, spread)


def described(data: str) -> str:
    """What was measured, and where its noise comes from, for captions."""
    log = _part(data)
    if isinstance(log, MrclamLog):
        return "Wheel odometry, ranges and bearings of {}; no fix, no compass. The first {:.3g} s calibrate the noise."
    read = ", ".join(f"{number} {what}" for what, number in log.summary.read.items() if number)
    where = "" if (span := _log(data)[1]) == "throughout" else f" {span},"
    noise = f"with the noise that it states{_begin(data)[2]}; the first {{:.3g}} s are not scored."
    return f"What {{}} holds ({read}),{where} {noise}"


def digests(data: str) -> dict[str, str]:
    """Digest of all that the numbers of a drive are made of."""
    log = _part(data)
    if not isinstance(log, MrclamLog):
        truth = "" if log.truth is None else log.truth.digest
        return {"log": digest(log.recording), "truth": truth}
    return {"log": hashed(Path(split(data)[0]))}


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
    marks = np.array(recording.landmarks, dtype=np.int64)
    landmarks = min(landmarks, len(marks))
    every = len(marks) / max(landmarks, 1)
    chosen = marks[(every * np.arange(landmarks)).astype(np.int64)]
    links = recording.links
    gone = np.isin(links.neighbour, marks) & ~np.isin(links.neighbour, chosen) & (links.step >= start)
    fewer = Links(links.step[~gone], links.observer[~gone], links.neighbour[~gone])
    return replace(recording, links=fewer, relative=recording.relative[:, ~gone], arrival=recording.arrival[:, ~gone])


def _part(data: str) -> MrclamLog | Log:
    """What is followed: of a log in body frames its longest part in which all vehicles are there."""
    return _log(data)[0]


@lru_cache(maxsize=2)
def _log(data: str) -> tuple[MrclamLog | Log, str]:
    """That, and where it is in words."""
    name, kind = split(data)[0], kind_of(data)
    if kind == "mrclam":
        return read_mrclam(Path(name)), "throughout"
    if kind not in ("log", "pyfg", "recording"):
        hint = "Check it; a log may hold what vehicles measured (docs/your_data.md), a folder a set of MR.CLAM."
        allowed = "must be the path of measurements, not only of drives"
        raise InputError("data", repr(data), allowed, hint if Path(name).exists() else bring(name, hint))
    log = load_log(data)
    if log.recording.body is None:
        hint = f"Take coopoc run side_by_side --data {data!r}."
        raise InputError("data", repr(data), "is a log in the world's frame, and filters here estimate headings", hint)
    return together(log)


@lru_cache(maxsize=2)
def _calibration(data: str, until: float) -> Calibration:
    log = _part(data)
    assert isinstance(log, MrclamLog)
    return calibrate(log, until)


@lru_cache(maxsize=2)
def _begin(data: str) -> tuple[Floats | None, tuple[float, ...], str]:
    log = _part(data)
    assert isinstance(log, Log)
    return begin_of(log)

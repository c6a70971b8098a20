"""Real vehicles with nothing simulated: when does a neighbour replace a landmark, such as a road-side unit?"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from coopoc.arrays import Floats
from coopoc.data.source import split
from coopoc.errors import InputError
from coopoc.evaluate.ledger import of_track
from coopoc.evaluate.metrics import errors, fix_innovations, heading_error, pose_nees
from coopoc.learned.pose_noise import PoseTask, fit_pose_noise
from coopoc.methods.poses.pose_filter import PoseFilter
from coopoc.methods.track import Track
from coopoc.study.environment import revision
from coopoc.study.study import Params, Row, Study
from coopoc.world.sensors import Sensors
from coopoc.world.v2x import V2X

from . import pose_drives as drives
from . import real_views as views
from .pose_drives import Drive, thinned
from .scene import CODE

METHODS: Mapping[str, Mapping[str, Any]] = dict(
    zip((*views.METHODS, views.LEARNED), ({}, {"fusion": "intersection"}, {"fusion": "naive"}, {}), strict=True)
)
TRAINING, SETTLED = (1, 4, 15), 30.0
"""Landmarks of the drives that noise is learned on, and s until they are thinned, a tenth of that part at most."""


@lru_cache(maxsize=1)
def learned(data: str, until: float, gate: float, evaluations: int) -> Sensors:
    """Noise learned on the part that calibrates, alone and together, with few landmarks and with all."""
    vehicles, marks = drives.counts(data)
    tasks = []
    for k in dict.fromkeys((0, min(max(views.NEIGHBOURS), vehicles - 1))):
        drive = drives.drive(data, until, V2X(max_neighbours=k, radius=float("inf")), gate)
        assert drive.truth is not None
        steps, settled = (int(s / drive.recording.dt) for s in (until, min(SETTLED, until / 10)))
        method = _filter({}, k, gate, drive)
        for landmarks in dict.fromkeys(min(n, marks) for n in TRAINING):
            part = thinned(drive.recording, landmarks, settled).between(0, steps)
            tasks.append(PoseTask(part, drive.truth.between(0, steps), drive.ids, method, settled))
    return fit_pose_noise(tasks, drive.recording.sensors, evaluations)


def channel(p: Params) -> V2X:
    """The K nearest vehicles that were seen, and the losses of their messages."""
    return V2X(max_neighbours=int(p["max_neighbours"]), radius=float("inf"), loss=float(p["loss"]))


def key(p: Params) -> dict[str, str]:
    """Digests of the code and of the measurements.

    Raises:
        InputError: data or a part to calibrate on that cannot be used, an unknown method.
    """
    if p["method"] not in METHODS:
        raise InputError("method", p["method"], f"must be among {list(METHODS)}", "Name one of them.")
    drives.check(str(p["data"]), drives.calibrated(p), float(p["gate"]))
    channel(p)
    return {"code": revision(*CODE), **drives.digests(str(p["data"]))}


def applies(p: Params) -> bool:
    """Whether the data has so many vehicles and landmarks, and the method needs what there is."""
    k, n, method, data = int(p["max_neighbours"]), int(p["landmarks"]), p["method"], str(p["data"])
    if not Path(split(data)[0]).exists():
        return True  # the key names what is wrong
    vehicles, marks = drives.counts(data)
    if k == 0 and method not in ("pose-fleet", views.LEARNED):
        return False
    ends = (0, min(max(views.NEIGHBOURS), vehicles - 1))
    if method == views.LEARNED and not (k in ends and drives.has_true_poses(data) and drives.calibrated(p)):
        return False
    return _distinct(k, views.NEIGHBOURS, vehicles - 1) and _distinct(n, views.LANDMARKS, marks)


def cell(p: Params) -> list[Row]:
    """Rows of one number of neighbours and landmarks: a vehicle and a block of time each."""
    data, until, gate, drive = str(p["data"]), drives.calibrated(p), float(p["gate"]), _drive(p)
    dt = drive.recording.dt
    start, block = int(until / dt), max(int(drives.block(p) / dt), 1)
    method = _filter(METHODS[p["method"]], int(p["max_neighbours"]), gate, drive)
    if p["method"] == views.LEARNED:
        method = replace(method, assumed=learned(data, until, gate, int(p["evaluations"])))
    recording = thinned(drive.recording, int(p["landmarks"]), start)
    track = method(recording, drive.ids)
    account = of_track(track, recording, method.message)
    sent, received = (account.of("online", "on air", way) / account.seconds for way in ("broadcast", "per receiver"))
    scores = _scores(track, drive)
    rows: list[Row] = []
    for ego, name in enumerate(drive.ids):
        for number, first in enumerate(range(start, len(recording.t) - block + 1, block)):
            found = {what: _reduced(what, score[first : first + block, ego]) for what, score in scores.items()}
            if any(np.isfinite(value) for value in found.values()):
                found["bytes_per_second"] = float(received[0, ego])
                found["sent_bytes_per_second"] = float(sent[0, ego])
                rows.append({"run": number, "ego": name, **found})
    return rows


def _drive(p: Params) -> Drive:
    return drives.drive(str(p["data"]), drives.calibrated(p), channel(p), float(p["gate"]))


def _filter(fusion: Mapping[str, Any], k: int, gate: float, drive: Drive) -> PoseFilter:
    unit: Any = "fleet" if k else "solo"
    return PoseFilter(
        unit, **(fusion if k else {}), lasting=drive.lasting, gate=gate, begin=drive.begin, spread=drive.spread
    )


def _scores(track: Track, drive: Drive) -> dict[str, Floats]:
    """Column -> (T, E) against the truth, as far as it is known, and innovations of the fixes, if there are any."""
    found = {}
    if drive.truth is not None:
        found["rt_le_m"] = errors(track, drive.truth)[0]
        if drive.truth.heading is not None:
            found["heading_deg"] = np.rad2deg(heading_error(track, drive.truth)[0])
            found["nees"] = pose_nees(track, drive.truth)[0]
    innovation = np.linalg.norm(fix_innovations(track, drive.recording)[0], axis=-1)
    return found | ({"innovation_m": innovation} if np.isfinite(innovation).any() else {})


def _reduced(what: str, values: Floats) -> float:
    """Root mean square of errors, mean of a NEES; NaN of none."""
    known = values[np.isfinite(values)]
    if not len(known):
        return float("nan")
    return float(known.mean()) if what == "nees" else float(np.sqrt((known**2).mean()))


def _distinct(number: int, axis: tuple[int, ...], most: int) -> bool:
    """Whether a number is not above all that there are, or is the first of the usual ones that is."""
    return number <= most or (number in axis and all(other < most for other in axis if other < number))


STUDY = Study(
    "real",
    "With nothing simulated and headings estimated, when does a neighbour replace a landmark?",
    cell,
    {"method": tuple(METHODS), "max_neighbours": views.NEIGHBOURS, "landmarks": views.LANDMARKS},
    settings={
        "data": "MRCLAM_Dataset6",
        "calibrate_s": None,
        "block_s": None,
        "gate": 5.0,
        "loss": 0.0,
        "evaluations": 150,
    },
    key=key,
    where=applies,
    shares=("max_neighbours",),
    tables={
        "rt_le": partial(views.table, value="rt_le_m", text="RT-LE [m], K neighbours against landmarks.", decimals=3),
        "heading": partial(views.table, value="heading_deg", text="Rms of the heading error [°].", decimals=1),
        "innovation": partial(
            views.table,
            value="innovation_m",
            text="RMS innovation of the fixes [m]: how well the pose before predicts a fix.",
        ),
        "nees": partial(views.table, value="nees", text="NEES of a pose (3 is consistent).", decimals=1),
        "bytes": views.bytes,
        "learned": views.learned,
        "fusion": partial(views.fusions, value="rt_le_m", text="RT-LE [m] of the ways of fusion", decimals=3),
        "fusion_nees": partial(views.fusions, value="nees", text="NEES of the ways of fusion", best=None, decimals=1),
    },
    figures={"rt_le": views.figure},
    findings=views.findings,
    limitations=(
        "The truth is used on the first part alone: noise, scales and lag of MR.CLAM's odometry are calibrated "
        "against Vicon, and noise is learned there.",
        "One drive: intervals over blocks of time do not extend to other vehicles or places.",
        "With one joint state a centre receives every measurement at its step; late messages are lost.",
    ),
    minutes=3,
)

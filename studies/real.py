"""Real robots with nothing simulated: when does a neighbour replace a landmark, such as a road-side unit?"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from coopoc.arrays import Floats
from coopoc.data.mrclam import MrclamLog, read_mrclam
from coopoc.data.mrclam_calibration import Calibration, calibrate
from coopoc.data.mrclam_poses import pose_recording, surveyed, thinned
from coopoc.errors import InputError
from coopoc.evaluate.ledger import of_track
from coopoc.evaluate.metrics import errors
from coopoc.evaluate.pose_metrics import heading_error, pose_nees
from coopoc.learned.pose_noise import PoseTask, fit_pose_noise
from coopoc.methods.pose_filter import PoseFilter
from coopoc.methods.pose_start import pose_start
from coopoc.study.environment import revision
from coopoc.study.study import Params, Row, Study
from coopoc.world.recording import Recording
from coopoc.world.sensors import Sensors
from coopoc.world.v2x import V2X

from . import real_views as views
from .scene import CODE

METHODS: Mapping[str, Mapping[str, Any]] = dict(
    zip((*views.METHODS, views.LEARNED), ({}, {"fusion": "intersection"}, {"fusion": "naive"}, {}), strict=True)
)
TRAINING, SETTLED = (1, 4, 15), 30.0
"""Landmarks of the drives that noise is learned on, and s until they are thinned there."""


@lru_cache(maxsize=2)
def log(data: str, until: float) -> tuple[MrclamLog, Calibration]:
    """A folder of MR.CLAM and its calibration."""
    found = read_mrclam(Path(data))
    return found, calibrate(found, until)


@lru_cache(maxsize=2)
def seen(data: str, until: float, v2x: V2X, gate: float) -> tuple[Recording, Floats]:
    """All that the robots measured, and their first poses."""
    recording = pose_recording(log(data, until)[0], v2x, log(data, until)[1])
    return recording, pose_start(recording, gate=gate)


@lru_cache(maxsize=1)
def learned(data: str, until: float, gate: float, evaluations: int) -> Sensors:
    """Noise learned on the part that calibrates, alone and together, with few landmarks and with all."""
    found, known = log(data, until)
    steps, settled, tasks = int(until / found.fleet.dt), int(SETTLED / found.fleet.dt), []
    for k in (0, max(views.NEIGHBOURS)):
        whole, begin = seen(data, until, V2X(max_neighbours=k, radius=float("inf")), gate)
        unit: Any = "fleet" if k else "solo"
        method = PoseFilter(unit, lasting=True, gate=gate, begin=begin)
        for landmarks in TRAINING:
            part = thinned(whole, landmarks, settled).between(0, steps)
            tasks.append(PoseTask(part, found.fleet.between(0, steps), found.fleet.ids, method, settled))
    return fit_pose_noise(tasks, known.sensors, evaluations)


def channel(p: Params) -> V2X:
    """The K nearest robots that were seen, and the losses of their messages."""
    return V2X(max_neighbours=int(p["max_neighbours"]), radius=float("inf"), loss=float(p["loss"]))


def key(p: Params) -> dict[str, str]:
    """Digests of the code and of the log.

    Raises:
        InputError: a folder or a part to calibrate on that cannot be used, an unknown method.
    """
    if p["method"] not in METHODS:
        raise InputError("method", p["method"], f"must be among {list(METHODS)}", "Name one of them.")
    found, _ = log(str(p["data"]), float(p["calibrate_s"]))
    surveyed(found), channel(p)
    sha = hashlib.sha256()
    for file in sorted(Path(str(p["data"])).glob("*.dat")):
        sha.update(file.name.encode() + file.read_bytes())
    return {"code": revision(*CODE), "log": sha.hexdigest()}


def cell(p: Params) -> list[Row]:
    """Rows of one number of neighbours and landmarks: a robot and a block of time each."""
    data, until, gate = str(p["data"]), float(p["calibrate_s"]), float(p["gate"])
    whole, begin = seen(data, until, channel(p), gate)
    fleet = log(data, until)[0].fleet
    start, block = int(until / fleet.dt), max(int(float(p["block_s"]) / fleet.dt), 1)
    unit: Any = "fleet" if p["max_neighbours"] else "solo"
    how = METHODS[p["method"]] if p["max_neighbours"] else {}
    assumed = learned(data, until, gate, int(p["evaluations"])) if p["method"] == views.LEARNED else None
    method = PoseFilter(unit, **how, lasting=True, gate=gate, begin=begin, assumed=assumed)
    recording = thinned(whole, int(p["landmarks"]), start)
    track = method(recording, fleet.ids)
    account = of_track(track, recording, method.message)
    sent, received = (account.of("online", "on air", way) / account.seconds for way in ("broadcast", "per receiver"))
    position, heading, nees = errors(track, fleet)[0], heading_error(track, fleet)[0], pose_nees(track, fleet)[0]
    rows: list[Row] = []
    for ego, name in enumerate(fleet.ids):
        for number, first in enumerate(range(start, len(fleet.t) - block + 1, block)):
            part = slice(first, first + block), ego
            if np.isfinite(position[part]).any():
                found = {"rt_le_m": _rms(position[part]), "heading_deg": float(np.rad2deg(_rms(heading[part])))}
                found |= {"nees": float(np.nanmean(nees[part])), "bytes_per_second": float(received[0, ego])}
                found["sent_bytes_per_second"] = float(sent[0, ego])
                rows.append({"run": number, "ego": name, **found})
    return rows


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


def _grid() -> list[dict[str, Any]]:
    cases = [
        (method, k, n)
        for method in METHODS
        for k in views.NEIGHBOURS
        for n in views.LANDMARKS
        if (k or method in ("pose-fleet", views.LEARNED))
        and (method != views.LEARNED or k in (0, max(views.NEIGHBOURS)))
    ]
    return [{"method": method, "max_neighbours": k, "landmarks": n} for method, k, n in cases]


STUDY = Study(
    "real",
    "With nothing simulated and headings estimated, when does a neighbour replace a landmark?",
    cell,
    _grid(),
    settings={
        "data": "MRCLAM_Dataset6",
        "calibrate_s": 300.0,
        "block_s": 30.0,
        "gate": 5.0,
        "loss": 0.0,
        "evaluations": 150,
    },
    key=key,
    shares=("max_neighbours",),
    tables={
        "rt_le": partial(views.table, value="rt_le_m", text="RT-LE [m], K neighbours against landmarks.", decimals=3),
        "heading": partial(views.table, value="heading_deg", text="Rms of the heading error [°].", decimals=1),
        "nees": partial(views.table, value="nees", text="NEES of a pose (3 is consistent).", decimals=1),
        "bytes": views.bytes,
        "learned": views.learned,
        "fusion": partial(views.fusions, value="rt_le_m", text="RT-LE [m] of the ways of fusion, K = 4.", decimals=3),
        "fusion_nees": partial(views.fusions, value="nees", text="NEES, K = 4.", best=None, decimals=1),
    },
    figures={"rt_le": views.figure},
    findings=views.findings,
    limitations=(
        "Noise, scales and lag of odometry are calibrated against Vicon on the first part, the only use of truth.",
        "One drive: an interval over blocks of time does not hold for other robots or rooms.",
        "With one state a centre receives all that is measured, at its step; late messages are lost.",
    ),
    minutes=3,
)

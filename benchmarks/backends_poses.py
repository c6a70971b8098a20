"""The pose smoother against a hand-written loop on GTSAM's incremental fixed-lag smoother."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from backends_star import Job, Row

import coopoc as co
from coopoc.methods.poses.pose_factors import PoseRun, pose_subgraph

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))
from oracles.pose_smoother import by_hand

LAG = 5.05
NOISE = co.Sensors(
    velocity_reading="speed", range_std=0.3, azimuth_std=0.02, inclination_std=0.02, heading_std=0.05, yaw_rate_std=0.02
)


def convoy(steps: int) -> co.Recording:
    """Four vehicles that wind along at 10 m/s, 8 m apart, and two masts."""
    t = 0.1 * np.arange(steps)
    course = 0.5 * np.sin(0.3 * t[:, None] + 0.4 * np.arange(4))
    velocity = 10 * np.stack([np.cos(course), np.sin(course), 0 * course], axis=2)
    position = 8.0 * np.arange(4)[:, None] * [1, 0, 0] + np.cumsum(0.1 * velocity, axis=0)
    masts = np.broadcast_to([[0.0, 12, 0], [40, -9, 0]], (steps, 2, 3))
    moving = np.append(velocity, 0 * masts, axis=1)
    fleet = co.Fleet(("a", "b", "c", "d", "m", "n"), t, np.append(position, masts, axis=1), moving)
    return co.observe(fleet, NOISE, co.V2X(max_neighbours=3), frame="body", landmarks=["m", "n"])


def pose_lag(steps: int = 150) -> Job:
    """Poses, fixes, compasses, ranges and bearings, a lag of fifty steps; the loop's numbers are made beforehand."""
    recording, smoother = convoy(steps), co.PoseSmoother(LAG)
    drive = PoseRun(recording, 0, NOISE, np.full((len(recording.ids), 4), np.nan), np.array(smoother.spread))
    known: dict[str, Any] = {}
    parts = []
    for step, found in enumerate(smoother.estimates(recording)):
        parts.append(pose_subgraph(drive, step, known))
        marks = dict(zip(parts[-1].names, parts[-1].x0, strict=True))  # type: ignore[arg-type]
        known |= {name: x for name, x in marks.items() if "@" not in name}
        known |= dict(zip(found.names, found.x, strict=True))

    def mine() -> Any:
        return np.stack([found.x[:, :2] for found in smoother.estimates(recording)])

    def hand() -> Any:
        return by_hand(parts, LAG, recording.dt)

    best = hand()
    job = "gtsam, fixed lag, poses"
    rows = [Row(job, "ours", steps, mine), Row(job, "hand-written", steps, hand)]
    return Job(rows, lambda x: float(np.abs(x - best).max()) < 0.01)

"""Clocks that disagree in a log in body frames: the log is turned into the world, where `log_clocks` looks at it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from coopoc.arrays import Floats
from coopoc.methods.pose_filter import PoseFilter
from coopoc.world.body_frames import midway, turned
from coopoc.world.links import wrap
from coopoc.world.recording import Recording

from .log_check import relative_residuals
from .log_clocks import clock_warnings

GATE = 5.0
"""Of the filters that check a log: standard deviations beyond which a measurement is left out."""


def clocks(rec: Recording, begin: Floats | None, who: Sequence[int]) -> tuple[Recording, list[str]]:
    """A recording in body frames, turned into the world by a filter of each vehicle alone, and what its clocks say.

    Args:
        rec: all vehicles there throughout.
        begin: first poses, None where fixes and compasses give them.
        who: columns of the vehicles.
    """
    size = len(rec.t), len(rec.ids)
    track = PoseFilter("solo", gate=GATE, begin=begin)(rec, who)
    assert track.heading is not None
    assert track.heading_covariance is not None
    assert track.covariance is not None
    x, variance, heading, unsure = np.zeros((*size, 3)), np.zeros((*size, 3)), np.zeros(size), np.zeros(size)
    x[:, list(rec.landmarks)] = rec.gnss[0][:, list(rec.landmarks)]
    x[:, who], heading[:, who], unsure[:, who] = track.x[0], track.heading[0], track.heading_covariance[0, ..., 3]
    variance[:, who] = np.diagonal(track.covariance[0], axis1=-2, axis2=-1)
    relative, at = rec.relative[:1].copy(), (rec.links.step, rec.links.observer)
    relative[..., 1] = wrap(relative[..., 1] + heading[at])
    first = rec.of_runs(slice(0, 1))
    world = replace(first, body=None, velocity=turned(first.velocity, midway(heading)), relative=relative)
    residual, expected = relative_residuals(world, x, variance)
    expected[:, 1] = np.sqrt(expected[:, 1] ** 2 + unsure[at])
    return world, clock_warnings(world, x, residual, expected)

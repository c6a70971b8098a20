"""Decentralised fusion of poses: the state of each member and of the one that it measured, and no other covariances."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..compiling.compile import part
from .pose_motion import PoseNoise
from .pose_rows import update_relative
from .pose_update import AT, KEPT, Poses, X, settle

TRIED = 10
"""Weights that covariance intersection tries."""
LEAST = 1e-9


@part
def fuse_pairs(poses: Poses, seen: Any, noise: PoseNoise, at: tuple[int, int], options: Any) -> None:
    """Update the observer of each relative measurement with the estimate of the member that it measured.

    Their joint covariance is taken as block diagonal, each block over its weight: 1 and 1 if the errors were
    independent, w and 1 - w for a bound whatever their correlation (covariance intersection), with the w that
    minimises the sum of the observer's d variances, each over what it was: at most d, so that their product never grows
    (a trace of the position alone would let headings grow without end). What the measured member would learn is
    dropped.

    Args:
        poses: the state; covariances between members are zero.
        seen: `PoseSeen`.
        noise: that is assumed.
        at: run and step.
        options: `PoseOptions`, its fusion not JOINT.

    References:
        Carrillo-Arce et al., Decentralized multi-robot cooperative localization using covariance intersection,
        IROS 2013.
    """
    (run, t), d, size = at, options.d, options.d * (seen.start[at[1] + 1] - seen.start[at[1]])
    for k in range(seen.first[t], seen.first[t + 1]):
        pair = (d * seen.ends[k, 0], d * seen.ends[k, 1])
        set_aside(poses, pair, d, np.int64(1))
        tries = TRIED if options.fusion == 2 and pair[1] >= 0 else 0
        best, chosen = math.inf, 1.0
        for attempt in range(tries + 1):
            weight = chosen if attempt == tries else (attempt + 1.0) / TRIED
            found = fuse(poses, seen, noise, (run, k), (d, size), weight, tries > 0)
            if attempt == tries:
                take_block(poses, pair[0], d)
            elif found < best:
                best, chosen = found, weight
            set_aside(poses, pair, d, np.int64(0))


@part
def fuse(poses: Poses, seen: Any, noise: PoseNoise, at: Any, sizes: Any, weight: float, weighs: bool) -> float:
    """Weigh both blocks, add one relative measurement; sum of the observer's variances over those before."""
    (run, k), (d, size) = at, sizes
    observer, other = d * seen.ends[k, 0], d * seen.ends[k, 1]
    if weighs:
        for i in range(d):
            for j in range(d):
                poses.cov[observer + i, observer + j] /= weight
                poses.cov[other + i, other + j] /= max(1.0 - weight, LEAST)
    for i in range(size):
        poses.vector[AT, i] = poses.vector[X, i]
    place = (seen.place[k, 0], seen.place[k, 1], seen.place[k, 2])
    found = (seen.relative[run, k, 0], seen.relative[run, k, 1], seen.relative[run, k, 2])
    update_relative(poses, size, (observer, other, np.int64(0)), place, found, (noise.relative, noise.gate))
    settle(poses, size)
    total = 0.0
    for i in range(observer, observer + d):
        if poses.kept[i, i] > 0.0:
            total += poses.cov[i, i] / poses.kept[i, i]
    return total


@part
def set_aside(poses: Poses, pair: tuple[int, int], d: int, away: Any) -> None:
    """Set the state and the covariance of two members aside (1), or bring them back (0)."""
    for first in pair:
        for i in range(first, first + d if first >= 0 else first):
            poses.vector[KEPT if away else X, i] = poses.vector[X if away else KEPT, i]
            for second in pair:
                for j in range(second, second + d if second >= 0 else second):
                    if away:
                        poses.kept[i, j] = poses.cov[i, j]
                    else:
                        poses.cov[i, j] = poses.kept[i, j]


@part
def take_block(poses: Poses, block: int, d: int) -> None:
    """Keep what was found of one member."""
    for i in range(block, block + d):
        poses.vector[KEPT, i] = poses.vector[X, i]
        for j in range(block, block + d):
            poses.kept[i, j] = poses.cov[i, j]

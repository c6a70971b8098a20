"""The pose filter of one unit: a vehicle alone, the star of an ego, or a whole fleet, over a whole drive.

Members come and go; each has a block of the state. What a unit knows of a step is a list of members with the newest
message of each, and a list of relative measurements between members or to landmarks.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..arrays import Floats, Ints
from .compile import compiled, inside
from .pose_members import PoseSeen, arrange, place_at
from .pose_motion import PoseNoise, velocity_variances
from .pose_pairs import fuse_pairs
from .pose_rows import retract, update_fix, update_heading, update_relative, wrapped
from .pose_update import AT, KEPT, PENDING, TOTAL, Poses, X, new_poses, settle

UNPLACED = 7
"""Bits of all components: nothing is known of the place of one of the two."""
JOINT, NAIVE, INTERSECTION = range(3)
"""How two estimates are fused: in one state, as if their errors were independent, by covariance intersection."""


class PoseOptions(NamedTuple):
    """How a unit filters.

    Attributes:
        d: numbers of a member, 4 or 6.
        passes: of the relative measurements, each linear at the state that the last one found.
        invariant: whether the error is that of the group SE(2), right-invariant.
        fusion: JOINT, NAIVE or INTERSECTION.
    """

    d: int
    passes: int
    invariant: bool
    fusion: int


@compiled
def follow(
    seen: PoseSeen, noise: PoseNoise, begin: Floats, spread: Floats, options: PoseOptions
) -> tuple[Floats, Floats, Floats]:
    """State (R, M, d) of every member, its covariance (R, M, d, d), and cost and number of measurements (R, 2).

    Args:
        seen: measurements.
        noise: that is assumed.
        begin: (R, N, 4) m and rad, poses at the first step; NaN for the first fix and compass.
        spread: (4,) standard deviations of these.
        options: of the filter.
    """
    runs, members, d = len(seen.gnss), len(seen.member), options.d
    most = 0
    for t in range(len(seen.start) - 1):
        most = max(most, seen.start[t + 1] - seen.start[t])
    x, cov, cost = np.empty((runs, members, d)), np.empty((runs, members, d, d)), np.empty((runs, 2))
    poses, uses = new_poses(max(most, 2) * d), np.zeros(2 * most)
    left_out = np.zeros(seen.relative.shape[1], dtype=np.int64)
    for run in range(runs):
        poses.vector[TOTAL, 0] = poses.vector[TOTAL, 1] = poses.vector[TOTAL, PENDING] = 0.0
        for t in range(len(seen.start) - 1):
            first, count = seen.start[t], seen.start[t + 1] - seen.start[t]
            arrange(poses, seen, noise, (run, t), d, uses)
            if t == 0:
                place_at(poses, seen, begin, spread, run, d)
            for k in range(count):
                add_own(poses, seen, noise, (run, t, k), (d, count * d))
            settle(poses, count * d)
            if options.fusion == JOINT:
                add_relative(poses, seen, noise, (run, t), options, left_out)
            else:
                fuse_pairs(poses, seen, noise, (run, t), options)
            for k in range(count):
                for i in range(d):
                    x[run, first + k, i] = poses.vector[X, d * k + i]
                    for j in range(d):
                        cov[run, first + k, i, j] = poses.cov[d * k + i, d * k + j]
        cost[run, 0], cost[run, 1] = poses.vector[TOTAL, 0], poses.vector[TOTAL, 1]
    return x, cov, cost


@inside
def add_own(poses: Poses, seen: PoseSeen, noise: PoseNoise, at: tuple[int, int, int], sizes: tuple[int, int]) -> None:
    """A member's fix and compass, once each; those of an older message are brought forward by its odometry."""
    (run, t, k), (d, size) = at, sizes
    i = seen.start[t] + k
    sent, column = seen.newest[run, i], seen.member[i]
    if sent < 0 or not seen.fresh[run, i]:
        return
    late = seen.dt * (t - sent)
    heading, fix = seen.heading[run, sent, column], seen.gnss[run, sent, column]
    u, rate = seen.velocity[run, sent, column], seen.yaw_rate[run, sent, column]
    if not math.isnan(heading):
        variance = noise.heading + late * late * noise.yaw_rate
        update_heading(poses, size, k * d, wrapped(heading + late * rate), variance, noise.gate)
    if not math.isnan(fix[0]):
        motion = (late * u[0], late * u[1], late * u[2])
        q = velocity_variances((u[0], u[1], u[2]), noise)
        wide = late * late * max(q[0], q[1], q[2])
        found = (fix[0], fix[1], fix[2], noise.fix[0] + wide, noise.fix[1] + wide, noise.fix[2] + wide)
        update_fix(poses, size, k * d, found, motion, noise.gate)


@inside
def add_relative(
    poses: Poses, seen: PoseSeen, noise: PoseNoise, at: tuple[int, int], options: PoseOptions, left_out: Ints
) -> None:
    """All relative measurements of a step, pass after pass: the first linear at the state after the fixes, each of the
    others at what the last one found, from the same prior."""
    run, t = at
    d, size = options.d, options.d * (seen.start[t + 1] - seen.start[t])
    begin, end = seen.first[t], seen.first[t + 1]
    if begin == end:
        return
    for i in range(size if options.passes > 1 else 0):
        poses.vector[KEPT, i] = poses.vector[X, i]
        for j in range(size):
            poses.kept[i, j] = poses.cov[i, j]
    for k in range(begin, end):
        i, j = d * seen.observer[k], d * max(seen.other[k], 0)
        left_out[k] = UNPLACED if max(poses.cov[i, i], poses.cov[j, j]) > 0.5 * noise.flat else 0
    for again in range(options.passes):
        for i in range(size):
            poses.vector[AT, i] = poses.vector[X, i]
        if again:
            for i in range(size):
                poses.vector[X, i] = poses.vector[KEPT, i]
                for j in range(size):
                    poses.cov[i, j] = poses.kept[i, j]
        for k in range(begin, end):
            place = (seen.place[k, 0], seen.place[k, 1], seen.place[k, 2])
            ends = (d * seen.observer[k], d * seen.other[k], left_out[k])
            found = (seen.relative[run, k, 0], seen.relative[run, k, 1], seen.relative[run, k, 2])
            left_out[k] = update_relative(poses, size, ends, place, found, (noise.relative, noise.gate))
        settle(poses, size)
    if options.invariant:
        retract(poses, size)

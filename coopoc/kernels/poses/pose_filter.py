"""The pose filter of one unit: a vehicle alone, the star of an ego, or a whole fleet, over a whole drive.

Members come and go; each has a block of the state. What a unit knows of a step is a list of members with the newest
message of each, and a list of relative measurements between members or to landmarks.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ...arrays import Floats, Ints
from ..compiling.compile import compiled, part, storage
from .pose_members import PoseSeen, arrange, own_of, place_at
from .pose_motion import PoseNoise, velocity_variances
from .pose_pairs import fuse_pairs
from .pose_rows import retract, update_fix, update_heading, update_relative, wrapped
from .pose_update import AT, KEPT, PENDING, TOTAL, Poses, X, settle

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
        first: step to begin with; the state is then that of the step before.
    """

    d: int
    passes: int
    invariant: bool
    fusion: int
    first: int


class PoseMemory(NamedTuple):
    """What a filter keeps from step to step.

    Attributes:
        poses: states and covariances.
        uses: (2 most,) steps that the newest odometry of each member has served, now and one step before.
    """

    poses: Poses
    uses: Floats


@compiled
def follow(
    seen: PoseSeen, noise: PoseNoise, begin: Floats, spread: Floats, options: PoseOptions, memory: PoseMemory
) -> tuple[Floats, Floats, Floats]:
    """State (R, M, d) of every member, its covariance (R, M, d, d), and cost and number of measurements (R, 2).

    Args:
        seen: measurements.
        noise: that is assumed.
        begin: (R, N, 4) m and rad, poses at the first step; NaN for the first fix and compass.
        spread: (4,) standard deviations of these.
        options: of the filter, which fuses in one state.
        memory: room for the most members of a step; of one run its state before the first step, and after the last.
    """
    x, cov, cost = room(seen, options.d)
    left_out = np.zeros(seen.relative.shape[1], dtype=np.int64)
    for run in range(len(seen.own)):
        for t in range(options.first, len(seen.start) - 1):
            add_own(memory, seen, noise, (run, t), (begin, spread), options.d)
            add_relative(memory.poses, seen, noise, (run, t), options, left_out)
            keep(memory.poses, seen, (run, t), options.d, (x, cov, cost))
    return x, cov, cost


@compiled
def follow_apart(
    seen: PoseSeen, noise: PoseNoise, begin: Floats, spread: Floats, options: PoseOptions, memory: PoseMemory
) -> tuple[Floats, Floats, Floats]:
    """As `follow`, of members that fuse each other's estimates and know no covariances between them."""
    x, cov, cost = room(seen, options.d)
    for run in range(len(seen.own)):
        for t in range(options.first, len(seen.start) - 1):
            add_own(memory, seen, noise, (run, t), (begin, spread), options.d)
            fuse_pairs(memory.poses, seen, noise, (run, t), options)
            keep(memory.poses, seen, (run, t), options.d, (x, cov, cost))
    return x, cov, cost


@storage
def room(seen: PoseSeen, d: int) -> tuple[Floats, Floats, Floats]:
    """Arrays for what is found of all members at all steps."""
    runs, members = len(seen.own), len(seen.member)
    return np.empty((runs, members, d)), np.empty((runs, members, d, d)), np.zeros((runs, 2))


@part
def keep(poses: Poses, seen: PoseSeen, at: tuple[int, int], d: int, found: tuple[Floats, Floats, Floats]) -> None:
    """Write down states, covariances and the sums so far."""
    (run, t), (x, cov, cost), vector, state_cov = at, found, poses.vector, poses.cov
    first = seen.start[t]
    for k in range(seen.start[t + 1] - first):
        for i in range(d):
            x[run, first + k, i] = vector[X, d * k + i]
            for j in range(d):
                cov[run, first + k, i, j] = state_cov[d * k + i, d * k + j]
    cost[run, 0], cost[run, 1] = vector[TOTAL, 0], vector[TOTAL, 1]


@part
def add_own(memory: PoseMemory, seen: PoseSeen, noise: PoseNoise, at: tuple[int, int], known: Any, d: int) -> None:
    """The members of a step in their order, moved, with the fix and the compass of each.

    Args:
        memory: of the step before.
        seen: measurements.
        noise: that is assumed.
        at: run and step.
        known: poses at the first step, and their standard deviations.
        d: numbers of a member.
    """
    (run, t), (begin, spread), poses = at, known, memory.poses
    if t == 0:
        poses.vector[TOTAL, 0] = poses.vector[TOTAL, 1] = poses.vector[TOTAL, PENDING] = 0.0
    arrange(poses, seen, noise, (run, t), d, memory.uses)
    if t == 0:
        place_at(poses, seen, begin, spread, run, d)
    count = seen.start[t + 1] - seen.start[t]
    for k in range(count):
        add_one(poses, seen, noise, (run, t, k), (d, count * d))
    settle(poses, count * d)


@part
def add_one(poses: Poses, seen: PoseSeen, noise: PoseNoise, at: tuple[int, int, int], sizes: tuple[int, int]) -> None:
    """A member's fix and compass, once each; those of an older message are brought forward by its odometry."""
    (run, t, k), (d, size) = at, sizes
    i = seen.start[t] + k
    sent, column = seen.newest[run, i], seen.member[i]
    if sent < 0 or not seen.fresh[run, i]:
        return
    late = seen.dt * (t - sent)
    (x, y, z), heading, (u, v, w), rate = own_of(seen.own, (run, sent, column))
    if not math.isnan(heading):
        variance = noise.heading + late * late * noise.yaw_rate
        update_heading(poses, size, k * d, wrapped(heading + late * rate), variance, noise.gate)
    if not math.isnan(x):
        p, q, r = velocity_variances((u, v, w), noise)
        wide = late * late * max(p, q, r)
        fix = (x, y, z, noise.fix[0] + wide, noise.fix[1] + wide, noise.fix[2] + wide)
        update_fix(poses, size, k * d, fix, (late * u, late * v, late * w), noise.gate)


@part
def add_relative(
    poses: Poses, seen: PoseSeen, noise: PoseNoise, at: tuple[int, int], options: PoseOptions, left_out: Ints
) -> None:
    """All relative measurements of a step, pass after pass: the first linear at the state after the fixes, each of the
    others at what the last one found, from the same prior."""
    vector, cov, kept = poses.vector, poses.cov, poses.kept
    ends_of, places, relative = seen.ends, seen.place, seen.relative
    run, t = at
    d, size = options.d, options.d * (seen.start[t + 1] - seen.start[t])
    begin, end = seen.first[t], seen.first[t + 1]
    if begin == end:
        return
    for i in range(size if options.passes > 1 else 0):
        vector[KEPT, i] = vector[X, i]
        for j in range(size):
            kept[i, j] = cov[i, j]
    for k in range(begin, end):
        i, j = d * ends_of[k, 0], d * max(ends_of[k, 1], 0)
        left_out[k] = UNPLACED if max(cov[i, i], cov[j, j]) > 0.5 * noise.flat else 0
    for again in range(options.passes):
        for i in range(size):
            vector[AT, i] = vector[X, i]
        if again:
            for i in range(size):
                vector[X, i] = vector[KEPT, i]
                for j in range(size):
                    cov[i, j] = kept[i, j]
        for k in range(begin, end):
            place = (places[k, 0], places[k, 1], places[k, 2])
            ends = (d * ends_of[k, 0], d * ends_of[k, 1], left_out[k])
            found = (relative[run, k, 0], relative[run, k, 1], relative[run, k, 2])
            left_out[k] = update_relative(poses, size, ends, place, found, (noise.relative, noise.gate))
        settle(poses, size)
    if options.invariant:
        retract(poses, size)

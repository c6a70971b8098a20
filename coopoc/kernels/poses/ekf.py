"""Extended Kalman filter of poses: one vehicle, or a fleet in one state or by fusion of pairs of estimates."""

from math import inf, isnan
from typing import NamedTuple

import numpy as np

from ...arrays import Bools, Floats, Ints
from ..compiling.compile import compiled, part
from ..odometry_fault import judge
from .odometry import join, predict, symmetrise
from .scalar_update import (
    ALONE,
    COST,
    USED,
    ZERO,
    PoseNoise,
    Poses,
    apply_pending_rows,
    update_fix,
    update_heading,
    update_relative,
)

UNPLACED = 7
"""Bits of all components: nothing is known of the position of one of the two."""
JOINT, NAIVE, INTERSECTION = range(3)
"""How estimates are fused: in one state, as if their errors were independent, by covariance intersection."""
WEIGHTS_TRIED = 10
"""Weights that covariance intersection tries."""
OF_PAIRS = 0.3
"""What the ranges of a pair are too long by, over what those of an observer are."""


class PoseMeasurements(NamedTuple):
    """What n members have measured in R runs of T steps, in body frames.

    Attributes:
        own: (R, T, n, 8) fix m, compass rad, NaN where missing, velocity m/s forward, left and up, yaw rate rad/s.
        active: (T, n) whether a member is there.
        ends: (L, 3) numbers of observer and other, -1 for a landmark, and of the pair, 0 where its offset is no state.
        first: (T+1,) first relative measurement of each step.
        landmark: (L, 3) m, its position.
        relative: (R, L, 3) m, rad from the observer's heading, rad; NaN where missing.
        dt: s.
        tags: (n + 1, 3) m forward, left, up, between which ranges are; the last, 0, of landmarks.
    """

    own: Floats
    active: Bools
    ends: Ints
    first: Ints
    landmark: Floats
    relative: Floats
    dt: float
    tags: Floats


@compiled
def run_filter(
    measured: PoseMeasurements,
    noise: PoseNoise,
    begin: Floats,
    spread: Floats,
    poses: Poses,
    pair: Poses,
    faults: Floats,
) -> tuple[Floats, Floats, Floats]:
    """States (R, T, n, d), NaN where absent, their covariances (R, T, n, d, d), and cost and number of rows (R, 2).

    Args:
        measured: by the members.
        noise: that is assumed.
        begin: (R, S, n, 4) m and rad, poses at the first step, and where a member begins for the s-th time after that;
            NaN for its fix and compass there.
        spread: (4,) standard deviations of these.
        poses: memory for the members.
        pair: memory for two members.
        faults: of `new_faults`.
    """
    (runs, steps, members, _), d = measured.own.shape, noise.d
    x, cov = np.full((runs, steps, members, d), np.nan), np.full((runs, steps, members, d, d), np.nan)
    cost = np.zeros((runs, 2))
    for run in range(runs):
        for t in range(steps):
            step(measured, noise, begin, spread, poses, pair, faults, run, t)
            for k in range(members):
                if measured.active[t, k]:
                    own = slice(d * k, d * k + d)
                    x[run, t, k], cov[run, t, k] = poses.x[own], poses.cov[own, own]
        cost[run, 0], cost[run, 1] = poses.totals[COST], poses.totals[USED]
    return x, cov, cost


@compiled
def step(
    measured: PoseMeasurements,
    noise: PoseNoise,
    begin: Floats,
    spread: Floats,
    poses: Poses,
    pair: Poses,
    faults: Floats,
    run: int,
    t: int,
) -> None:
    """One step of all members: prediction, then each one's fix and compass, then the relative measurements."""
    d, members, active = noise.d, measured.own.shape[2], measured.active[t]
    if t == 0:
        poses.totals[COST] = poses.totals[USED] = 0.0
        poses.x[:], poses.cov[:] = 0.0, 0.0
        for i in range(d * members + 1, len(poses.x)):
            poses.cov[i, i] = OF_PAIRS * OF_PAIRS * noise.lasting[2]
    for k in range(members):
        own, member = measured.own[run, t, k], d * k
        if active[k] and t > 0 and measured.active[t - 1, k]:
            predict(poses, faults[k], member, d, own[4:7], own[7], measured.dt, noise)
        elif active[k]:
            join(poses, member, d, own, noise)
            faults[k] = faults[-1]
            again = 0
            for s in range(t):
                again += measured.active[s + 1, k] and not measured.active[s, k]
            for i in range(4 if again < begin.shape[1] else 0):
                if not isnan(begin[run, again, k, i]):
                    poses.x[member + i] = begin[run, again, k, i]
                    poses.cov[member + i, member + i] = spread[i] * spread[i]
    for k in range(members):
        own = measured.own[run, t, k]
        if active[k] and not isnan(own[0]):
            if not isnan(own[3]):  # else it may be the heading that is wrong
                lost = judge(faults[k], own[0], own[1], 0.5 * (noise.fix[0] + noise.fix[1]), measured.dt)
                poses.cov[d * k, d * k] += lost
                poses.cov[d * k + 1, d * k + 1] += lost
            update_fix(poses, d * k, own, noise.fix, noise.gate)
        if active[k] and not isnan(own[3]):
            update_heading(poses, d * k, own[3], noise.heading, noise.gate)
    apply_pending_rows(poses)
    if measured.first[t] == measured.first[t + 1]:
        return
    if noise.fusion == JOINT:
        update_jointly(measured, noise, poses, run, t)
    else:
        for k in range(measured.first[t], measured.first[t + 1]):
            fuse_pair(measured, noise, poses, pair, run, k)


@compiled
def update_jointly(measured: PoseMeasurements, noise: PoseNoise, poses: Poses, run: int, t: int) -> None:
    """All relative measurements of a step, pass after pass: the first linear at the state after the fixes, each of the
    others at what the last one found, from the same prior."""
    d, begin, end = noise.d, measured.first[t], measured.first[t + 1]
    left_out = np.zeros(end - begin, np.int64)
    for k in range(begin, end):
        i, j = d * measured.ends[k, 0], d * measured.ends[k, 1]
        if max(poses.cov[i, i], poses.cov[j, j] if j >= 0 else 0.0) > 0.5 * noise.flat:
            left_out[k - begin] = UNPLACED
    if noise.passes > 1:
        poses.prior_x[:], poses.prior_cov[:] = poses.x, poses.cov
    cost = poses.totals[COST]  # of a pass: that of the last one is Laplace's approximation of the likelihood
    for again in range(noise.passes):
        poses.linear[:] = poses.x
        if again:
            poses.x[:], poses.cov[:], poses.totals[COST] = poses.prior_x, poses.prior_cov, cost
        for k in range(begin, end):
            i, j, pair = measured.ends[k]
            ends = (d * i, d * j, d * measured.own.shape[2] + pair)
            landmark, relative, bits = measured.landmark[k], measured.relative[run, k], left_out[k - begin]
            tags = measured.tags[i], measured.tags[j]
            left_out[k - begin] = update_relative(poses, ends, landmark, relative, noise, bits, tags)
        apply_pending_rows(poses)


@part
def fuse_pair(measured: PoseMeasurements, noise: PoseNoise, poses: Poses, pair: Poses, run: int, k: int) -> None:
    """Update the observer of a relative measurement with the estimate of the member that it measured.

    Their joint covariance is taken as block diagonal, each block over its weight: 1 and 1 if the errors were
    independent, w and 1 - w for a bound whatever their correlation (covariance intersection), with the w that
    minimises the sum of the observer's d variances, each over what it was: at most d, so that their product never grows
    (a trace of the position alone would let headings grow without end). What the measured member would learn is
    dropped.

    Args:
        measured: by the members.
        noise: that is assumed, its fusion not JOINT.
        poses: the state; covariances between members are zero.
        pair: memory.
        run: of the measurement.
        k: number of the measurement.

    References:
        Carrillo-Arce et al., Decentralized multi-robot cooperative localization using covariance intersection,
        IROS 2013.
    """
    d, observer, other = noise.d, noise.d * measured.ends[k, 0], noise.d * measured.ends[k, 1]
    ends = (ZERO, d if other >= 0 else ALONE, 2 * d)
    tags = measured.tags[measured.ends[k, 0]], measured.tags[measured.ends[k, 1]]
    tries = WEIGHTS_TRIED if noise.fusion == INTERSECTION and other >= 0 else 0
    best, chosen = inf, 1.0
    for attempt in range(tries + 1):
        weight = chosen if attempt == tries else (attempt + 1.0) / WEIGHTS_TRIED
        pair.cov[:], pair.hits[:] = 0.0, 0.0
        set_member(pair, 0, poses, observer, d, weight)
        if other >= 0:
            set_member(pair, d, poses, other, d, max(1.0 - weight, 1e-9) if tries > 0 else 1.0)
        for i in range(2 * d):
            pair.linear[i] = pair.x[i]
        landmark, relative = measured.landmark[k], measured.relative[run, k]
        update_relative(pair, ends, landmark, relative, noise, ZERO, tags)
        apply_pending_rows(pair)
        total = 0.0
        for i in range(d):
            before = poses.cov[observer + i, observer + i]
            total += pair.cov[i, i] / before if before > 0.0 else 0.0
        if attempt < tries and total < best:
            best, chosen = total, weight
    set_member(poses, observer, pair, 0, d, 1.0)


@part
def set_member(poses: Poses, member: int, source: Poses, at: int, d: int, weight: float) -> None:
    """Copy the state and the covariance over `weight` of one member."""
    for i in range(d):
        poses.x[member + i] = source.x[at + i]
        for j in range(d):
            poses.cov[member + i, member + j] = source.cov[at + i, at + j] / weight
    symmetrise(poses.cov, member, d)

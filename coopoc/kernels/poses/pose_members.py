"""Members of a unit of the pose filter: what they measure, their blocks as they come and go, and their motion."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from ...arrays import Bools, Floats, Ints
from ..compiling.compile import part
from .pose_motion import PoseNoise, predict
from .pose_update import HEADING, KEPT, Poses, X

UNKNOWN_HEADING = math.pi**2 / 3.0
"""rad^2, variance of a heading of which nothing is known: uniform over a turn."""


class PoseSeen(NamedTuple):
    """What a unit has measured and received in R runs of T steps of N vehicles, in body frames.

    Attributes:
        own: (R, T, N, 8) fix m, compass rad, NaN where missing, velocity m/s forward, left and up, yaw rate rad/s.
        member: (M,) columns of the members of all steps.
        start: (T+1,) first member of each step.
        newest: (R, M) step of the newest message of each member, -1 for none.
        fresh: (R, M) whether it is new.
        ends: (L, 2) places of observer and other among the members of the step, -1 for a landmark.
        first: (T+1,) first relative measurement of each step.
        place: (L, 3) m, of the landmark.
        relative: (R, L, 3) m, rad from the observer's heading, rad; NaN where missing.
        dt: s.
    """

    own: Floats
    member: Ints
    start: Ints
    newest: Ints
    fresh: Bools
    ends: Ints
    first: Ints
    place: Floats
    relative: Floats
    dt: float


@part
def arrange(poses: Poses, seen: PoseSeen, noise: PoseNoise, at: tuple[int, int], d: int, uses: Floats) -> None:
    """Take the members of this step in their order from those of the last one, and move them; others join."""
    vector, cov, kept = poses.vector, poses.cov, poses.kept
    start, member, newest = seen.start, seen.member, seen.newest
    run, t = at
    first, count = start[t], start[t + 1] - start[t]
    before = start[t - 1] if t > 0 else first
    old = first - before
    same = old == count
    for k in range(min(old, count)):
        same = same and goes_on(member, newest, run, before + k, first + k)
    if not same:
        for i in range(old * d):
            vector[KEPT, i] = vector[X, i]
            for j in range(old * d):
                kept[i, j] = cov[i, j]
    for k in range(old):
        uses[len(uses) // 2 + k] = uses[k]
    for k in range(count):
        came = k if same else previous(member, newest, (run, before, old), first + k)
        if not same:
            for m in range(count):
                other = previous(member, newest, (run, before, old), first + m)
                for i in range(d):
                    for j in range(d):
                        both = came >= 0 and other >= 0
                        value = kept[came * d + i, other * d + j] if both else 0.0
                        cov[k * d + i, m * d + j] = value
            for i in range(d):
                vector[X, k * d + i] = vector[KEPT, came * d + i] if came >= 0 else 0.0
        again = came >= 0 and newest[run, before + came] == newest[run, first + k]
        uses[k] = uses[len(uses) // 2 + came] + 1.0 if again else 1.0
        if came < 0:
            join(poses, seen, noise, (run, t, k), d)
    for k in range(count):
        if same or previous(member, newest, (run, before, old), first + k) >= 0:
            advance(poses, seen, noise, (run, t, k), (d, count * d), uses[k])


@part
def previous(member: Ints, newest: Ints, last: tuple[int, int, int], one: int) -> int:
    """Place of a member in the last step, -1 if it begins now."""
    run, before, old = last
    for k in range(old):
        if goes_on(member, newest, run, before + k, one):
            return k
    return -1


@part
def goes_on(member: Ints, newest: Ints, run: int, before: int, one: int) -> bool:
    """Whether a member is one of the last step. One without a message so far begins with the first: its place was
    arbitrary, and its variance is finite."""
    known = newest[run, before] >= 0 or newest[run, one] < 0
    return bool(known and member[before] == member[one])


@part
def own_of(own: Floats, at: tuple[int, int, int]) -> Any:
    """Fix, compass heading, velocity and yaw rate of `PoseSeen.own` at a run, step and vehicle."""
    run, t, vehicle = at
    fix = own[run, t, vehicle, 0], own[run, t, vehicle, 1], own[run, t, vehicle, 2]
    velocity = own[run, t, vehicle, 4], own[run, t, vehicle, 5], own[run, t, vehicle, 6]
    return fix, own[run, t, vehicle, 3], velocity, own[run, t, vehicle, 7]


@part
def advance(
    poses: Poses, seen: PoseSeen, noise: PoseNoise, at: tuple[int, int, int], sizes: tuple[int, int], uses: float
) -> None:
    """Move a member by the odometry of its newest message; nothing is known of the motion of one without."""
    (run, t, k), (d, size) = at, sizes
    i = seen.start[t] + k
    sent, column = seen.newest[run, i], seen.member[i]
    if sent < 0:
        for axis in range(3):
            poses.cov[k * d + axis, k * d + axis] += noise.flat
        poses.cov[k * d + HEADING, k * d + HEADING] += UNKNOWN_HEADING
        return
    _, _, (forward, left, up), rate = own_of(seen.own, (run, sent, column))
    odometry, age = (forward, left, up, rate), seen.dt * (t - sent)
    late = age * noise.acceleration
    more = (2.0 * uses - 1.0, late * late)
    predict(poses, (k * d, d, size), odometry, seen.dt, noise, more)


@part
def join(poses: Poses, seen: PoseSeen, noise: PoseNoise, at: tuple[int, int, int], d: int) -> None:
    """Begin a member where its message places it, and know nothing of it yet."""
    vector, cov = poses.vector, poses.cov
    run, t, k = at
    i = seen.start[t] + k
    sent, column, block = seen.newest[run, i], seen.member[i], k * d
    heading = seen.own[run, sent, column, HEADING] if sent >= 0 else math.nan
    vector[X, block + HEADING] = 0.0 if math.isnan(heading) else heading
    for axis in range(3):
        fix = seen.own[run, sent, column, axis] if sent >= 0 else math.nan
        vector[X, block + axis] = 0.0 if math.isnan(fix) else fix
        cov[block + axis, block + axis] = noise.flat
    cov[block + HEADING, block + HEADING] = UNKNOWN_HEADING
    for j in range(4, d):
        cov[block + j, block + j] = noise.lasting[j - 4]


@part
def place_at(poses: Poses, seen: PoseSeen, begin: Floats, spread: Floats, run: int, d: int) -> None:
    """Begin the members of the first step at poses that are given."""
    vector, cov, start = poses.vector, poses.cov, seen.start
    for k in range(start[1] - start[0]):
        column = seen.member[start[0] + k]
        for i in range(4):
            if not math.isnan(begin[run, column, i]):
                vector[X, k * d + i] = begin[run, column, i]
                cov[k * d + i, k * d + i] = spread[i] * spread[i]

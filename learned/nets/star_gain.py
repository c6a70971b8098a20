"""The joint filter of a star whose vehicles send their noise, by the compiled step of `JointFilter`.

Two kinds of messages: the newest fix and velocity, or sums since departure, of which the receiver takes the difference
to the last ones of that vehicle: what happened while messages were lost is not lost.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from coopoc.arrays import AnyArray, Floats
from coopoc.kernels.compiling.compile import as_written, inner, inside
from coopoc.kernels.compiling.small import add, load, square, store
from coopoc.kernels.compiling.vectors import LANES
from coopoc.kernels.stars.elimination import rescale
from coopoc.kernels.stars.joint import Joint, joint_within
from coopoc.kernels.stars.joint_filter import step, write
from coopoc.kernels.stars.messages import (
    HELD,
    MOVED,
    NEW,
    NONE,
    POSITION,
    PROCESS,
    RELATIVE,
    ROW,
    VARIANCE,
    Assumptions,
    Measurements,
    Star,
    gather,
    largest,
    star_within,
)
from coopoc.kernels.stars.relative import vector

SUMS, LAST, STEP, JOINED, GUESSED, VELOCITY, INFORMATION, SIZE = 0, 12, 24, 25, 26, 29, 32, 35
"""Columns of a vehicle: motion m, its variance m^2, 1/r and (fix - motion)/r, each summed since departure, three axes
each; the same as in its last message; the step of that message, -1 for none; 1 if it came since the vehicle joined the
star; m of extrapolated motion since then, m of motion per step, and the information 1/r of its newest fix."""


class SumsHistory(NamedTuple):
    """Sums and last messages of all vehicles, and the information of the members' fixes.

    Attributes:
        vehicle: (LANES, N, SIZE), columns as above.
        information: (3 most, LANES) m^-2, of the fixes as sent last, of the members of the present star.
        last_information: the same of the members of the last star; 0 if a vehicle has sent none.
    """

    vehicle: Floats
    information: Floats
    last_information: Floats


@as_written
def follow(seen: Measurements, known: Assumptions, sums: bool) -> tuple[Floats, Floats, Floats]:
    """x (R, T, 3) m, covariance (R, T, 3, 3) m^2, neighbours (R, M, 3) m; `known` holds what the vehicles send."""
    runs, steps, vehicles = seen.gnss.shape[:3]
    out = np.empty((runs, steps, 3)), np.empty((runs, steps, 3, 3)), np.empty((runs, seen.relative.shape[1], 3))
    most = largest(seen.start) + 1
    for first in range(0, runs, LANES):
        star, joint, old, last = star_within(most), joint_within(most, ROW), NONE, min(first + LANES, runs) - 1
        history = SumsHistory(
            np.zeros((LANES, vehicles, SIZE)), np.zeros((3 * most, LANES)), np.zeros((3 * most, LANES))
        )
        for lane in range(LANES):
            for k in range(vehicles):
                history.vehicle[lane, k, STEP] = -1.0
        for t in range(steps):
            n = gather(star, seen, known, first, last, t, old)
            for lane in range(LANES):
                run = min(first + lane, last)
                if sums:
                    for k in range(vehicles):
                        accumulate(history.vehicle[lane, k], seen, known, run, t, k)
                for k in range(n):
                    news = k == 0 or (
                        seen.fresh[run, seen.start[t] + k - 1] if sums else star.status[5 * k + HELD, lane] > 0.0
                    )
                    if sums:
                        difference(star, history.vehicle[lane, star.member[k]], t, (k, lane, news))
                    set_information(star, history, known, (run, t), (k, lane, news, sums))
            rescale_prior(star, joint, history, n, old)
            step(star, joint, known, True, n, old)
            initialise(star, joint, n)
            for i in range(3 * n):
                store(history.last_information, i, load(history.information, i, (0.0,)))
            write(out, joint, first, last, t, seen.start[t], n, ROW)
            old = n
    return out


@inside
def at(values: AnyArray, run: int, t: int, k: int, axis: int) -> float:
    """Of what is broadcastable to (R, T, N, 3)."""
    value: float = values[min(run, values.shape[0] - 1), min(t, values.shape[1] - 1), min(k, values.shape[2] - 1), axis]
    return value


@inside
def accumulate(own: AnyArray, seen: Measurements, known: Assumptions, run: int, t: int, k: int) -> None:
    """Add a step to the sums of a vehicle."""
    for c in range(3):
        motion = seen.dt * seen.velocity[run, t, k, c], at(known.process, run, t, k, c)
        add_step(own, motion, (seen.gnss[run, t, k, c], at(known.fixes, run, t, k, c)), c)


@inside
def add_step(own: AnyArray, motion: Any, fix: Any, c: int) -> None:
    """Add to the sums of an axis a motion m and its variance m^2, and a fix m and its; NaN adds nothing."""
    (step, q), (z, r) = motion, fix
    if not np.isnan(z):
        own[6 + c] += 1.0 / r
        own[9 + c] += (z - own[c] - step) / r
    if not np.isnan(step):
        own[c] += step
        own[3 + c] += q


@inner
def difference(star: Star, own: AnyArray, t: int, member: Any) -> None:
    """Difference of a member's sums to those of its last message; without a new message its velocity is extrapolated.

    The next message replaces the extrapolated motion. Averaging n fixes along the motion adds
    (n - 1)(2 n - 1) / (6 n^2) of the motion's variance to that of the average.
    """
    (k, lane, news), row = member, 12 * member[0]
    if star.previous[k] < 0:
        own[JOINED] = 0.0
    again = news and own[JOINED] > 0.0
    steps = t - own[STEP]
    late = (steps - 1.0) * (2.0 * steps - 1.0) / (6.0 * steps * steps) if steps > 0.0 else 0.0
    star.status[5 * k + NEW, lane] = 1.0 if news and own[6] > own[18] else 0.0
    for c in range(3):
        moved, q, w = own[c] - own[LAST + c], own[3 + c] - own[15 + c], own[6 + c] - own[18 + c]
        star.motion[row + 3 * MOVED + c, lane] = moved - own[GUESSED + c] if again else own[VELOCITY + c]
        star.motion[row + 3 * PROCESS + c, lane] = q if again else 0.0
        w = w if news and w > 0.0 else 1.0
        mean = (own[9 + c] - own[21 + c]) / w
        star.motion[row + 3 * POSITION + c, lane] = mean + own[c]
        star.motion[row + 3 * VARIANCE + c, lane] = 1.0 / w + late * q
        if news:
            own[GUESSED + c], own[VELOCITY + c] = 0.0, moved / steps if again else 0.0
        else:
            own[GUESSED + c] += own[VELOCITY + c]
    if news:
        own[STEP], own[JOINED] = t, 1.0
        for i in range(LAST):
            own[LAST + i] = own[SUMS + i]
    star.status[5 * k + HELD, lane] = own[JOINED]


@inside
def set_information(star: Star, history: SumsHistory, known: Assumptions, source: Any, member: Any) -> None:
    """Set the information 1/r of the member's fix as sent last; without a new message its measurement has none."""
    (run, t), (k, lane, news, sums) = source, member
    sent, own = t if sums else int(star.status[5 * k, lane]), history.vehicle[lane, star.member[k]]
    for c in range(3):
        if news:
            own[INFORMATION + c] = 1.0 / at(known.fixes, run, sent, star.member[k], c)
        else:
            star.relative[8 * k + 5 + c, lane] = np.inf
        history.information[3 * k + c, lane] = own[INFORMATION + c] if news or sums else 0.0


@inner
def rescale_prior(star: Star, joint: Joint, history: SumsHistory, n: int, old: int) -> None:
    """Scale the prior's covariance, per axis, by the fixes' information as sent before over that of now; means stay."""
    for lane in range(LANES):
        for c in range(3):
            before, now = 0.0, 0.0
            for k in range(n):
                if star.previous[k] >= 0:
                    p, q = (
                        history.last_information[3 * star.previous[k] + c, lane],
                        history.information[3 * k + c, lane],
                    )
                    if p > 0.0 and q > 0.0:
                        before, now = before + p, now + q
            for k in range(old):
                joint.move[3 * k + c, lane] = math.sqrt(now / before) if now > 0.0 else 1.0
    rescale(joint.information, old, joint.stride, joint.move, square(ROW), ROW)


@inner
def initialise(star: Star, joint: Joint, n: int) -> None:
    """Place a member without a message at the ego's position plus the measured vector."""
    for k in range(1, n):
        there = add(load(joint.state, 0, ROW), vector(load(star.relative, k, RELATIVE)))
        store(joint.scratch, 2 * k + 3, there)
        for lane in range(LANES):
            if star.status[5 * k + HELD, lane] == 0.0:
                for c in range(3):
                    joint.state[3 * k + c, lane] = joint.scratch[3 * (2 * k + 3) + c, lane]

"""Streams of stars: a step's rows, each with the newest message of a neighbour, and the steps of both filters.

Times are in seconds, and any dt will do: a velocity that has served for L s and serves for dt more makes an error of
(L + dt)^2 - L^2 times its own variance.
"""

from __future__ import annotations

import math

import numpy as np

from ...arrays import Floats, Ints
from ..compiling.compile import as_written, compiled
from ..compiling.vectors import LANES
from ..dead_reckoning import BAD_INPUT, ROUNDING, dead_reckon
from ..motion import MotionNoise, keep_pace, process_variance
from .cooperative_filter import step
from .cooperative_messages import remember
from .cooperative_state import (
    AGE,
    ANSWER,
    DT,
    FIX,
    FIX_VARIANCE,
    MOTION,
    MOTION_VARIANCE,
    SOLO,
    SPEED,
    STEP,
    STEPS,
    TYPICAL,
    VAGUE,
    WAY,
    Filter,
    Model,
    begin,
    copy_filter,
    new_filter,
)
from .gated import Gates, gates_within
from .gaussian import PLACE
from .joint_filter import Joint, joint_within
from .joint_filter import step as step_joint
from .messages import (
    ACCELERATION_STD,
    FIX_GROWTH,
    FORGOTTEN,
    NOWHERE,
    Assumptions,
    interpret,
    measured,
    star_within,
)
from .otherwise import Tries, new_tries

INDEX, SERVES, USED_AT = range(3)
"""Of a vehicle's newest message: its index in the last star of the joint filter (-1 for none; the ego's is that of the
last member), s for which its velocity has served, and when the one that was used last was sent s."""
OF_EGO, OF_NEIGHBOUR = (MOTION, MOTION_VARIANCE, FIX, FIX_VARIANCE), (SPEED, STEP, SOLO, TYPICAL)
"""Where motion or velocity, its variance, position and its variance begin in a row."""


@compiled
def stream_rows(
    given: Floats,
    history: Floats,
    motion: MotionNoise,
    fix: Floats,
    own: Floats,
    rows: Floats,
    vehicles: Ints,
    last: Floats,
    time: float,
    max_age: float,
    memory: Floats,
) -> int:
    """Rows of a step: the ego's by dead reckoning, a fix of some age brought forward, and those of its neighbours with
    the newest message of each. `kernels.dead_reckoning` says when it is NO_FIX_YET or BAD_INPUT; then nothing changes.

    Args:
        given: (8,) fix m, velocity m/s, dt s, age of the fix s.
        history: of `motion`.
        motion: noise.
        fix: (3,) m^2, variance of a fix.
        own: (OWN,) out.
        rows: (k, WIDTH) measurements and new messages with their age, NaN for none; then with the newest message.
        vehicles: (k,) which they are; the ego is vehicle 0.
        last: (vehicles, WIDTH) newest message of each, AGE the time when it was sent s, the square of its pace in STEP.
        time: s, of the step.
        max_age: s, of the oldest message that counts.
        memory: of `remember`, of the ego.
    """
    since, late, dt = np.zeros(3), np.zeros(3), given[6]
    outcome = dead_reckon(given, history, motion, own[MOTION:MOTION_VARIANCE], own[MOTION_VARIANCE:DT], since, late)
    if outcome == BAD_INPUT:
        return BAD_INPUT
    own[DT], interval = dt, motion.interval if motion.interval > 0.0 else dt
    for c in range(3):
        own[FIX + c], own[FIX_VARIANCE + c] = given[c] + since[c], fix[c] + late[c]
    remember(memory, own[MOTION:MOTION_VARIANCE], own[FIX:FIX_VARIANCE], own[FIX_VARIANCE:MOTION], dt)
    for i in range(len(rows)):
        row, newest, sent = rows[i], last[vehicles[i]], time - rows[i, AGE]
        if math.isfinite(row[SPEED]) and sent >= newest[AGE] - ROUNDING:
            gap = sent - newest[AGE]
            if gap > max_age + ROUNDING:
                newest[STEP:TYPICAL] = math.nan
            else:
                keep_pace(newest[STEP:TYPICAL], newest[SPEED:STEP], gap)
            newest[SOLO:STEP], newest[AGE] = row[SOLO:STEP], sent
        age = max(time - newest[AGE], 0.0)
        row[AGE] = -1.0 if age > max_age + ROUNDING else age if age > ROUNDING else 0.0
        row[SOLO:STEP] = newest[SOLO:STEP]
        process_variance(motion, newest[STEP:TYPICAL], newest[SPEED:STEP], interval, row[STEP:TYPICAL])
        for c in range(3):
            row[STEP + c], row[TYPICAL + c] = row[STEP + c] * (dt / interval) ** 2, fix[c]
    return int(outcome)


@compiled
def make_joint(most: int) -> tuple[Joint, Gates]:
    """State of the joint filter with room for that many members, for Python."""
    return joint_within(most), gates_within(most)


@as_written
def joint_step(
    joint: Joint,
    gates: Gates,
    std: Floats,
    least: float,
    refine: bool,
    robust: bool,
    own: Floats,
    rows: Floats,
    vehicles: Ints,
    last: Floats,
    answer: Floats,
) -> None:
    """One step of the joint filter, as `stream_step`; all lanes hold the same run.

    Args:
        joint: state.
        gates: state.
        std: (3,) m, rad, rad of relative measurements; of no length for unit covariances.
        least: m, least range.
        refine: one Gauss-Newton step on range and angles.
        robust: gate innovations.
        own: (OWN,).
        rows: (k, WIDTH) of the neighbours that are measured now.
        vehicles: (k,) which they are; the ego is vehicle 0.
        last: (vehicles, WIDTH) of `stream_rows`; INDEX, SERVES and USED in front are of this function.
        answer: (12 + 3 k,) out.
    """
    n, old, zero = 1 + len(rows), int(last[0, INDEX]) + 1, np.zeros((1, 1, 1, 3))
    star, known = star_within(n), Assumptions(zero, zero, zero, FIX_GROWTH, std, least, FORGOTTEN, ACCELERATION_STD)
    for k in range(n):
        j, row, at, age, dt = 0, own, OF_EGO, 0.0, 1.0
        if k > 0:
            j, row, at, age, dt = vehicles[k - 1], rows[k - 1], OF_NEIGHBOUR, rows[k - 1, AGE], own[DT]
        memory, held, there = last[j], age >= 0.0, math.isfinite(row[at[2]])
        new = k == 0 or memory[AGE] > memory[USED_AT] + ROUNDING
        star.previous[k] = int(min(memory[INDEX], 0.0) if k == 0 else memory[INDEX])
        serves = 0.0 if new or memory[INDEX] < 0.0 else memory[SERVES]
        memory[SERVES], memory[USED_AT] = serves + dt, memory[AGE]
        counts = 1.0 if new and held and there else 0.0
        status = 0.0, 1.0 + serves / dt, max(age, 0.0) / dt, 1.0 if held else 0.0, counts
        for lane in range(LANES):
            for i in range(5):
                star.status[5 * k + i, lane] = status[i]
            if k > 0:
                measured(star.relative, row, std, k, lane)
        for i in range(12):
            value = 0.0 if i < 9 else NOWHERE
            if held and (i < 6 or there):
                value = row[at[i // 3] + i % 3]
            for lane in range(LANES):
                star.motion[12 * k + i, lane] = value
        interpret(star, known, k, dt)
    step_joint(star, joint, gates, known, refine, robust, n, old)
    last[:, INDEX] = -1.0
    last[0, INDEX] = n - 1
    for k in range(1, n):
        last[vehicles[k - 1], INDEX] = k
    for c in range(3):
        answer[c] = joint.state[c, 0]
        for d in range(3):
            answer[3 + 3 * c + d] = joint.scratch[3 * min(c, d) + max(c, d), 0]
        for k in range(1, n):
            answer[9 + 3 * k + c] = joint.state[3 * k + c, 0]


@compiled
def stream_step(
    f: Filter,
    tries: Tries,
    model: Model,
    own: Floats,
    rows: Floats,
    vehicles: Ints,
    start: Floats,
    answer: Floats,
) -> None:
    """One step.

    Args:
        f: filter.
        tries: memory of the same size.
        model: noise model.
        own: (OWN,).
        rows: (k, WIDTH) of the neighbours that are measured now.
        vehicles: (k,) which they are; the ego is vehicle 0.
        start: (3,) m, known before the first step, NaN for none.
        answer: (12 + 3 k,) out: position m, covariance m^2, positions of the neighbours m.
    """
    if f.g.vectors[0] == 0:
        begin(f, model, own, rows, len(vehicles), 0)
        if math.isfinite(start[0]):
            f.ego[STEPS], f.member[0, VAGUE] = 1, 0.0
            for c in range(3):
                f.g.x[c] = start[c]
    step(f, tries, model, own, rows, vehicles, len(vehicles))
    for i in range(12):
        answer[i] = f.ego[ANSWER + i]
    for i in range(len(vehicles)):
        k = f.slot[vehicles[i]]
        for c in range(3):
            answer[12 + 3 * i + c] = f.g.x[3 * f.g.block[k, PLACE] + c] + f.member[k, WAY + c]


@compiled
def make_filter(slots: int, vehicles: int) -> tuple[Filter, Tries]:
    """A filter before its first step, and its memory, for Python."""
    return new_filter(slots, vehicles), new_tries(slots, vehicles)


@compiled
def restore(source: Filter, target: Filter) -> None:
    """Copy a state."""
    copy_filter(source, target)

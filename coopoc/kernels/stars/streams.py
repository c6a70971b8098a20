"""Streams of stars: a step's rows, each with the newest message of a neighbour, and the filter's step.

Times are in seconds, and any dt will do: a velocity that has served for L s and serves for dt more makes an error of
(L + dt)^2 - L^2 times its own variance.
"""

from math import isfinite, nan

import numpy as np

from ...arrays import Floats, Ints
from ..compiling.compile import compiled
from ..dead_reckoning import BAD_INPUT, ROUNDING, dead_reckon
from ..gate import CONFIRMED
from ..motion import MotionNoise, keep_pace, process_variance
from .cooperative_filter import step
from .cooperative_messages import remember, take_fix
from .cooperative_state import (
    AGE,
    ANSWER,
    AT,
    BY_FIXES,
    DT,
    EXTRA_VARIANCE,
    FIX,
    FIX_VARIANCE,
    MORE,
    MOTION,
    MOTION_VARIANCE,
    OWN,
    SOLO,
    SPEED,
    STEP,
    STEPS,
    TYPICAL,
    VOTES,
    Filter,
    Model,
    begin,
    copy,
    copy_filter,
    is_placed,
    new_filter,
)
from .otherwise import Tries, measured_motion, new_tries

REPEATED_S = 0.005
"""s, between when two messages of a vehicle were sent, from which the second is not the first again."""


@compiled
def stream_rows(
    numbers: Floats,
    history: Floats,
    motion: MotionNoise,
    fix: Floats,
    odometry: Floats,
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
        numbers: (8,) fix m, velocity m/s, dt s, age of the fix s.
        history: of `motion`.
        motion: noise.
        fix: (3,) m^2, variance of a fix.
        odometry: of `dead_reckon`.
        own: (OWN,) out.
        rows: (k, WIDTH) measurements and new messages with their age, NaN for none; then with the newest message.
        vehicles: (k,) which they are; the ego is vehicle 0.
        last: (vehicles, WIDTH) newest message of each, AGE the time when it was sent s, the square of its pace in STEP.
        time: s, of the step.
        max_age: s, of the oldest message that counts.
        memory: (12,) of `remember`, of the ego, and its last fix m.
    """
    since, late, dt = np.zeros(3), np.zeros(3), numbers[6]
    moved, q = own[MOTION:MOTION_VARIANCE], own[MOTION_VARIANCE:DT]
    outcome = dead_reckon(numbers, history, motion, fix, odometry, moved, q, since, late, own[BY_FIXES:OWN])
    if outcome == BAD_INPUT:
        return BAD_INPUT
    take_fix(numbers, moved, fix[0], memory[9:], numbers)
    own[DT], interval = dt, motion.interval if motion.interval > 0.0 else dt
    for c in range(3):
        own[FIX + c], own[FIX_VARIANCE + c] = numbers[c] + since[c], fix[c] + late[c]
    remember(memory, moved, own[FIX:FIX_VARIANCE], own[FIX_VARIANCE:MOTION], dt)
    measured_motion(own)
    for c in range(3):
        q[c] -= own[MORE]
    for i in range(len(rows)):
        row, newest, sent = rows[i], last[vehicles[i]], time - rows[i, AGE]
        if isfinite(row[SPEED]) and sent > newest[AGE] + REPEATED_S:
            gap = sent - newest[AGE]
            if gap > max_age + ROUNDING:
                newest[STEP:TYPICAL] = nan
            else:
                keep_pace(newest[STEP:TYPICAL], newest[SPEED:STEP], gap)
            newest[SOLO:STEP], newest[AGE] = row[SOLO:STEP], sent
        age = max(time - newest[AGE], 0.0)
        row[AGE] = -1.0 if age > max_age + ROUNDING else age if age > ROUNDING else 0.0
        row[SOLO:STEP] = newest[SOLO:STEP]
        process_variance(motion, newest[STEP:TYPICAL], newest[SPEED:STEP], interval, row[STEP:TYPICAL])
        for c in range(3):
            row[STEP + c], row[TYPICAL + c] = row[STEP + c] * (dt / interval) ** 2, fix[c]
    return outcome


@compiled
def stream_step(
    f: Filter, tries: Tries, model: Model, own: Floats, rows: Floats, vehicles: Ints, start: Floats, answer: Floats
) -> bool:
    """One step; False, and nothing changed, where nothing shows yet where the ego is.

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
        if not (is_placed(own, rows) or isfinite(start[0])):
            return False
        begin(f, model, own, rows, 0)
        if isfinite(start[0]):
            f.ego[STEPS], f.ego[VOTES + 7], f.member[0, EXTRA_VARIANCE] = 1, CONFIRMED, 0.0
            for c in range(3):
                f.g.x[c] = start[c]
    step(f, tries, model, own, rows, vehicles)
    for i in range(12):
        answer[i] = f.ego[ANSWER + i]
    for i in range(len(vehicles)):
        k = f.slot[vehicles[i]]
        for c in range(3):
            answer[12 + 3 * i + c] = f.member[k, AT + c] if k >= 0 else nan
    return True


@compiled
def make_filter(slots: int, vehicles: int) -> tuple[Filter, Tries]:
    """A filter before its first step, and its memory, for Python."""
    return new_filter(slots, vehicles), new_tries(slots, vehicles)


@compiled
def restore(source: Filter, tries: Tries, target: Filter, targets: Tries) -> None:
    """Copy a state, and that of the ego alone."""
    copy_filter(source, target)
    copy_filter(tries.alone, targets.alone)
    copy(tries.doubts, targets.doubts)

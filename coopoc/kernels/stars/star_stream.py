"""One step of the joint filter of a star that is fed as it drives: its neighbours' messages, then the filter's step.

Times are in seconds here, and any dt will do: a velocity that has served for L s and serves for dt more makes an error
of (L + dt)^2 - L^2 times its own variance. All lanes hold the same run.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...arrays import Floats, Ints
from ..compiling.compile import as_written, inner, inside, storage
from ..compiling.small import store
from ..compiling.vectors import LANES
from ..dead_reckoning import ESTIMATE, NO_FIX_YET, ROUNDING, dead_reckon
from ..motion import MotionNoise, process_variance
from .joint import Joint, joint_in, joint_rows, new_joint
from .joint_filter import step
from .messages import (
    FIX_GROWTH,
    MOVED,
    POSITION,
    PROCESS,
    ROW,
    USES,
    VARIANCE,
    Assumptions,
    Star,
    interpret,
    measured,
    star_in,
)
from .relative import five

RELATIVE, MESSAGE, MESSAGE_AGE, VELOCITY, FIX = slice(0, 3), 3, 4, slice(5, 8), slice(8, 11)
"""Where a neighbour's input stands in its row: the measurement, 1 for a message, its age s, velocity m/s, fix m."""
LAST, LAST_AGE, LAST_SERVED, PREVIOUS, WIDTH = slice(11, 14), 14, 15, 16, 17
"""Behind it the velocity of its last message m/s, the age of that, how long it has served, s, and the neighbour's index
in the last star, -1 for none."""


class Noise(NamedTuple):
    """What a stream assumes: of motions, of all else, the oldest message s, and whether the filter refines."""

    motion: MotionNoise
    known: Assumptions
    max_age: float
    refine: bool


def packed(noise: Noise) -> Floats:
    """A Noise as one array: a tuple of arrays takes longer to hand over than a step takes."""
    motion, known = noise.motion, noise.known
    unit = float(len(known.relative_std) == 0)
    std = np.ones(3) if unit else known.relative_std
    rest = [known.min_range, known.flat, known.acceleration, noise.max_age, float(noise.refine), unit, *np.zeros(3)]
    return np.concatenate([motion.base, motion.ratio, motion[2:], known.fixes.ravel(), std, rest])


@storage
def unpacked(values: Floats) -> Noise:
    """The Noise of an array; a message holds a fix and a velocity."""
    motion = MotionNoise(values[:3], values[3:6], values[6], values[7], values[8])
    fixes = values[9:12].reshape((1, 1, 1, 3))
    std, still = values[12 : 12 if values[20] > 0.0 else 15], MotionNoise(values[21:24], values[21:24], 0.0, 0.0, 0.0)
    known = Assumptions(fixes, fixes, fixes, FIX_GROWTH, std, values[15], values[16], values[17], still)
    return Noise(motion, known, values[18], values[19] > 0.0)


def resized(memory: Floats, n: int, before: int, most: int) -> Floats:
    """Memory for a star of up to `most` members, with the state and the information of the n of the last one."""
    larger = np.zeros((30 * most + joint_rows(most, ROW)) * LANES)
    if n:
        old, new = (
            new_joint(before, ROW, memory[30 * before * LANES :]),
            new_joint(most, ROW, larger[30 * most * LANES :]),
        )
        new.state[: 3 * n] = old.state[: 3 * n]
        blocks, more = (joint.information.reshape(joint.stride, joint.stride, 9, LANES) for joint in (old, new))
        more[:n, :n] = blocks[:n, :n]
    return larger


@as_written
def stream_step(
    given: Floats,
    rows: Floats,
    memory: Floats,
    columns: Ints,
    old: int,
    history: Floats,
    assumed: Floats,
    answer: Floats,
) -> int:
    """Take what is new and fill the answer: position m, covariance m^2, positions of the neighbours m.

    Args:
        given: (12,) fix m, velocity m/s, dt s, age of the fix s; then x0 m if it is known before the first step, 1.
        rows: (k, WIDTH) of the neighbours measured now; their last messages are brought up to date.
        memory: of the star and its Gaussian.
        columns: (3 most,) of the star, of up to `most` members.
        old: members of the last star.
        history: of `motion`.
        assumed: of `packed`.
        answer: (12 + 3 k,).
    """
    n, most, noise, dt = 1 + len(rows), len(columns) // 3, unpacked(assumed), given[6]
    star, joint = star_in(memory, columns, most), joint_in(memory[30 * most * LANES :], most, ROW)
    moved, q, since, late = np.empty(3), np.empty(3), np.zeros(3), np.zeros(3)
    outcome = dead_reckon(given, history, noise.motion, moved, q, since, late)
    exact = old == 0 and given[11] > 0.0
    if outcome != ESTIMATE and outcome != NO_FIX_YET:
        return outcome
    for k in range(1, n):
        receive(rows[k - 1], dt)
    if outcome == NO_FIX_YET and old == 0 and not exact:
        return outcome
    set_ego(star, noise.known, given, moved, q, since, late, outcome == ESTIMATE, exact)
    star.previous[0] = 0 if old > 0 else -1
    interpret(star, noise.known, 0, 1.0)
    for k in range(1, n):
        star.previous[k] = int(rows[k - 1, PREVIOUS])
        set_neighbour(star, noise, rows[k - 1], k, dt)
        interpret(star, noise.known, k, dt)
    step(star, joint, noise.known, noise.refine, n, old)
    write_answer(joint, n, answer)
    return ESTIMATE


@inside
def write_answer(joint: Joint, n: int, answer: Floats) -> None:
    """Position m and covariance m^2 of the ego, and positions of its neighbours m."""
    for c in range(3):
        answer[c] = joint.state[c, 0]
        for i in range(3):
            answer[3 + 3 * c + i] = joint.scratch[3 * min(c, i) + max(c, i), 0]
        for k in range(1, n):
            answer[9 + 3 * k + c] = joint.state[3 * k + c, 0]


@inner
def set_ego(
    star: Star,
    known: Assumptions,
    given: Floats,
    moved: Floats,
    q: Floats,
    since: Floats,
    late: Floats,
    fixed: bool,
    exact: bool,
) -> None:
    """The ego's motion and its fix, brought forward; a known start, moved, is joined with the first fix."""
    for c in range(3):
        weight = 1.0 / (known.fixes[0, 0, 0, c] + late[c]) if fixed else 0.0
        z = given[c] + since[c] if fixed else 0.0
        if exact:
            more = 1.0 / max(q[c], 1e-18)
            z = (z * weight + (given[8 + c] + moved[c]) * more) / (weight + more)
            weight = weight + more
        set_axis(star, 0, c, moved[c], q[c], z, 1.0 / weight if weight > 0.0 else 1.0)
    set_status(star, 0, 1.0, 0.0, 1.0, 1.0 if fixed or exact else 0.0)


@inside
def set_axis(star: Star, k: int, c: int, moved: float, process: float, position: float, variance: float) -> None:
    """The motion and the message of member k on axis c, in all lanes."""
    store(star.motion, 3 * (4 * k + MOVED) + c, (moved,))
    store(star.motion, 3 * (4 * k + PROCESS) + c, (process,))
    store(star.motion, 3 * (4 * k + POSITION) + c, (position,))
    store(star.motion, 3 * (4 * k + VARIANCE) + c, (variance,))


@inside
def set_status(star: Star, k: int, uses: float, age: float, held: float, new: float) -> None:
    """The status of member k, in all lanes."""
    for i, value in enumerate((uses, age, held, new)):
        store(star.status, 5 * k + USES + i, (value,))


@inside
def receive(row: Floats, dt: float) -> None:
    """Replace the last message by a new one; a vehicle that was not in the last star has not been moved by it."""
    row[LAST_AGE] += dt
    if row[PREVIOUS] < 0.0:
        row[LAST_SERVED] = 0.0
    if row[MESSAGE] > 0.0:
        for c in range(3):
            row[11 + c] = row[5 + c]
        row[LAST_AGE], row[LAST_SERVED] = row[MESSAGE_AGE], 0.0


@inner
def set_neighbour(star: Star, noise: Noise, row: Floats, k: int, dt: float) -> None:
    """Fill member k from its last message and its measurement."""
    held, there = row[LAST_AGE] <= noise.max_age + ROUNDING, math.isfinite(row[8] + row[9] + row[10])
    new = held and there and row[MESSAGE] > 0.0
    age = row[LAST_AGE] / dt if held else 0.0
    set_status(star, k, 1.0 + row[LAST_SERVED] / dt, age, 1.0 if held else 0.0, 1.0 if new else 0.0)
    row[LAST_SERVED] += dt
    interval = noise.motion.interval if noise.motion.interval > 0.0 else dt
    share, variance = dt / interval, process_variance(noise.motion, row[LAST], interval)
    for c in range(3):
        position = row[8 + c] if there else 0.0
        set_axis(star, k, c, row[11 + c], variance[c] * share * share, position, noise.known.broadcast[0, 0, 0, c])
    seen = five(row[0], row[1], row[2])
    for lane in range(LANES):
        measured(star.relative, seen, noise.known.relative_std, k, lane)

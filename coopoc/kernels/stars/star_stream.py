"""One step of the joint filter of a star that is fed as it drives: its neighbours' messages, then the filter's step.

Times are in seconds here, and any dt will do: a velocity that has served for L s and serves for dt more makes an error
of (L + dt)^2 - L^2 times its own variance. All lanes hold the same run.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ...arrays import AnyArray, Floats, Ints
from ..compiling.compile import as_written, inner, inside, storage
from ..compiling.small import load, square, store
from ..compiling.vectors import LANES
from ..motion import ROUNDING, MotionNoise, process_variance
from ..solo import ESTIMATE, NO_FIX_YET, dead_reckon
from .joint import Joint, joint_in, joint_size
from .joint_filter import step
from .messages import (
    AGE,
    HELD,
    MOVED,
    NEW,
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
from .relative import or_else, sine_and_cosine

RELATIVE, MESSAGE, MESSAGE_AGE, VELOCITY, FIX = slice(0, 3), 3, 4, slice(5, 8), slice(8, 11)
"""Where a neighbour's input stands in its row: the measurement, 1 for a message, its age s, velocity m/s, fix m."""
LAST_AGE, LAST_USED = 3, 4
"""Of a known vehicle, behind the velocity of its last message: its age, and for how long it has served, s."""


class Memory(NamedTuple):
    """What a stream keeps from step to step; M vehicles known, up to `most` in the star.

    Attributes:
        numbers: of the star and its Gaussian.
        columns: of the star and its Gaussian.
        last: (M, 5).
        place: (M,) index in the last star, -1 for none.
        size: (2,) members of the last star, `most`.
    """

    numbers: Floats
    columns: Ints
    last: Floats
    place: Ints
    size: Ints


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
def unpacked(values: AnyArray) -> Noise:
    """The Noise of an array; a message holds a fix and a velocity."""
    motion = MotionNoise(values[:3], values[3:6], values[6], values[7], values[8])
    fixes = values[9:12].reshape((1, 1, 1, 3))
    std, still = values[12 : 12 if values[20] > 0.0 else 15], MotionNoise(values[21:24], values[21:24], 0.0, 0.0, 0.0)
    known = Assumptions(fixes, fixes, fixes, FIX_GROWTH, std, values[15], values[16], values[17], still)
    return Noise(motion, known, values[18], values[19] > 0.0)


FIX_GROWTH = (1.0, 0.0)


@as_written
def resized(numbers: AnyArray, size: AnyArray, most: int) -> Floats:
    """Memory for a star of up to `most` members, with the state and the information of the last star."""
    found = np.zeros((30 * most + joint_size(most, ROW)) * LANES)
    if size[0] > 0:
        before = joint_in(numbers[30 * size[1] * LANES :], size[1], ROW)
        now = joint_in(found[30 * most * LANES :], most, ROW)
        for i in range(size[0]):
            store(now.state, i, load(before.state, i, ROW))
            for j in range(i, size[0]):
                one = load(before.information, i * size[1] + j, square(ROW))
                store(now.information, i * most + j, one)
    return found


@as_written
def stream_step(
    given: AnyArray,
    inbox: AnyArray,
    numbers: AnyArray,
    index: AnyArray,
    last: AnyArray,
    history: AnyArray,
    assumed: AnyArray,
    answer: AnyArray,
) -> int:
    """Take what is new and fill the answer: position m, covariance m^2, positions of the neighbours m.

    Args:
        given: (12,) fix m, velocity m/s, dt s, age of the fix s; then x0 m if it is known before the first step, 1.
        inbox: (k, 12) of the neighbours measured now, behind each its row in `last`.
        numbers: of Memory.
        last: of Memory.
        index: its size, columns and place, one behind the other.
        assumed: of `packed`.
    """
    n, old, most, slots = 1 + len(inbox), index[0], index[1], inbox[:, 11]
    memory = Memory(numbers, index[2 : 2 + 3 * most], last, index[2 + 3 * most :], index[:2])
    noise = unpacked(assumed)
    star = star_in(memory.numbers, memory.columns, most)
    joint = joint_in(memory.numbers[30 * most * LANES :], most, ROW)
    moved, q, since, late, dt = np.empty(3), np.empty(3), np.zeros(3), np.zeros(3), given[6]
    found = dead_reckon(given, history, noise.motion, moved, q, since, late)
    if found != ESTIMATE and found != NO_FIX_YET:
        return found
    for slot in range(len(memory.last)):
        memory.last[slot, LAST_AGE] += dt
    there = found == ESTIMATE
    exact = old == 0 and given[11] > 0.0
    for k in range(n - 1):
        receive(memory, inbox[k], int(slots[k]))
    if old == 0 and not there and not exact:
        return NO_FIX_YET
    for c in range(3):
        ego(star, noise.known, (given[c] + since[c], late[c], there), (moved[c], q[c]), (given[8 + c], exact), c)
    status(star, 0, (1.0, 0.0, 1.0, 1.0 if there or exact else 0.0))
    star.previous[0] = 0 if old > 0 else -1
    for k in range(1, n):
        star.previous[k] = memory.place[int(slots[k - 1])]
        neighbour(star, memory, noise, inbox[k - 1], int(slots[k - 1]), k, dt)
    for k in range(n):
        interpret(star, noise.known, k, dt if k > 0 else 1.0)
    step(star, joint, noise.known, noise.refine, None, (n, old), ROW)
    finish(memory, slots, n, dt)
    answered(joint, n, answer)
    return ESTIMATE


@inside
def answered(joint: Joint, n: int, answer: AnyArray) -> None:
    """Position m and covariance m^2 of the ego, and positions of its neighbours m."""
    for c in range(3):
        answer[c] = joint.state[c, 0]
        for i in range(3):
            answer[3 + 3 * c + i] = joint.scratch[3 * min(c, i) + max(c, i), 0]
        for k in range(1, n):
            answer[9 + 3 * k + c] = joint.state[3 * k + c, 0]


@inner
def see(star: Star, row: AnyArray, std: AnyArray, k: int) -> None:
    """Range m, azimuth and inclination rad of member k, with which a row begins; NaN is what was not measured."""
    sa, ca = sine_and_cosine(row[1])
    si, ci = sine_and_cosine(row[2])
    seen = or_else(row[0], -1.0), or_else(sa, 0.0), or_else(ca, 0.0), or_else(si, 0.0), or_else(ci, 0.0)
    for lane in range(LANES):
        measured(star.relative, seen, std, k, lane)


@inside
def receive(memory: Memory, row: AnyArray, slot: int) -> None:
    """Replace the last message by a new one; a vehicle that was not in the last star has not been moved by it."""
    if memory.place[slot] < 0:
        memory.last[slot, LAST_USED] = 0.0
    if row[MESSAGE] > 0.0:
        for c in range(3):
            memory.last[slot, c] = row[5 + c]
        memory.last[slot, LAST_AGE], memory.last[slot, LAST_USED] = row[MESSAGE_AGE], 0.0


@inside
def ego(star: Star, known: Assumptions, fix: Any, motion: Any, start: Any, c: int) -> None:
    """One axis of the ego: its motion, its fix; a known start, moved, is joined with the first fix."""
    (z, late, there), (moved, q), (x0, exact) = fix, motion, start
    variance = known.fixes[0, 0, 0, c] + late
    weight = 1.0 / variance if there else 0.0
    if exact:
        more = 1.0 / max(q, 1e-18)
        z = ((z * weight if there else 0.0) + (x0 + moved) * more) / (weight + more)
        weight = weight + more
    for lane in range(LANES):
        star.motion[3 * MOVED + c, lane], star.motion[3 * PROCESS + c, lane] = moved, q
        star.motion[3 * POSITION + c, lane] = z if weight > 0.0 else 0.0
        star.motion[3 * VARIANCE + c, lane] = 1.0 / weight if weight > 0.0 else 1.0


@inside
def status(star: Star, k: int, values: Any) -> None:
    """Uses, age in steps, held and new of member k."""
    store(star.status, 5 * k + USES, (values[0],))
    store(star.status, 5 * k + AGE, (values[1],))
    store(star.status, 5 * k + HELD, (values[2],))
    store(star.status, 5 * k + NEW, (values[3],))


@inner
def neighbour(star: Star, memory: Memory, noise: Noise, row: AnyArray, slot: int, k: int, dt: float) -> None:
    """Fill member k from its last message and its measurement."""
    last, at = memory.last[slot], 12 * k
    held = last[LAST_AGE] <= noise.max_age + ROUNDING
    there = math.isfinite(row[8] + row[9] + row[10])
    age = last[LAST_AGE] / dt if held else 0.0
    status(
        star,
        k,
        (1.0 + last[LAST_USED] / dt, age, 1.0 if held else 0.0, 1.0 if held and row[MESSAGE] > 0.0 and there else 0.0),
    )
    interval = noise.motion.interval if noise.motion.interval > 0.0 else dt
    share = dt / interval
    variance = process_variance(noise.motion, last, interval)
    for c in range(3):
        values = last[c], variance[c] * share * share, row[8 + c] if there else 0.0, noise.known.broadcast[0, 0, 0, c]
        for lane in range(LANES):
            for i in range(4):
                star.motion[at + 3 * i + c, lane] = values[i]
    see(star, row, noise.known.relative_std, k)


@inside
def finish(memory: Memory, slots: AnyArray, n: int, dt: float) -> None:
    """Remember the star: places of its members, and how long their velocities have served."""
    memory.place[:] = -1
    for k in range(1, n):
        memory.place[int(slots[k - 1])] = k
        memory.last[int(slots[k - 1]), LAST_USED] += dt
    memory.size[0] = n

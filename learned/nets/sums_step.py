"""One step of the cooperative gain of an ego that is fed as it drives: own sums, messages of neighbours, the filter.

The pieces are those of `star_gain.follow`. All lanes hold the same run.
"""

from __future__ import annotations

import math

import numpy as np

from coopoc.arrays import AnyArray, Floats
from coopoc.kernels.compiling.compile import as_written, inner, storage
from coopoc.kernels.compiling.small import load, store
from coopoc.kernels.compiling.vectors import LANES
from coopoc.kernels.motion import MotionNoise
from coopoc.kernels.stars.joint import joint_in
from coopoc.kernels.stars.joint_filter import step
from coopoc.kernels.stars.messages import ROW, Assumptions, Star, star_in
from coopoc.kernels.stars.star_stream import measure, write_answer
from coopoc.methods.star import FORGOTTEN

from .star_gain import (
    LAST,
    SIZE,
    STEP,
    SUMS,
    SumsHistory,
    add_step,
    difference,
    initialise,
    rescale_prior,
    set_information,
)

RELATIVE, NEWS, MESSAGE, SENT, SLOT, ROW_SIZE = 0, 3, 4, 15, 19, 20
"""In the row of a neighbour: range m, azimuth and inclination rad; 1 for a message; its numbers, of which there are
SENT: the sums, and the variance m^2 of a fix of now; the neighbour's row in the history."""


@storage
def history_in(memory: AnyArray, vehicles: int, most: int) -> SumsHistory:
    """History of so many vehicles and of stars of up to `most` members, in memory (>= history_size,)."""
    a, b = LANES * vehicles * SIZE, 3 * most * LANES
    shape = (3 * most, LANES)
    own = memory[:a].reshape((LANES, vehicles, SIZE))
    return SumsHistory(own, memory[a : a + b].reshape(shape), memory[a + b : a + 2 * b].reshape(shape))


def history_size(vehicles: int, most: int) -> int:
    """Numbers of `history_in`."""
    return int(LANES * (vehicles * SIZE + 6 * most))


def relative_assumed(std: Floats, min_range: float) -> Floats:
    """(9,) standard deviations of relative measurements m, rad, rad, least range m, prior of a member that joins m^2,
    1 for unit covariances, of which `std` has no length, and three zeros."""
    unit = len(std) == 0
    return np.array([*(np.ones(3) if unit else std), min_range, FORGOTTEN, float(unit), *np.zeros(3)])


@storage
def assumed(values: AnyArray, fixes: AnyArray) -> Assumptions:
    """What the filter assumes: of `relative_assumed`, and the variances (1, 1, M, 3) m^2 that vehicles sent."""
    std, none = values[: 0 if values[5] > 0.0 else 3], values[6:9]
    return Assumptions(
        fixes, fixes, fixes, (1.0, 0.0), std, values[3], values[4], 0.0, MotionNoise(none, none, 0.0, 0.0, 0.0)
    )


@as_written
def sums_step(
    given: AnyArray,
    variances: AnyArray,
    inbox: AnyArray,
    numbers: AnyArray,
    index: AnyArray,
    history: AnyArray,
    fixes: AnyArray,
    relative: AnyArray,
    answer: AnyArray,
) -> bool:
    """Take what is new and fill the answer: position m, covariance m^2, positions of the neighbours m; False, and no
    answer, before the ego's first fix.

    Args:
        given: (7,) fix m, velocity m/s, dt s.
        variances: (6,) of a fix and of the motion m^2.
        inbox: (k, ROW_SIZE).
        numbers: of the star and its Gaussian, as in `coopoc.kernels.stars.star_stream`.
        index: members of the last star, `most`, the number of the step; columns (3 most,); place in the last star (M,).
        history: of `history_in`.
        fixes: (1, 1, M, 3) m^2 of the last messages.
        relative: of `assumed`.
        answer: (12 + 3 k,).
    """
    n, old, most, t = 1 + len(inbox), index[0], index[1], index[2]
    place, known = index[3 + 3 * most :], assumed(relative, fixes)
    star = star_in(numbers, index[3 : 3 + 3 * most], most)
    joint, held = joint_in(numbers[30 * most * LANES :], most, ROW), history_in(history, len(place), most)
    index[2] = t + 1
    for c in range(3):
        fixes[0, 0, 0, c] = variances[c]
        for lane in range(LANES):
            motion = given[6] * given[3 + c], variances[3 + c]
            add_step(held.vehicle[lane, 0], motion, (given[c], variances[c]), c)
    if old == 0 and math.isnan(given[0]):
        for lane in range(LANES):
            restart(held.vehicle[lane, 0], t)
        return False
    star.member[0], star.previous[0] = 0, place[0] if old > 0 else -1
    for k in range(1, n):
        slot = int(inbox[k - 1, SLOT])
        star.member[k], star.previous[k] = slot, place[slot]
        receive(star, held, known, inbox[k - 1], slot, k)
    for k in range(n):
        news = k == 0 or inbox[k - 1, NEWS] > 0.0
        for lane in range(LANES):
            difference(star, held.vehicle[lane, star.member[k]], t, (k, lane, news))
            set_information(star, held, known, (0, t), (k, lane, news, True))
    rescale_prior(star, joint, held, n, old)
    step(star, joint, known, True, n, old)
    initialise(star, joint, n)
    for i in range(3 * n):
        store(held.last_information, i, load(held.information, i, (0.0,)))
    place[:] = -1
    for k in range(n):
        place[star.member[k]] = k
    index[0] = n
    write_answer(joint, n, answer)
    return True


@inner
def restart(own: AnyArray, t: int) -> None:
    """Let the ego's next step begin here: without a position nothing is moved."""
    own[STEP] = t
    for i in range(LAST - SUMS):
        own[LAST + i] = own[SUMS + i]


@inner
def receive(star: Star, held: SumsHistory, known: Assumptions, row: AnyArray, slot: int, k: int) -> None:
    """Copy the measurement of member k, and its message if one has come."""
    measure(star, row, known.relative_std, k)
    if row[NEWS] > 0.0:
        for lane in range(LANES):
            for i in range(LAST - SUMS):
                held.vehicle[lane, slot, SUMS + i] = row[MESSAGE + i]
        for c in range(3):
            known.fixes[0, 0, slot, c] = row[MESSAGE + LAST + c]


def new_history(vehicles: int, most: int, old: Floats | None = None, before: tuple[int, int] = (0, 0)) -> Floats:
    """Memory of `history_in`, with what an older one of sizes `before` held."""
    found = np.zeros(history_size(vehicles, most))
    found[: LANES * vehicles * SIZE].reshape(LANES, vehicles, SIZE)[..., STEP] = -1.0
    if old is not None:
        (m, k), a, b = before, LANES * vehicles * SIZE, LANES * before[0] * SIZE
        found[:a].reshape(LANES, vehicles, SIZE)[:, :m] = old[:b].reshape(LANES, m, SIZE)
        for part in range(2):
            size, start = 3 * k * LANES, a + 3 * most * LANES * part
            found[start : start + size] = old[b + size * part : b + size * (part + 1)]
    return found

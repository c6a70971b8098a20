"""The newest message of each member of a star, brought forward to a step, for LANES runs side by side.

The one place that defines a message: the members of the star, the place of each in the last one, its motion
since then, and its position as broadcast, brought forward to now. A message that is missing or lost has held = 0, one
whose position was used before, or has no fix, has new = 0.
"""

import math
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from ...arrays import Bools, Floats, Ints
from ..compiling.compile import inner, inside, storage
from ..compiling.small import add, choose_each, load, scale, store, vector_at
from ..compiling.vectors import LANES, Lanes, choose, take
from ..geometry import Numbers, with_std

MOVED, PROCESS, POSITION, VARIANCE = range(4)
"""Rows of a member in `Star.motion`, three numbers each: motion m and its variance m^2 since the last step, position m
as broadcast and brought forward, and its variance m^2."""
SENT, USES, AGE, HELD, NEW = range(5)
"""Rows of a member in `Star.status`: the step of the message, for how many steps in a row its velocity has served, its
age in steps, 1 if there is one, and 1 if its position counts."""
FORGOTTEN = 1e6
"""m^2, prior variance of a vehicle that has just joined: nothing is known of it."""
ACCELERATION_STD = 1.0
"""m/s^2, how fast a velocity may have changed since the message that carried it."""
FIX_GROWTH, ESTIMATE_GROWTH = (1.0, 0.0), (1.0, 2.0)
"""(a, b): after `age` steps a position has gained age (a age + b) times the variance of one step. A fix that is moved
with one velocity makes its error age times; an estimate has made that error once before, fully correlated."""
LEAST_PROCESS = (1e-90,) * 3
"""m^2; the cube of its inverse is still a number, and far beyond any digit that counts."""
NOWHERE = 1e18
"""m^2, variance of a position that is not known."""
Estimates: TypeAlias = tuple[Floats, Floats, Floats]
"""x (R, T, 3) m, covariance (R, T, 3, 3) m^2, neighbours (R, M, 3) m."""
UNIT = np.ones(3)
"""Standard deviations m where covariances are unit matrices."""
ROW, BLOCK, RELATIVE = (0.0,) * 3, (0.0,) * 9, (0.0,) * 8
NONE: Any = np.int64(0)
"""Members before the first star. For a constant of Python's numba would compile the whole step once more."""


class Measurements(NamedTuple):
    """What one ego has measured and received in R runs of T steps; M links, neighbours of a step nearest first.

    Attributes:
        gnss: (R, T, N, 3) m.
        velocity: (R, T, N, 3) m/s.
        broadcast: (R, T, N, 3) m, position in the neighbours' messages.
        relative: (R, M, 5) of `components`.
        neighbour: (M,) columns.
        start: (T+1,) first link of each step.
        newest: (R, M) step of the newest message held, -1 for none.
        fresh: (R, M) whether it is new.
        most: members of the largest star.
    """

    gnss: Floats
    velocity: Floats
    broadcast: Floats
    relative: Floats
    neighbour: Ints
    start: Ints
    newest: Ints
    fresh: Bools
    most: int
    ego: int
    dt: float


class Assumptions(NamedTuple):
    """Noise model of a star filter; arrays are broadcastable to (R, T, N, 3) m^2.

    Attributes:
        process: of one step, at the step at which its velocity was measured.
        fixes: of the ego's fixes.
        broadcast: of positions in messages.
        growth: variance of a position of age a: that of one step times a (growth[0] a + growth[1]).
        relative_std: (3,) m, rad, rad; of no length for unit covariances.
        min_range: m.
        flat: m^2, prior of a member that joins.
        acceleration: m/s^2, change of a velocity since it was sent.
    """

    process: Floats
    fixes: Floats
    broadcast: Floats
    growth: tuple[float, float]
    relative_std: Floats
    min_range: float
    flat: float
    acceleration: float


class Star(NamedTuple):
    """The members of a star at a step, the ego first, in LANES runs.

    Attributes:
        member: (most,) column.
        previous: (most,) index in the last star, -1 for a member that joins.
        status: (5 most, LANES).
        motion: (12 most, LANES).
        relative: (8 most, LANES): range m, sine and cosine of azimuth and of inclination, and three standard
            deviations, infinite where nothing was measured.
    """

    member: Ints
    previous: Ints
    status: Floats
    motion: Floats
    relative: Floats


@inside
def moved_of(star: Star, k: int) -> Lanes:
    """Motion m of member k since the last step."""
    return vector_at(star.motion, 4 * k + MOVED)


@inside
def process_of(star: Star, k: int) -> Lanes:
    """Its variance m^2."""
    return vector_at(star.motion, 4 * k + PROCESS)


@inside
def position_of(star: Star, k: int) -> Lanes:
    """Position m of member k, as broadcast and brought forward."""
    return vector_at(star.motion, 4 * k + POSITION)


@inside
def variance_of(star: Star, k: int) -> Lanes:
    """Its variance m^2."""
    return vector_at(star.motion, 4 * k + VARIANCE)


@inside
def relative_of(star: Star, k: int) -> Lanes:
    """What is measured of member k, the eight numbers of `Star.relative`."""
    return load(star.relative, k, RELATIVE)


@storage
def star_within(most: int) -> Star:
    """Room for `most` members."""
    status, motion, relative = np.zeros((5 * most, LANES)), np.zeros((12 * most, LANES)), np.zeros((8 * most, LANES))
    return Star(np.zeros(most, np.int64), np.zeros(most, np.int64), status, motion, relative)


@storage
def new_estimates(measurements: Measurements) -> Estimates:
    """Room for the estimates of all runs and steps, made by compiled code."""
    runs, steps = measurements.gnss.shape[:2]
    return (
        np.empty((runs, steps, 3)),
        np.empty((runs, steps, 3, 3)),
        np.empty((runs, measurements.relative.shape[1], 3)),
    )


@inner
def gather(
    star: Star, before: Star, measurements: Measurements, model: Assumptions, first: int, last: int, t: int, old: int
) -> int:
    """Fill the star of step t with last messages, for runs first to last, at most LANES, the last one repeated; the
    number of its members.

    Args:
        star: memory.
        before: of the last step, of `old` members.
        measurements: measurements and messages.
        model: noise model.
        first: run.
        last: run.
        t: step.
        old: members of the last star.
    """
    n = 1 + measurements.start[t + 1] - measurements.start[t]
    for k in range(n):
        link = measurements.start[t] + k - 1
        star.member[k] = j = measurements.ego if k == 0 else measurements.neighbour[link]
        star.previous[k] = -1
        for i in range(old):
            if before.member[i] == j:
                star.previous[k] = i
        previous, last_status = star.previous[k], 5 * max(star.previous[k], 0)
        for lane in range(LANES):
            run = min(first + int(lane), last)
            sent = t if k == 0 else measurements.newest[run, link]
            when = sent if sent >= 0 else t
            again = previous >= 0 and before.status[last_status + SENT, lane] == sent
            uses, held = before.status[last_status + USES, lane] + 1.0 if again else 1.0, 1.0 if sent >= 0 else 0.0
            at, variance = three_of(measurements.broadcast, run, when, j), three_of(model.broadcast, run, when, j)
            if k == 0:
                at, variance = three_of(measurements.gnss, run, when, j), three_of(model.fixes, run, when, j)
            there = math.isfinite(at[0] + at[1] + at[2])
            if not there:
                at, variance = ROW, (NOWHERE, NOWHERE, NOWHERE)
            velocity, process = three_of(measurements.velocity, run, when, j), three_of(model.process, run, when, j)
            put_lane(star.motion, 12 * k, lane, (*velocity, *process, *at, *variance))
            new = 1.0 if there and (k == 0 or measurements.fresh[run, link]) else 0.0
            put_lane(star.status, 5 * k, lane, (float(sent), uses, float(t - when), held, new))
            if k > 0:
                std = model.relative_std if len(model.relative_std) else UNIT
                put_lane(star.relative, 8 * k, lane, with_std(measurements.relative[run, link], std))
        interpret(star, model, k, measurements.dt)
    return int(n)


@inside
def clear(values: Floats) -> None:
    """Fill with zeros."""
    for i in range(len(values)):
        store(values, i, (0.0,))


@inside
def interpret(star: Star, model: Assumptions, k: int, dt: float) -> None:
    """What the last message of member k means now: the velocity moves it, the position is brought forward.

    A velocity that serves for the n-th step in a row makes the same error n times: the variance of the sum is n^2 of
    that of one step, so this step adds 2 n - 1 of it. It has changed since it was sent, too.
    """
    uses, age = take(star.status, 5 * k + USES), take(star.status, 5 * k + AGE)
    held = take(star.status, 5 * k + HELD)
    late, often = dt * dt * age * model.acceleration, 2.0 * uses - 1.0
    velocity, late = moved_of(star, k), late * late
    one = add(process_of(star, k), (late, late, late))
    moved = scale(velocity, choose(held, dt + 0.0 * age, 0.0 * age))
    flat = 0.0 * age + model.flat
    grown = scale(one, age * (model.growth[0] * age + model.growth[1]))
    store(star.motion, 4 * k + MOVED, moved)
    store(star.motion, 4 * k + PROCESS, choose_each(held, scale(one, often), (flat, flat, flat)))
    store(star.motion, 4 * k + POSITION, add(position_of(star, k), scale(moved, age)))
    store(star.motion, 4 * k + VARIANCE, add(variance_of(star, k), grown))


@inside
def three_of(values: Floats, run: int, t: int, member: int) -> Numbers:
    """Three of what is broadcastable to (R, T, N, 3)."""
    i, j, k = min(run, values.shape[0] - 1), min(t, values.shape[1] - 1), min(member, values.shape[2] - 1)
    return values[i, j, k, 0], values[i, j, k, 1], values[i, j, k, 2]


@inside
def put_lane(memory: Floats, at: int, lane: int, values: Numbers) -> None:
    """Write numbers of one run."""
    for i in range(len(values)):
        memory[at + i, lane] = values[i]

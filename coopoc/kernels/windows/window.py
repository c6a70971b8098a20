"""The most probable window of stars of each run and step: converted linear start, then exact Gauss-Newton steps.

A window of one step is a snapshot. LANES runs go side by side, each with the digits that it has alone: one that has
settled stands still until the others have.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy import uint64

from ...arrays import AnyArray, Bools, Floats, Ints
from ..compiling.compile import as_written, inner
from ..compiling.small import load, store, subtract
from ..compiling.vectors import LANES, put, take
from ..stars.edges import AT_MEASUREMENT, EXACT
from ..stars.messages import HELD, NEW, POSITION, USES, VARIANCE, Assumptions, Measurements, Star, new_star
from .chains import Memory, move, new_memory
from .gnc import GNC, Weights, new_weights, residuals, restore, reweigh, trust_all, weigh
from .slots import ROW, Window, any_positive, count_of, enter, linearise, new_window, place_of

SOLVED, MET, LOST, BLIND = range(4)
"""Solved exactly; solved converted, since two vehicles met; not solved: Gauss-Newton did not settle; solved with all
fixes, since the GNC weights had rejected every one."""
START, LEAST_SQUARES, ROBUST, MEETING = range(4)
"""Stages of a window."""
LIMIT = 12
"""Gauss-Newton steps; about 3 are needed."""
HALVES = 200
"""Half steps where whole ones oscillate, before the damped reference takes over. They gain a digit every three or four,
so that the last must be the shorter."""


class Fresh(NamedTuple):
    """Which positions count once: own (R, T) of the ego's, link (R, M) of the neighbours' where new; met (M,) step at
    which the neighbour of each link was linked before, -1 for never."""

    own: Bools
    link: Bools
    met: Ints


class Settings(NamedTuple):
    """Steps of a window; m, largest move of the last step; m on the ground, closer vehicles stand in one place."""

    length: int
    tolerance: float
    apart: float


class Found(NamedTuple):
    """x (R, T, 3) m, covariance (R, T, 3, 3) m^2, neighbours (R, M, 3) m, NaN without any message, and how each ended
    (R, T)."""

    x: Floats
    covariance: Floats
    neighbours: Floats
    ended: Ints


def windows(seen: Measurements, known: Assumptions, fresh: Fresh, settings: Settings, gnc: GNC) -> Found:
    """All windows of a drive.

    Args:
        seen: `fresh` is where any message is held.
        gnc: without rounds for no robust loss.
    """
    runs, steps = seen.gnss.shape[:2]
    found = Found(
        np.empty((runs, steps, 3)),
        np.empty((runs, steps, 3, 3)),
        np.empty((runs, len(seen.neighbour), 3)),
        np.full((runs, steps), LOST),
    )
    window, star = new_windows(seen.start, settings.length)
    tools = new_memory(settings.length, window.layout[1]), new_weights(seen.gnss.shape[2]), gnc
    solve_all(window, star, seen, known, fresh, settings, tools, found)
    return found


@as_written
def solve_all(
    window: Window,
    star: Star,
    seen: Measurements,
    known: Assumptions,
    fresh: Fresh,
    settings: Settings,
    tools: Any,
    found: Found,
) -> None:
    """Solve window after window."""
    runs, steps = seen.gnss.shape[:2]
    for first in range(0, runs, LANES):
        here = (first, min(first + LANES, runs) - 1)
        for t in range(steps):
            span = (max(0, t - settings.length + 1), t)
            enter(window, star, seen, known, here, t)
            use_fixes(window, seen.start, fresh, here, span)
            solve(window, seen, known, here, span, settings, tools, found)


def new_windows(start: AnyArray, length: int) -> tuple[Window, Star]:
    """Room for the windows of a drive."""
    most = 1 + int(np.diff(start).max(initial=0))
    return new_window(length, most), new_star(most)


@as_written
def gather_window(
    window: Window, star: Star, seen: Measurements, known: Assumptions, fresh: Fresh, runs: Any, span: Any
) -> None:
    """Take in the last step of a span, yet to be solved."""
    enter(window, star, seen, known, runs, span[1])
    use_fixes(window, seen.start, fresh, runs, span)


@inner
def use_fixes(window: Window, start: AnyArray, fresh: Fresh, runs: Any, span: Any) -> None:
    """Start from the positions, with the information of those that count: one that is not new counts where the window
    meets its vehicle, and never twice in a window."""
    for step in range(span[0], span[1] + 1):
        for k in range(count_of(window.sizes, step)):
            place, link = place_of(window.layout, step, k), start[step] + k - 1
            meets = step == span[0] if k == 0 else fresh.met[link] < span[0]
            for lane in range(LANES):
                run = min(runs[0] + lane, runs[1])
                new = fresh.own[run, step] if k == 0 else fresh.link[run, link]
                window.status[5 * place + USES, lane] = 1.0 if new or meets else 0.0
            count = take(window.status, uint64(5 * place + USES)) * take(window.status, uint64(5 * place + NEW))
            p, q, r = load(window.motion, 4 * place + VARIANCE, ROW)
            fix = count / p, count / q, count / r
            store(window.fix, place, fix)
            store(window.used, place, fix)
            store(window.point, place, load(window.motion, 4 * place + POSITION, ROW))


@inner
def solve(
    window: Window,
    seen: Measurements,
    known: Assumptions,
    runs: Any,
    span: Any,
    settings: Settings,
    tools: Any,
    found: Found,
) -> None:
    """The newest point of a window, its covariance, and how it ended, in each of the runs.

    Stage by stage: converted, exact, with the GNC weights of each round, and converted where vehicles met.
    """
    memory, weights, gnc = tools
    here, exact, stage = (runs, span[1], seen.start[span[1]]), len(known.relative_std) > 0, START
    for lane in range(LANES):
        memory.active[lane] = 1.0 if lane <= runs[1] - runs[0] else 0.0
        weights.going[lane], weights.blind[lane], weights.mu[lane] = False, False, 0.0
    while any_positive(memory.active):
        how = EXACT if exact and stage != START and stage != MEETING else AT_MEASUREMENT
        descend(window, span, (known.relative_std, known.min_range), how, settings, memory, here, found)
        if stage == START:
            stage = ROBUST if gnc.rounds > 0 and trust_all(window, span, weights, gnc.ego) else LEAST_SQUARES
            for lane in range(runs[1] - runs[0] + 1):
                weights.going[lane] = stage == ROBUST
                memory.active[lane] = 1.0 if exact else 0.0
                if exact:
                    found.ended[runs[0] + lane, span[1]] = LOST
            if exact:
                continue
        if stage == ROBUST:
            sharpen(window, span, weights, gnc, memory, here, found)
        if stage != MEETING and exact and not any_positive(memory.active):
            stage = MEETING
            find_met(window, span, settings, memory, here, found)


@inner
def descend(
    window: Window, span: Any, assumed: Any, how: Any, settings: Settings, memory: Memory, here: Any, found: Found
) -> None:
    """Gauss-Newton steps of the active runs until each has settled; a converted problem is linear.

    A run that has not settled after all of them is no longer active, and lost.
    """
    for count in range(1 if how != EXACT else LIMIT + HALVES):
        share, enough = (1.0, settings.tolerance) if count < LIMIT else (0.5, 1e-3 * settings.tolerance)
        linearise(window, span, assumed, how)
        put(memory.most, uint64(0), move(window, span, memory, share * take(memory.active, uint64(0))))
        for lane in range(LANES):
            if memory.active[lane] > 0.0 and (memory.most[lane] <= enough or how != EXACT):
                memory.active[lane] = 0.0
                record(window, memory, lane, here, found)
        if not any_positive(memory.active):
            break
    for lane in range(LANES):
        if memory.active[lane] > 0.0:
            found.ended[here[0][0] + lane, here[1]], memory.active[lane] = LOST, 0.0


@inner
def sharpen(window: Window, span: Any, weights: Weights, gnc: GNC, memory: Memory, here: Any, found: Found) -> None:
    """The next weights of the runs whose weights still change; these are active then."""
    runs, t, _ = here
    residuals(window, span, weights, gnc.ego)
    for lane in range(runs[1] - runs[0] + 1):
        run = runs[0] + lane
        weights.going[lane] &= found.ended[run, t] == SOLVED
        if weights.blind[lane] and found.ended[run, t] == SOLVED:
            found.ended[run, t] = BLIND
        if weights.going[lane]:
            weights.going[lane] = not reweigh(weights, gnc, lane)
            found.ended[run, t], memory.active[lane] = LOST, 1.0
    weigh(window, span, weights)
    if gnc.ego:
        restore(window, span, weights, memory.active)


@inner
def find_met(window: Window, span: Any, settings: Settings, memory: Memory, here: Any, found: Found) -> None:
    """Runs in which a neighbour is `apart` or less from the ego; the converted problem answers there."""
    runs, t, _ = here
    put(memory.most, uint64(0), nearest(window, span))
    for lane in range(runs[1] - runs[0] + 1):
        if memory.most[lane] < settings.apart and found.ended[runs[0] + lane, t] == SOLVED:
            memory.active[lane], found.ended[runs[0] + lane, t] = 1.0, MET


@inner
def nearest(window: Window, span: Any) -> Any:
    """m on the ground between the ego and a neighbour, the least of all steps."""
    least = 0.0 * take(window.odometry, uint64(0)) + 1e300
    for step in range(span[0], span[1] + 1):
        ego = place_of(window.layout, step, 0)
        for place in range(ego + 1, ego + count_of(window.sizes, step)):
            x, y, _ = subtract(load(window.point, place, ROW), load(window.point, ego, ROW))
            least = -max(-least, -math.sqrt(x * x + y * y))
    return least


@inner
def record(window: Window, memory: Memory, lane: int, here: Any, found: Found) -> None:
    """What one of the runs has found."""
    runs, t, link = here
    run, ego = runs[0] + lane, place_of(window.layout, t, 0)
    found.ended[run, t] = MET if found.ended[run, t] == MET else SOLVED
    for i in range(3):
        found.x[run, t, i] = window.point[3 * ego + i, lane]
        for j in range(3):
            found.covariance[run, t, i, j] = -memory.cov[3 * min(i, j) + max(i, j), lane]
    for k in range(1, count_of(window.sizes, t)):
        held = window.status[5 * (ego + k) + HELD, lane] > 0.0
        for i in range(3):
            point = window.point[3 * (ego + k) + i, lane]
            found.neighbours[run, link + k - 1, i] = point if held else np.nan

"""Most probable window of stars of each run and step: converted linear start, then exact Gauss-Newton steps.

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
from ..compiling.small import load, store
from ..compiling.vectors import LANES, put, take
from ..stars.edges import AT_MEASUREMENT, EXACT, edge
from ..stars.messages import (
    HELD,
    NEW,
    POSITION,
    RELATIVE,
    USES,
    VARIANCE,
    Assumptions,
    Measurements,
    Star,
)
from .chains import System, advance, gap_of, gauss_newton, new_system
from .robust import GNC, Weights, new_weights, residuals, reweigh, trust_all, weigh
from .window_layout import ROW, Window, any_positive, count_of, enter, new_star, new_window, row_of

SOLVED, MET, LOST = range(3)
"""Solved exactly; solved converted, since two vehicles met; not solved: Gauss-Newton did not settle."""
START, LEAST_SQUARES, ROBUST, MEETING = range(4)
"""Stages of a window."""
LIMIT = 12
"""Gauss-Newton steps; about 3 are needed."""
HALVES = 200
"""Half steps where whole ones oscillate, before the damped reference takes over. They gain a digit every three or four,
so that the last must be the shorter."""
FLOOR = 1e-12
"""1/m^2 on the first point of every neighbour: one of which nothing is known has a place all the same."""


class Fresh(NamedTuple):
    """Which positions count once: own (R, T) of the ego's, link (R, M) of the neighbours' where new; met (M,) step at
    which the neighbour of each link was linked before, -1 for never."""

    own: Bools
    link: Bools
    met: Ints


class BatchSettings(NamedTuple):
    """Steps of a window; m, largest move of the last step; m on the ground, closer vehicles stand in one place."""

    length: int
    tolerance: float
    apart: float


class Solutions(NamedTuple):
    """x (R, T, 3) m, covariance (R, T, 3, 3) m^2, neighbours (R, M, 3) m, NaN without any message, and how each ended
    (R, T)."""

    x: Floats
    covariance: Floats
    neighbours: Floats
    ended: Ints


def windows(seen: Measurements, known: Assumptions, fresh: Fresh, settings: BatchSettings, gnc: GNC) -> Solutions:
    """All windows of a drive.

    Args:
        seen: `fresh` is where any message is held.
        known: the noise that is assumed.
        fresh: which positions count.
        settings: of the windows.
        gnc: without rounds for no robust loss.
    """
    runs, steps = seen.gnss.shape[:2]
    x, cov, ended = np.empty((runs, steps, 3)), np.empty((runs, steps, 3, 3)), np.full((runs, steps), LOST)
    solutions = Solutions(x, cov, np.empty((runs, len(seen.neighbour), 3)), ended)
    window, star = new_windows(seen.start, settings.length)
    tools = new_system(settings.length, window.layout[1]), new_weights(seen.gnss.shape[2]), gnc
    solve_all(window, star, seen, known, fresh, settings, tools, solutions)
    return solutions


@as_written
def solve_all(
    window: Window,
    star: Star,
    seen: Measurements,
    known: Assumptions,
    fresh: Fresh,
    settings: BatchSettings,
    tools: Any,
    solutions: Solutions,
) -> None:
    """Solve window after window."""
    runs, steps = seen.gnss.shape[:2]
    for first in range(0, runs, LANES):
        here = (first, min(first + LANES, runs) - 1)
        for t in range(steps):
            span = (max(0, t - settings.length + 1), t)
            enter(window, star, seen, known, here, t)
            use_fixes(window, seen.start, fresh, here, span)
            solve_stages(window, seen, known, here, span, settings, tools, solutions)


def new_windows(start: AnyArray, length: int) -> tuple[Window, Star]:
    """Room for the windows of a drive."""
    most = 1 + int(np.diff(start).max(initial=0))
    return new_window(length, most), new_star(most)


@as_written
def gather_window(
    window: Window,
    star: Star,
    seen: Measurements,
    known: Assumptions,
    fresh: Fresh,
    runs: tuple[int, int],
    span: tuple[int, int],
) -> None:
    """Take in the last step of a span, yet to be solved."""
    enter(window, star, seen, known, runs, span[1])
    use_fixes(window, seen.start, fresh, runs, span)


@inner
def use_fixes(window: Window, start: AnyArray, fresh: Fresh, runs: tuple[int, int], span: tuple[int, int]) -> None:
    """Start from the positions, with the information of those that count: one that is not new counts where the window
    meets its vehicle, and never twice in a window."""
    for step in range(span[0], span[1] + 1):
        for k in range(count_of(window.sizes, step)):
            row, link = row_of(window.layout, step, k), start[step] + k - 1
            meets = step == span[0] if k == 0 else fresh.met[link] < span[0]
            for lane in range(LANES):
                run = min(runs[0] + lane, runs[1])
                new = fresh.own[run, step] if k == 0 else fresh.link[run, link]
                window.status[5 * row + USES, lane] = 1.0 if new or meets else 0.0
            count = take(window.status, uint64(5 * row + USES)) * take(window.status, uint64(5 * row + NEW))
            p, q, r = load(window.motion, 4 * row + VARIANCE, ROW)
            fix, at = (count / p, count / q, count / r), load(window.motion, 4 * row + POSITION, ROW)
            store(window.fix, row, fix)
            store(window.used, row, fix)
            store(window.point, row, at)
            store(window.start, row, at)


@inner
def solve_stages(
    window: Window,
    seen: Measurements,
    known: Assumptions,
    runs: tuple[int, int],
    span: tuple[int, int],
    settings: BatchSettings,
    tools: Any,
    solutions: Solutions,
) -> None:
    """The newest point of a window, its covariance, and how it ended, in each of the runs.

    Stage by stage: converted, exact, with the GNC weights of each round, and converted where vehicles met.
    """
    system, weights, gnc = tools
    here, exact, stage = (runs, span[1], seen.start[span[1]]), len(known.relative_std) > 0, START
    for lane in range(LANES):
        system.active[lane] = 1.0 if lane <= runs[1] - runs[0] else 0.0
        weights.going[lane], weights.mu[lane] = False, 0.0
    while any_positive(system.active):
        how = EXACT if exact and stage != START and stage != MEETING else AT_MEASUREMENT
        descend(window, span, (known.relative_std, known.min_range), how, settings, system, here, solutions)
        if stage == START:
            stage = ROBUST if gnc.rounds > 0 and trust_all(window, span, weights) else LEAST_SQUARES
            for lane in range(runs[1] - runs[0] + 1):
                weights.going[lane] = stage == ROBUST
                system.active[lane] = 1.0 if exact else 0.0
                if exact:
                    solutions.ended[runs[0] + lane, span[1]] = LOST
            if exact:
                continue
        if stage == ROBUST:
            sharpen(window, span, weights, gnc, system, here, solutions)
        if stage != MEETING and exact and not any_positive(system.active):
            stage = MEETING
            find_met(window, span, settings, system, here, solutions)


@inner
def descend(
    window: Window,
    span: tuple[int, int],
    assumed: Any,
    how: Any,
    settings: BatchSettings,
    system: System,
    here: Any,
    solutions: Solutions,
) -> None:
    """Gauss-Newton steps of the active runs until each has settled; a converted problem is linear.

    A run that has not settled after all of them is no longer active, and lost.
    """
    for count in range(1 if how != EXACT else LIMIT + HALVES):
        share, enough = (1.0, settings.tolerance) if count < LIMIT else (0.5, 1e-3 * settings.tolerance)
        linearise(window, span, assumed, how)
        gauss_newton(window, span, system, -1, FLOOR)
        put(system.most, uint64(0), advance(window, span, system, share * take(system.active, uint64(0))))
        for lane in range(LANES):
            if system.active[lane] > 0.0 and (system.most[lane] <= enough or how != EXACT):
                system.active[lane] = 0.0
                record(window, system, lane, here, solutions)
        if not any_positive(system.active):
            break
    for lane in range(LANES):
        if system.active[lane] > 0.0:
            solutions.ended[here[0][0] + lane, here[1]], system.active[lane] = LOST, 0.0


@inner
def linearise(window: Window, span: tuple[int, int], assumed: Any, how: int) -> None:
    """The relative measurements as edges at the points, in one of the ways of `edge`."""
    for step in range(span[0], span[1] + 1):
        ego = row_of(window.layout, step, 0)
        for row in range(ego + 1, ego + count_of(window.sizes, step)):
            gap = gap_of(window.point, ego, row)
            information, eta = edge(gap, load(window.relative, row, RELATIVE), assumed[0], assumed[1], how)
            store(window.edge, row, information)
            store(window.eta, row, eta)


@inner
def sharpen(
    window: Window,
    span: tuple[int, int],
    weights: Weights,
    gnc: GNC,
    system: System,
    here: Any,
    solutions: Solutions,
) -> None:
    """The next weights of the runs whose weights still change; these are active then."""
    runs, t, _ = here
    residuals(window, span, weights)
    for lane in range(runs[1] - runs[0] + 1):
        run = runs[0] + lane
        weights.going[lane] &= solutions.ended[run, t] == SOLVED
        if weights.going[lane]:
            weights.going[lane] = not reweigh(weights, gnc, lane)
            solutions.ended[run, t], system.active[lane] = LOST, 1.0
    weigh(window, span, weights)


@inner
def find_met(
    window: Window, span: tuple[int, int], settings: BatchSettings, system: System, here: Any, solutions: Solutions
) -> None:
    """Runs in which a neighbour is `apart` or less from the ego; the converted problem answers there."""
    runs, t, _ = here
    put(system.most, uint64(0), nearest(window, span))
    for lane in range(runs[1] - runs[0] + 1):
        if system.most[lane] < settings.apart and solutions.ended[runs[0] + lane, t] == SOLVED:
            system.active[lane], solutions.ended[runs[0] + lane, t] = 1.0, MET


@inner
def nearest(window: Window, span: tuple[int, int]) -> Any:
    """m on the ground between the ego and a neighbour, the least of all steps."""
    least = 0.0 * take(window.located, uint64(0)) + 1e300
    for step in range(span[0], span[1] + 1):
        ego = row_of(window.layout, step, 0)
        for row in range(ego + 1, ego + count_of(window.sizes, step)):
            x, y, _ = gap_of(window.point, ego, row)
            least = -max(-least, -math.sqrt(x * x + y * y))
    return least


@inner
def record(window: Window, system: System, lane: int, here: Any, solutions: Solutions) -> None:
    """The solution of one of the runs."""
    runs, t, link = here
    run, ego = runs[0] + lane, row_of(window.layout, t, 0)
    solutions.ended[run, t] = MET if solutions.ended[run, t] == MET else SOLVED
    for i in range(3):
        solutions.x[run, t, i] = window.point[3 * ego + i, lane]
        for j in range(3):
            solutions.covariance[run, t, i, j] = -system.cov[3 * min(i, j) + max(i, j), lane]
    for k in range(1, count_of(window.sizes, t)):
        held = window.status[5 * (ego + k) + HELD, lane] > 0.0
        for i in range(3):
            point = window.point[3 * (ego + k) + i, lane]
            solutions.neighbours[run, link + k - 1, i] = point if held else np.nan

"""Moving horizons and fixed-lag smoothers of one ego's star: a window of steps behind an arrival cost.

A Gauss-Newton step of the window eliminates it step by step up to the newest, solves that, and substitutes back
(`windows.sweep`); a step that leaves the window becomes the arrival cost of the next. LANES runs go side by
side.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy import uint64

from ...arrays import AnyArray, Bools, Floats
from ..compiling.compile import as_written, inner
from ..compiling.small import load, negate, store
from ..compiling.vectors import LANES, put, take
from ..stars.joint import Joint, new_joint
from ..stars.messages import (
    NEW,
    SENT,
    USES,
    VARIANCE,
    Assumptions,
    Measurements,
    Star,
    interpret,
    new_star,
    receive,
)
from .back import Past, ego_covariance, new_past
from .slots import ROW, Window, any_positive, count_of, enter, new_window, place_of, star_at
from .sweep import distance, start_points, sweep


class Settings(NamedTuple):
    """Steps of a window; relative measurements in range and angles, or converted vectors; Gauss-Newton steps after the
    first, taken where a vector has left the point at which its measurement is linear by more than `strayed` m; steps
    for which a velocity may serve, negative where a message counts when it arrives and not when it was sent; whether a
    step is estimated when it leaves the window."""

    length: int
    exact: bool
    sweeps: int
    strayed: float
    age: float
    smoothed: bool


class Found(NamedTuple):
    """x (R, T, 3) m, covariance (R, T, 3, 3) m^2, neighbours (R, M, 3) m, and (R, T) whether a window still moved."""

    x: Floats
    covariance: Floats
    neighbours: Floats
    moving: Bools


class Horizon(NamedTuple):
    """A window of LANES runs, its past, and the memory of its steps; mask (LANES,): 1 where a run still moves."""

    window: Window
    past: Past
    joint: Joint
    star: Star
    mask: Floats


def new_horizon(length: int, most: int) -> Horizon:
    """Room for windows of `length` steps of at most `most` members."""
    joint = new_joint(most, ROW)
    return Horizon(new_window(length, most), new_past(length, most), joint, new_star(most), np.ones(LANES))


def horizons(seen: Measurements, known: Assumptions, arrival: AnyArray, settings: Settings) -> Found:
    """All windows of a drive."""
    found = empty(seen)
    for runs, horizon in each_group(seen, settings.length):
        advance(horizon, seen, known, arrival, settings, runs, (0, len(seen.start) - 1), found)
    return found


def empty(seen: Measurements) -> Found:
    """Room for what is found."""
    runs, steps = seen.gnss.shape[:2]
    x, cov = np.empty((runs, steps, 3)), np.empty((runs, steps, 3, 3))
    return Found(x, cov, np.empty((runs, len(seen.neighbour), 3)), np.zeros((runs, steps), np.bool_))


def each_group(seen: Measurements, length: int) -> Iterator[tuple[tuple[int, int], Horizon]]:
    """First and last run of LANES runs, and room for them, to `advance` step by step."""
    most = 1 + int(np.diff(seen.start).max(initial=0))
    for first in range(0, len(seen.gnss), LANES):
        yield (first, min(first + LANES, len(seen.gnss)) - 1), new_horizon(length, most)


@as_written
def advance(
    horizon: Horizon,
    seen: Measurements,
    known: Assumptions,
    arrival: AnyArray,
    settings: Settings,
    runs: Any,
    steps: Any,
    found: Found,
) -> None:
    """Take in the steps from steps[0] up to steps[1], and solve the window that ends at each, in runs first to last.

    Args:
        seen: `newest` and `fresh` are overwritten where messages count when they were sent.
        arrival: (R, M) step at which the message of each link arrives, -1 for never.
    """
    window, past, joint, star, mask = horizon
    end = len(seen.start) - 2
    for t in range(steps[0], steps[1]):
        span = (max(0, t - settings.length + 1), t)
        enter(window, star, seen, known, runs, t)
        if settings.age >= 0.0:
            for step in range(span[0], t + 1):
                gather_arrived(window, seen, known, arrival, settings.age, runs, step, t)
        use_fixes(window, t if settings.age < 0.0 else span[0], t)
        start_points(window, past, known, t)
        mask[:] = 1.0
        for count in range(settings.sweeps + 1):
            sweep(window, past, joint, known, span, settings.exact, count == 0, mask)
            for lane in range(0 if settings.smoothed else runs[1] - runs[0] + 1):
                if mask[lane] > 0.0:
                    write_lane(window, joint.scratch, seen.start[t], (runs[0] + lane, lane), t, found)
            if settings.sweeps == 0 and settings.age < 0.0:
                break
            find_moving(window, past, span, settings, mask, joint.scratch)
            for lane in range(runs[1] - runs[0] + 1):
                found.moving[runs[0] + lane, t] = settings.exact and mask[lane] > 0.0
            if not any_positive(mask):
                break
        late = t - settings.length + 1
        for step in range(max(late, 0), (t if t == end else late) + 1 if settings.smoothed else 0):
            store(joint.scratch, 0, negate(ego_covariance(window, past, joint, (step, t))))
            for lane in range(runs[1] - runs[0] + 1):
                write_lane(window, joint.scratch, seen.start[step], (runs[0] + lane, lane), step, found)


@inner
def find_moving(window: Window, past: Past, span: Any, settings: Settings, mask: AnyArray, scratch: AnyArray) -> None:
    """Mask the runs in which a vector has left the one at which its measurement is linear."""
    put(scratch, uint64(0), distance(window, past, span))
    for lane in range(LANES):
        mask[lane] = 1.0 if scratch[0, lane] > settings.strayed else 0.0


@inner
def gather_arrived(
    window: Window,
    seen: Measurements,
    known: Assumptions,
    arrival: AnyArray,
    age: float,
    runs: Any,
    step: int,
    now: int,
) -> None:
    """Put the messages that have arrived by now where they belong: the message of a step moves its sender there, or
    the last one before that has arrived and is not too old, as if it had done so since it was sent, and its fix stands
    at the step at which it was sent."""
    star, here = star_at(window, step), place_of(window.layout, step, 0)
    for k in range(1, count_of(window.sizes, step)):
        link, place, changed = seen.start[step] + k - 1, window.previous[here + k], step == now
        for run in range(runs[0], runs[1] + 1):
            come = 0 <= arrival[run, link] <= now
            sent = step if come else seen.newest[run, link]
            if place >= 0 and step > 0:
                carried = int(star.last_status[5 * place + SENT, run - runs[0]])
                sent = max(sent, carried if step - carried <= age else -1)
            changed |= sent != seen.newest[run, link] or come != seen.fresh[run, link]
            seen.newest[run, link], seen.fresh[run, link] = sent, come
        if changed:
            for lane in range(uint64(LANES)):
                run = min(runs[0] + int(lane), runs[1])
                receive(star, seen, known, (run, step, link), (k, place, lane))
                used_since = max(seen.newest[run, link], window.joined[here + k])
                star.status[5 * k + USES, lane] = step - used_since + 1
            interpret(star, known, k, seen.dt)


@inner
def use_fixes(window: Window, first: int, last: int) -> None:
    """Information of the new fixes of some steps."""
    for step in range(first, last + 1):
        for place in range(
            place_of(window.layout, step, 0), place_of(window.layout, step, count_of(window.sizes, step))
        ):
            new = take(window.status, uint64(5 * place + NEW))
            p, q, r = load(window.motion, 4 * place + VARIANCE, ROW)
            store(window.used, place, (new / p, new / q, new / r))


@inner
def write_lane(window: Window, cov: AnyArray, link: int, which: Any, t: int, found: Found) -> None:
    """Copy one run's points and the ego's covariance."""
    (run, lane), ego = which, place_of(window.layout, t, 0)
    for i in range(3):
        found.x[run, t, i] = window.point[3 * ego + i, lane]
        for j in range(3):
            found.covariance[run, t, i, j] = cov[3 * min(i, j) + max(i, j), lane]
        for k in range(1, count_of(window.sizes, t)):
            found.neighbours[run, link + k - 1, i] = window.point[3 * (ego + k) + i, lane]

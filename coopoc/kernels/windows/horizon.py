"""Moving horizons of one ego's star: a window of steps behind an arrival cost.

A step that leaves the window is solved by itself, given its own past; its Gaussian, predicted, is the arrival cost of
the next one. LANES runs go side by side.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, cast

import numpy as np
from numpy import uint64

from ...arrays import AnyArray, Bools, Floats, Ints
from ..compiling.compile import as_written, inner, inside
from ..compiling.small import (
    add,
    add_diagonal,
    choose_each,
    from_upper,
    load,
    negate,
    plus_applied,
    scale,
    store,
    subtract,
    times,
    zeros,
)
from ..compiling.vectors import LANES, choose, put, take
from ..geometry import Numbers, completed, converted, direction, exact, vector, whole
from ..stars.gated import Gates, carry, gate_position, gate_star, gates_within, set_ego
from ..stars.joint import Joint, add_relative, block_of, joint_within, predict, rearrange, solve
from ..stars.messages import (
    BLOCK,
    NEW,
    RELATIVE,
    ROW,
    SENT,
    USES,
    Assumptions,
    Measurements,
    block_at,
    clear,
    fix_information,
    interpret,
    moved_of,
    position_of,
    receive,
    vector_at,
)
from .chains import System, advance, gap_of, gauss_newton, new_system
from .window_layout import (
    Window,
    any_positive,
    count_of,
    enter,
    largest_of,
    motion,
    new_window,
    row_of,
    star_at,
)

EXACT, AT_GAP = np.arange(2)
"""Linear in range and angles at the present points; converted to a vector, weighted by the geometry of the points,
which must not depend on the measurement. NumPy's integers: for each constant of Python's numba would compile a function
once more."""


class Settings(NamedTuple):
    """How a horizon is solved.

    Attributes:
        length: steps of a window.
        exact: relative measurements in range and angles, or converted vectors.
        repeats: Gauss-Newton steps after the first, taken where a vector has left its `base` by more than `strayed`.
        strayed: m.
        age: steps for which a velocity may serve.
        robust: gate innovations.
    """

    length: int
    exact: bool
    repeats: int
    strayed: float
    age: float
    robust: bool


class Estimates(NamedTuple):
    """x (R, T, 3) m, covariance (R, T, 3, 3) m^2, neighbours (R, M, 3) m, and (R, T) whether a window still moved."""

    x: Floats
    covariance: Floats
    neighbours: Floats
    moving: Bools


def horizons(measurements: Measurements, model: Assumptions, arrival: Ints, settings: Settings) -> Estimates:
    """Estimates at the newest step of all windows of a drive.

    Args:
        measurements: `newest` and `fresh` are overwritten.
        model: the noise that is assumed.
        arrival: (R, M) step at which the message of each link arrives, -1 for never.
        settings: of the windows.
    """
    (runs, steps), most = measurements.gnss.shape[:2], 1 + int(np.diff(measurements.start).max(initial=0))
    x, cov = np.empty((runs, steps, 3)), np.empty((runs, steps, 3, 3))
    estimates = Estimates(x, cov, np.empty((runs, len(measurements.neighbour), 3)), np.zeros((runs, steps), np.bool_))
    window, within = new_window(settings.length, most), cast(Any, (joint_within, gates_within))
    joint, gates = (make.py_func(most) for make in within)
    system = new_system(settings.length, most, joint.information)
    for first in range(0, runs, LANES):
        here = first, min(first + LANES, runs) - 1
        follow_horizon((window, joint, system, gates), measurements, model, arrival, settings, here, estimates)
    return estimates


@as_written
def follow_horizon(
    memory: Any,
    measurements: Measurements,
    model: Assumptions,
    arrival: Ints,
    settings: Settings,
    runs: tuple[int, int],
    estimates: Estimates,
) -> None:
    """Solve the window that ends at each step, in runs first to last."""
    window, joint, system, gates = memory
    for t in range(len(measurements.start) - 1):
        span = (max(0, t - settings.length + 1), t)
        enter(window, measurements, model, runs, t)
        for step in range(span[0], t + 1):
            gather_arrived(window, gates, measurements, model, arrival, settings, runs, step, t)
        start_points(window, t)
        if settings.robust:
            gate_step(window, gates, model, t)
        link_points(window, model, t)
        use_new_fixes(window, span[0], t)
        if span[0] > 0:
            leave(window, joint, model, span[0] - 1)
        elif t == 0:
            forget(joint, model, count_of(window.sizes, 0))
        system.active[:] = 1.0
        for count in range(settings.repeats + 1):
            solve_window(window, model, span, settings.exact, count == 0, system)
            for lane in range(runs[1] - runs[0] + 1):
                if system.active[lane] > 0.0:
                    write_lane(window, system.cov, measurements.start[t], (runs[0] + lane, lane), t, estimates)
            put(system.most, uint64(0), distance(window, span))
            for lane in range(LANES):
                system.active[lane] = 1.0 if system.most[lane] > settings.strayed else 0.0
            for lane in range(runs[1] - runs[0] + 1):
                estimates.moving[runs[0] + lane, t] = settings.exact and system.active[lane] > 0.0
            if not any_positive(system.active):
                break
        set_ego(gates, negate(block_at(system.cov, 0)))


@inner
def solve_window(
    window: Window, model: Assumptions, span: tuple[int, int], exact: bool, entered: bool, system: System
) -> None:
    """One Gauss-Newton step of the window in the active runs.

    Args:
        window: its steps, and their relative measurements as last made linear.
        model: the noise that is assumed.
        span: its first and last step.
        exact: measurements in range and angles.
        entered: the newest step has just come: it is solved converted, and made exact where that leads.
        system: the normal equations.
    """
    active, last = take(system.active, uint64(0)), span[1]
    coupled, prior = count_of(window.sizes, span[0]) - 1, 1.0 / model.flat
    for step in range(span[0], last + (0 if entered else 1) if exact else span[0]):
        linearise_step(window, model, step, active)
    gauss_newton(window, span, system, coupled, prior)
    if exact and entered:
        ego = row_of(window.layout, last, 0)
        for row in range(ego + 1, ego + count_of(window.sizes, last)):
            gap = add(gap_of(window.point, ego, row), gap_of(system.move, ego, row))
            put_edge(window, model, ego, row, gap, EXACT, active)
        gauss_newton(window, span, system, coupled, prior)
    advance(window, span, system, active)


@inner
def linearise_step(window: Window, model: Assumptions, step: int, active: Any) -> None:
    """The relative measurements of a step in range and angles, where its points are."""
    ego = row_of(window.layout, step, 0)
    for row in range(ego + 1, ego + count_of(window.sizes, step)):
        put_edge(window, model, ego, row, gap_of(window.point, ego, row), EXACT, active)


@inner
def put_edge(window: Window, model: Assumptions, ego: int, row: int, gap: Any, how: Any, active: Any) -> None:
    """The relative measurement of a row, linear at the vector `gap`, where `active` is positive."""
    z = load(window.relative, row, RELATIVE)
    information, eta = edge(gap, z, model.relative_std, model.min_range, how)
    eta = plus_applied(eta, information, subtract(gap, gap_of(window.point, ego, row)))
    o, used = 0.0 * gap[0], max(take(window.located, uint64(row)), whole(load(window.relative, row, RELATIVE))) - 0.5
    information, eta = choose_each(used, information, zeros(o, BLOCK)), choose_each(used, eta, zeros(o, ROW))
    store(window.edge, row, choose_each(active, information, block_at(window.edge, row)))
    store(window.eta, row, choose_each(active, eta, vector_at(window.eta, row)))
    store(window.base, row, choose_each(active, gap, vector_at(window.base, row)))


@inner
def edge(gap: Numbers, z: Numbers, std: Floats, least: float, how: int) -> tuple[Numbers, Numbers]:
    """E = J^T W J and eta = J^T W (z - h) at the vector `gap` m; without standard deviations E is the unit matrix.

    Args:
        gap: from the ego to the neighbour.
        z: the measurement.
        std: (3,) m, rad, rad, of no length for unit matrices.
        least: m; the angles of a measurement that is shorter have their standard deviations inflated.
        how: EXACT or AT_GAP.
    """
    z = z if how == AT_GAP else inflated(z, least)
    if len(std) == 0:
        there = whole(z)
        o = 0.0 * there
        return from_upper((there, o, o, there, o, there)), scale(subtract(vector(z), gap), there)
    return exact(gap, z, 0.0) if how == EXACT else converted(gap, z, False, least)


@inner
def inflated(z: Numbers, least: float) -> Numbers:
    """The measurement, its angles' standard deviations inflated by least / range, up to half a turn."""
    wide = choose(1e300 - z[5], max(least / max(z[0], 1e-300), 1.0), 0.0 * z[0] + 1.0)
    s1, s2 = -max(-(wide * z[6]), -math.pi), -max(-(wide * z[7]), -math.pi)
    return z[0], z[1], z[2], z[3], z[4], z[5], max(s1, z[6]), max(s2, z[7])


@inner
def distance(window: Window, span: tuple[int, int]) -> Any:
    """m by which a vector has left the one at which its measurement is linear, the largest along an axis."""
    most = 0.0 * vector_at(window.point, row_of(window.layout, span[1], 0))[0]
    for step in range(span[0], span[1] + 1):
        ego = row_of(window.layout, step, 0)
        for row in range(ego + 1, ego + count_of(window.sizes, step)):
            most = max(most, largest_of(subtract(gap_of(window.point, ego, row), vector_at(window.base, row))))
    return most


@inner
def start_points(window: Window, t: int) -> None:
    """A new step where it is expected: a member that stays moves, one that joins stands where the ego measures it, and
    one that nothing has located yet where its first position puts it, with its earlier points."""
    ego, before = row_of(window.layout, t, 0), row_of(window.layout, t - 1, 0)
    for k in range(count_of(window.sizes, t)):
        row, previous = ego + k, window.previous[ego + k]
        fix, new = position_of(window, row), take(window.status, uint64(5 * row + NEW))
        there = 0.0 * new + 1.0 if k == 0 else max(new, whole(load(window.relative, row, RELATIVE)))
        at = fix
        if previous >= 0:
            located = take(window.located, uint64(before + previous))
            at = add(vector_at(window.point, before + previous), moved_of(window, row))
            first = new - located - 0.5  # > 0: its first position
            at = choose_each(first, fix, at)
            there = max(there, located)
            if any_above(first):
                locate_before(window, row, t, first, at)
        elif k > 0:
            origin = vector_at(window.point, ego)
            x, y, z = subtract(fix, origin)
            at = add(origin, vector(completed(load(window.relative, row, RELATIVE), direction(x, y, z))))
        put(window.located, uint64(row), there)
        store(window.point, row, at)
        store(window.start, row, at)


@inner
def gate_step(window: Window, gates: Gates, model: Assumptions, t: int) -> None:
    """Gate what is new at the newest step where its points are expected."""
    here, n = row_of(window.layout, t, 0), count_of(window.sizes, t)
    star, old = star_at(window, t), count_of(window.sizes, t - 1) if t > 0 else 0
    carry(star, gates, model.flat, n, old)
    points, located = window.point[3 * here : 3 * (here + n)], window.located[here : here + n]
    gate_star(star, gates, points, located, model.min_range, n)


@inner
def link_points(window: Window, model: Assumptions, t: int) -> None:
    """The relative measurements of a new step, where its points are expected."""
    ego = row_of(window.layout, t, 0)
    for row in range(ego + 1, ego + count_of(window.sizes, t)):
        gap = gap_of(window.point, ego, row)
        put_edge(window, model, ego, row, gap, AT_GAP, 0.0 * gap[0] + 1.0)


@inside
def any_above(values: Any) -> bool:
    """True if any of these runs has a number > 0."""
    return not values <= 0.0 * values


@inner
def locate_before(window: Window, row: int, t: int, mask: Any, at: Any) -> None:
    """Bring the earlier points of a member, which nothing had located, to where its first position puts them."""
    here, step = row, t
    while window.previous[here] >= 0 and step > 0 and t - step < len(window.sizes) - 1:
        at = subtract(at, moved_of(window, here))
        here, step = row_of(window.layout, step - 1, window.previous[here]), step - 1
        lost = choose(mask, 0.5 - take(window.located, uint64(here)), 0.0 * at[0])
        store(window.point, here, choose_each(lost, at, vector_at(window.point, here)))
        put(window.located, uint64(here), choose(lost, 0.0 * at[0] + 1.0, take(window.located, uint64(here))))


@inner
def forget(joint: Joint, model: Assumptions, n: int) -> None:
    """Know nothing of the past of the first step."""
    clear(joint.information)
    nothing = zeros(0.0 * take(joint.information, uint64(0)), BLOCK)
    flat = nothing[0] + 1.0 / model.flat
    for i in range(n):
        store(joint.information, i * (joint.stride + 1), add_diagonal(nothing, (flat, flat, flat)))


@inner
def leave(window: Window, joint: Joint, model: Assumptions, step: int) -> None:
    """A step becomes the past of the next one: its mean, moved, is where that expects its points, and its covariance,
    grown by the process noise, the arrival cost."""
    ego, after, n = row_of(window.layout, step, 0), row_of(window.layout, step + 1, 0), count_of(window.sizes, step)
    for k in range(n):
        i, row, fix = block_of(k, n), ego + k, vector_at(window.used, ego + k)
        at, off = i * (joint.stride + 1), position_of(window, row)
        store(joint.information, at, add_diagonal(block_at(joint.information, at), fix))
        store(joint.eta, i, times(fix, subtract(off, vector_at(window.start, row))))
        process, later = zeros(fix[0], ROW), window.later[row]
        if later >= 0:
            process, _ = motion(window, row, after + later)
        store(joint.process, i, process)
    for k in range(1, n):
        away = subtract(gap_of(window.point, ego, ego + k), gap_of(window.start, ego, ego + k))
        information = block_at(window.edge, ego + k)
        eta = plus_applied(vector_at(window.eta, ego + k), information, away)
        add_relative(joint.information, joint.eta, joint.stride, k, n, information, eta)
    solve(joint.information, joint, joint.eta, n)
    predict(joint.information, n, joint.stride, joint.process, joint.scratch)
    m, prior = count_of(window.sizes, step + 1), 1.0 / model.flat
    rearrange(star_at(window, step + 1), joint, m, n, (prior, prior, prior))
    for row in range(after, after + m):
        if window.previous[row] >= 0:
            before = ego + window.previous[row]
            mean = add(vector_at(window.start, before), vector_at(joint.eta, block_of(window.previous[row], n)))
            store(window.start, row, add(mean, moved_of(window, row)))


@inner
def gather_arrived(
    window: Window,
    gates: Gates,
    measurements: Measurements,
    model: Assumptions,
    arrival: Ints,
    settings: Settings,
    runs: tuple[int, int],
    step: int,
    now: int,
) -> None:
    """Put the messages that have arrived by now where they belong: the message of a step moves its sender there, or
    the last one before that has arrived and is not too old, as if it had done so since it was sent, and its fix stands
    at the step at which it was sent."""
    star, before = star_at(window, step), star_at(window, step - 1)
    here = row_of(window.layout, step, 0)
    for k in range(1, count_of(window.sizes, step)):
        link, place, changed = measurements.start[step] + k - 1, window.previous[here + k], step == now
        for run in range(runs[0], runs[1] + 1):
            come = 0 <= arrival[run, link] <= now
            sent = step if come else measurements.newest[run, link]
            if place >= 0 and step > 0:
                carried = int(before.status[5 * place + SENT, run - runs[0]])
                sent = max(sent, carried if step - carried <= settings.age else -1)
            changed |= sent != measurements.newest[run, link] or come != measurements.fresh[run, link]
            measurements.newest[run, link], measurements.fresh[run, link] = sent, come
        if changed:
            for lane in range(uint64(LANES)):
                run = min(runs[0] + int(lane), runs[1])
                receive(star, before, measurements, model, run, step, link, k, lane)
                used_since = max(measurements.newest[run, link], window.joined[here + k])
                star.status[5 * k + USES, lane] = step - used_since + 1
            interpret(star, model, k, measurements.dt)
            if settings.robust and step < now:
                point, cov = vector_at(window.point, here + k), block_at(gates.state, 0)
                gate_position(star, k, point, scale(cov, 2.0), 0.0 * point[0])


@inner
def use_new_fixes(window: Window, first: int, last: int) -> None:
    """Information of the new fixes of some steps."""
    for step in range(first, last + 1):
        ego = row_of(window.layout, step, 0)
        for row in range(ego, ego + count_of(window.sizes, step)):
            store(window.used, row, fix_information(window, row))


@inner
def write_lane(window: Window, cov: AnyArray, link: int, which: tuple[int, int], t: int, estimates: Estimates) -> None:
    """Copy one run's points and the ego's covariance, whose negative is in `cov`."""
    (run, lane), ego = which, row_of(window.layout, t, 0)
    for i in range(3):
        estimates.x[run, t, i] = window.point[3 * ego + i, lane]
        for j in range(3):
            estimates.covariance[run, t, i, j] = -cov[3 * min(i, j) + max(i, j), lane]
        for k in range(1, count_of(window.sizes, t)):
            estimates.neighbours[run, link + k - 1, i] = window.point[3 * (ego + k) + i, lane]

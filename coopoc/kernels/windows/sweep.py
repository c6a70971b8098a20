"""One Gauss-Newton step of a window of stars: on through its steps, solve the newest, and back.

A step's information matrix goes on to the next one block by block (`stars.elimination.predict`): with motion
of information D the block k leaves A - U (A_kk + D)^-1 U^T, U its columns, which are kept. Going back, the point was
(A_kk + D)^-1 (eta_k + D d - U z), d being the move of the next one and z those of all others.
"""

from __future__ import annotations

from typing import Any

from numpy import uint64

from ...arrays import AnyArray
from ..compiling.compile import inner, inside
from ..compiling.small import (
    add,
    add_diagonal,
    choose_each,
    less_applied,
    less_transposed_applied,
    load,
    minus_apply,
    mirrored,
    negate,
    plus_applied,
    store,
    subtract,
    times,
    transpose,
    zeros,
)
from ..compiling.vectors import choose, put, take
from ..stars.edges import AT_GAP, EXACT, edge
from ..stars.elimination import predict
from ..stars.joint import Joint, add_relative, block_of, copy, rearrange, solve
from ..stars.messages import MOVED, NEW, POSITION, RELATIVE, Assumptions, clear
from ..stars.relative import completed, vector
from .back import Past, advance_points, go_back, kept_of, process_information
from .slots import ONE, ROW, Window, count_of, fix_gap, largest_of, place_of, star_at


@inner
def start_points(window: Window, past: Past, known: Assumptions, t: int) -> None:
    """A new step where it is expected: a member that stays moves, one that joins stands where the ego measures it, and
    one that nothing has located yet where its first position puts it, with its earlier points.

    Its relative measurements are converted vectors, weighted by that geometry.
    """
    ego, before = place_of(window.layout, t, 0), place_of(window.layout, t - 1, 0)
    for k in range(count_of(window.sizes, t)):
        place, previous = ego + k, window.previous[ego + k]
        fix, new = load(window.motion, 4 * place + POSITION, ROW), take(window.status, uint64(5 * place + NEW))
        there = 0.0 * new + 1.0 if k == 0 else max(new, whole_of(window, place))
        at = fix
        if previous >= 0:
            located = take(window.located, uint64(before + previous))
            at = add(load(window.point, before + previous, ROW), load(window.motion, 4 * place + MOVED, ROW))
            first = new - located - 0.5  # > 0: its first position
            at = choose_each(first, fix, at)
            there = max(there, located)
            if any_above(first):
                locate_before(window, place, t, first, at)
        elif k > 0:
            origin = load(window.point, ego, ROW)
            at = add(origin, vector(completed(load(window.relative, place, RELATIVE), subtract(fix, origin))))
        put(window.located, uint64(place), there)
        store(window.point, place, at)
        store(past.at, place, at)
        if k > 0:
            gap = subtract(at, load(window.point, ego, ROW))
            put_edge(window, past, known, place, gap, AT_GAP, 0.0 * gap[0] + 1.0)
    if t == 0:
        n = count_of(window.sizes, t)
        nothing = zeros(load(window.point, 0, ROW)[0], ONE)
        clear(past.information)
        clear(past.eta)
        for k in range(n):
            prior = 1.0 / known.flat + nothing[0]
            store(past.information, k * (window.layout[1] + 1), add_diagonal(nothing, (prior, prior, prior)))


@inner
def whole_of(window: Window, place: int) -> Any:
    """1 where all components of a relative measurement were measured, else 0."""
    z = load(window.relative, place, RELATIVE)
    return choose(1e300 - (z[5] + z[6] + z[7]), 0.0 * z[0] + 1.0, 0.0 * z[0])


@inside
def any_above(values: Any) -> bool:
    """True if any of these runs has a number > 0."""
    return not values <= 0.0 * values


@inner
def locate_before(window: Window, place: int, t: int, mask: Any, at: Any) -> None:
    """Bring the earlier points of a member, which nothing had located, to where its first position puts them."""
    here, step = place, t
    while window.previous[here] >= 0 and step > 0 and t - step < len(window.sizes) - 1:
        at = subtract(at, load(window.motion, 4 * here + MOVED, ROW))
        here, step = place_of(window.layout, step - 1, window.previous[here]), step - 1
        lost = choose(mask, 0.5 - take(window.located, uint64(here)), 0.0 * at[0])
        store(window.point, here, choose_each(lost, at, load(window.point, here, ROW)))
        put(window.located, uint64(here), choose(lost, 0.0 * at[0] + 1.0, take(window.located, uint64(here))))


@inner
def put_edge(window: Window, past: Past, known: Assumptions, place: int, gap: Any, how: Any, mask: Any) -> None:
    """The relative measurement of a place, linear at the vector `gap`, where the mask is positive: E and E v + eta."""
    z = load(window.relative, place, RELATIVE)
    information, eta = edge(gap, z, (known.relative_std, known.min_range), how)
    o, used = 0.0 * gap[0], max(take(window.located, uint64(place)), whole_of(window, place)) - 0.5
    information, eta = choose_each(used, information, zeros(o, ONE)), choose_each(used, eta, zeros(o, ROW))
    eta = plus_applied(eta, information, gap)
    store(window.edge, place, choose_each(mask, information, load(window.edge, place, ONE)))
    store(window.eta, place, choose_each(mask, eta, load(window.eta, place, ROW)))
    store(past.base, place, choose_each(mask, gap, load(past.base, place, ROW)))


@inner
def linearise_step(window: Window, past: Past, known: Assumptions, step: int, joint: Joint, mask: Any) -> None:
    """The relative measurements of a step in range and angles, where its points are, moved by `joint.move`."""
    ego, n = place_of(window.layout, step, 0), count_of(window.sizes, step)
    for k in range(1, n):
        ahead = subtract(load(joint.move, block_of(k, n), ROW), load(joint.move, block_of(0, n), ROW))
        gap = subtract(load(window.point, ego + k, ROW), load(window.point, ego, ROW))
        put_edge(window, past, known, ego + k, add(gap, ahead), EXACT, mask)


@inner
def distance(window: Window, past: Past, span: Any) -> Any:
    """m by which a vector has left the one at which its measurement is linear, the largest along an axis."""
    most = 0.0 * load(window.point, place_of(window.layout, span[1], 0), ROW)[0]
    for step in range(span[0], span[1] + 1):
        ego = place_of(window.layout, step, 0)
        for place in range(ego + 1, ego + count_of(window.sizes, step)):
            gap = subtract(load(window.point, place, ROW), load(window.point, ego, ROW))
            most = max(most, largest_of(subtract(gap, load(past.base, place, ROW))))
    return most


@inner
def assemble(window: Window, past: Past, joint: Joint, step: int) -> None:
    """Move the information of the past from `at` to a step's points, and add the step's fixes."""
    ego, n, stride = place_of(window.layout, step, 0), count_of(window.sizes, step), joint.stride
    for k in range(n):
        place = ego + k
        store(joint.move, block_of(k, n), subtract(load(past.at, place, ROW), load(window.point, place, ROW)))
    for i in range(n):
        away = load(joint.move, i, ROW)
        eta = plus_applied(load(joint.eta, i, ROW), mirrored(load(joint.information, i * stride + i, ONE)), away)
        for j in range(i + 1, n):
            block = load(joint.information, i * stride + j, ONE)
            eta = plus_applied(eta, block, load(joint.move, j, ROW))
            store(joint.eta, j, plus_applied(load(joint.eta, j, ROW), transpose(block), away))
        store(joint.eta, i, eta)
    for k in range(n):
        fix, i = load(window.used, ego + k, ROW), block_of(k, n)
        at = i * stride + i
        store(joint.information, at, add_diagonal(load(joint.information, at, ONE), fix))
        store(joint.eta, i, add(load(joint.eta, i, ROW), times(fix, fix_gap(window, ego + k))))


@inner
def add_edges(window: Window, a: AnyArray, eta: AnyArray, stride: int, step: int) -> None:
    """Add the relative measurements of a step."""
    ego, n = place_of(window.layout, step, 0), count_of(window.sizes, step)
    for k in range(1, n):
        gap = subtract(load(window.point, ego + k, ROW), load(window.point, ego, ROW))
        information = load(window.edge, ego + k, ONE)
        edge = information, less_applied(load(window.eta, ego + k, ROW), information, gap)
        add_relative(a, eta, stride, (k, n), edge, ROW)


@inner
def go_on(window: Window, past: Past, joint: Joint, known: Assumptions, step: int) -> None:
    """A step becomes the past of the next one; what it takes to go back is kept."""
    m, n, stride = count_of(window.sizes, step), count_of(window.sizes, step + 1), joint.stride
    here, after = place_of(window.layout, step, 0), place_of(window.layout, step + 1, 0)
    process_information(window, joint, step)
    kept = kept_of(window, past, step)
    predict(joint.information, m, stride, joint.process, kept, ONE, ROW, m + 1)
    for k in range(m):
        eta, columns = load(joint.eta, k, ROW), m + k * (m + 1)
        store(past.kept_eta, here + k, eta)
        solved = minus_apply(load(kept, columns + m, ONE), eta)
        for i in range(m):
            one = less_transposed_applied(load(joint.eta, i, ROW), load(kept, columns + i, ONE), solved)
            store(joint.eta, i, one)
    prior = 1.0 / known.flat
    rearrange(star_at(window, step + 1), joint, n, m, (prior, prior, prior), ROW)
    for k in range(m):
        store(joint.move, k, load(joint.eta, k, ROW))
    for k in range(n):
        previous, eta = window.previous[after + k], zeros(load(window.point, here, ROW)[0], ROW)
        if previous >= 0:
            eta = load(joint.move, block_of(previous, m), ROW)
            moved = load(window.motion, 4 * (after + k) + MOVED, ROW)
            store(past.at, after + k, add(load(window.point, here + previous, ROW), moved))
        store(joint.eta, block_of(k, n), eta)


@inner
def recall(window: Window, past: Past, joint: Joint, step: int) -> None:
    """Begin with the arrival cost of the first step."""
    n = count_of(window.sizes, step)
    copy(past.information, joint.information, n, joint.stride, ONE)
    for k in range(n):
        store(joint.eta, k, load(past.eta, k, ROW))


@inner
def copy_system(joint: Joint, n: int, information: AnyArray, eta: AnyArray) -> None:
    """The information matrix and vector of n members."""
    copy(joint.information, information, n, joint.stride, ONE)
    for k in range(n):
        store(eta, k, load(joint.eta, k, ROW))


@inner
def sweep(
    window: Window, past: Past, joint: Joint, known: Assumptions, span: Any, exact: bool, entered: bool, mask: AnyArray
) -> None:
    """One Gauss-Newton step of the window in the runs of the mask; the ego's newest covariance is then in `scratch`.

    Args:
        exact: measurements in range and angles.
        entered: the newest step has just come; it is solved converted, and made exact where that leads, and the oldest
            becomes the arrival cost.
    """
    first, last = span
    moves, leaving = take(mask, uint64(0)), first - 1
    begin = leaving if entered and last - first + 2 == len(window.sizes) and first > 0 else first
    recall(window, past, joint, begin)
    for step in range(begin, last + 1):
        assemble(window, past, joint, step)
        clear(joint.move)
        passes = 2 if exact and entered and step == last else 1
        for count in range(passes):
            a, eta = joint.information, joint.eta
            if count < passes - 1:
                a, eta = joint.factor, joint.move
                copy_system(joint, count_of(window.sizes, step), a, eta)
            elif exact and step > leaving:
                linearise_step(window, past, known, step, joint, moves)
            add_edges(window, a, eta, joint.stride, step)
            if step == last:
                cov = solve(a, joint, eta, count_of(window.sizes, step), ROW)
        if step < last:
            go_on(window, past, joint, known, step)
        if step == leaving:
            copy_system(joint, count_of(window.sizes, first), past.information, past.eta)
    store(joint.scratch, 0, negate(cov))
    advance_points(window, joint.eta, last, moves)
    for step in range(last - 1, first - 1, -1):
        go_back(window, past, joint, step)
        advance_points(window, joint.move, step, moves)

"""Gauss-Newton step of a window of stars: each neighbour's chain of points is eliminated onto the ego's points.

A neighbour's points meet one another in time and the ego's points, never another neighbour. A chain is eliminated from
its newest point back; what remains is a dense matrix of the ego's h points and, behind an arrival cost, of the
neighbours' points of the first step, which it couples. With S the information of a point without the motion that leads
to it, of information Q, the one before inherits (S^-1 + Q^-1)^-1 = Q (S + Q)^-1 S, which is no difference of near
numbers, and its blocks beside the ego's points, and eta, times Q (S + Q)^-1.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy import uint64

from ...arrays import AnyArray, Floats, Ints
from ..compiling.compile import inner
from ..compiling.small import (
    add,
    add_diagonal,
    inverse,
    less_applied,
    less_transposed_applied,
    less_transposed_product,
    minus_apply,
    minus_product,
    mirrored,
    negate,
    plus_applied,
    scale,
    scale_rows,
    store,
    subtract,
    times,
    transpose,
    zeros,
)
from ..compiling.vectors import LANES, take
from ..stars.joint import eliminate, substitute
from ..stars.messages import BLOCK, ROW, block_at, vector_at
from .window_layout import Window, count_of, fix_gap, motion, row_of


class System(NamedTuple):
    """The normal equations of a window and their solution.

    Attributes:
        arm: (9 h rows, LANES) blocks of each point beside the ego's points.
        eta: (3 rows, LANES).
        pivot: (9 rows, LANES) minus the inverse pivots.
        move: (3 rows, LANES) m, the Gauss-Newton step.
        end: (rows,) last step of the point's chain, counted from the first of the window.
        core: (9 c^2, LANES) dense matrix of the points that remain.
        vector: (3 c, LANES) its information vector, then its solution.
        scratch: (9 c, LANES).
        cov: (9, LANES) minus the covariance of the ego's newest point.
        most: (LANES,) largest step m.
        active: (LANES,) 1 where a run still moves.
        arrival: (9 most^2, LANES), arrival cost around `Window.start`, neighbours first, then the ego.
    """

    arm: Floats
    eta: Floats
    pivot: Floats
    move: Floats
    end: Ints
    core: Floats
    vector: Floats
    scratch: Floats
    cov: Floats
    most: Floats
    active: Floats
    arrival: Floats


def new_system(length: int, most: int, arrival: Floats) -> System:
    """Room for windows of `length` steps of at most `most` members, behind an arrival cost."""
    rows, core = (length + 1) * most, length + most - 1
    arm, eta, pivot, move = (np.zeros((size * rows, LANES)) for size in (9 * length, 3, 9, 3))
    dense, vector, scratch = (np.zeros((size * core, LANES)) for size in (9 * core, 3, 9))
    cov, most_moved, active = np.zeros((9, LANES)), np.zeros(LANES), np.zeros(LANES)
    end = np.zeros(rows, np.int64)
    return System(arm, eta, pivot, move, end, dense, vector, scratch, cov, most_moved, active, arrival)


@inner
def gauss_newton(window: Window, span: tuple[int, int], system: System, coupled: int, prior: float) -> None:
    """Solve for the step of all points of a span; minus the covariance of the ego's newest point is in `system.cov`.

    Args:
        coupled: neighbours in the arrival cost.
        prior: 1/m^2, information of the first point of every other chain around `Window.start`.
    """
    first, last = span
    size = coupled + last - first + 1
    assemble_core(window, span, system, coupled)
    for step in range(first, last + 1):
        ego = row_of(window.layout, step, 0)
        for row in range(ego + 1, ego + count_of(window.sizes, step)):
            if step == last or window.later[row] < 0:
                fold(window, span, step, row, system, coupled, prior)
    cov = eliminate(system.core, system.core, system.vector, size, size, system.scratch)
    store(system.cov, 0, cov)
    substitute(system.core, system.vector, size, size)
    for step in range(first, last + 1):
        ego = row_of(window.layout, step, 0)
        store(system.move, ego, vector_at(system.vector, coupled + step - first))
        for k in range(1, count_of(window.sizes, step)):
            if step == first:
                store(system.move, ego + k, vector_at(system.vector, k - 1))
            else:
                unfold(window, span, step, ego + k, system, coupled)


@inner
def assemble_core(window: Window, span: tuple[int, int], system: System, coupled: int) -> None:
    """Arrival cost, and information and eta of the ego's points: fixes, odometry, and the ego's end of each edge."""
    first, last = span
    size = coupled + last - first + 1
    nothing = zeros(take(window.located, uint64(0)), BLOCK)
    for i in range(size):
        store(system.vector, i, zeros(nothing[0], ROW))
        for j in range(i, size):
            store(system.core, i * size + j, nothing)
    add_arrival(window, first, system, coupled + 1, size)
    for s in range(last - first + 1):
        ego, i = row_of(window.layout, first + s, 0), coupled + s
        own, diagonal = vector_at(window.used, ego), i * (size + 1)
        block, eta = add_diagonal(block_at(system.core, diagonal), own), times(own, fix_gap(window, ego))
        eta = add(vector_at(system.vector, i), eta)
        if s > 0:
            process, off = motion(window, row_of(window.layout, first + s - 1, 0), ego)
            block, eta, above = add_diagonal(block, process), add(eta, off), diagonal - size - 1
            store(system.core, above, add_diagonal(block_at(system.core, above), process))
            store(system.core, above + 1, add_diagonal(nothing, negate(process)))
            store(system.vector, i - 1, subtract(vector_at(system.vector, i - 1), off))
        for row in range(ego + 1, ego + count_of(window.sizes, first + s)):
            block, eta = add(block, block_at(window.edge, row)), subtract(eta, vector_at(window.eta, row))
        store(system.core, diagonal, block)
        store(system.vector, i, eta)


@inner
def add_arrival(window: Window, first: int, system: System, n: int, size: int) -> None:
    """Move the arrival cost from where it expects the n points of the first step to the points."""
    for i in range(n):
        away = from_start(window, first, i, n)
        own = mirrored(block_at(system.arrival, i * (window.layout[1] + 1)))
        store(system.core, i * (size + 1), own)
        eta = plus_applied(vector_at(system.vector, i), own, away)
        for j in range(i + 1, n):
            block = block_at(system.arrival, i * window.layout[1] + j)
            store(system.core, i * size + j, block)
            eta = plus_applied(eta, block, from_start(window, first, j, n))
            store(system.vector, j, plus_applied(vector_at(system.vector, j), transpose(block), away))
        store(system.vector, i, eta)


@inner
def from_start(window: Window, first: int, i: int, n: int) -> Any:
    """m from the point of block i of the first step to where it was expected."""
    row = row_of(window.layout, first, i + 1 if i < n - 1 else 0)
    return subtract(vector_at(window.start, row), vector_at(window.point, row))


@inner
def fold(
    window: Window, span: tuple[int, int], step: int, row: int, system: System, coupled: int, prior: float
) -> None:
    """Eliminate the chain that ends at a row onto the ego's points; its point in the first step joins them where an
    arrival cost couples it."""
    first, last = span
    h, end = last - first + 1, step - first
    size = coupled + h
    nothing = zeros(take(window.located, uint64(0)), ROW)
    eta, own, flat = nothing, zeros(nothing[0], BLOCK), nothing[0] + prior
    while True:
        here, arm = step - first, row * h
        information, fix = block_at(window.edge, row), vector_at(window.used, row)
        store(system.arm, arm + here, negate(information))
        own = add_diagonal(add(own, information), fix)
        eta = add(add(eta, vector_at(window.eta, row)), times(fix, fix_gap(window, row)))
        if here == 0:
            i = row - row_of(window.layout, first, 1)
            for j in range(end + 1):
                store(system.core, i * size + coupled + j, add_to(system, i * size + coupled + j, arm + j))
            store(system.core, i * (size + 1), add(block_at(system.core, i * (size + 1)), own))
            store(system.vector, i, add(vector_at(system.vector, i), eta))
            return
        before = window.previous[row]
        process, off = nothing, nothing
        if before >= 0:
            before = row_of(window.layout, step - 1, before)
            process, off = motion(window, before, row)
            eta = add(eta, off)
        else:
            own = add_diagonal(own, (flat, flat, flat))
            eta = add(eta, scale(subtract(vector_at(window.start, row), vector_at(window.point, row)), flat))
        pivot = negate(inverse(add_diagonal(own, process)))
        solved = minus_apply(pivot, eta)
        store(system.eta, row, eta)
        store(system.pivot, row, pivot)
        system.end[row] = end
        for i in range(here, end + 1):
            store(system.scratch, i, minus_product(pivot, block_at(system.arm, arm + i)))
        for i in range(here, end + 1):
            left, at = block_at(system.arm, arm + i), (coupled + i) * size + coupled
            for j in range(i, end + 1):
                right = block_at(system.scratch, j)
                store(system.core, at + j, less_transposed_product(block_at(system.core, at + j), left, right))
            moved = less_transposed_applied(vector_at(system.vector, coupled + i), left, solved)
            store(system.vector, coupled + i, moved)
        if before < 0:
            return
        own = mirrored(scale_rows(process, minus_product(pivot, own)))
        eta = subtract(times(process, solved), off)
        for i in range(here, end + 1):
            store(system.arm, before * h + i, scale_rows(process, block_at(system.scratch, i)))
        step, row = step - 1, before


@inner
def add_to(system: System, at: int, arm: int) -> Any:
    """A block of the dense matrix and one of a chain."""
    return add(block_at(system.core, at), block_at(system.arm, arm))


@inner
def unfold(window: Window, span: tuple[int, int], step: int, row: int, system: System, coupled: int) -> None:
    """The step of a point of a chain, those of the ego and of the point before being known."""
    first, last = span
    h, eta = last - first + 1, vector_at(system.eta, row)
    for i in range(step - first, system.end[row] + 1):
        eta = less_applied(eta, block_at(system.arm, row * h + i), vector_at(system.vector, coupled + i))
    before = window.previous[row]
    if before >= 0:
        before = row_of(window.layout, step - 1, before)
        process, _ = motion(window, before, row)
        eta = add(eta, times(process, vector_at(system.move, before)))
    store(system.move, row, minus_apply(block_at(system.pivot, row), eta))


@inner
def advance(window: Window, span: tuple[int, int], system: System, share: Any) -> None:
    """Move all points by a share of the step, and the edges' information vectors with them."""
    for step in range(span[0], span[1] + 1):
        ego = row_of(window.layout, step, 0)
        own = vector_at(system.move, ego)
        for row in range(ego, ego + count_of(window.sizes, step)):
            moved = vector_at(system.move, row)
            store(window.point, row, add(vector_at(window.point, row), scale(moved, share)))
            if row > ego:
                ahead = scale(subtract(moved, own), share)
                eta = less_applied(vector_at(window.eta, row), block_at(window.edge, row), ahead)
                store(window.eta, row, eta)


@inner
def gap_of(points: AnyArray, ego: int, row: int) -> Any:
    """Vector m from the ego to a neighbour."""
    return subtract(vector_at(points, row), vector_at(points, ego))

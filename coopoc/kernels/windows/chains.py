"""The Gauss-Newton step of a window of stars: each neighbour is a chain of points that meets the ego's points only.

Eliminating the chains one after the other leaves the ego's information matrix of h x h blocks. With S the information
of a point without the motion that leaves it, of information Q, the next one inherits (S^-1 + Q^-1)^-1 = Q (S + Q)^-1 S,
which is no difference of near numbers, and its blocks beside the ego's points, and eta, times Q (S + Q)^-1.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy import uint64

from ...arrays import Floats
from ..compiling.compile import inner
from ..compiling.small import (
    add,
    add_diagonal,
    inverse,
    less_applied,
    less_transposed_applied,
    less_transposed_product,
    load,
    minus_apply,
    minus_product,
    mirrored,
    negate,
    scale,
    scale_rows,
    store,
    subtract,
    times,
    zeros,
)
from ..compiling.vectors import LANES, take
from ..stars.elimination import eliminate, substitute
from .slots import ONE, ROW, Window, count_of, fix_gap, largest_of, motion, place_of

FLOOR = 1e-12
"""1/m^2 on every point of a neighbour: one of which nothing is known has a place all the same."""


class Memory(NamedTuple):
    """Scratch: of each place its blocks beside the ego's points, its eta, minus its inverse pivot and its move; the
    ego's matrix of h x h blocks, its eta, two rows of blocks; of each run the largest move m, and a mask."""

    arm: Floats
    eta: Floats
    pivot: Floats
    move: Floats
    a: Floats
    b: Floats
    row: Floats
    cov: Floats
    most: Floats
    active: Floats


def new_memory(length: int, most: int) -> Memory:
    """Scratch for the same."""
    places = (length + 1) * most
    return Memory(
        np.zeros((9 * length * places, LANES)),
        np.zeros((3 * places, LANES)),
        np.zeros((9 * places, LANES)),
        np.zeros((3 * places, LANES)),
        np.zeros((9 * length * length, LANES)),
        np.zeros((3 * length, LANES)),
        np.zeros((9 * length, LANES)),
        np.zeros((9, LANES)),
        np.zeros(LANES),
        np.zeros(LANES),
    )


@inner
def move(window: Window, span: Any, memory: Memory, share: Any) -> Any:
    """Move all points by a share of the Gauss-Newton step; the largest step m of each run. Minus the covariance of the
    ego's newest point is in `memory.cov`."""
    first, last = span
    h = last - first + 1
    assemble_ego(window, span, memory)
    for step in range(first, last + 1):
        for place in range(
            place_of(window.layout, step, 1), place_of(window.layout, step, count_of(window.sizes, step))
        ):
            if step == first or window.previous[place] < 0:
                fold(window, span, step, place, memory)
    store(memory.cov, 0, eliminate(memory.a, memory.a, memory.b, h, h, memory.row, ONE, ROW))
    substitute(memory.a, memory.b, h, h, ONE, ROW)
    most = 0.0 * share
    for step in range(last, first - 1, -1):
        ego = place_of(window.layout, step, 0)
        own = load(memory.b, step - first, ROW)
        most = max(most, largest_of(own))
        store(window.point, ego, add(load(window.point, ego, ROW), scale(own, share)))
        for place in range(ego + 1, ego + count_of(window.sizes, step)):
            moved = unfold(window, span, step, place, memory)
            most = max(most, largest_of(moved))
            store(window.point, place, add(load(window.point, place, ROW), scale(moved, share)))
    return most


@inner
def assemble_ego(window: Window, span: Any, memory: Memory) -> None:
    """Information and eta of the ego's points: fixes, odometry, and the ego's end of each edge."""
    first, last = span
    h = last - first + 1
    trust = take(window.odometry, uint64(0))
    nothing = zeros(trust, ONE)
    for s in range(h):
        ego = place_of(window.layout, first + s, 0)
        own, gap = load(window.used, ego, ROW), fix_gap(window, ego)
        block, eta = add_diagonal(nothing, own), times(own, gap)
        for j in range(s + 1, h):
            store(memory.a, s * h + j, nothing)
        if s > 0:
            process, off = motion(window, place_of(window.layout, first + s - 1, 0), ego)
            process, off = scale(process, trust), scale(off, trust)
            block, eta = add_diagonal(block, process), add(eta, off)
            before = s - 1
            store(memory.a, before * (h + 1), add_diagonal(load(memory.a, before * (h + 1), ONE), process))
            store(memory.a, before * (h + 1) + 1, add_diagonal(nothing, negate(process)))
            store(memory.b, before, subtract(load(memory.b, before, ROW), off))
        for place in range(ego + 1, ego + count_of(window.sizes, first + s)):
            block, eta = add(block, load(window.edge, place, ONE)), subtract(eta, load(window.eta, place, ROW))
        store(memory.a, s * (h + 1), block)
        store(memory.b, s, eta)


@inner
def fold(window: Window, span: Any, step: int, place: int, memory: Memory) -> None:
    """Eliminate the chain that begins at a place onto the ego's points."""
    first, last = span
    h, begin = last - first + 1, step - first
    nothing = zeros(take(window.odometry, uint64(0)), ROW)
    own, eta = (
        add_diagonal(zeros(nothing[0], ONE), (nothing[0] + FLOOR, nothing[0] + FLOOR, nothing[0] + FLOOR)),
        nothing,
    )
    while True:
        end, arm = step - first, place * h
        information, fix = load(window.edge, place, ONE), load(window.used, place, ROW)
        store(memory.arm, arm + end, negate(information))
        own = add_diagonal(add(own, information), fix)
        eta = add(add(eta, load(window.eta, place, ROW)), times(fix, fix_gap(window, place)))
        after = window.later[place] if step < last else -1
        process, off = nothing, nothing
        if after >= 0:
            after = place_of(window.layout, step + 1, after)
            process, off = motion(window, place, after)
        eta = subtract(eta, off)
        pivot = negate(inverse(add_diagonal(own, process)))
        solved = minus_apply(pivot, eta)
        store(memory.eta, place, eta)
        store(memory.pivot, place, pivot)
        for i in range(begin, end + 1):
            store(memory.row, i, minus_product(pivot, load(memory.arm, arm + i, ONE)))
        for i in range(begin, end + 1):
            left = load(memory.arm, arm + i, ONE)
            for j in range(i, end + 1):
                at = i * h + j
                right = load(memory.row, j, ONE)
                store(memory.a, at, less_transposed_product(load(memory.a, at, ONE), left, right))
            store(memory.b, i, less_transposed_applied(load(memory.b, i, ROW), left, solved))
        if after < 0:
            return
        own = mirrored(scale_rows(process, minus_product(pivot, own)))
        eta = add(times(process, solved), off)
        for i in range(begin, end + 1):
            store(memory.arm, after * h + i, scale_rows(process, load(memory.row, i, ONE)))
        step, place = step + 1, after


@inner
def unfold(window: Window, span: Any, step: int, place: int, memory: Memory) -> Any:
    """The move of a point of a chain, those of the ego and of the next one being known."""
    first, last = span
    h, eta = last - first + 1, load(memory.eta, place, ROW)
    begin = step
    here = place
    while begin > first and window.previous[here] >= 0:
        begin, here = begin - 1, place_of(window.layout, begin - 1, window.previous[here])
    for i in range(begin - first, step - first + 1):
        eta = less_applied(eta, load(memory.arm, place * h + i, ONE), load(memory.b, i, ROW))
    after = window.later[place] if step < last else -1
    if after >= 0:
        after = place_of(window.layout, step + 1, after)
        process, _ = motion(window, place, after)
        eta = add(eta, times(process, load(memory.move, after, ROW)))
    moved = minus_apply(load(memory.pivot, place, ONE), eta)
    store(memory.move, place, moved)
    return moved

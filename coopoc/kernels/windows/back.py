"""The way back through a window of stars: moves of its points and late covariances, from what `predict` kept."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ...arrays import AnyArray, Floats
from ..compiling.compile import inner, storage
from ..compiling.small import (
    add,
    add_diagonal,
    less_applied,
    less_transposed_product,
    load,
    minus_apply,
    minus_product,
    scale,
    scale_rows,
    store,
    subtract,
    times,
    transpose,
    zeros,
)
from ..compiling.vectors import LANES
from ..stars.joint import Joint, block_of
from .slots import ONE, ROW, Window, count_of, motion, place_of


class Past(NamedTuple):
    """Information of the steps before a window about its first step, and what it takes to go back through the window.

    Attributes:
        information: (9 most^2, LANES), arrival cost around `at`.
        eta: (3 most, LANES), its information vector.
        at: (3 places, LANES) m, where the past expects each point.
        base: (3 places, LANES) m, vector at which its measurement is linear.
        kept: (9 most (most + 2) slots, LANES), of `predict` step by step.
        kept_eta: (3 places, LANES), of `predict` step by step.
    """

    information: Floats
    eta: Floats
    at: Floats
    base: Floats
    kept: Floats
    kept_eta: Floats


def new_past(length: int, most: int) -> Past:
    """Room for windows of `length` steps of at most `most` members."""
    rows = (3 * (length + 1) * most, LANES)
    kept = 9 * (length + 1) * most * (most + 2)
    return Past(
        np.zeros((9 * most * most, LANES)),
        np.zeros((3 * most, LANES)),
        np.zeros(rows),
        np.zeros(rows),
        np.zeros((kept, LANES)),
        np.zeros(rows),
    )


@storage
def kept_of(window: Window, past: Past, step: int) -> Floats:
    """What is kept of a step."""
    size = 9 * window.layout[1] * (window.layout[1] + 2)
    slot = step % len(window.sizes)
    return past.kept[slot * size : (slot + 1) * size]


@inner
def process_information(window: Window, joint: Joint, step: int) -> None:
    """Inverse process noise of the members that stay for the next step, zero of the others."""
    ego, after, m = place_of(window.layout, step, 0), place_of(window.layout, step + 1, 0), count_of(window.sizes, step)
    for k in range(m):
        later = window.later[ego + k]
        process = zeros(load(window.point, ego, ROW)[0], ROW)
        if later >= 0:
            process, _ = motion(window, ego + k, after + later)
        store(joint.process, block_of(k, m), process)


@inner
def advance_points(window: Window, moves: AnyArray, step: int, share: Any) -> None:
    """Move the points of a step."""
    ego, n = place_of(window.layout, step, 0), count_of(window.sizes, step)
    for k in range(n):
        moved = scale(load(moves, block_of(k, n), ROW), share)
        store(window.point, ego + k, add(load(window.point, ego + k, ROW), moved))


@inner
def go_back(window: Window, past: Past, joint: Joint, step: int) -> None:
    """Moves of the points of a step, those of the next one being known."""
    here, after, m = (
        place_of(window.layout, step, 0),
        place_of(window.layout, step + 1, 0),
        count_of(window.sizes, step),
    )
    kept = kept_of(window, past, step)
    process_information(window, joint, step)
    for k in range(m):
        later, ahead = window.later[here + k], zeros(load(window.point, here, ROW)[0], ROW)
        if later >= 0:
            place = after + later
            ahead = subtract(load(window.point, place, ROW), load(past.at, place, ROW))
        store(joint.move, block_of(k, m), ahead)
    for k in range(m - 1, -1, -1):
        ahead = times(load(joint.process, k, ROW), load(joint.move, k, ROW))
        eta, columns = add(load(past.kept_eta, here + k, ROW), ahead), m + k * (m + 1)
        for j in range(m):
            if j != k:
                eta = less_applied(eta, load(kept, columns + j, ONE), load(joint.move, j, ROW))
        store(joint.move, k, minus_apply(load(kept, columns + m, ONE), eta))


@inner
def ego_covariance(window: Window, past: Past, joint: Joint, span: Any) -> Any:
    """Minus the ego's covariance at the first step of a span, all later steps known: -sum V^T S^-1 V over the steps,
    V being D S^-1 V of the step before and, of the first one, the ego's columns."""
    first, last = span
    nothing = zeros(load(window.point, 0, ROW)[0], ONE)
    unit = nothing[0] + 1.0
    m, cov = count_of(window.sizes, first), nothing
    for k in range(m):
        store(joint.scratch, k, add_diagonal(nothing, (unit, unit, unit)) if k == m - 1 else nothing)
    for step in range(first, last + 1):
        m = count_of(window.sizes, step)
        kept, offset, row = joint.factor, 0, joint.stride
        if step < last:
            kept, offset, row = kept_of(window, past, step), m, m + 1
        for k in range(m):
            own, at = load(joint.scratch, k, ONE), offset + k * row
            solved = minus_product(load(kept, at + (m if step < last else k), ONE), own)
            cov = less_transposed_product(cov, own, solved)
            for j in range(k + 1, m):
                right = solved if step < last else own
                store(
                    joint.scratch,
                    j,
                    less_transposed_product(load(joint.scratch, j, ONE), load(kept, at + j, ONE), right),
                )
        if step == last:
            return cov
        for k in range(m - 1, -1, -1):
            own, at = load(joint.scratch, k, ONE), offset + k * row
            for j in range(k + 1, m):
                own = less_transposed_product(own, transpose(load(kept, at + j, ONE)), load(joint.scratch, j, ONE))
            store(joint.scratch, k, minus_product(load(kept, at + m, ONE), own))
        process_information(window, joint, step)
        here, n = place_of(window.layout, step, 0), count_of(window.sizes, step + 1)
        for k in range(n):
            store(joint.scratch, window.layout[1] + block_of(k, n), nothing)
        for k in range(m):
            later, i = window.later[here + k], block_of(k, m)
            if later >= 0:
                one = scale_rows(load(joint.process, i, ROW), load(joint.scratch, i, ONE))
                store(joint.scratch, window.layout[1] + block_of(later, n), one)
        for k in range(n):
            store(joint.scratch, k, load(joint.scratch, window.layout[1] + k, ONE))
    return cov

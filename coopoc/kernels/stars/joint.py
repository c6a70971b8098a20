"""Gaussian of a star in information form: prediction, fixes and relative measurements in d x d blocks, d >= 3.

The state of member k is tuple k, its position first; its block is k - 1, and the ego's is the last, so that elimination
ends with the ego's covariance. A filter calls, step by step, `gather` of `coopoc.kernels.stars.messages`,
`predict_state`, `predict` of `coopoc.kernels.stars.elimination`, `rearrange`, its own fixes, `add_relative`, and
`solve`. The argument `row` is any tuple of d numbers, from which the compiler takes d.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, cast

import numpy as np

from ...arrays import Floats
from ..compiling.compile import inner, inside, storage
from ..compiling.small import (
    add,
    add_corner,
    add_diagonal,
    apply,
    choose_each,
    first3,
    from_upper,
    load,
    negate,
    plus_applied,
    scale,
    square,
    store,
    subtract,
    transpose,
    with_first3,
    zeros,
)
from ..compiling.vectors import LANES, choose
from .elimination import eliminate, substitute
from .messages import MOVED, NEW, POSITION, PROCESS, RELATIVE, ROW, Star, clear
from .relative import Numbers, completed, converted, exact, incomplete, vector

LEAST_KNOWN = 1e-4
"""1/m^2, information along x below which nothing is known of where a member is."""
LEAST_PROCESS = 1e-90
"""m^2; the cube of its inverse is still a number, and far beyond any digit that counts."""


class Joint(NamedTuple):
    """A Gaussian of the members' states in information form, and scratch memory; arrays are (., LANES).

    Attributes:
        state: (d most,).
        information: (d^2 most^2,).
        factor: (d^2 most^2,).
        eta: (d most,) information vector.
        move: (d most,) step of the state.
        process: (d most,) process information, the inverse of the process noise.
        scratch: (2 d^2 most,).
        stride: blocks in a row.
    """

    state: Floats
    information: Floats
    factor: Floats
    eta: Floats
    move: Floats
    process: Floats
    scratch: Floats
    stride: int


def joint_rows(most: int, row: Numbers) -> int:
    """Rows of memory for `most` members."""
    return 4 * len(row) * most + 2 * len(row) * len(row) * (most * most + most)


joint_size = storage(joint_rows)
"""The same, for compiled code."""


@storage
def joint_in(memory: Floats, most: int, row: Numbers) -> Joint:
    """A Gaussian of up to `most` members, whose state is as long as `row`, in memory (>= joint_size LANES,)."""
    d, size = len(row), len(memory) // LANES
    rows = memory[: size * LANES].reshape((size, LANES))
    a, b = d * most, d * d * most * most
    return Joint(
        rows[:a],
        rows[4 * a : 4 * a + b],
        rows[4 * a + b : 4 * a + 2 * b],
        rows[a : 2 * a],
        rows[2 * a : 3 * a],
        rows[3 * a : 4 * a],
        rows[4 * a + 2 * b :],
        most,
    )


@storage
def joint_within(most: int, row: Numbers) -> Joint:
    """Room for `most` members, made by compiled code."""
    return joint_in(np.zeros(joint_size(most, row) * LANES), most, row)


def new_joint(most: int, row: Numbers, memory: Floats | None = None) -> Joint:
    """Room for `most` members, or that in memory."""
    plain: Any = joint_in
    return cast(Joint, plain.py_func(np.zeros(joint_rows(most, row) * LANES) if memory is None else memory, most, row))


@inside
def block_of(k: int, n: int) -> int:
    """Block of member k among n."""
    return k - 1 if k > 0 else n - 1


@inner
def predict_state(star: Star, joint: Joint, n: int, old: int, row: Numbers) -> None:
    """Move the members that stay; the ego starts where its first fix is, one that joins where the ego measures it, or,
    if the ego does not measure all three components, where its own message puts it.

    Fills the inverse process noise of the positions, in the order of the last star: zero for members that left.
    """
    for k in range(old):
        store(joint.move, k, load(joint.state, k, row))
    clear(joint.process)
    for k in range(n):
        place, row_of = star.previous[k], 4 * k
        if place >= 0:
            before = load(joint.move, place, row)
            at = add(first3(before), load(star.motion, row_of + MOVED, ROW))
            store(joint.state, k, with_first3(before, at))
            p, q, r = load(star.motion, row_of + PROCESS, ROW)
            process = 1.0 / max(p, LEAST_PROCESS), 1.0 / max(q, LEAST_PROCESS), 1.0 / max(r, LEAST_PROCESS)
            at_block = block_of(place, old)
            store(joint.process, at_block, with_first3(load(joint.process, at_block, row), process))
        elif k == 0:
            first = load(star.motion, row_of + POSITION, ROW)
            store(joint.state, k, with_first3(zeros(first[0], row), first))
        else:
            at = first_place(star, k, first3(load(joint.state, 0, row)))
            store(joint.state, k, with_first3(zeros(at[0], row), at))


@inside
def first_place(star: Star, k: int, ego: Numbers) -> Numbers:
    """Position of a member that joins: as measured, else as broadcast, else somewhere near the ego."""
    seen = load(star.relative, k, RELATIVE)
    measured: Numbers = add(ego, vector(seen))
    if not incomplete(seen):
        return measured
    lacks = seen[5] + seen[6] + seen[7] - (0.0 * seen[0] + 1e300)
    new = load(star.status, 5 * k + NEW, (0.0,))[0] - 0.5
    near = seen[0] + 1.0
    somewhere = add(ego, (near, near, 0.1 * near))
    broadcast = choose_each(new, load(star.motion, 4 * k + POSITION, ROW), somewhere)
    place: Numbers = choose_each(lacks, broadcast, measured)
    return place


@inner
def place_on_broadcast(star: Star, joint: Joint, n: int, row: Numbers) -> None:
    """Put members of which nothing was known where their first message with a position does: what was measured of them
    is linear there, and not where they were assumed to be until now."""
    for k in range(1, n):
        if star.previous[k] >= 0:
            state = load(joint.state, k, row)
            own = load(joint.information, (k - 1) * joint.stride + k - 1, square(row))[0]
            new, at = load(star.status, 5 * k + NEW, (0.0,))[0] - 0.5, first3(state)
            there = choose_each(new, load(star.motion, 4 * k + POSITION, ROW), at)
            store(joint.state, k, with_first3(state, choose_each(own - LEAST_KNOWN, at, there)))


@inside
def placed(joint: Joint, k: int, seen: Numbers, row: Numbers) -> float:
    """1 where the geometry of an incomplete measurement of member k is known, or all of it was measured; else 0."""
    own = load(joint.information, (k - 1) * joint.stride + k - 1, square(row))[0]
    whole = 0.0 * seen[0] + 1e300 - (seen[5] + seen[6] + seen[7])
    one = 0.0 * own + 1.0
    share: float = choose(whole, one, choose(own - LEAST_KNOWN, one, 0.0 * own))
    return share


@inside
def stayed(star: Star, n: int, old: int) -> bool:
    """True if every member stands where it stood."""
    moved = int(n != old)
    for k in range(n):
        moved += star.previous[k] != k
    return moved == 0


@inner
def rearrange(star: Star, joint: Joint, n: int, old: int, prior: Numbers, row: Numbers) -> None:
    """Information in the order of the new star; that of a member that joins is diagonal, the tuple `prior`."""
    if stayed(star, n, old):
        return
    block, stride = square(row), joint.stride
    o = 0.0 * load(joint.information, 0, row)[0]
    for k in range(n):
        for j in range(n):
            i, c = block_of(k, n), block_of(j, n)
            if c < i:
                continue
            p, q = star.previous[k], star.previous[j]
            if p < 0 or q < 0:
                nothing = zeros(o, block)
                store(joint.factor, i * stride + c, add_diagonal(nothing, prior) if k == j else nothing)
                continue
            p, q = block_of(p, old), block_of(q, old)
            if p <= q:
                store(joint.factor, i * stride + c, load(joint.information, p * stride + q, block))
            else:
                store(joint.factor, i * stride + c, transpose(load(joint.information, q * stride + p, block)))
    copy(joint.factor, joint.information, n, stride, block)


@inner
def copy(source: Floats, target: Floats, n: int, stride: int, block: Numbers) -> None:
    """The blocks on and above the diagonal."""
    for i in range(n):
        for j in range(i, n):
            store(target, i * stride + j, load(source, i * stride + j, block))


@inside
def relative_information(
    star: Star, joint: Joint, k: int, std: Floats, least: float, row: Numbers
) -> tuple[Numbers, Numbers]:
    """Information (3, 3) of the converted measurement of member k at the predicted geometry, and what it adds to the
    information vector: W and W (measured vector - predicted vector)."""
    seen = load(star.relative, k, RELATIVE)
    gap = subtract(first3(load(joint.state, k, row)), first3(load(joint.state, 0, row)))
    x, y, z = gap
    lacking = incomplete(seen)
    if len(std) or lacking:
        weight = converted(x, y, z, deviations(seen, gap, len(std) == 0), least)
        if lacking:
            weight = scale(weight, placed(joint, k, seen, row))
    else:
        o, one = 0.0 * x, 0.0 * x + 1.0
        weight = one, o, o, one, o, one
    found = vector(completed(seen, gap)) if lacking else vector(seen)
    full = from_upper(weight)
    return full, apply(full, subtract(found, gap))


@inside
def deviations(seen: Numbers, gap: Numbers, unit: bool) -> Numbers:
    """Standard deviations of range m and angles rad; of a unit covariance 1 m along each."""
    if unit:
        flat2 = gap[0] * gap[0] + gap[1] * gap[1]
        return seen[5], seen[6] / math.sqrt(flat2), seen[7] / math.sqrt(flat2 + gap[2] * gap[2])
    return seen[5], seen[6], seen[7]


@inside
def exact_information(star: Star, joint: Joint, k: int, n: int, least: float, row: Numbers) -> tuple[Numbers, Numbers]:
    """The same of range and angles, linear at the state moved by `move`, as seen from the state."""
    seen = load(star.relative, k, RELATIVE)
    ahead = subtract(first3(load(joint.move, k - 1, row)), first3(load(joint.move, n - 1, row)))
    gap = subtract(first3(load(joint.state, k, row)), first3(load(joint.state, 0, row)))
    x, y, z = add(gap, ahead)
    found = exact(x, y, z, seen, (seen[5], seen[6], seen[7]), least)
    if incomplete(seen):
        found = scale(found, placed(joint, k, seen, row))
    weight = from_upper(found[:6])
    return weight, plus_applied(found[6:], weight, ahead)


@inside
def add_relative(
    a: Floats, eta: Floats, stride: int, k: int, n: int, weight: Numbers, vector: Numbers, row: Numbers
) -> None:
    """Add information (weight, vector) about the position of member k of n less that of the ego, to matrix and
    vector."""
    i, e, like = k - 1, n - 1, square(row)
    for at in (i, e):
        diagonal = at * stride + at
        store(a, diagonal, add_corner(load(a, diagonal, like), weight))
    at = i * stride + e
    store(a, at, add_corner(load(a, at, like), negate(weight)))
    mine, egos = load(eta, i, row), load(eta, e, row)
    store(eta, i, with_first3(mine, add(first3(mine), vector)))
    store(eta, e, with_first3(egos, subtract(first3(egos), vector)))


@inside
def solve(a: Floats, joint: Joint, eta: Floats, n: int, row: Numbers) -> Numbers:
    """Step A^-1 eta of the state in place of eta; minus the covariance of the ego."""
    cov = eliminate(a, joint.factor, eta, n, joint.stride, joint.scratch, square(row), row)
    substitute(joint.factor, eta, n, joint.stride, square(row), row)
    return cov


@inside
def move(joint: Joint, n: int, row: Numbers) -> None:
    """Add the step in `eta` to the state."""
    for k in range(n):
        store(joint.state, k, add(load(joint.state, k, row), load(joint.eta, block_of(k, n), row)))

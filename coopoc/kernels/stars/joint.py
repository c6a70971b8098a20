"""Building blocks of a filter of a star in information form, for blocks of any size d >= 3, position first.

The state of member k is tuple k; its block is k - 1, and the ego's is the last, so that elimination ends with the ego's
covariance. A filter calls, step by step, `gather` of `coopoc.kernels.stars.messages`, `predict_state`, `predict` of
`coopoc.kernels.stars.elimination`, `rearrange`, `add_fix` and `add_relative`, and `solve`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ...arrays import AnyArray, Floats
from ..compiling.compile import inner, inside, storage
from ..compiling.small import (
    add,
    add_corner,
    add_diagonal,
    apply,
    first3,
    from_upper,
    load,
    negate,
    plus_applied,
    square,
    store,
    subtract,
    times,
    transpose,
    with_first3,
    zeros,
)
from ..compiling.vectors import LANES, choose
from .elimination import eliminate, substitute
from .messages import MOVED, NEW, POSITION, PROCESS, RELATIVE, ROW, Star, clear
from .relative import completed, converted, exact, incomplete, vector

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


@inside
def joint_size(most: int, row: Any) -> int:
    """Rows of memory for `most` members."""
    return 4 * len(row) * most + 2 * len(row) * len(row) * (most * most + most)


@storage
def joint_in(memory: AnyArray, most: int, row: Any) -> Joint:
    """A Gaussian of up to `most` members, whose state is as long as `row`, in memory (>= joint_size LANES,)."""
    d, size = len(row), joint_size(most, row)
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
def joint_within(most: int, row: Any) -> Joint:
    """Room for `most` members, made by compiled code."""
    return joint_in(np.zeros(joint_size(most, row) * LANES), most, row)


def new_joint(most: int, row: Any) -> Joint:
    """Room for `most` members."""
    d = len(row)
    information, factor, scratch = (
        np.zeros((d * d * blocks, LANES)) for blocks in (most * most, most * most, 2 * most)
    )
    state, eta, move, process = (np.zeros((d * most, LANES)) for _ in range(4))
    return Joint(state, information, factor, eta, move, process, scratch, most)


@inside
def block_of(k: int, n: int) -> int:
    """Block of member k among n."""
    return k - 1 if k > 0 else n - 1


@inner
def predict_state(star: Star, joint: Joint, n: int, old: int, row: Any) -> None:
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
def first_place(star: Star, k: int, ego: Any) -> Any:
    """Position of a member that joins: as measured, else as broadcast, else somewhere near the ego."""
    seen = load(star.relative, k, RELATIVE)
    measured = add(ego, vector(seen))
    if not incomplete(seen):
        return measured
    lacks = seen[5] + seen[6] + seen[7] - (0.0 * seen[0] + 1e300)
    new = load(star.status, 5 * k + NEW, (0.0,))[0] - 0.5
    x, y, z = load(star.motion, 4 * k + POSITION, ROW)
    near = seen[0] + 1.0
    return (
        choose(lacks, choose(new, x, ego[0] + near), measured[0]),
        choose(lacks, choose(new, y, ego[1] + near), measured[1]),
        choose(lacks, choose(new, z, ego[2] + 0.1 * near), measured[2]),
    )


@inside
def place(star: Star, joint: Joint, k: int, row: Any) -> None:
    """Put a member of which nothing was known where its first message with a position does: what was measured of it is
    linear there, and not where it was assumed to be until now."""
    state = load(joint.state, k, row)
    own = load(joint.information, (k - 1) * joint.stride + k - 1, square(row))[0]
    new, at = load(star.status, 5 * k + NEW, (0.0,))[0] - 0.5, first3(state)
    x, y, z = load(star.motion, 4 * k + POSITION, ROW)
    there = choose(new, x, at[0]), choose(new, y, at[1]), choose(new, z, at[2])
    known = own - LEAST_KNOWN
    found = choose(known, at[0], there[0]), choose(known, at[1], there[1]), choose(known, at[2], there[2])
    store(joint.state, k, with_first3(state, found))


@inside
def placed(joint: Joint, k: int, seen: Any, row: Any) -> Any:
    """1 where the geometry of an incomplete measurement of member k is known, or all of it was measured; else 0."""
    own = load(joint.information, (k - 1) * joint.stride + k - 1, square(row))[0]
    whole = 0.0 * seen[0] + 1e300 - (seen[5] + seen[6] + seen[7])
    one = 0.0 * own + 1.0
    return choose(whole, one, choose(own - LEAST_KNOWN, one, 0.0 * own))


@inside
def stayed(star: Star, n: int, old: int) -> bool:
    """True if every member stands where it stood."""
    moved = int(n != old)
    for k in range(n):
        moved += star.previous[k] != k
    return moved == 0


@inner
def rearrange(star: Star, joint: Joint, n: int, old: int, prior: Any, row: Any) -> None:
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
def copy(source: AnyArray, target: AnyArray, n: int, stride: int, block: Any) -> None:
    """The blocks on and above the diagonal."""
    for i in range(n):
        for j in range(i, n):
            store(target, i * stride + j, load(source, i * stride + j, block))


@inside
def relative_information(star: Star, joint: Joint, k: int, std: AnyArray, least: float, row: Any) -> Any:
    """Information (3, 3) of the converted measurement of member k at the predicted geometry, and what it adds to the
    information vector: W and W (measured vector - predicted vector)."""
    seen = load(star.relative, k, RELATIVE)
    gap = subtract(first3(load(joint.state, k, row)), first3(load(joint.state, 0, row)))
    x, y, z = gap
    lacking = incomplete(seen)
    if len(std) or lacking:
        weight = converted(x, y, z, deviations(seen, gap, len(std) == 0), least)
        if lacking:
            weight = times_all(weight, placed(joint, k, seen, row))
    else:
        o, one = 0.0 * x, 0.0 * x + 1.0
        weight = one, o, o, one, o, one
    found = vector(completed(seen, gap)) if lacking else vector(seen)
    full = from_upper(weight)
    return full, apply(full, subtract(found, gap))


@inside
def times_all(six: Any, factor: Any) -> Any:
    """All six numbers times one."""
    a, b, c, d, e, f = six
    return a * factor, b * factor, c * factor, d * factor, e * factor, f * factor


@inside
def deviations(seen: Any, gap: Any, unit: bool) -> Any:
    """Standard deviations of range m and angles rad; of a unit covariance 1 m along each."""
    if unit:
        flat2 = gap[0] * gap[0] + gap[1] * gap[1]
        return seen[5], seen[6] / math.sqrt(flat2), seen[7] / math.sqrt(flat2 + gap[2] * gap[2])
    return seen[5], seen[6], seen[7]


@inside
def exact_information(star: Star, joint: Joint, k: int, n: int, least: float, row: Any) -> Any:
    """The same of range and angles, linear at the state moved by `move`, as seen from the state."""
    seen = load(star.relative, k, RELATIVE)
    ahead = subtract(first3(load(joint.move, k - 1, row)), first3(load(joint.move, n - 1, row)))
    gap = subtract(first3(load(joint.state, k, row)), first3(load(joint.state, 0, row)))
    x, y, z = add(gap, ahead)
    xx, xy, xz, yy, yz, zz, p, q, r = exact(x, y, z, seen, (seen[5], seen[6], seen[7]), least)
    if incomplete(seen):
        known = placed(joint, k, seen, row)
        xx, xy, xz, yy, yz, zz = times_all((xx, xy, xz, yy, yz, zz), known)
        p, q, r = p * known, q * known, r * known
    weight = from_upper((xx, xy, xz, yy, yz, zz))
    return weight, plus_applied((p, q, r), weight, ahead)


@inside
def add_relative(a: AnyArray, eta: AnyArray, stride: int, members: Any, edge: Any, row: Any) -> None:
    """Add information (weight, vector) about the position of member k less that of the ego, to matrix and vector.

    Args:
        members: k and the number n of blocks.
    """
    (k, n), (weight, vector) = members, edge
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
def add_fix(joint: Joint, i: int, weight: Any, gap: Any, row: Any) -> None:
    """Add a measured position to block i: its inverse variances, and the measured position less the predicted one."""
    at = i * joint.stride + i
    own = load(joint.information, at, square(row))
    store(joint.information, at, add_diagonal(own, with_first3(zeros(weight[0], row), weight)))
    mine = load(joint.eta, i, row)
    store(joint.eta, i, with_first3(mine, add(first3(mine), times(weight, gap))))


@inside
def solve(a: AnyArray, joint: Joint, eta: AnyArray, n: int, row: Any) -> Any:
    """Step A^-1 eta of the state in place of eta; minus the covariance of the ego."""
    cov = eliminate(a, joint.factor, eta, n, joint.stride, joint.scratch, square(row), row)
    substitute(joint.factor, eta, n, joint.stride, square(row), row)
    return cov


@inside
def move(joint: Joint, n: int, row: Any) -> None:
    """Add the step in `eta` to the state."""
    for k in range(n):
        store(joint.state, k, add(load(joint.state, k, row), load(joint.eta, block_of(k, n), row)))

"""The joint filter of a star, a Gaussian in information form: predict, add fixes, then relative measurements by
Gauss-Newton, and eliminate in 3 x 3 blocks. No matrix is ever inverted as a whole.

The position of member k is tuple k; its block is k - 1, and the ego's is the last, so that elimination ends with the
ego's covariance. A filter calls, step by step, `gather` of `coopoc.kernels.stars.messages`, `predict_state`, `predict`,
`rearrange`, its own fixes, `add_relative`, and `solve`.

A matrix of n x n blocks stands in memory as `compiling.small` keeps it: block (i, j), j >= i, is tuple number
i stride + j; those below the diagonal are never read.
"""

from typing import NamedTuple

import numpy as np

from ...arrays import Floats
from ..compiling.compile import as_written, inner, inside, storage
from ..compiling.small import (
    add,
    add_diagonal,
    apply,
    block_at,
    choose_each,
    diagonal,
    from_upper,
    inverse,
    less_transposed_product,
    load,
    minus_product,
    negate,
    over,
    scale,
    store,
    subtract,
    times,
    transpose,
    vector_at,
)
from ..compiling.vectors import LANES, Lanes, choose, take
from ..gate import BACK
from ..geometry import Numbers, converted, exact, incomplete, metres, missing, vector, whole
from .gated import STATE, Gates, carry, fresh, gate_star, gates_within, go_back
from .messages import (
    LEAST_PROCESS,
    NEW,
    NONE,
    Assumptions,
    Estimates,
    Measurements,
    Star,
    clear,
    gather,
    moved_of,
    new_estimates,
    position_of,
    process_of,
    relative_of,
    star_within,
    variance_of,
)

LEAST_KNOWN = 1e-4
"""1/m^2, information along x below which nothing is known of where a member is."""

UNMOVED = 1e30
"""1/m^2, process information of a member that stays where it is."""


class Joint(NamedTuple):
    """A Gaussian of the members' states in information form, and scratch memory; arrays are (., LANES).

    Attributes:
        state: (3 most,).
        information: (9 most^2,).
        factor: (9 most^2,).
        eta: (3 most,) information vector.
        move: (3 most,) step of the state.
        process: (3 most,) process information, the inverse of the process noise.
        scratch: (18 most,).
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


@storage
def joint_within(most: int) -> Joint:
    """Room for `most` members."""
    a, b = np.zeros((4, 3 * most, LANES)), np.zeros((2, 9 * most * most, LANES))
    return Joint(a[0], b[0], b[1], a[1], a[2], a[3], np.zeros((18 * most, LANES)), most)


@inner
def eliminate(source: Floats, a: Floats, eta: Floats, n: int, stride: int, memory: Floats) -> Numbers:
    """Factorise A = R^T D R: D^-1 R in `a` (which may be `source`), minus the inverse pivots on its diagonal, and
    D^-1 R^-T eta in place of eta.

    Returns the last of them, -Cov of the last block. The next pivot is inverted as soon as its row is ready, while the
    rows below are still worked on. `memory` holds n blocks.
    """
    p: Numbers = negate(inverse(block_at(source, 0)))
    for k in range(n):
        first = k * stride
        v = minus_product(p, vector_at(eta, k))
        store(eta, k, v)
        store(a, first + k, p)
        for j in range(k + 1, n):
            one = block_at(source, first + j)
            store(memory, j, one)
            store(a, first + j, minus_product(p, one))
        for i in range(k + 1, n):
            left = block_at(memory, i)
            for j in range(i, n):
                at = i * stride + j
                store(a, at, less_transposed_product(block_at(source, at), left, block_at(a, first + j)))
            store(eta, i, less_transposed_product(vector_at(eta, i), left, v))
            if i == k + 1:
                p = negate(inverse(block_at(a, i * stride + i)))
        source = a
    return p


@inner
def substitute(factor: Floats, x: Floats, n: int, stride: int) -> None:
    """Solution A^-1 eta in place of what `eliminate` left in eta."""
    for k in range(n - 1, -1, -1):
        v = vector_at(x, k)
        for j in range(k + 1, n):
            v = subtract(v, apply(block_at(factor, k * stride + j), vector_at(x, j)))
        store(x, k, v)


@inner
def predict(a: Floats, n: int, stride: int, process: Floats, memory: Floats) -> None:
    """Information (A^-1 + Q)^-1 in place of A, Q^-1 = diag(process): with infinite process noise (0) a block is
    forgotten, one after the other as a rank-3 update. `memory` holds 2 n blocks.

    With E_k the columns of block k and W_k = Q_k^-1, A <- A - A E_k (E_k^T A E_k + W_k)^-1 E_k^T A.
    """
    for k in range(n):
        predict_block(a, k, n, stride, vector_at(process, k), memory)


@inner
def predict_block(a: Floats, k: int, n: int, stride: int, process: Numbers, memory: Floats) -> None:
    """`predict` of one block."""
    for j in range(n):
        store(memory, n + j, block(a, k, j, stride))
    own = block_at(memory, n + k)
    own = from_upper((*own[:3], *own[4:6], own[8]))
    store(memory, n + k, own)
    pivot = negate(inverse(add_diagonal(own, process)))
    for j in range(n):
        store(memory, j, minus_product(pivot, block_at(memory, n + j)))
    for i in range(n):
        left = block_at(memory, n + i)
        for j in range(i, n):
            at = i * stride + j
            store(a, at, less_transposed_product(block_at(a, at), left, block_at(memory, j)))


@inside
def block(a: Floats, i: int, j: int, stride: int) -> Lanes:
    """A block, also one below the diagonal."""
    return block_at(a, i * stride + j) if i <= j else transpose(block_at(a, j * stride + i))


@inside
def block_of(k: int, n: int) -> int:
    """Block of member k among n."""
    return k - 1 if k > 0 else n - 1


@inner
def predict_state(star: Star, joint: Joint, n: int, old: int) -> None:
    """Move the members that stay; the ego starts where its first fix is, one that joins where the ego measures it, or,
    if the ego does not measure all three components, where its own message puts it.

    Fills the inverse process noise of the positions, in the order of the last star: zero for members that left.
    """
    for k in range(old):
        store(joint.move, k, vector_at(joint.state, k))
    clear(joint.process)
    for k in range(n):
        previous = star.previous[k]
        if previous >= 0:
            store(joint.state, k, add(vector_at(joint.move, previous), moved_of(star, k)))
            store(joint.process, block_of(previous, old), over(add(process_of(star, k), LEAST_PROCESS)))
        elif k == 0:
            store(joint.state, k, position_of(star, k))
        else:
            store(joint.state, k, first_place(star, k, vector_at(joint.state, 0)))


@inside
def first_place(star: Star, k: int, ego: Numbers) -> Lanes:
    """Position of a member that joins: as measured, else as broadcast, else somewhere near the ego."""
    polar = relative_of(star, k)
    measured: Numbers = add(ego, vector(polar))
    if not incomplete(polar):
        return measured
    new = take(star.status, 5 * k + NEW) - 0.5
    near = polar[0] + 1.0
    broadcast = choose_each(new, position_of(star, k), add(ego, (near, near, 0.1 * near)))
    return choose_each(missing(polar), broadcast, measured)


@inner
def place_on_broadcast(star: Star, joint: Joint, n: int) -> None:
    """Put members of which nothing was known where their first message with a position does: what was measured of them
    is linear there, and not where they were assumed to be until now."""
    for k in range(1, n):
        if star.previous[k] >= 0:
            at = vector_at(joint.state, k)
            own = block_at(joint.information, (k - 1) * joint.stride + k - 1)[0]
            there = choose_each(take(star.status, 5 * k + NEW) - 0.5, position_of(star, k), at)
            store(joint.state, k, choose_each(own - LEAST_KNOWN, at, there))


@inside
def placed(joint: Joint, k: int, measured: Numbers) -> Lanes:
    """1 where the geometry of an incomplete measurement of member k is known, or all of it was measured; else 0."""
    own = block_at(joint.information, (k - 1) * joint.stride + k - 1)[0]
    return max(whole(measured), choose(own - LEAST_KNOWN, 0.0 * own + 1.0, 0.0 * own))


@inside
def unknown(like: float, i: int, j: int, flat: float) -> Lanes:
    """Information about members of which nothing is known: 1 / flat m^-2 in the blocks on the diagonal, else 0."""
    f = 0.0 * like + (1.0 / flat if i == j else 0.0)
    return diagonal((f, f, f))


@inner
def rearrange(star: Star, joint: Joint, n: int, old: int, flat: float) -> None:
    """Information in the order of the new star; of a member that joins nothing is known."""
    moved = int(n != old)
    for k in range(n):
        moved += star.previous[k] != k
    if moved == 0:
        return
    stride = joint.stride
    for k in range(n):
        for j in range(n):
            i, c = block_of(k, n), block_of(j, n)
            p, q = star.previous[k], star.previous[j]
            if i <= c:
                own = unknown(vector_at(joint.information, 0)[0], k, j, flat)
                if p >= 0 and q >= 0:
                    own = block(joint.information, block_of(p, old), block_of(q, old), stride)
                store(joint.factor, i * stride + c, own)
    copy(joint.factor, joint.information, n, stride)


@inner
def copy(source: Floats, target: Floats, n: int, stride: int) -> None:
    """The blocks on and above the diagonal."""
    for i in range(n):
        for j in range(i, n):
            store(target, i * stride + j, block_at(source, i * stride + j))


@inside
def add_relative(a: Floats, eta: Floats, stride: int, k: int, n: int, weight: Numbers, vector: Numbers) -> None:
    """Add information (weight, vector) about the position of member k of n less that of the ego, to matrix and
    vector."""
    i, e = k - 1, n - 1
    for at in (i, e):
        diagonal = at * stride + at
        store(a, diagonal, add(block_at(a, diagonal), weight))
    at = i * stride + e
    store(a, at, add(block_at(a, at), negate(weight)))
    store(eta, i, add(vector_at(eta, i), vector))
    store(eta, e, subtract(vector_at(eta, e), vector))


@as_written
def run_filter(
    measurements: Measurements, model: Assumptions, refine: bool, robust: bool, laplacian: bool
) -> Estimates:
    """x (R, T, 3) m, covariance (R, T, 3, 3) m^2, neighbours (R, M, 3) m.

    Args:
        measurements: measurements and messages of the ego.
        model: noise model.
        refine: one Gauss-Newton step on range and angles.
        robust: gate innovations.
        laplacian: the relative measurements as LKF-SA takes them.
    """
    runs, steps = measurements.gnss.shape[:2]
    out = new_estimates(measurements)
    most = measurements.most
    for first in range(0, runs, LANES):
        last, old = min(first + LANES, runs) - 1, NONE
        star, before, joint, gates = star_within(most), star_within(most), joint_within(most), gates_within(most)
        for t in range(steps):
            star, before = before, star
            n = gather(star, before, measurements, model, first, last, t, old)
            step(star, joint, gates, model, refine, robust, laplacian, n, old)
            write(out, joint.state, joint.scratch, first, last, t, measurements.start[t], n)
            old = n
    return out


@inner
def write(out: Estimates, state: Floats, own: Floats, first: int, last: int, t: int, link: int, n: int) -> None:
    """Copy the estimates of a step, and the ego's covariance, in runs first to last; `link` is its first link."""
    x, cov, neighbours = out
    for lane in range(last - first + 1):
        for i in range(3):
            x[first + lane, t, i] = state[i, lane]
            for j in range(3):
                cov[first + lane, t, i, j] = own[3 * i + j, lane]
            for k in range(1, n):
                neighbours[first + lane, link + k - 1, i] = state[3 * k + i, lane]


@inner
def step(
    star: Star,
    joint: Joint,
    gates: Gates,
    model: Assumptions,
    refine: bool,
    robust: bool,
    laplacian: bool,
    n: int,
    old: int,
) -> None:
    """Predict and update the state of n members, `old` of them before; the ego's covariance is then in `scratch`."""
    predict_state(star, joint, n, old)
    predict(joint.information, old, joint.stride, joint.process, joint.scratch)
    rearrange(star, joint, n, old, model.flat)
    if robust:
        carry(star, gates, model.flat, n, old)
        back = go_back(star, gates, joint.state, n)
        if not back <= 0.0 * back:
            o, at = 0.0 * back, (n - 1) * joint.stride + n - 1  # the ego's covariance is replaced
            q = choose(back, o, o + UNMOVED)
            predict_block(joint.information, n - 1, n, joint.stride, (q, q, q), joint.scratch)
            there = inverse(block_at(gates.state, 0))
            store(joint.information, at, choose_each(back, there, block_at(joint.information, at)))
            begin_anew(star, joint, gates, back - BACK, model.flat, n)
    if not laplacian:
        place_on_broadcast(star, joint, n)
    if robust:
        for k in range(1, n):
            store(joint.move, k, (placed(joint, k, relative_of(star, k)),))
        gate_star(star, gates, joint.state, joint.move, model.min_range, n)
    clear(joint.eta)
    add_fixes(star, joint, n)
    update(star, joint, model, refine, laplacian, n)
    store(gates.state, 0, (*block_at(joint.scratch, 0), *load(gates.state, 0, STATE)[9:]))


@inner
def begin_anew(star: Star, joint: Joint, gates: Gates, where: float, flat: float, n: int) -> None:
    """Forget all, where a number is above 0: the ego starts at its fix, and its neighbours join."""
    for i in range(n):
        at = position_of(star, 0) if i == 0 else first_place(star, i, vector_at(joint.state, 0))
        store(joint.state, i, choose_each(where, at, vector_at(joint.state, i)))
        store(gates.state, i, choose_each(where, fresh(star, i, flat), load(gates.state, i, STATE)))
        for j in range(i, n):
            k = i * joint.stride + j
            anew = choose_each(where, unknown(where, i, j, flat), block_at(joint.information, k))
            store(joint.information, k, anew)


@inner
def add_fixes(star: Star, joint: Joint, n: int) -> None:
    """Add every member's position as broadcast."""
    for k in range(n):
        weight, i = scale(over(variance_of(star, k)), take(star.status, 5 * k + NEW)), block_of(k, n)
        gap, at = subtract(position_of(star, k), vector_at(joint.state, k)), i * joint.stride + i
        store(joint.information, at, add_diagonal(block_at(joint.information, at), weight))
        store(joint.eta, i, add(vector_at(joint.eta, i), times(weight, gap)))


@inner
def update(star: Star, joint: Joint, model: Assumptions, refine: bool, laplacian: bool, n: int) -> None:
    """Add the relative measurements, converted at the predicted geometry, and solve; to refine, solve a copy and add
    them once more, exact, linear at that solution."""
    last = 1 if refine and n > 1 else 0
    clear(joint.move)
    for stage in range(last + 1):
        a, eta = joint.information, joint.eta
        if stage < last:
            a, eta = joint.factor, joint.move
            copy(joint.information, a, n, joint.stride)
            for i in range(n):
                store(eta, i, vector_at(joint.eta, i))
        if laplacian:
            add_laplacian(star, joint, model, n)
        for k in range(1, 1 if laplacian else n):
            polar = relative_of(star, k)
            gap = subtract(vector_at(joint.state, k), vector_at(joint.state, 0))
            ahead = subtract(vector_at(joint.move, k - 1), vector_at(joint.move, n - 1))
            if stage == 1:
                weight, vector = exact(add(gap, ahead), polar, model.min_range)
            else:
                weight, vector = converted(gap, polar, len(model.relative_std) == 0, model.min_range)
            if incomplete(polar):
                is_placed = placed(joint, k, polar)
                weight, vector = scale(weight, is_placed), scale(vector, is_placed)
            vector = add(vector, apply(weight, ahead)) if stage == 1 else vector
            add_relative(a, eta, joint.stride, k, n, weight, vector)
        store(joint.scratch, 0, negate(eliminate(a, joint.factor, eta, n, joint.stride, joint.scratch)))
        substitute(joint.factor, eta, n, joint.stride)
    for k in range(n):
        store(joint.state, k, add(vector_at(joint.state, k), vector_at(joint.eta, block_of(k, n))))


@inner
def add_laplacian(star: Star, joint: Joint, model: Assumptions, n: int) -> None:
    """Add L W L and L W (delta - L x), L the Laplacian of the star of complete measurements: W is 1, or the edges'
    information over the degree; that of an edge is the inverse mean variance per axis of the converted vectors."""
    o, std, stride = 0.0 * vector_at(joint.state, 0)[0], model.relative_std, joint.stride
    count, total, gaps = o, o, (o, o, o)
    for k in range(1, n):
        polar = relative_of(star, k)
        edge = whole(polar)
        gap = subtract(vector(polar), subtract(vector_at(joint.state, k), vector_at(joint.state, 0)))
        store(joint.move, k, scale(gap, edge))
        store(joint.process, k, (edge,))
        count, gaps = count + edge, add(gaps, vector_at(joint.move, k))
        if len(std):
            a, b, c = metres(polar, std, model.min_range)
            total = total + edge * (a * a + b * b + c * c)
    store(joint.process, 0, (-count,))
    outer = central = o + 1.0
    if len(std):
        outer = choose(count, 3.0 * count / max(total, o + 1e-300), outer)
        central = outer / max(count, o + 1.0)
    for k in range(1, n):
        f = outer * take(joint.process, k)
        add_relative(
            joint.information, joint.eta, stride, k, n, diagonal((f, f, f)), scale(vector_at(joint.move, k), outer)
        )
    for i in range(n):
        row = central * take(joint.process, (i + 1) % n)
        store(joint.eta, i, add(vector_at(joint.eta, i), scale(gaps, row)))
        for j in range(i, n):
            at, f = i * stride + j, row * take(joint.process, (j + 1) % n)
            store(joint.information, at, add_diagonal(block_at(joint.information, at), (f, f, f)))

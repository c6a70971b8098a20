"""A Gaussian of 3-vectors that come and go, in covariance form, and its update by up to three numbers with gates.

A vector belongs to a member of the star and has a kind: its position, the error of its fixes, ... The vectors in use
stand side by side in x and P, so that every loop runs over contiguous numbers; `block` holds where.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...arrays import Bools, Floats, Ints
from ..compiling.compile import part, storage

PLACE, ERROR, VELOCITY, CLONE, FRESH = range(5)
"""Kinds of a neighbour's vectors: position m, error of its fixes m, velocity m/s, where it was when it sent its last
message that was used m, and scratch of `settle`."""
COMMON, COMPASS = 2, 3
"""Of the ego in place of velocity and clone: the error m that all fixes share, and (bias, noise of this step, 0) of its
compass, rad."""
KINDS, TERMS = 5, 8
ABSENT = -1
REJECTED = 4.0
"""Times the gate: from there on a number is not only down-weighted."""


class Gaussian(NamedTuple):
    """Mean and covariance of the vectors in use.

    Attributes:
        x: (size,).
        p: (size, size), of which the first 3 vectors[0] numbers are in use.
        block: (members, KINDS) index of each vector, ABSENT for none.
        owner: (size // 3,) member KINDS + kind of each vector.
        vectors: (1,) how many are in use.
    """

    x: Floats
    p: Floats
    block: Ints
    owner: Ints
    vectors: Ints


class Rows(NamedTuple):
    """Up to three measured numbers z_c = sum_i weight[c, i] x[column[c, i]] + N(0, variance[c]), and what came of them.

    Attributes:
        z: (3,).
        variance: (3,).
        used: (3,) False where nothing was measured.
        gate: (3,) on the squared normalised innovation of each number, 0 for none.
        column: (3, TERMS).
        weight: (3, TERMS).
        terms: (1,) terms in use.
        gap: (3,) out: innovations.
        q: (3,) out: squared normalised innovation, 0 where nothing was measured.
        before: (1,) rows of before that P and x do not hold yet.
        gain: (3 members, size) scratch: columns of the square root of what the update takes from P.
        white: (3 members,) scratch: whitened innovations.
        square: (2, 3, 3) scratch.
    """

    z: Floats
    variance: Floats
    used: Bools
    gate: Floats
    column: Ints
    weight: Floats
    terms: Ints
    gap: Floats
    q: Floats
    before: Ints
    gain: Floats
    white: Floats
    square: Floats


@storage
def new_gaussian(members: int) -> Gaussian:
    """Room for all vectors of that many members."""
    size = 3 * KINDS * members
    block = np.full((members, KINDS), ABSENT)
    return Gaussian(np.zeros(size), np.zeros((size, size)), block, np.zeros(size // 3, np.int64), np.zeros(1, np.int64))


@storage
def new_rows(members: int) -> Rows:
    """Room for three numbers."""
    return Rows(
        np.zeros(3),
        np.zeros(3),
        np.zeros(3, np.bool_),
        np.zeros(3),
        np.zeros((3, TERMS), np.int64),
        np.zeros((3, TERMS)),
        np.zeros(1, np.int64),
        np.zeros(3),
        np.zeros(3),
        np.zeros(1, np.int64),
        np.zeros((3 * members, 3 * KINDS * members)),
        np.zeros(3 * members),
        np.zeros((2, 3, 3)),
    )


@part
def has(g: Gaussian, member: int, kind: int) -> bool:
    """Whether a vector is in the state."""
    return bool(g.block[member, kind] >= 0)


@part
def insert(g: Gaussian, member: int, kind: int, variance: float) -> int:
    """Put a vector of mean 0 and of that variance behind the others; index of its first number."""
    b = g.vectors[0]
    g.vectors[0] = b + 1
    g.block[member, kind], g.owner[b] = b, member * KINDS + kind
    return clear(g, 3 * b, variance)


@part
def clear(g: Gaussian, first: int, variance: float) -> int:
    """Give a vector mean 0 and that variance, independent of all others; its first number."""
    for i in range(first, first + 3):
        g.x[i] = 0.0
        for j in range(3 * g.vectors[0]):
            g.p[i, j] = 0.0
            g.p[j, i] = 0.0
        g.p[i, i] = variance
    return int(first)


@part
def remove(g: Gaussian, member: int, kind: int) -> None:
    """Marginalise a vector out, if it is in the state: the last one takes its place."""
    b, last = g.block[member, kind], g.vectors[0] - 1
    if b < 0:
        return
    n = 3 * last + 3
    for c in range(3):
        i, k = 3 * b + c, 3 * last + c
        g.x[i] = g.x[k]
        for j in range(n):
            g.p[i, j] = g.p[k, j]
    for j in range(n):
        for c in range(3):
            g.p[j, 3 * b + c] = g.p[j, 3 * last + c]
    moved = g.owner[last]
    g.owner[b] = moved
    g.block[moved // KINDS, moved % KINDS] = b
    g.block[member, kind] = ABSENT
    g.vectors[0] = last


@part
def copy_gaussian(source: Gaussian, target: Gaussian) -> None:
    """Copy the vectors; the target has room for as many members or more."""
    for i in range(3 * source.vectors[0]):
        target.x[i] = source.x[i]
        for j in range(3 * source.vectors[0]):
            target.p[i, j] = source.p[i, j]
    target.vectors[0] = source.vectors[0]
    for i in range(len(source.owner)):
        target.owner[i] = source.owner[i]
        target.block[i // KINDS, i % KINDS] = source.block[i // KINDS, i % KINDS]


@part
def shift(g: Gaussian, i: int, j: int, factor: float) -> None:
    """x_i += factor x_j of two vectors by their first numbers; of one vector x_i *= 1 + factor."""
    n = 3 * g.vectors[0]
    for c in range(3):
        g.x[i + c] += factor * g.x[j + c]
        for k in range(n):
            g.p[i + c, k] += factor * g.p[j + c, k]
    for k in range(n):
        for c in range(3):
            g.p[k, i + c] += factor * g.p[k, j + c]


@part
def widen(g: Gaussian, i: int, variance: float) -> None:
    """Add white noise of that variance to a vector."""
    for c in range(3):
        g.p[i + c, i + c] += variance


@part
def term(h: Rows, k: int, first: int, weight: float) -> None:
    """Let the k-th term of row c be `weight` times number c of the vector that starts at `first`."""
    for c in range(3):
        h.column[c, k], h.weight[c, k] = first + c, weight
    h.terms[0] = k + 1


@part
def expect(h: Rows, c: int, z: float, variance: float) -> None:
    """Row c measured z with that variance, and has no gate of its own."""
    h.z[c], h.variance[c], h.used[c], h.gate[c] = z, variance, True, 0.0


@part
def weight(q: float, gate: float) -> float:
    """Share of its information that a number keeps: 1 / (inflation of the innovation's covariance)."""
    if gate == 0.0 or not q > gate:
        return 1.0 + 0.0 * q
    return gate / q * (0.01 if q > REJECTED * gate else 1.0)


@part
def update(g: Gaussian, h: Rows, gate: float) -> float:
    """Kalman update by the rows, as one vector with a gate; its squared Mahalanobis distance."""
    q = innovate(g, h)
    correct(g, h, weight(q, gate))
    return q


@part
def innovate(g: Gaussian, h: Rows) -> float:
    """Decorrelate each row from those before it, and gate it; squared Mahalanobis distance of the three.

    `gain` is U = P H^T L^-T, S = L L^T the innovation's covariance. Where the squared normalised innovation q of a row
    exceeds its gate, its variance is multiplied by q / gate, and by 100 more where it exceeds REJECTED times the gate.
    """
    x, p, n, terms, total = g.x, g.p, 3 * g.vectors[0], h.terms[0], 0.0
    for c in range(3):
        row = h.before[0] + c
        h.q[c] = h.white[row] = h.gap[c] = 0.0
        for j in range(n):
            h.gain[row, j] = 0.0
        if not h.used[c]:
            continue
        innovation, variance = h.z[c], h.variance[c]
        for k in range(terms):
            i, w = h.column[c, k], h.weight[c, k]
            innovation -= w * x[i]
            for j in range(n):
                h.gain[row, j] += w * p[i, j]
        h.gap[c] = innovation
        for k in range(terms):
            variance += h.weight[c, k] * h.gain[row, h.column[c, k]]
        for d in range(row):
            shared = 0.0
            for k in range(terms):
                shared += h.weight[c, k] * h.gain[d, h.column[c, k]]
            innovation -= shared * h.white[d]
            variance -= shared * shared
            for j in range(n):
                h.gain[row, j] -= shared * h.gain[d, j]
        h.q[c] = innovation * innovation / variance
        scale = math.sqrt(weight(h.q[c], h.gate[c]) / variance)
        h.white[row] = innovation * scale
        total += h.white[row] * h.white[row]
        for j in range(n):
            h.gain[row, j] *= scale
    return float(total)


@part
def correct(g: Gaussian, h: Rows, share: float) -> None:
    """P <- P - share U U^T: the innovation's covariance is that of `innovate` over `share`."""
    x, p, n = g.x, g.p, 3 * g.vectors[0]
    y0, y1, y2 = share * h.white[0], share * h.white[1], share * h.white[2]
    for i in range(n):
        u0, u1, u2 = h.gain[0, i], h.gain[1, i], h.gain[2, i]
        x[i] += u0 * y0 + u1 * y1 + u2 * y2
        u0, u1, u2 = share * u0, share * u1, share * u2
        for j in range(n):
            p[i, j] -= u0 * h.gain[0, j] + u1 * h.gain[1, j] + u2 * h.gain[2, j]


@part
def settle(g: Gaussian, h: Rows, member: int, flat: float) -> None:
    """Update by three rows of a position x whose variance is `flat` m^2 more than P says, without its large numbers.

    With z = A x + B y + w the position is A^-1 (z - B y - w), which is put into the state as another vector; that both
    are the same but for N(0, flat) is then the measurement, and the vector replaces the position.
    """
    first, terms, a, inverse = 3 * g.block[member, PLACE], h.terms[0], h.square[0], h.square[1]
    n, new = 3 * g.vectors[0], insert(g, member, FRESH, 0.0)
    for c in range(3):
        h.white[c] = h.z[c]
        for d in range(3):
            a[c, d] = 0.0
        for j in range(n):
            h.gain[c, j] = 0.0
        for k in range(terms):
            i, w = h.column[c, k], h.weight[c, k]
            if first <= i < first + 3:
                a[c, i - first] += w
                h.weight[c, k] = 0.0
                continue
            h.white[c] -= w * g.x[i]
            for j in range(n):
                h.gain[c, j] -= w * g.p[i, j]
    for c in range(3):
        i, k = (c + 1) % 3, (c + 2) % 3
        for d in range(3):
            j, m = (d + 1) % 3, (d + 2) % 3
            inverse[d, c] = a[i, j] * a[k, m] - a[i, m] * a[k, j]
    det = a[0, 0] * inverse[0, 0] + a[0, 1] * inverse[1, 0] + a[0, 2] * inverse[2, 0]
    for c in range(3):
        for d in range(3):
            inverse[c, d] /= det
            a[c, d] = h.variance[c] if c == d else 0.0
            for k in range(terms):
                a[c, d] -= h.weight[c, k] * h.gain[d, h.column[c, k]]
    for c in range(3):
        for k in range(3):
            g.x[new + c] += inverse[c, k] * h.white[k]
            for j in range(n):
                g.p[new + c, j] += inverse[c, k] * h.gain[k, j]
            for d in range(3):
                for m in range(3):
                    g.p[new + c, new + d] += inverse[c, k] * a[k, m] * inverse[d, m]
        for j in range(n):
            g.p[j, new + c] = g.p[new + c, j]
    term(h, 0, new, 1.0)
    term(h, 1, first, -1.0)
    for c in range(3):
        expect(h, c, 0.0, flat)
    update(g, h, 0.0)
    remove(g, member, PLACE)
    b = first // 3
    g.block[member, PLACE], g.owner[b], g.block[member, FRESH] = b, member * KINDS + PLACE, ABSENT


@part
def distance(s: Floats, x: Floats) -> tuple[float, float]:
    """x^T S^-1 x of a symmetric S (3, 3), and its determinant."""
    a, b = s[1, 0] / s[0, 0], s[2, 0] / s[0, 0]
    d, cross = s[1, 1] - a * s[1, 0], s[2, 1] - b * s[1, 0]
    c = cross / d
    e, y = s[2, 2] - b * s[2, 0] - c * cross, x[1] - a * x[0]
    z = x[2] - b * x[0] - c * y
    return x[0] * x[0] / s[0, 0] + y * y / d + z * z / e, s[0, 0] * d * e

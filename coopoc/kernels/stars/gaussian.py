"""A Gaussian of 3-vectors that come and go, in covariance form, and its update by up to three numbers with a gate.

A vector belongs to a member of the star and has a kind: its position, the error of its fixes, ... The vectors in use
stand side by side in x and P, so that every loop runs over contiguous numbers; `block` holds where.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...arrays import Bools, Floats, Ints
from ..compiling.compile import part, storage

POSITION, ERROR, VELOCITY, CLONE = range(4)
"""Kinds of a neighbour's vectors: position m, error of its fixes m, velocity m/s, and where it was when it sent its
last message that was used m."""
COMMON, COMPASS = 2, 3
"""Of the ego in place of the last two: the error m that all fixes share, and (bias, noise of this step, 0) of its
compass, rad."""
KINDS, TERMS = 4, 8
ABSENT = -1
REJECTED = 4.0
"""Times the gate: from there on a component is not only down-weighted."""


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
        gated: (3,) False for one that counts whatever its innovation.
        column: (3, TERMS).
        weight: (3, TERMS).
        terms: (1,) terms in use.
        q: (3,) out: squared normalised innovation, 0 where nothing was measured.
        gain: (3, size) scratch: columns of the square root of what the update takes from P.
        white: (3,) scratch: whitened innovations.
    """

    z: Floats
    variance: Floats
    used: Bools
    gated: Bools
    column: Ints
    weight: Floats
    terms: Ints
    q: Floats
    gain: Floats
    white: Floats


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
        np.zeros(3, np.bool_),
        np.zeros((3, TERMS), np.int64),
        np.zeros((3, TERMS)),
        np.zeros(1, np.int64),
        np.zeros(3),
        np.zeros((3, 3 * KINDS * members)),
        np.zeros(3),
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
    first, n = 3 * b, 3 * b + 3
    for i in range(first, n):
        g.x[i] = 0.0
        for j in range(n):
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
def update(x: Floats, p: Floats, n: int, h: Rows, gate: float) -> None:
    """Kalman update of the first n numbers: each row is decorrelated from those before it, gated, and used.

    P <- P - U U^T with U = P H^T L^-T, S = L L^T the innovation's covariance. Where the squared normalised innovation q
    of a row exceeds the gate, its variance is multiplied by q / gate (Huber's weight), and by 100 more where it
    exceeds REJECTED times the gate.
    """
    terms = h.terms[0]
    for c in range(3):
        h.q[c] = 0.0
        for j in range(n):
            h.gain[c, j] = 0.0
        h.white[c] = 0.0
        if not h.used[c]:
            continue
        innovation, variance = h.z[c], h.variance[c]
        for k in range(terms):
            i, w = h.column[c, k], h.weight[c, k]
            innovation -= w * x[i]
            for j in range(n):
                h.gain[c, j] += w * p[i, j]
        for k in range(terms):
            variance += h.weight[c, k] * h.gain[c, h.column[c, k]]
        for d in range(c):
            shared = 0.0
            for k in range(terms):
                shared += h.weight[c, k] * h.gain[d, h.column[c, k]]
            innovation -= shared * h.white[d]
            variance -= shared * shared
            for j in range(n):
                h.gain[c, j] -= shared * h.gain[d, j]
        q = innovation * innovation / variance
        h.q[c] = q
        if gate > 0.0 and h.gated[c] and q > gate:
            variance *= q / gate * (100.0 if q > REJECTED * gate else 1.0)
        scale = 1.0 / math.sqrt(variance)
        h.white[c] = innovation * scale
        for j in range(n):
            h.gain[c, j] *= scale
    y0, y1, y2 = h.white[0], h.white[1], h.white[2]
    for i in range(n):
        u0, u1, u2 = h.gain[0, i], h.gain[1, i], h.gain[2, i]
        x[i] += u0 * y0 + u1 * y1 + u2 * y2
        for j in range(n):
            p[i, j] -= u0 * h.gain[0, j] + u1 * h.gain[1, j] + u2 * h.gain[2, j]

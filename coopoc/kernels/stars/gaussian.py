"""A Gaussian of 3-vectors that come and go, in covariance form, and its update by up to three numbers with gates.

A vector belongs to a member of the star and has a kind: its position, the error of its fixes, ... The vectors in use
stand side by side in x and P, and zeros behind them, so that every loop runs over whole LANES of contiguous numbers;
`block` holds where.
"""

import math
from typing import NamedTuple

import numpy as np

from ...arrays import Floats, Ints
from ..compiling.compile import inside, part, storage
from ..compiling.small import (
    add,
    apply,
    block_at,
    inverse,
    less_inner_product,
    less_transposed_product,
    minus_product,
    negate,
    scale,
    store,
    subtract,
    transpose,
    vector_at,
)
from ..compiling.vectors import LANES, plus, put, take
from ..geometry import Numbers
from .messages import BLOCK, ROW

PLACE, ERROR, TURN, FRESH, COMMON, COMPASS, RANGED = range(7)
"""Kinds of vectors. Of every member: position m; error of its fixes m; errors of its odometry (heading rad, scale,
unused); scratch of `insert_from_measurement`. Of the ego: error m common to all fixes; (compass bias rad, compass noise
of this step rad, offset of its ranges m); scale error of its ranges. Of a neighbour: offset m of the ranges to it."""
KINDS, TERMS = 7, 6
ABSENT = -1
IDENTITY: Numbers = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
STRONG_INFLATION_FACTOR = 4.0
"""Multiple of the gate beyond which a measurement's variance is inflated by another factor of 100."""


class Gaussian(NamedTuple):
    """Mean and covariance of the vectors in use; numbers beyond them are 0.

    Attributes:
        x: (size,), a multiple of 12.
        p: (size, size).
        block: (members, KINDS) index of each vector, ABSENT for none.
        vectors: (1 + members KINDS,) how many are in use, and member KINDS + kind of each.
    """

    x: Floats
    p: Floats
    block: Ints
    vectors: Ints


Z, VARIANCE, LIMIT, GAP, Q, WHITE, SCHUR, CURVE = range(0, 24, 3)
THREE = CURVE + 1
"""Of three measured numbers: what was measured and its variance; the gate on each squared normalised innovation, 0 for
none; out, innovations, these squared and normalised, 0 where nothing was measured, whitened innovations, and their
variances; and of range, azimuth and inclination 1 / m^2, one over the squared distance, else 0."""
MEASURED = TERMS + 1
COV, TURNED, MATRIX = range(9 * TERMS, 9 * TERMS + 27, 9)
"""Behind the matrices of the terms: H P H^T, out, and derivatives of `otherwise.turned`."""


class Rows(NamedTuple):
    """Up to three measured numbers z = sum_k W_k v_k + N(0, diag(variance)) of vectors v_k, and what came of them.

    Attributes:
        three: (THREE,).
        matrix: (MATRIX,) the matrices W_k, and those behind them.
        block: (TERMS + 4,) indices of the vectors, how many are in use, and whether each number was measured.
        gain: (3 size,) out: columns of the square root of what the update takes from P.
    """

    three: Floats
    matrix: Floats
    block: Ints
    gain: Floats


@storage
def new_gaussian(members: int) -> tuple[Gaussian, Rows]:
    """Room for all vectors of that many members, and for rows of them."""
    size = 12 * (1 + KINDS * members // 4)
    block = np.full((members, KINDS), ABSENT)
    g = Gaussian(np.zeros(size), np.zeros((size, size)), block, np.zeros(1 + KINDS * members, np.int64))
    return g, Rows(np.zeros(THREE), np.zeros(MATRIX), np.zeros(MEASURED + 3, np.int64), np.zeros(3 * size))


@inside
def lanes(g: Gaussian) -> int:
    """LANES of numbers that hold the vectors in use."""
    return int((3 * g.vectors[0] + LANES - 1) // LANES)


@inside
def three_rows(rows: Floats, i: int, wide: int) -> Numbers:
    """LANES of three rows, `wide` of them apart."""
    return take(rows, i), take(rows, i + wide), take(rows, i + 2 * wide)


@part
def has(g: Gaussian, member: int, kind: int) -> bool:
    """Whether a vector is in the state."""
    return bool(g.block[member, kind] >= 0)


@part
def insert(g: Gaussian, member: int, kind: int) -> int:
    """Put a vector of mean and variance 0 behind the others; index of its first number."""
    b = g.vectors[0]
    g.vectors[0] = b + 1
    g.block[member, kind], g.vectors[1 + b] = b, member * KINDS + kind
    return int(3 * b)


@part
def insert_error(g: Gaussian, member: int, kind: int, variance: Numbers) -> None:
    """Insert a vector of mean 0 and of these variances, unless all are 0: there is no such error."""
    if sum(variance) > 0.0:
        i = insert(g, member, kind)
        for c in range(3):
            g.p[i + c, i + c] = variance[c]


@part
def clear(g: Gaussian, first: int) -> None:
    """Set mean and covariances of a vector to 0."""
    for i in range(first, first + 3):
        g.x[i], g.p[i], g.p[:, i] = 0.0, 0.0, 0.0


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
            g.p[j, i] = g.p[j, k]
    clear(g, 3 * last)
    moved = g.vectors[1 + last]
    g.vectors[1 + b] = moved
    g.block[moved // KINDS, moved % KINDS] = b
    g.block[member, kind] = ABSENT
    g.vectors[0] = last


@part
def stretch(g: Gaussian, i: int, share: float) -> None:
    """Multiply a vector by a number."""
    n = 3 * g.vectors[0]
    for c in range(3):
        g.x[i + c] *= share
        for k in range(n):
            g.p[i + c, k] *= share
    for k in range(n):
        for c in range(3):
            g.p[k, i + c] *= share


@inside
def widen(g: Gaussian, i: int, variance: float) -> None:
    """Add white noise of that variance to a vector."""
    for c in range(3):
        g.p[i + c, i + c] += variance


@inside
def begin_rows(h: Rows) -> None:
    """Let the rows have no term yet."""
    h.block[TERMS], h.three[CURVE] = 0, 0.0


@inside
def add_term(h: Rows, block: int, w: Numbers) -> None:
    """Let the rows have another term, W times a vector, if that is in the state."""
    n = h.block[TERMS]
    if block >= 0:
        store(h.matrix, n, w)
        h.block[n], h.block[TERMS] = block, n + 1


@inside
def expect(h: Rows, c: int, z: float, variance: float) -> None:
    """Row c measured z with that variance, and has no gate of its own."""
    h.three[Z + c], h.three[VARIANCE + c], h.block[MEASURED + c], h.three[LIMIT + c] = z, variance, True, 0.0


@inside
def weight(q: float, gate: float) -> float:
    """Share of its information that a measurement keeps: 1 / (inflation of the innovation's covariance)."""
    if gate == 0.0 or not q > gate:
        return 1.0 + 0.0 * q
    return gate / q * (0.01 if q > STRONG_INFLATION_FACTOR * gate else 1.0)


@part
def update(g: Gaussian, h: Rows) -> None:
    """Kalman update by the rows."""
    innovate(g, h)
    correct(g, h, 1.0)


@inside
def project(g: Gaussian, h: Rows) -> None:
    """Innovations z - H x, H P in place of `gain`, and H P H^T."""
    gain, wide, third = h.gain, len(g.x) // LANES, len(g.x) // 3
    for k in range(h.block[TERMS]):
        i, w = 3 * h.block[k] * wide, block_at(h.matrix, k)
        for j in range(lanes(g)):
            a, b, c = three_rows(g.p, i + j, wide)
            d, e, f = w[0] * a, w[3] * a, w[6] * a
            if k > 0:
                d, e, f = take(gain, j) + d, take(gain, wide + j) + e, take(gain, 2 * wide + j) + f
            put(gain, j, plus(plus(d, w[1], b), w[2], c))
            put(gain, wide + j, plus(plus(e, w[4], b), w[5], c))
            put(gain, 2 * wide + j, plus(plus(f, w[7], b), w[8], c))
    gap, one, two, three = vector_at(h.three, Z // 3), ROW, ROW, ROW
    for k in range(h.block[TERMS]):
        b, w = h.block[k], block_at(h.matrix, k)
        gap = subtract(gap, apply(w, vector_at(g.x, b)))
        one = add(one, apply(w, vector_at(gain, b)))
        two = add(two, apply(w, vector_at(gain, third + b)))
        three = add(three, apply(w, vector_at(gain, 2 * third + b)))
    store(h.three, GAP // 3, gap)
    store(h.matrix, COV // 9, (*one, *two, *three))


@inside
def innovate(g: Gaussian, h: Rows) -> float:
    """Decorrelate each row from those before it, and gate it; squared Mahalanobis distance of the three.

    `gain` is U = P H^T L^-T, S = L L^T the innovation's covariance. Where the squared normalised innovation q of a row
    exceeds its gate, its variance is multiplied by q / gate. Beyond STRONG_INFLATION_FACTOR gates it is multiplied by
    100 as well.
    """
    project(g, h)
    if h.three[CURVE] > 0.0:
        add_curvature(h)
    gain, wide, gap, cov = h.gain, len(g.x) // LANES, vector_at(h.three, GAP // 3), block_at(h.matrix, COV // 9)
    x, d = whitened(h, 0, gap[0], h.three[VARIANCE] + cov[0])
    s = cov[1] * d
    y, e = whitened(h, 1, gap[1] - s * x, h.three[VARIANCE + 1] + cov[4] - s * s)
    a = -e * s * d
    s, t = cov[2] * d, cov[5] * e + cov[2] * a
    z, f = whitened(h, 2, gap[2] - s * x - t * y, h.three[VARIANCE + 2] + cov[8] - s * s - t * t)
    b, c = -f * (s * d + t * a), -f * t * e
    store(h.three, WHITE // 3, (x, y, z))
    for j in range(lanes(g)):
        p, q, r = three_rows(gain, j, wide)
        put(gain, j, d * p)
        put(gain, wide + j, plus(e * q, a, p))
        put(gain, 2 * wide + j, plus(plus(f * r, c, q), b, p))
    return x * x + y * y + z * z


@inside
def add_curvature(h: Rows) -> None:
    """Add the variance of the second-order terms of range, azimuth and inclination, which linear rows leave out.

    At a distance of d, u beyond and v and w beside the point of linearisation, they are, in m,
    d + u + (v^2 + w^2) / 2 d, v - u v / d and w - u w / d. Of each error the part counts that its own measurement
    leaves.
    """
    u, v, w = left_of(h, 0), left_of(h, 1), left_of(h, 2)
    h.three[VARIANCE] += 0.5 * h.three[CURVE] * (v * v + w * w)
    h.three[VARIANCE + 1] += h.three[CURVE] * u * h.matrix[COV + 4]
    h.three[VARIANCE + 2] += h.three[CURVE] * u * h.matrix[COV + 8]


@inside
def left_of(h: Rows, c: int) -> float:
    """Variance of row c that its measurement leaves."""
    p, r = h.matrix[COV + 4 * c], h.three[VARIANCE + c]
    return float(p * r / (p + r) if h.block[MEASURED + c] else p)


@inside
def whitened(h: Rows, c: int, innovation: float, variance: float) -> tuple[float, float]:
    """Innovation of row c over its gated standard deviation, and 1 over that; 0 where nothing was measured."""
    if not h.block[MEASURED + c]:
        h.three[Q + c] = h.three[GAP + c] = 0.0
        return 0.0, 0.0
    h.three[SCHUR + c] = variance
    h.three[Q + c] = q = innovation * innovation / variance
    scale = math.sqrt(weight(q, h.three[LIMIT + c]) / variance)
    return innovation * scale, scale


@inside
def correct(g: Gaussian, h: Rows, share: float) -> None:
    """x <- x + share U times the whitened innovations, P <- P - share U U^T: the innovation's covariance is that of
    `innovate` over `share`."""
    p, gain, wide, third = g.p, h.gain, len(g.x) // LANES, len(g.x) // 3
    x, y, z = scale(vector_at(h.three, WHITE // 3), share)
    for j in range(lanes(g)):
        u, v, w = three_rows(gain, j, wide)
        put(g.x, j, plus(plus(plus(take(g.x, j), x, u), y, v), z, w))
    for k in range(g.vectors[0]):
        i, a = 3 * k * wide, scale(vector_at(gain, k), share)
        b, c = scale(vector_at(gain, third + k), share), scale(vector_at(gain, 2 * third + k), share)
        for j in range(lanes(g)):
            rows = three_rows(gain, j, wide)
            for row in range(3):
                at = i + row * wide + j
                put(p, at, less_inner_product(take(p, at), (a[row], b[row], c[row]), rows))


@part
def insert_from_measurement(g: Gaussian, h: Rows, member: int, flat: float) -> None:
    """Update by three rows of a position x whose variance is `flat` m^2 more than P says, without its large numbers.

    With z = A x + B y + w the position is A^-1 (z - B y - w), which is put into the state as another vector; that both
    are the same but for N(0, flat) is then the measurement, and the vector replaces the position.
    """
    position, n, b = g.block[member, PLACE], 3 * g.vectors[0], BLOCK
    for k in range(h.block[TERMS]):
        if h.block[k] == position:
            a = block_at(h.matrix, k)
            b = minus_product(inverse(less_transposed_product(BLOCK, a, a)), transpose(a))
            store(h.matrix, k, BLOCK)
    for k in range(h.block[TERMS]):
        store(h.matrix, k, minus_product(b, block_at(h.matrix, k)))
    store(h.three, Z // 3, minus_product(b, vector_at(h.three, Z // 3)))
    project(g, h)
    new = insert(g, member, FRESH)
    for c in range(3):
        g.x[new + c] = -h.three[GAP + c]
        for j in range(n):
            g.p[new + c, j] = g.p[j, new + c] = h.gain[c * len(g.x) + j]
        for d in range(3):
            g.p[new + c, new + d] = h.matrix[COV + 3 * c + d]
            for k in range(3):
                g.p[new + c, new + d] += b[3 * c + k] * h.three[VARIANCE + k] * b[3 * d + k]
    begin_rows(h)
    add_term(h, new // 3, IDENTITY)
    add_term(h, position, negate(IDENTITY))
    for c in range(3):
        expect(h, c, 0.0, flat)
    update(g, h)
    remove(g, member, PLACE)
    g.block[member, PLACE], g.vectors[1 + position], g.block[member, FRESH] = position, member * KINDS + PLACE, ABSENT


@part
def distance(s: Numbers, x: Numbers) -> tuple[float, float]:
    """x^T S^-1 x of a symmetric 3 x 3 matrix S, also where x and S have no height, and its determinant."""
    a, b = s[3] / s[0], s[6] / s[0]
    d, cross = s[4] - a * s[3], s[7] - b * s[3]
    c = cross / d
    e, y = s[8] - b * s[6] - c * cross, x[1] - a * x[0]
    z = x[2] - b * x[0] - c * y
    return x[0] * x[0] / s[0] + y * y / d + (z * z / e if z != 0.0 else 0.0), s[0] * d * e

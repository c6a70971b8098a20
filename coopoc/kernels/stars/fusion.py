"""The fusion of sources by (split) covariance intersection, one run.

A symmetric (3, 3) is six numbers, its upper triangle. The information of a source is a quotient of polynomials in its
s, which is w for the ego itself and 1 - w for all others,

    (Cd / s + Ci)^-1 = s adj(Cd + s Ci) / det(Cd + s Ci),

whose coefficients are made once a step. The weight w is the only minimum of a convex function, by Newton's method from
the weight of the step before.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from ...arrays import AnyArray, Floats
from ..compiling.compile import part

DET = 18
"""Of a source's coefficients, the first of its determinant; before it three times six of its adjugate."""
ROUNDS, TOLERANCE = 60, 1e-8
LEAST, NEGLIGIBLE = 1e-9, 1e-12
"""Least weight of the ego's own estimate, at zero nothing might be left to invert; a dependent share that is none."""
DIAGONAL = (0, 3, 5)
PLACE = ((0, 1, 2), (1, 3, 4), (2, 4, 5))
"""Of the numbers of a symmetric (3, 3) in its upper triangle, row by row."""
UNIT = (1.0, 0.0, 0.0, 1.0, 0.0, 1.0)
NOTHING = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class Fusion(NamedTuple):
    """What is fused at a step.

    Attributes:
        source: (most, 22) coefficients of each source, the ego's first.
        gap: (most, 3) m, from the ego to their pseudo-fixes.
        fixed: (9,) information and information vector that do not depend on w.
        sums: (18,) scratch.
        at: (3,) m, position of the ego.
    """

    source: Floats
    gap: Floats
    fixed: Floats
    sums: Floats
    at: Floats


@part
def describe(d: Any, i: Any, split: bool, source: AnyArray, j: int) -> bool:
    """Coefficients of a source of dependent and independent covariance; True if none of it is dependent."""
    both = plus(d, i)
    alone = split and abs(inner(inverse3(both), d)) < NEGLIGIBLE
    if alone:
        d, i = NOTHING, both
    elif not split:
        d, i = both, NOTHING
    a, b, c = mixed(d, d), mixed(d, i), mixed(i, i)
    for k in range(6):
        source[j, k], source[j, 6 + k], source[j, 12 + k] = 0.5 * a[k], b[k], 0.5 * c[k]
    source[j, DET] = 0.5 * (d[0] * a[0] + d[1] * a[1] + d[2] * a[2])
    source[j, DET + 1], source[j, DET + 2] = 0.5 * inner(a, i), 0.5 * inner(c, d)
    source[j, DET + 3] = 0.5 * (i[0] * c[0] + i[1] * c[1] + i[2] * c[2])
    return alone


@part
def mixed(a: Any, b: Any) -> Any:
    """adj(a + b) - adj(a) - adj(b): twice the adjugate if they are the same."""
    return (
        a[3] * b[5] + b[3] * a[5] - 2.0 * a[4] * b[4],
        a[2] * b[4] + b[2] * a[4] - a[1] * b[5] - b[1] * a[5],
        a[1] * b[4] + b[1] * a[4] - a[2] * b[3] - b[2] * a[3],
        a[0] * b[5] + b[0] * a[5] - 2.0 * a[2] * b[2],
        a[1] * b[2] + b[1] * a[2] - a[0] * b[4] - b[0] * a[4],
        a[0] * b[3] + b[0] * a[3] - 2.0 * a[1] * b[1],
    )


@part
def inner(a: Any, b: Any) -> Any:
    """tr(a b)."""
    return a[0] * b[0] + a[3] * b[3] + a[5] * b[5] + 2.0 * (a[1] * b[1] + a[2] * b[2] + a[4] * b[4])


@part
def between(a: Any, b: Any) -> Any:
    """a b a."""
    p, q, r = times(b, a[0], a[1], a[2]), times(b, a[1], a[3], a[4]), times(b, a[2], a[4], a[5])
    return (
        a[0] * p[0] + a[1] * p[1] + a[2] * p[2],
        a[0] * q[0] + a[1] * q[1] + a[2] * q[2],
        a[0] * r[0] + a[1] * r[1] + a[2] * r[2],
        a[1] * q[0] + a[3] * q[1] + a[4] * q[2],
        a[1] * r[0] + a[3] * r[1] + a[4] * r[2],
        a[2] * r[0] + a[4] * r[1] + a[5] * r[2],
    )


@part
def best_weight(fusion: Fusion, count: int, least_det: bool, alone: bool, start: float) -> float:
    """w of least trace or determinant in [LEAST, 1]; the ends are looked at when Newton's method asks for them."""
    if count == 1:
        return 1.0
    if alone:
        return LEAST
    low, high, bottom, top = LEAST, 1.0, True, True
    w = start if LEAST < start < 1.0 else 0.5
    for _ in range(ROUNDS):
        first, second = derivatives(fusion, count, w, least_det)
        low, high = w if first <= 0.0 else low, w if first >= 0.0 else high
        newton = w - first / second if second > 0.0 else w
        if newton <= LEAST and bottom:
            bottom = False
            if derivatives(fusion, count, LEAST, least_det)[0] >= 0.0:
                return LEAST
        elif newton >= 1.0 and top:
            top = False
            if derivatives(fusion, count, 1.0, least_det)[0] <= 0.0:
                return 1.0
        before, w = w, newton if low <= newton <= high else 0.5 * (low + high)
        if abs(w - before) < TOLERANCE:
            break
    return w


@part
def derivatives(fusion: Fusion, count: int, w: float, least_det: bool) -> Any:
    """First and second derivative of tr P or of log det P by w, from those of the information."""
    add_up(fusion, count, w)
    p, derivative, second = inverse3(six(fusion.sums, 0)), six(fusion.sums, 6), six(fusion.sums, 12)
    outer, twice = (p, 1.0) if least_det else (between(p, UNIT), 2.0)
    return -inner(outer, derivative), twice * inner(outer, between(derivative, p)) - inner(outer, second)


@part
def six(sums: AnyArray, k: int) -> Any:
    """Six numbers."""
    return sums[k], sums[k + 1], sums[k + 2], sums[k + 3], sums[k + 4], sums[k + 5]


@part
def add_up(fusion: Fusion, count: int, w: float) -> None:
    """Information (six numbers) and its first and second derivative by w (six each) of all sources together."""
    sums = fusion.sums
    for c in range(6):
        sums[c], sums[6 + c], sums[12 + c] = fusion.fixed[c], 0.0, 0.0
    add(fusion.source, 0, w, 1.0, sums)
    for j in range(1, count):
        add(fusion.source, j, 1.0 - w, -1.0, sums)


@part
def add(source: AnyArray, j: int, s: float, sign: float, sums: AnyArray) -> None:
    """Add the information of one source at its s, which is `sign` times w and a constant."""
    p, q, r = source[j, DET + 1], source[j, DET + 2], source[j, DET + 3]
    scale = 1.0 / (source[j, DET] + s * (p + s * (q + s * r)))
    first, second = p + s * (2.0 * q + 3.0 * s * r), 2.0 * q + 6.0 * s * r
    for c in range(6):
        p, q, r = source[j, c], source[j, 6 + c], source[j, 12 + c]
        value = s * (p + s * (q + s * r)) * scale
        derivative = (p + s * (2.0 * q + 3.0 * s * r) - value * first) * scale
        sums[c] += value
        sums[6 + c] += sign * derivative
        sums[12 + c] += (2.0 * q + 6.0 * s * r - 2.0 * derivative * first - value * second) * scale


@part
def fuse(fusion: Fusion, count: int, w: float) -> Any:
    """Move the ego to the weighted mean; its dependent and independent covariance.

    The first is P (sum of s dL/ds) P with L the information of a source, since s dL/ds = L (Cd / s) L.
    """
    source, gap, fixed, sums, at = fusion
    total, dependent = six(fixed, 0), NOTHING
    x, y, z = fixed[6], fixed[7], fixed[8]
    for j in range(count):
        s = w if j == 0 else 1.0 - w
        sums[:] = 0.0
        add(source, j, s, s, sums)
        p, q, r = times(six(sums, 0), gap[j, 0], gap[j, 1], gap[j, 2])
        x, y, z, total = x + p, y + q, z + r, plus(total, six(sums, 0))
        dependent = plus(dependent, six(sums, 6))
    cov = inverse3(total)
    p, q, r = times(cov, x, y, z)
    at[0], at[1], at[2] = at[0] + p, at[1] + q, at[2] + r
    dependent = between(cov, dependent)
    return dependent, plus(cov, dependent, -1.0)


@part
def plus(a: Any, b: Any, sign: float = 1.0) -> Any:
    """Sum, or difference."""
    return (
        a[0] + sign * b[0],
        a[1] + sign * b[1],
        a[2] + sign * b[2],
        a[3] + sign * b[3],
        a[4] + sign * b[4],
        a[5] + sign * b[5],
    )


@part
def inverse3(m: Any) -> Any:
    """The inverse of a symmetric matrix."""
    a, b, c = m[3] * m[5] - m[4] * m[4], m[2] * m[4] - m[1] * m[5], m[1] * m[4] - m[2] * m[3]
    s = 1.0 / (m[0] * a + m[1] * b + m[2] * c)
    return (
        a * s,
        b * s,
        c * s,
        (m[0] * m[5] - m[2] * m[2]) * s,
        (m[1] * m[2] - m[0] * m[4]) * s,
        (m[0] * m[3] - m[1] * m[1]) * s,
    )


@part
def times(m: Any, x: float, y: float, z: float) -> Any:
    """A symmetric matrix times a vector."""
    return m[0] * x + m[1] * y + m[2] * z, m[1] * x + m[3] * y + m[4] * z, m[2] * x + m[4] * y + m[5] * z

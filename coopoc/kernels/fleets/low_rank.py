"""P <- (P^-1 + F)^-1 of a component, F the sparse information of a step: no dense matrix is factored or inverted.

F = L L^T, vehicle by vehicle, the one with the fewest neighbours left first. The three columns L_k of a vehicle are one
measurement of a few positions with unit noise: with G = L_k^T P and C C^T = 1 + G L_k it takes V^T V from P,
V = C^-1 G, and moves the estimate by V^T C^-1 times the innovation. F may be singular, where fixes are missing: a
column without a pivot is zero. Up to `DEPTH` rows of V are collected, so that P is read and written seldom. (3n)^3
flops for n vehicles, half of those of two inversions. Matrices as in `coopoc.kernels.fleets.components`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy import uint64

from ...arrays import AnyArray
from ..compiling.compile import part
from ..compiling.vectors import LANES, less, pack, put, subtract, take
from .components import BASE, BEGIN, MEMBER, STRIDE, TILE

DEPTH = 24
X, COLUMN, WAITING = 3, 6, 10
COPIED = WAITING + DEPTH
"""Rows of scratch, behind those of -G: of a (3, 3), of L_k with its numbers four apart, of V, and of P, vehicle by
vehicle: as long as P does not change, its rows need not be copied again."""
NO_PIVOT = 1e-12
"""Share of its first value below which a pivot is rounding noise."""


class Scratch(NamedTuple):
    """Memory of the update.

    Attributes:
        rows: flat, `COPIED` + 3N rows as wide as the widest component.
        left: (N,) members that are not eliminated yet.
        degree: (N,) neighbours of each among these.
        touched: (N,) neighbours of the member at hand, and itself.
        copied: (N,) whether its rows of P are in `rows`.
        diagonal: (3N,) of F, before any elimination.
    """

    rows: AnyArray
    left: AnyArray
    degree: AnyArray
    touched: AnyArray
    copied: AnyArray
    diagonal: AnyArray


def scratch(vehicles: int, wide: int) -> Scratch:
    """For so many vehicles and a stride."""
    return Scratch(
        np.zeros((COPIED + wide) * wide),
        np.zeros(vehicles, np.int64),
        np.zeros(vehicles, np.int64),
        np.zeros(vehicles, np.int64),
        np.zeros(vehicles, np.int64),
        np.zeros(3 * vehicles),
    )


@part
def update(
    plan: AnyArray,
    component: int,
    covariance: AnyArray,
    info: AnyArray,
    near: AnyArray,
    memory: Scratch,
    eta: AnyArray,
    moved: AnyArray,
) -> None:
    """Add the information of a step to a component's covariance, and find how far that moves the estimate.

    Args:
        plan: of the components.
        component: which of them.
        covariance: m^2, of which the upper triangle counts.
        info: informations 1/m^2, the lower triangle, zeros above; used up.
        near: (N, N) by the members' slots, True for two that share a block of `info`; False on the diagonal.
        memory: scratch.
        eta: (runs, N, 3) 1/m, used up.
        moved: (runs, 3N or more) m, by the members' rows.
    """
    begin, stride, base = plan[BEGIN, component], plan[STRIDE, component], plan[BASE, component]
    n = plan[BEGIN, component + 1] - begin
    p, f, members = covariance[base : base + stride**2], info[base : base + stride**2], plan[MEMBER, begin : begin + n]
    close = near[begin:, begin:]
    for i in range(n):
        memory.left[i], memory.degree[i], memory.copied[i] = i, 0, 0
        for j in range(n):
            memory.degree[i] += close[i, j]
    for i in range(3 * n):
        memory.diagonal[i] = f[i * (stride + 1)]
    moved[:, : 3 * n] = 0.0
    waiting = 0
    for count in range(n - 1, -1, -1):
        k = fewest(memory.degree, memory.left, count)
        touched = memory.touched[: eliminate(f, stride, close, count, k, memory) + 1]
        if f[3 * k * (stride + 1)] + f[(3 * k + 1) * (stride + 1)] + f[(3 * k + 2) * (stride + 1)] > 0.0:
            whitening = take_in(p, f, stride, touched, k, memory, waiting)
            v = memory.rows[(WAITING + waiting) * stride : (WAITING + waiting + 3) * stride]
            for run in range(len(eta)):
                follow_up(f, touched, k, v, whitening, members, eta[run], moved[run, : 3 * n])
            waiting += 3
        if waiting == DEPTH or count == 0:
            shrink(p, stride, 3 * n, memory.rows, WAITING * stride, waiting)
            waiting, memory.copied[:n] = 0, 0


@part
def fewest(degree: AnyArray, left: AnyArray, last: int) -> int:
    """The member of left[: last + 1] with the fewest neighbours; left[:last] are the others."""
    best = 0
    for i in range(1, last + 1):
        if degree[left[i]] < degree[left[best]]:
            best = i
    k = left[best]
    left[best] = left[last]
    return int(k)


@part
def root(pivot: float, first: float) -> tuple[float, float]:
    """Square root of a pivot and its inverse, both 0 if it is no more than rounding noise."""
    a = math.sqrt(pivot) if pivot > NO_PIVOT * first else 0.0
    return a, reciprocal(a)


@part
def reciprocal(a: float) -> float:
    """1 / a, and 0 for 0."""
    return 1.0 / a if a > 0.0 else 0.0


@part
def eliminate(f: AnyArray, stride: int, close: AnyArray, count: int, k: int, memory: Scratch) -> int:
    """Columns L_k into the columns of k, which no other uses any more; how many others they touch, behind these k
    itself."""
    many, degree, touched, diagonal = 0, memory.degree, memory.touched, memory.diagonal[3 * k : 3 * k + 3]
    for i in range(count):
        if close[k, memory.left[i]]:
            touched[many] = memory.left[i]
            many += 1
    touched[many] = k
    at = 3 * k * (stride + 1)
    a, one = root(f[at], diagonal[0])
    b, c = f[at + stride] * one, f[at + 2 * stride] * one
    d, two = root(f[at + stride + 1] - b * b, diagonal[1])
    e = (f[at + 2 * stride + 1] - c * b) * two
    g, three = root(f[at + 2 * stride + 2] - c * c - e * e, diagonal[2])
    f[at], f[at + 1], f[at + 2], f[at + stride], f[at + stride + 1] = a, 0.0, 0.0, b, d
    f[at + stride + 2], f[at + 2 * stride], f[at + 2 * stride + 1], f[at + 2 * stride + 2] = 0.0, c, e, g
    for i in range(many):
        r = touched[i]
        degree[r] -= 1
        source, across, down = (3 * (r * stride + k), 1, stride) if r > k else (3 * (k * stride + r), stride, 1)
        for row in range(3):
            x, y, z = f[source], f[source + across], f[source + 2 * across]
            to = 3 * (r * stride + k) + row * stride
            f[to] = x * one
            f[to + 1] = (y - f[to] * b) * two
            f[to + 2] = (z - f[to] * c - f[to + 1] * e) * three
            source += down
    for i in range(many):
        for j in range(many):
            r, s = touched[i], touched[j]
            if r >= s:
                lessen(f, 3 * (r * stride + s), 3 * (r * stride + k), 3 * (s * stride + k), stride)
            if r > s and not close[r, s]:
                close[r, s] = close[s, r] = True
                degree[r] += 1
                degree[s] += 1
    return many


@part
def lessen(f: AnyArray, out: int, one: int, other: int, stride: int) -> None:
    """A block less the product of one with the other transposed."""
    for r in range(3):
        x, y, z = f[one + r * stride], f[one + r * stride + 1], f[one + r * stride + 2]
        for s in range(3):
            at = other + s * stride
            f[out + r * stride + s] -= x * f[at] + y * f[at + 1] + z * f[at + 2]


@part
def subtract(
    out: AnyArray, to: int, left: AnyArray, by: int, right: AnyArray, of: int, stride: int, tiles: int
) -> None:
    """Three rows less the transposed (3, 3) of `left` times three rows of `right`."""
    for a in range(3):
        for c in range(3):
            factor = left[by + c * stride + a]
            for j in range(tiles * LANES):
                out[to + a * stride + j] -= factor * right[of + c * stride + j]


@part
def take_in(p: AnyArray, f: AnyArray, stride: int, touched: AnyArray, k: int, memory: Scratch, waiting: int) -> Any:
    """-V of the measurement L_k behind those collected, and what `whiten` returns."""
    rows = memory.rows
    rows[: 3 * stride] = 0.0
    for q, r in enumerate(touched):
        at, u = 3 * (r * stride + k), (COPIED + 3 * r) * stride
        if not memory.copied[r]:
            memory.copied[r] = 1
            fetch(p, stride, r, rows, u)
        subtract(rows, 0, f, at, rows, u, stride, stride // LANES)
        for i in range(COLUMN * stride + 12 * q, COLUMN * stride + 12 * q + 12, 4):
            rows[i], rows[i + 1], rows[i + 2] = f[at], f[at + 1], f[at + 2]
            at += stride
    for i in range(WAITING, WAITING + waiting, 3):
        minus_seen(rows, i * stride, stride, touched)
        subtract(rows, 0, rows, X * stride, rows, i * stride, stride, stride // LANES)
    minus_seen(rows, 0, stride, touched)
    return whiten(rows, stride, (WAITING + waiting) * stride)


@part
def whiten(rows: AnyArray, stride: int, to: int) -> Any:
    """-V = -C^-1 G, and what solves with C: the inverses of its diagonal, and the others of its numbers."""
    s, step = X * stride, uint64(stride)
    a = 1.0 / math.sqrt(1.0 + rows[s])
    b, c = a * rows[s + stride], a * rows[s + 2 * stride]
    d = 1.0 / math.sqrt(1.0 + rows[s + stride + 1] - b * b)
    e = d * (rows[s + 2 * stride + 1] - c * b)
    g = 1.0 / math.sqrt(1.0 + rows[s + 2 * stride + 2] - c * c - e * e)
    u = uint64(to)
    v, w = u + step, u + step + step
    for j in range(step):
        x = a * rows[j]
        y = d * (rows[j + step] - b * x)
        rows[u + j], rows[v + j], rows[w + j] = x, y, g * (rows[j + step + step] - c * x - e * y)
    return a, b, c, d, e, g


@part
def follow_up(
    f: AnyArray,
    touched: AnyArray,
    k: int,
    v: AnyArray,
    whitening: Any,
    members: AnyArray,
    eta: AnyArray,
    moved: AnyArray,
) -> None:
    """Move by V^T C^-1 (y - L_k^T moved), y the measurement: L y is the information vector."""
    step = uint64(len(v) // 3)
    stride, own = len(v) // 3, members[k]
    at = 3 * k * (stride + 1)
    x = eta[own, 0] * reciprocal(f[at])
    y = (eta[own, 1] - f[at + stride] * x) * reciprocal(f[at + stride + 1])
    z = (eta[own, 2] - f[at + 2 * stride] * x - f[at + 2 * stride + 1] * y) * reciprocal(f[at + 2 * stride + 2])
    p, q, r = x, y, z
    for i in touched:
        for c in range(3):
            at, other = 3 * (i * stride + k) + c * stride, moved[3 * i + c]
            eta[members[i], c] -= f[at] * x + f[at + 1] * y + f[at + 2] * z
            p, q, r = p - f[at] * other, q - f[at + 1] * other, r - f[at + 2] * other
    a, b, c, d, e, g = whitening
    p = a * p
    q = d * (q - b * p)
    r = g * (r - c * p - e * q)
    for j in range(uint64(len(moved))):
        moved[j] -= p * v[j] + q * v[step + j] + r * v[step + step + j]


@part
def fetch(p: AnyArray, stride: int, r: int, rows: AnyArray, to: int) -> None:
    """Three whole rows of a symmetric matrix whose upper triangle is there."""
    step, at, one, two = uint64(stride), uint64(3 * r), uint64(1), uint64(2)
    u = uint64(to)
    v, w, k = u + step, u + step + step, at
    for j in range(at):
        rows[u + j], rows[v + j], rows[w + j] = p[k], p[k + one], p[k + two]
        k += step
    for j in range(at, step):
        rows[u + j], rows[v + j], rows[w + j] = p[k], p[k + step], p[k + step + step]
        k += one
    rows[v + at], rows[w + at], rows[w + at + one] = rows[u + at + one], rows[u + at + two], rows[v + at + two]


@part
def minus_seen(rows: AnyArray, at: int, stride: int, touched: AnyArray) -> None:
    """Minus three rows times L_k, (3, 3)."""
    x, y, z = pack(0.0, 0.0, 0.0, 0.0), pack(0.0, 0.0, 0.0, 0.0), pack(0.0, 0.0, 0.0, 0.0)
    place, step, one = uint64(COLUMN * stride // LANES), uint64(stride), uint64(1)
    for r in touched:
        i = uint64(at + 3 * r)
        for _ in range(3):
            column = take(rows, place)
            x, y, z = less(x, column, rows[i]), less(y, column, rows[i + step]), less(z, column, rows[i + step + step])
            i, place = i + one, place + one
    out, step = uint64(X * stride // LANES), uint64(stride // LANES)
    put(rows, out, x)
    put(rows, out + step, y)
    put(rows, out + step + step, z)


@part
def shrink(p: AnyArray, stride: int, height: int, rows: AnyArray, at: int, depth: int) -> None:
    """P - V^T V, the upper triangle, tile by tile of 4 x 12, which are twelve vectors; V are some of the rows."""
    for i in range(0, height, 4):
        for j in range(i // TILE * TILE, stride, TILE):
            tile(p, i * stride + j, stride, rows, at + i, at + j, depth)


@part
def tile(p: AnyArray, place: int, stride: int, rows: AnyArray, left: int, right: int, depth: int) -> None:
    """A tile less its part of V^T V."""
    a, step, one, two = uint64(place // LANES), uint64(stride // LANES), uint64(1), uint64(2)
    b, c, d = a + step, a + step + step, a + step + step + step
    axx, axy, axz = take(p, a), take(p, a + one), take(p, a + two)
    bxx, bxy, bxz = take(p, b), take(p, b + one), take(p, b + two)
    cxx, cxy, cxz = take(p, c), take(p, c + one), take(p, c + two)
    dxx, dxy, dxz = take(p, d), take(p, d + one), take(p, d + two)
    i, j = uint64(left), uint64(right // LANES)
    for _ in range(uint64(depth)):
        x, y, z = take(rows, j), take(rows, j + one), take(rows, j + two)
        e, f, g, h = rows[i], rows[i + one], rows[i + two], rows[i + uint64(3)]
        axx, axy, axz = less(axx, x, e), less(axy, y, e), less(axz, z, e)
        bxx, bxy, bxz = less(bxx, x, f), less(bxy, y, f), less(bxz, z, f)
        cxx, cxy, cxz = less(cxx, x, g), less(cxy, y, g), less(cxz, z, g)
        dxx, dxy, dxz = less(dxx, x, h), less(dxy, y, h), less(dxz, z, h)
        i, j = i + uint64(stride), j + step
    put(p, a, axx)
    put(p, a + one, axy)
    put(p, a + two, axz)
    put(p, b, bxx)
    put(p, b + one, bxy)
    put(p, b + two, bxz)
    put(p, c, cxx)
    put(p, c + one, cxy)
    put(p, c + two, cxz)
    put(p, d, dxx)
    put(p, d + one, dxy)
    put(p, d + two, dxz)

"""Gauss-Newton steps of a window of stars, whose arrays are those of `coopoc.kernels.window`."""

from __future__ import annotations

import math
from typing import Any

from numpy import uint64

from ..arrays import AnyArray
from .blocks import eliminate, substitute, width
from .chains import LEAST_PROCESS, fold, unfold
from .compile import compiled
from .roster import FIX, MOVED, PROCESS
from .sighting import exact, vector
from .snapshot import LIMIT
from .snapshot_step import as_measured, widened


@compiled
def settle(
    window: Any, seen: AnyArray, start: AnyArray, first: int, last: int, std: AnyArray, least: float,
    tolerance: float, memory: Any, cov: AnyArray, again: bool,
) -> bool:  # fmt: skip
    """Exact Gauss-Newton steps until one is short, False if none is; or not `again`, the converted solution, which is
    one step from anywhere."""
    for _ in range(LIMIT):
        linearise(window, seen, start, first, last, std, least, again)
        if move(window, first, last, memory, cov) <= tolerance or not again:
            return True
    return False


@compiled
def linearise(
    window: Any, seen: AnyArray, start: AnyArray, first: int, last: int, std: AnyArray, least: float, again: bool
) -> None:  # fmt: skip
    """The edges: linear in range and angles at the points, or `again` False, converted where they were measured."""
    _, _, edge, point, count, _, _ = window
    for step in range(first, last + 1):
        slot = step % len(point)
        for k in range(1, count[slot]):
            one, e = seen[start[step] + k - 1], edge[slot, k]
            x, y, z = (
                point[slot, k, 0] - point[slot, 0, 0], point[slot, k, 1] - point[slot, 0, 1],
                point[slot, k, 2] - point[slot, 0, 2],
            )  # fmt: skip
            if again:
                wide = widened(one, std, least)
                e[0], e[1], e[2], e[3], e[4], e[5], e[6], e[7], e[8] = exact(x, y, z, one, wide, 0.0)
                continue
            xx, xy, xz, yy, yz, zz = as_measured(one, std, least)
            a, b, c = vector(one)
            x, y, z = a - x, b - y, c - z
            e[0], e[1], e[2], e[3], e[4], e[5] = xx, xy, xz, yy, yz, zz
            e[6], e[7], e[8] = xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z


@compiled
def meeting(window: Any, first: int, last: int, apart: float) -> bool:
    """True if the ego and a neighbour stand in one place at some step."""
    point, count = window[3], window[4]
    for step in range(first, last + 1):
        slot = step % len(point)
        for k in range(1, count[slot]):
            x, y = point[slot, k, 0] - point[slot, 0, 0], point[slot, k, 1] - point[slot, 0, 1]
            if math.sqrt(x * x + y * y) < apart:
                return True
    return False


@compiled
def move(window: Any, first: int, last: int, memory: Any, cov: AnyArray) -> float:
    """One Gauss-Newton step: all points, the covariance of the ego's newest, and the largest move m."""
    arms, pivots, a, factor, inverses, b, scratch = memory
    point, count, before = window[3], window[4], window[5]
    length, n = len(point), 3 * (last - first + 1)
    stride = width(n)
    ego(window, first, last, stride, a)
    for step in range(first, last + 1):
        for k in range(1, count[step % length]):
            if step == first or before[step % length, k] < 0:
                fold(window, first, step, last, k, stride, arms, pivots, a, scratch)
    eliminate(a, n, stride, factor, inverses)
    substitute(factor, n, stride, b)
    for i in range(3):
        for j in range(3):
            cov[i, j] = -inverses[3 * n - 9 + 3 * i + j]
    most = 0.0
    for step in range(last, first - 1, -1):
        for k in range(1, count[step % length]):
            most = max(most, unfold(window, first, step, last, k, stride, arms, pivots, b))
    for s in range(last - first + 1):
        slot = (first + s) % length
        for c in range(3):
            point[slot, 0, c] += b[3 * s + c]
            most = max(most, abs(b[3 * s + c]))
    return most


@compiled
def ego(window: Any, first: int, last: int, stride: int, a: AnyArray) -> None:
    """Information (3h, 3h), upper triangle, and beside it the pull of the ego's points: fixes, motion, and its end of
    each edge."""
    said, weight, edge, point, count, _, _ = window
    length, n = len(point), 3 * (last - first + 1)
    for i in range(uint64(n * stride)):
        a[i] = 0.0
    for s in range(last - first + 1):
        slot, at = (first + s) % length, 3 * s * (stride + 1)
        for c in range(3):
            own, side = at + c * (stride + 1), (3 * s + c) * stride + n
            a[own] += weight[slot, 0, c]
            a[side] += weight[slot, 0, c] * (said[slot, FIX, 0, c] - point[slot, 0, c])
            if s > 0:
                q = 1.0 / max(said[slot, PROCESS, 0, c], LEAST_PROCESS)
                force = q * (said[slot, MOVED, 0, c] - point[slot, 0, c] + point[slot - 1, 0, c])
                a[own] += q
                a[own - 3 * (stride + 1)] += q
                a[own - 3 * stride] -= q
                a[side] += force
                a[side - 3 * stride] -= force
        for k in range(1, count[slot]):
            e = edge[slot, k]
            a[at], a[at + 1], a[at + 2] = a[at] + e[0], a[at + 1] + e[1], a[at + 2] + e[2]
            own = at + stride + 1
            a[own], a[own + 1], a[own + stride + 1] = a[own] + e[3], a[own + 1] + e[4], a[own + stride + 1] + e[5]
            for c in range(3):
                a[(3 * s + c) * stride + n] -= e[6 + c]

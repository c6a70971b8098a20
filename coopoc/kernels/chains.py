"""A neighbour's points in a window, a chain of motion that meets the ego's points only: eliminate it onto these.

Arrays are those of `coopoc.kernels.window`. The ego's matrix (3h, 3h) with its right-hand side, which remains, is one
of `coopoc.kernels.blocks`. Kept of each point, in flat arrays: its arm (3, stride) to the ego's points with its pull
beside it, and twelve numbers, minus the inverse of its own block and then its move.
"""

from __future__ import annotations

from typing import Any

from numpy import uint64

from ..arrays import AnyArray
from .blocks import inverse3
from .compile import compiled, summing
from .lanes import LANES, minus_product, subtract
from .roster import FIX, MOVED, PROCESS

LEAST_PROCESS = 1e-90
"""m^2; the cube of its inverse is still a number, and far beyond any digit that counts."""


@compiled
def fold(
    window: Any, first: int, step: int, last: int, k: int, stride: int, arms: AnyArray, pivots: AnyArray, a: AnyArray,
    scratch: AnyArray,
) -> None:  # fmt: skip
    """Eliminate the chain that begins at place k of a step onto the ego's points.

    With S the information of a point without the motion that leaves it, of information Q, the next one inherits
    (S^-1 + Q^-1)^-1 = Q (S + Q)^-1 S, no difference of near numbers, and arms and pulls times Q (S + Q)^-1.
    """
    said, weight, edge, point, _, _, later = window
    length, most, begin, beside = len(point), point.shape[1], 3 * (step - first), 3 * (last - first + 1)
    xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    slot = step % length
    at = 3 * stride * (slot * most + k)
    for j in range(uint64(at), uint64(at + 3 * stride)):
        arms[j] = 0.0
    while True:
        end = 3 * (step - first)
        e, w = edge[slot, k], weight[slot, k]
        own, row, below, lowest = at + end, at + beside, at + stride + beside, at + 2 * stride + beside
        arms[own], arms[own + 1], arms[own + 2] = -e[0], -e[1], -e[2]
        arms[own + stride], arms[own + stride + 1], arms[own + stride + 2] = -e[1], -e[3], -e[4]
        own += 2 * stride
        arms[own], arms[own + 1], arms[own + 2] = -e[2], -e[4], -e[5]
        xx, xy, xz = xx + e[0] + w[0], xy + e[1], xz + e[2]
        yy, yz, zz = yy + e[3] + w[1], yz + e[4], zz + e[5] + w[2]
        arms[row] += e[6] + w[0] * (said[slot, FIX, k, 0] - point[slot, k, 0])
        arms[below] += e[7] + w[1] * (said[slot, FIX, k, 1] - point[slot, k, 1])
        arms[lowest] += e[8] + w[2] * (said[slot, FIX, k, 2] - point[slot, k, 2])
        goes = later[slot, k] if step < last else -1
        qx, qy, qz, gx, gy, gz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        then = slot + 1 if slot + 1 < length else 0
        if goes >= 0:
            qx, gx = motion(said, point, slot, k, then, goes, 0)
            qy, gy = motion(said, point, slot, k, then, goes, 1)
            qz, gz = motion(said, point, slot, k, then, goes, 2)
            arms[row] -= gx
            arms[below] -= gy
            arms[lowest] -= gz
        p = 12 * (slot * most + k)
        ixx, ixy, ixz, iyy, iyz, izz = inverse3(xx + qx, xy, xz, yy + qy, yz, zz + qz)
        pivots[p], pivots[p + 1], pivots[p + 2], pivots[p + 3], pivots[p + 4] = -ixx, -ixy, -ixz, -ixy, -iyy
        pivots[p + 5], pivots[p + 6], pivots[p + 7], pivots[p + 8] = -iyz, -ixz, -iyz, -izz
        j = begin // LANES * LANES
        minus_product(scratch, j, pivots, p, arms, at + j, stride, (stride - j) // LANES)
        for i in range(begin, end + 3, 3):
            j = i // LANES * LANES
            subtract(a, i * stride + j, arms, at + i, scratch, j, stride, (stride - j) // LANES)
        if goes < 0:
            return
        xx, xy, xz, yy, yz, zz = (
            qx * (ixx * xx + ixy * xy + ixz * xz), qx * (ixx * xy + ixy * yy + ixz * yz),
            qx * (ixx * xz + ixy * yz + ixz * zz), qy * (ixy * xy + iyy * yy + iyz * yz),
            qy * (ixy * xz + iyy * yz + iyz * zz), qz * (ixz * xz + iyz * yz + izz * zz),
        )  # fmt: skip
        step, slot, k = step + 1, then, goes
        at = 3 * stride * (slot * most + k)
        hand_on(scratch, stride, begin, qx, qy, qz, arms, at)
        arms[at + beside] += gx
        arms[at + stride + beside] += gy
        arms[at + 2 * stride + beside] += gz


@compiled
def motion(said: AnyArray, point: AnyArray, slot: int, k: int, then: int, goes: int, c: int) -> tuple[float, float]:
    """Information 1/m^2 of the motion to the next step along an axis, and its pull 1/m on that step's point."""
    q = 1.0 / max(said[then, PROCESS, goes, c], LEAST_PROCESS)
    return q, q * (said[then, MOVED, goes, c] - point[then, goes, c] + point[slot, k, c])


@compiled
def hand_on(v: AnyArray, stride: int, begin: int, qx: float, qy: float, qz: float, arms: AnyArray, place: int) -> None:
    """The arm of the next point: Q times (S + Q)^-1 times this one's, zero before the chain."""
    at, one, two = uint64(place), uint64(stride), uint64(2 * stride)
    for j in range(uint64(stride)):
        there = j >= uint64(begin)
        arms[at + j] = qx * v[j] if there else 0.0
        arms[at + one + j] = qy * v[one + j] if there else 0.0
        arms[at + two + j] = qz * v[two + j] if there else 0.0


@compiled
def unfold(
    window: Any, first: int, step: int, last: int, k: int, stride: int, arms: AnyArray, pivots: AnyArray, b: AnyArray
) -> float:  # fmt: skip
    """Move one point of a chain, the next one's being known, and the ego's `b` (3h,); its largest move m."""
    said, _, _, point, _, _, later = window
    slot, most = step % len(point), point.shape[1]
    at, p = 3 * stride * (slot * most + k), uint64(12 * (slot * most + k))
    x, y, z = reach(arms, at, stride, 3 * (step - first + 1), 3 * (last - first + 1), b)
    goes = later[slot, k]
    if goes >= 0:
        then = slot + 1 if slot + 1 < len(point) else 0
        other = uint64(12 * (then * most + goes) + 9)
        x += pivots[other] / max(said[then, PROCESS, goes, 0], LEAST_PROCESS)
        y += pivots[other + uint64(1)] / max(said[then, PROCESS, goes, 1], LEAST_PROCESS)
        z += pivots[other + uint64(2)] / max(said[then, PROCESS, goes, 2], LEAST_PROCESS)
    largest, to = 0.0, p + uint64(9)
    for c in range(3):
        moved = -(pivots[p] * x + pivots[p + uint64(1)] * y + pivots[p + uint64(2)] * z)
        pivots[to] = moved
        point[slot, k, c] += moved
        largest = max(largest, abs(moved))
        p, to = p + uint64(3), to + uint64(1)
    return largest


@summing
def reach(arms: AnyArray, place: int, stride: int, count: int, beside: int, b: AnyArray) -> Any:
    """The pull on a point less its arm (3, count) times `b`."""
    at, row, end = uint64(place), uint64(stride), uint64(beside)
    two = row + row
    x, y, z = 0.0, 0.0, 0.0
    for j in range(uint64(count)):
        x += arms[at + j] * b[j]
        y += arms[at + row + j] * b[j]
        z += arms[at + two + j] * b[j]
    return arms[at + end] - x, arms[at + row + end] - y, arms[at + two + end] - z

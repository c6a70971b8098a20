"""One number after the other into the state of poses and its covariance.

The state of a member is d = 4 or 6 numbers: position m, heading rad and, of six, the odometer's scale error and the
yaw rate's bias rad/s. A row is linear in the pose of one member, (a, b, c, h), and at most in the position of another,
(-a, -b, -c): every measurement here is one of the vector between the two and of the first one's heading.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy import uint64

from ...arrays import Floats
from ..compiling.compile import part
from ..compiling.vectors import LANES, less, plus, put, take

HEADING = 3
"""Place of the heading in a member's state."""
ROWS = 4
"""Rows that may be pending, so that one pass over the covariance serves them all."""
X, AT, KEPT, TOTAL, COLUMN, SCALED = 0, 1, 2, 3, 4, 4 + ROWS
"""Rows of `Poses.vector`: the state, the state at which rows are linear, the state before the relative measurements;
the sum of r^2 / s + log s, the number of rows that were used, and of those pending with the 1 / s of each; ROWS columns
P h of pending rows, which are not yet in the covariance, and the same over s."""
PENDING = 2
"""Place in the row TOTAL."""


class Poses(NamedTuple):
    """State of the members of one unit.

    Attributes:
        vector: (4 + 2 ROWS, stride), see `X`; the stride is a multiple of LANES.
        cov: (stride, stride).
        kept: the same, before the relative measurements.
    """

    vector: Floats
    cov: Floats
    kept: Floats


def new_poses(size: int) -> Poses:
    """Room for `size` numbers."""
    stride = (size + LANES - 1) // LANES * LANES
    return Poses(np.zeros((4 + 2 * ROWS, stride)), np.zeros((stride, stride)), np.zeros((stride, stride)))


@part
def update_row(poses: Poses, size: int, ends: Any, row: Any, measured: Any, gate: float) -> bool:
    """x += P h r / s, P -= P h h^T P / s with s = h^T P h + variance; nothing where r^2 > gate^2 s.

    The covariance follows when ROWS rows are pending, or with `settle`; a row sees those that are pending.

    Args:
        poses: the state.
        size: its numbers.
        ends: first number of the member and of the other, -1 for none.
        row: (a, b, c, h).
        measured: r, at the state, and the variance of the measurement.
        gate: in standard deviations.

    Returns:
        Whether the measurement is used.
    """
    vector, cov, (k, o), (a, b, c, h), (residual, variance) = poses.vector, poses.cov, ends, row, measured
    if vector[TOTAL, PENDING] == ROWS:
        settle(poses, size)
    pending = int(vector[TOTAL, PENDING])
    column = COLUMN + pending
    tiles, wide = (size + LANES - 1) // LANES, vector.shape[1] // LANES
    for i in range(tiles):
        x, y, z = tile(cov, k, wide, i), tile(cov, k + 1, wide, i), tile(cov, k + 2, wide, i)
        if o >= 0:
            x, y, z = x - tile(cov, o, wide, i), y - tile(cov, o + 1, wide, i), z - tile(cov, o + 2, wide, i)
        put(vector, uint64(column * wide + i), plus(plus(plus(h * tile(cov, k + 3, wide, i), a, x), b, y), c, z))
    for q in range(pending):
        share = along(vector, COLUMN + q, ends, row) * vector[TOTAL, PENDING + 1 + q]
        for i in range(tiles):
            left = less(tile(vector, column, wide, i), share, tile(vector, COLUMN + q, wide, i))
            put(vector, uint64(column * wide + i), left)
    s = variance + along(vector, column, ends, row)
    weight = 1.0 / s
    step = residual * weight
    square = residual * step
    vector[TOTAL, 0] += min(square, gate * gate) + math.log(s)
    if square > gate * gate:
        return False
    vector[TOTAL, 1] += 1.0
    for i in range(tiles):
        one = tile(vector, column, wide, i)
        put(vector, uint64(X * wide + i), plus(tile(vector, X, wide, i), step, one))
        put(vector, uint64((SCALED + pending) * wide + i), weight * one)
    vector[TOTAL, PENDING + 1 + pending] = weight
    vector[TOTAL, PENDING] = pending + 1.0
    return True


@part
def tile(rows: Floats, row: int, wide: int, i: int) -> Any:
    """LANES numbers of a row of `wide` times as many."""
    return take(rows, uint64(row * wide + i))


@part
def along(vector: Floats, column: int, ends: Any, row: Any) -> float:
    """h^T v of a row and a column."""
    (k, o), (a, b, c, h) = ends, row
    total: float = (
        a * vector[column, k] + b * vector[column, k + 1] + c * vector[column, k + 2] + h * vector[column, k + 3]
    )
    if o >= 0:
        total -= a * vector[column, o] + b * vector[column, o + 1] + c * vector[column, o + 2]
    return total


@part
def settle(poses: Poses, size: int) -> None:
    """Bring the pending rows into the covariance, ROWS rows of it at a time."""
    vector, stride = poses.vector, poses.vector.shape[1]
    pending = int(vector[TOTAL, PENDING])
    if pending == 0:
        return
    for q in range(pending, ROWS):
        for i in range(stride):
            vector[SCALED + q, i] = 0.0
    tiles, width = (size + LANES - 1) // LANES, stride // LANES
    for first in range(0, size, ROWS):
        if any_of(vector, first, size):
            for i in range(first, first + ROWS):
                for tile in range(tiles):
                    row = take(poses.cov, uint64(i * width + tile))
                    for q in range(ROWS):
                        row = less(row, vector[SCALED + q, i], take(vector, uint64((COLUMN + q) * width + tile)))
                    put(poses.cov, uint64(i * width + tile), row)
    vector[TOTAL, PENDING] = 0.0


@part
def any_of(vector: Floats, first: int, size: int) -> bool:
    """Whether a pending row changes one of ROWS rows of the covariance."""
    for i in range(first, min(first + ROWS, size)):
        for q in range(ROWS):
            if vector[SCALED + q, i] != 0.0:
                return True
    return False

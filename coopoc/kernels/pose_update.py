"""One number after the other into the state of poses and its covariance.

The state of a member is d = 4 or 6 numbers: position m, heading rad and, of six, the odometer's scale error and the
yaw rate's bias rad/s. A row is linear in the pose of one member, (a, b, c, h), and at most in the position of another,
(-a, -b, -c): every measurement here is one of the vector between the two and of the first one's heading.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ..arrays import Floats
from .compile import part
from .lanes import LANES, subtract

HEADING = 3
"""Place of the heading in a member's state."""
X, AT, KEPT, TOTAL, COLUMN, SCALED = 0, 1, 2, 3, 4, 7
"""Rows of `Poses.vector`: the state, the state at which rows are linear, the state before the relative measurements;
the sum of r^2 / s + log s, the number of rows that were used, and of those pending with the s of each; three columns
P h of pending rows, which are not yet in the covariance, and the same over s."""
PENDING = 2
"""Place in the row TOTAL. Three rows may be pending: one pass over the covariance then takes as long as for one."""


class Poses(NamedTuple):
    """State of the members of one unit.

    Attributes:
        vector: (10, stride), see `X`; the stride is a multiple of LANES.
        cov: (most d + 2, stride).
        kept: the same, before the relative measurements.
        vector_memory: the numbers of `vector` one after the other.
        cov_memory: the numbers of `cov`.
    """

    vector: Floats
    cov: Floats
    kept: Floats
    vector_memory: Floats
    cov_memory: Floats


def new_poses(size: int) -> Poses:
    """Room for `size` numbers."""
    stride = (size + LANES - 1) // LANES * LANES
    vector, cov = np.zeros(10 * stride + LANES), np.zeros((size + 2) * stride)  # three rows at a time reach beyond
    whole = cov.reshape((size + 2, stride))
    return Poses(vector[: 10 * stride].reshape((10, stride)), whole, np.zeros((size + 2, stride)), vector, cov)


@part
def update_row(poses: Poses, size: int, ends: Any, row: Any, measured: Any, gate: float) -> bool:
    """x += P h r / s, P -= P h h^T P / s with s = h^T P h + variance; nothing where r^2 > gate^2 s.

    The covariance follows with the third row, or with `settle`; a row sees those that are pending.

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
    if vector[TOTAL, PENDING] == 3.0:
        settle(poses, size)
    pending = int(vector[TOTAL, PENDING])
    column = COLUMN + pending
    if o < 0:
        for i in range(size):
            vector[column, i] = a * cov[k, i] + b * cov[k + 1, i] + c * cov[k + 2, i] + h * cov[k + 3, i]
    else:
        for i in range(size):
            x, y, z = cov[k, i] - cov[o, i], cov[k + 1, i] - cov[o + 1, i], cov[k + 2, i] - cov[o + 2, i]
            vector[column, i] = a * x + b * y + c * z + h * cov[k + 3, i]
    for q in range(pending):
        share = along(vector, COLUMN + q, ends, row) / vector[TOTAL, PENDING + 1 + q]
        for i in range(size):
            vector[column, i] -= share * vector[COLUMN + q, i]
    s = variance + along(vector, column, ends, row)
    square = residual * residual / s
    vector[TOTAL, 0] += min(square, gate * gate) + math.log(s)
    if square > gate * gate:
        return False
    vector[TOTAL, 1] += 1.0
    step = residual / s
    for i in range(size):
        vector[X, i] += step * vector[column, i]
    vector[TOTAL, PENDING + 1 + pending] = s
    vector[TOTAL, PENDING] = pending + 1.0
    return True


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
    """Bring the pending rows into the covariance, three rows of it at a time."""
    vector, stride = poses.vector, poses.vector.shape[1]
    pending = int(vector[TOTAL, PENDING])
    if pending == 0:
        return
    for q in range(3):
        weight = 1.0 / vector[TOTAL, PENDING + 1 + q] if q < pending else 0.0
        for i in range(size):
            vector[SCALED + q, i] = weight * vector[COLUMN + q, i]
    tiles = (size + LANES - 1) // LANES
    for i in range(0, size, 3):
        if any_of(vector, i, size):
            left, right = SCALED * stride + i, COLUMN * stride
            memory = poses.vector_memory
            subtract(poses.cov_memory, i * stride, memory, left, memory, right, stride, tiles)
    vector[TOTAL, PENDING] = 0.0


@part
def any_of(vector: Floats, first: int, size: int) -> bool:
    """Whether a pending row changes one of three rows of the covariance."""
    for i in range(first, min(first + 3, size)):
        if vector[SCALED, i] != 0.0 or vector[SCALED + 1, i] != 0.0 or vector[SCALED + 2, i] != 0.0:
            return True
    return False

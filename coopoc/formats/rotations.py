"""Orientations as files write them (an angle, a quaternion) and as rotation matrices."""

from __future__ import annotations

import numpy as np

from ..arrays import Floats

UNIT = 1e-2  # |norm - 1| of a quaternion that was merely rounded (to three decimals); more is not a rotation


def to_rotation(orientation: Floats) -> Floats:
    """Rotation matrices of angles or quaternions, R(theta) or R(q / |q|).

    Args:
        orientation: (..., 1) angle, rad, or (..., 4) quaternion qx qy qz qw. NaN gives NaN.

    Returns:
        (..., 2, 2) or (..., 3, 3).

    >>> to_rotation(np.array([0.0, 0, 0, 1])).tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    if orientation.shape[-1] == 1:
        c, s = np.cos(orientation[..., 0]), np.sin(orientation[..., 0])
        return np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
    x, y, z, w = np.moveaxis(orientation / np.linalg.norm(orientation, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def to_orientation(rotation: Floats) -> Floats:
    """The inverse of `to_rotation`: an angle in (-pi, pi], or the unit quaternion with qw >= 0.

    4 q q^T is linear in R; its column with the largest diagonal is the best conditioned multiple of q
    (Shepperd, J. Guidance and Control 1(3), 1978).

    Args:
        rotation: (..., 2, 2) or (..., 3, 3).

    Returns:
        (..., 1) rad or (..., 4) qx qy qz qw.

    >>> to_orientation(np.array([[0.0, -1], [1, 0]])).round(4)
    array([1.5708])
    """
    if rotation.shape[-1] == 2:
        return np.arctan2(rotation[..., 1, 0], rotation[..., 0, 0])[..., None]
    r = rotation
    a, b, c = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    outer = np.empty((*r.shape[:-2], 4, 4))
    for k, diagonal in enumerate((1 + a - b - c, 1 - a + b - c, 1 - a - b + c, 1 + a + b + c)):
        outer[..., k, k] = diagonal
    for i, j in ((0, 1), (0, 2), (1, 2)):
        outer[..., i, j] = outer[..., j, i] = r[..., i, j] + r[..., j, i]
    for k, (i, j) in enumerate(((2, 1), (0, 2), (1, 0))):
        outer[..., k, 3] = outer[..., 3, k] = r[..., i, j] - r[..., j, i]
    best = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(outer, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.asarray(np.where(q[..., 3:] < 0, -q, q))

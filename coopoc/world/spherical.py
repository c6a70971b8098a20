"""The relative measurement between two vehicles: range, azimuth, inclination, and back to a vector."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..arrays import Floats


def spherical(dx: Any, dy: Any, dz: Any, m: Any = np) -> tuple[Any, Any, Any]:
    """Range, azimuth and inclination of the vector (dx, dy, dz), for any namespace `m` with sqrt and atan2.

    d = |v|, az = atan2(dy, dx) anticlockwise from +x, inc = atan2(hypot(dx, dy), dz) from +z.

    Args:
        dx: metres, of any one shape.
        dy: metres, of any one shape.
        dz: metres, of any one shape.
        m: numpy, torch, casadi, or anything with `sqrt` and `atan2`.

    Returns:
        metres, radians, radians.

    >>> [round(float(v), 3) for v in spherical(0.0, 2.0, 0.0)]
    [2.0, 1.571, 1.571]
    """
    ground = dx * dx + dy * dy
    return m.sqrt(ground + dz * dz), m.atan2(dy, dx), m.atan2(m.sqrt(ground), dz)


def to_vector(relative: Floats) -> Floats:
    """Vectors d [sin inc cos az, sin inc sin az, cos inc] of measurements (..., 3), in metres.

    >>> to_vector(np.array([2.0, 0.0, np.pi / 2])).round(3) + 0.0
    array([2., 0., 0.])
    """
    d, az, inc = np.moveaxis(relative, -1, 0)
    return np.stack([d * np.sin(inc) * np.cos(az), d * np.sin(inc) * np.sin(az), d * np.cos(inc)], axis=-1)


def vector_cov(relative: Floats, std: Floats, min_range: float = 0.0) -> Floats:
    """Covariance J diag(std^2) J^T of `to_vector(relative)`, J its Jacobian: (..., 3, 3) m^2.

    The tangential part uses max(d, min_range): a noisy range near zero would make the angles seem exact.

    Args:
        relative: (..., 3) m, rad, rad.
        std: (3,) m, rad, rad.
        min_range: m.

    >>> np.diag(vector_cov(np.array([10.0, 0.0, np.pi / 2]), np.array([1.0, 0.1, 0.1]))).round(6)
    array([1., 1., 1.])
    """
    az, inc = relative[..., 1], relative[..., 2]
    d = np.maximum(relative[..., 0], min_range)
    sa, ca, si, ci = np.sin(az), np.cos(az), np.sin(inc), np.cos(inc)
    zero = np.zeros_like(d)
    columns = [
        [std[0] * si * ca, std[0] * si * sa, std[0] * ci],
        [-std[1] * d * si * sa, std[1] * d * si * ca, zero],
        [std[2] * d * ci * ca, std[2] * d * ci * sa, -std[2] * d * si],
    ]
    root = np.stack([np.stack(c, axis=-1) for c in columns], axis=-1)
    cov: Floats = root @ np.swapaxes(root, -1, -2)
    return cov


def wrap(angle: Any) -> Any:
    """The same angle in [-pi, pi).

    >>> round(float(wrap(3.5)), 4)
    -2.7832
    """
    return (angle + np.pi) % (2 * np.pi) - np.pi

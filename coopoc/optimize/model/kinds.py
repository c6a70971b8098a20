"""The kinds of measurement that we know: fixes, odometry, ranges and angles, of points and of poses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ...world import links as polar
from .measurements import Measurement, measurement

VECTOR = ("coordinate",) * 3
PLANE = (0, 1)


@measurement("position", arity=1, components=VECTOR, linear=True, plane=PLANE)  # type: ignore[arg-type]
def position(x: Any, y: Any, z: Any, m: Any = np) -> Sequence[Any]:
    """Where a node is, such as a GNSS fix: m."""
    return x, y, z


@measurement("displacement", arity=2, components=VECTOR, linear=True, plane=PLANE)  # type: ignore[arg-type]
def displacement(dx: Any, dy: Any, dz: Any, m: Any = np) -> Sequence[Any]:
    """The world vector from the first node to the second, such as odometry dt u: m."""
    return dx, dy, dz


@measurement("range", arity=2, components=("distance",), plane=(0,))
def range_(dx: Any, dy: Any, dz: Any, m: Any = np) -> Sequence[Any]:
    """Distance between two nodes: m."""
    return polar.spherical(dx, dy, dz, m)[:1]


@measurement("azimuth", arity=2, components=("angle",), plane=(0,))
def azimuth(dx: Any, dy: Any, dz: Any, m: Any = np) -> Sequence[Any]:
    """Angle of the second node as the first sees it, atan2(dy, dx) in the world frame: rad."""
    return polar.spherical(dx, dy, dz, m)[1:2]


@measurement("inclination", arity=2, components=("angle",))
def inclination(dx: Any, dy: Any, dz: Any, m: Any = np) -> Sequence[Any]:
    """Angle from +z of the second node as the first sees it: rad."""
    return polar.spherical(dx, dy, dz, m)[2:]


@measurement("spherical", arity=2, components=("distance", "angle", "angle"), plane=PLANE)
def spherical(dx: Any, dy: Any, dz: Any, m: Any = np) -> Sequence[Any]:
    """Range, azimuth and inclination (in the plane: range and azimuth) of the second node from the first: m, rad."""
    return polar.spherical(dx, dy, dz, m)


@measurement("speed", arity=2, components=("distance",), plane=(0,), constants=1)
def speed(dx: Any, dy: Any, dz: Any, dt: Any, m: Any = np) -> Sequence[Any]:
    """Mean speed between two positions of a vehicle that are dt apart (the constant, s): m/s."""
    return (polar.spherical(dx, dy, dz, m)[0] / dt,)


@measurement("relative_position", arity=2, components=VECTOR, frame="body", plane=PLANE)  # type: ignore[arg-type]
def relative_position(x: Any, y: Any, z: Any, m: Any = np) -> Sequence[Any]:
    """The second node in the body frame of the first, R_i^T (p_j - p_i): m."""
    return x, y, z


@measurement("bearing", arity=2, components=("angle",), frame="body", plane=(0,))
def bearing(x: Any, y: Any, z: Any, m: Any = np) -> Sequence[Any]:
    """Angle of the second node from the first's forward axis, anticlockwise about its up axis: rad."""
    return polar.spherical(x, y, z, m)[1:2]


@measurement("body_spherical", arity=2, components=("distance", "angle", "angle"), frame="body", plane=PLANE)
def body_spherical(x: Any, y: Any, z: Any, m: Any = np) -> Sequence[Any]:
    """Range, bearing and inclination (in the plane: range and bearing) in the body frame of the first: m, rad."""
    return polar.spherical(x, y, z, m)


def geodesic(x: Any, y: Any, z: Any, R: Any, measured: Any, m: Any = np) -> Sequence[Any]:
    """Rz^T (t - tz) and Log(Rz^T R), the error of a relative pose (t, R) against a measured (tz, Rz): m, rad."""
    *at, turned = measured
    gap = [x - at[0], y - at[1], z - at[2]]
    moved = [sum(turned[k][i] * gap[k] for k in range(3)) for i in range(3)]
    error = [[sum(turned[k][i] * R[k][j] for k in range(3)) for j in range(3)] for i in range(3)]
    half = [0.5 * (error[2][1] - error[1][2]), 0.5 * (error[0][2] - error[2][0]), 0.5 * (error[1][0] - error[0][1])]
    sine = half[0] * half[0] + half[1] * half[1] + half[2] * half[2]
    cosine = 0.5 * (error[0][0] + error[1][1] + error[2][2] - 1.0)
    if isinstance(R[2][2], float):  # in the plane one angle suffices
        return *moved, 0.0, 0.0, m.atan2(half[2], cosine)
    turning = sine > 1e-12
    root = m.sqrt(m.where(turning, sine, 1.0))
    small = m.where(cosine > 0.0, 1.0 + sine / 6.0, np.nan)  # half a turn has no direction
    ratio = m.where(turning, m.atan2(root, cosine) / root, small)
    return *moved, *(ratio * h for h in half)


def logarithm(x: Any, y: Any, z: Any, R: Any, measured: Any, m: Any = np) -> Sequence[Any]:
    """Log(Tz^-1 T), the twist that takes a measured pose Tz to the relative pose T: GTSAM's BetweenFactor, m and rad.

    Its rotation vector w is that of `geodesic`, its translation u - w x u / 2 + c w x (w x u) with
    c = (1 - (|w| / 2) cot(|w| / 2)) / |w|^2 and u = Rz^T (t - tz).

    References:
        Sola et al., A micro Lie theory, arXiv 1812.01537, equations 146 and 174.
    """
    *u, a, b, c = geodesic(x, y, z, R, measured, m)
    w = (a, b, c)
    once = _cross(w, u)
    twice = _cross(w, once)
    share = _half_cotangent(a * a + b * b + c * c, m)
    return *(u[k] - 0.5 * once[k] + share * twice[k] for k in range(3)), *w


def _cross(a: Sequence[Any], b: Sequence[Any]) -> list[Any]:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _half_cotangent(square: Any, m: Any) -> Any:
    """(1 - (w / 2) cot(w / 2)) / w^2 of w^2; near zero by its series, whose terms beyond are below rounding."""
    large = square > 1e-2
    w = m.sqrt(m.where(large, square, 1.0))
    exact = (1.0 - 0.5 * w * m.cos(0.5 * w) / m.sin(0.5 * w)) / (w * w)
    series = 1 / 12 + square * (1 / 720 + square * (1 / 30240 + square * (1 / 1209600 + square / 47900160)))
    return m.where(large, exact, series)


def chordal(x: Any, y: Any, z: Any, R: Any, measured: Any, m: Any = np) -> Sequence[Any]:
    """t - tz and the nine entries of R - Rz: PyFG's objective, quadratic in positions and rotation matrices: m, 1."""
    *at, turned = measured
    return x - at[0], y - at[1], z - at[2], *(R[i][j] - turned[i][j] for i in range(3) for j in range(3))


_TURN = (*VECTOR, "turn", "turn", "turn")
_CHORD = ("coordinate",) * 12
for _name, _arity in (("pose", 1), ("relative_pose", 2)):
    _options = {"arity": _arity, "frame": "relative", "compares_poses": True}
    measurement(_name, components=_TURN, plane=(0, 1, 5), **_options)(geodesic)  # type: ignore[arg-type]
    if _arity == 2:
        measurement(f"{_name}_log", components=_TURN, plane=(0, 1, 5), **_options)(logarithm)  # type: ignore[arg-type]
    measurement(f"{_name}_chordal", components=_CHORD, plane=(0, 1, 3, 4, 6, 7), **_options)(chordal)  # type: ignore[arg-type]


LEAST_RANGE = 1.0
"""m; a noisy range near zero would make the converted angles seem exact."""
LEAST_SINE = 0.05
"""Of the inclination: near the vertical the azimuth carries no information."""


def is_converted(measurement: Measurement) -> bool:
    """Whether a kind's measurements become vectors; of the others those that are linear stay, and angles are left out.

    >>> from coopoc.optimize.model.measurements import lookup
    >>> is_converted(lookup("spherical")), is_converted(lookup("range"))
    (True, False)
    """
    return measurement.name == "spherical"


def converted_rows(z: list[Any], m: Any) -> tuple[Any, list[list[Any]]]:
    """Range d and rows of diag(1, 1/(d sin inc), 1/d) [u e_az e_inc]^T in any namespace, from measured values.

    The converted residual is their product with the vector between the nodes, less (d, 0, 0): d u is the measured one.

    Args:
        z: range, azimuth and, in space, inclination.
        m: with sin, cos, fabs, fmax and where.

    >>> import numpy as np
    >>> converted_rows([2.0, 0.0], np)[1]
    [[np.float64(1.0), np.float64(0.0)], [np.float64(-0.0), np.float64(0.5)]]
    """
    d, sa, ca = m.fmax(z[0], LEAST_RANGE), m.sin(z[1]), m.cos(z[1])
    if len(z) == 2:
        return d, [[ca, sa], [-sa / d, ca / d]]
    si, ci = m.sin(z[2]), m.cos(z[2])
    across = d * m.where(si < 0, -1.0, 1.0) * m.fmax(m.fabs(si), LEAST_SINE)
    return d, [[si * ca, si * sa, ci], [-sa / across, ca / across, 0.0 * d], [ci * ca / d, ci * sa / d, -si / d]]

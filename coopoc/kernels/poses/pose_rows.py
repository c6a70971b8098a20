"""Rows of pose filters: fixes, compasses, ranges and angles, each linear in the state."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ...arrays import Floats
from ..compiling.compile import part
from .pose_update import AT, HEADING, Poses, X, update_row

NEAREST = 1e-3
"""m, least distance at which an angle is linearised."""


@part
def wrapped(angle: float) -> float:
    """The same angle in [-pi, pi)."""
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))


@part
def linear_residual(poses: Poses, ends: Any, row: Any, residual: float) -> float:
    """Residual at the state of a row that is linear at `AT`, where it is `residual`."""
    (k, o), (a, b, c, h), vector = ends, row, poses.vector
    residual -= h * (vector[X, k + 3] - vector[AT, k + 3])
    for axis, entry in ((0, a), (1, b), (2, c)):
        residual -= entry * (vector[X, k + axis] - vector[AT, k + axis])
        if o >= 0:
            residual += entry * (vector[X, o + axis] - vector[AT, o + axis])
    return residual


@part
def update_fix(poses: Poses, size: int, block: int, fix: Any, way: Any, gate: float) -> None:
    """A position that was measured some time ago, when it was the present one less the way driven since.

    Args:
        poses: the state.
        size: its numbers.
        block: first number of the member.
        fix: position m, and its variance m^2.
        way: m that the member has driven since, forward, left and up.
        gate: in standard deviations.
    """
    vector, (x, y, z, xx, yy, zz), (ahead, aside, up) = poses.vector, fix, way
    ends = (block, np.int64(-1))
    for i in range(block, block + 4):
        vector[AT, i] = vector[X, i]
    cos, sin = math.cos(vector[X, block + HEADING]), math.sin(vector[X, block + HEADING])
    east, north = cos * ahead - sin * aside, sin * ahead + cos * aside
    px, py, pz = vector[X, block], vector[X, block + 1], vector[X, block + 2]
    for axis in range(3):
        row, gap, variance = (0.0, 0.0, 1.0, 0.0), z + up - pz, zz
        if axis == 0:
            row, gap, variance = (1.0, 0.0, 0.0, north), x + east - px, xx
        elif axis == 1:
            row, gap, variance = (0.0, 1.0, 0.0, -east), y + north - py, yy
        residual = linear_residual(poses, ends, row, gap)
        update_row(poses, size, ends, row, (residual, variance), gate)


@part
def update_heading(poses: Poses, size: int, block: int, heading: float, variance: float, gate: float) -> None:
    """A compass heading rad."""
    residual = wrapped(heading - poses.vector[X, block + HEADING])
    update_row(poses, size, (block, np.int64(-1)), (0.0, 0.0, 0.0, 1.0), (residual, variance), gate)


@part
def relative_row(vector: Floats, component: int, ends: Any, place: Any, measured: float) -> Any:
    """Residual and row of a range (0), a bearing from the observer's heading (1) or an inclination (2) at `AT`.

    Args:
        vector: of the state.
        component: which of the three.
        ends: first numbers of the observer and of the other, -1 for a landmark.
        place: of the landmark, m.
        measured: m or rad.
    """
    (k, o), (px, py, pz) = ends, place
    if o >= 0:
        px, py, pz = vector[AT, o], vector[AT, o + 1], vector[AT, o + 2]
    x, y, z = px - vector[AT, k], py - vector[AT, k + 1], pz - vector[AT, k + 2]
    flat2 = max(x * x + y * y, NEAREST * NEAREST)
    flat, r2 = math.sqrt(flat2), flat2 + z * z
    if component == 0:
        r = math.sqrt(r2)
        return measured - r, -x / r, -y / r, -z / r, 0.0
    if component == 1:
        return wrapped(measured - math.atan2(y, x) + vector[AT, k + HEADING]), y / flat2, -x / flat2, 0.0, -1.0
    return wrapped(measured - math.atan2(flat, z)), -x * z / (flat * r2), -y * z / (flat * r2), flat / r2, 0.0


@part
def update_relative(poses: Poses, size: int, ends: Any, place: Any, measured: Any, noise: Any) -> int:
    """The components of one relative measurement, linear at `AT`.

    Args:
        poses: the state.
        size: its numbers.
        ends: first numbers of observer and other (-1: a landmark), and a bit for each component to leave out.
        place: of the landmark, m.
        measured: m, rad, rad, NaN where missing.
        noise: three variances, and the gate in standard deviations.

    Returns:
        The bits, and those of the components beyond the gate.
    """
    observer, other = ends[0], ends[1]
    left_out: int = ends[2]
    variances, gate = noise
    for component in range(3):
        if math.isnan(measured[component]) or left_out & (1 << component):
            continue
        residual, a, b, c, h = relative_row(poses.vector, component, (observer, other), place, measured[component])
        row = (a, b, c, h)
        residual = linear_residual(poses, (observer, other), row, residual)
        if not update_row(poses, size, (observer, other), row, (residual, variances[component]), gate):
            left_out |= 1 << component
    return left_out


@part
def retract(poses: Poses, size: int) -> None:
    """Take a linear step dx of a lone pose as one of the group: X' = Exp(xi) X with xi = (dp - dth J p, dth).

    p' = p + R(dth) p - p + V(dth) (dp - dth J p), and the covariance follows, dp' = dp + dth J (p' - p), since the
    error xi and not dx is what has one (Barrau, Bonnabel, IEEE TAC 62(4), 2017).
    """
    vector, cov = poses.vector, poses.cov
    turn, px, py = vector[X, HEADING] - vector[AT, HEADING], vector[AT, 0], vector[AT, 1]
    rx, ry = vector[X, 0] - px + turn * py, vector[X, 1] - py - turn * px
    sine = math.sin(turn) / turn if abs(turn) > 1e-6 else 1.0
    versine = (1.0 - math.cos(turn)) / turn if abs(turn) > 1e-6 else 0.5 * turn
    cos, sin = math.cos(turn), math.sin(turn)
    vector[X, 0] = cos * px - sin * py + sine * rx - versine * ry
    vector[X, 1] = sin * px + cos * py + versine * rx + sine * ry
    dx, dy = vector[X, 0] - px, vector[X, 1] - py
    for j in range(size):
        cov[0, j] -= dy * cov[HEADING, j]
        cov[1, j] += dx * cov[HEADING, j]
    for i in range(size):
        cov[i, 0] -= dy * cov[i, HEADING]
        cov[i, 1] += dx * cov[i, HEADING]

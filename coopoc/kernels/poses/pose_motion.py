"""Motion of poses: odometry of speed and yaw rate moves a member's state and its covariance."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from ...arrays import Floats
from ..compiling.compile import part
from .pose_update import HEADING, Poses, X


class PoseNoise(NamedTuple):
    """What a pose filter assumes.

    Attributes:
        fix: three variances, m^2.
        heading: rad^2, of a compass.
        relative: three variances, m^2, rad^2, rad^2.
        velocity: noise of the odometer: ratio, least std m/s, 1 for a ratio of the speed on every axis.
        yaw_rate: rad^2/s^2.
        lasting: stationary variances of scale error and of yaw-rate bias, rad^2/s^2.
        keep: share of both that is left after a step.
        flat: m^2, prior of a member that joins.
        acceleration: m/s^2, change of a velocity since it was sent.
        gate: standard deviations of its innovation beyond which a measurement is left out.
    """

    fix: tuple[float, float, float]
    heading: float
    relative: tuple[float, float, float]
    velocity: tuple[float, float, float]
    yaw_rate: float
    lasting: tuple[float, float]
    keep: float
    flat: float
    acceleration: float
    gate: float


@part
def velocity_variances(u: Any, noise: PoseNoise) -> Any:
    """Variance (m/s)^2 of each component of a measured velocity, forward, left and up."""
    ratio, floor, of_speed = noise.velocity
    a, b, c = abs(u[0]), abs(u[1]), abs(u[2])
    if of_speed > 0.0:
        a = b = c = math.sqrt(a * a + b * b + c * c)
    a, b, c = max(ratio * a, floor), max(ratio * b, floor), max(ratio * c, floor)
    return a * a, b * b, c * c


@part
def predict(poses: Poses, at: Any, odometry: Any, dt: float, noise: PoseNoise, more: Any) -> None:
    """Move one member by its odometry.

    th' = th + dt (w - b), p' = p + dt R(th + dt (w - b) / 2) u / (1 + s), and P' = F P F^T + G Q G^T with the
    derivatives of these; s and b decay (Gauss-Markov).

    Args:
        poses: the state.
        at: first number of the member, numbers of a member, numbers of the state.
        odometry: forward, left and up m/s, and yaw rate rad/s.
        dt: s.
        noise: that is assumed.
        more: factor of the odometry's variances, and (m/s)^2 to be added to the velocity's.
    """
    vector, cov = poses.vector, poses.cov
    (block, d, size), (forward, left, up, rate), (factor, added) = at, odometry, more
    qf, ql, qu = velocity_variances((forward, left, up), noise)
    qf, ql, qu, qw = factor * qf + added, factor * ql + added, factor * qu + added, factor * noise.yaw_rate
    scale, bias = 1.0, 0.0
    if d > 4:
        scale, bias = 1.0 / (1.0 + vector[X, block + 4]), vector[X, block + 5]
    heading = vector[X, block + HEADING] + 0.5 * dt * (rate - bias)
    cos, sin, up = dt * scale * math.cos(heading), dt * scale * math.sin(heading), dt * scale * up
    east, north = cos * forward - sin * left, sin * forward + cos * left
    vector[X, block] += east
    vector[X, block + 1] += north
    vector[X, block + 2] += up
    vector[X, block + HEADING] += dt * (rate - bias)
    if d > 4:
        vector[X, block + 4] *= noise.keep
        vector[X, block + 5] *= noise.keep
    effects = (east, north, up, scale, dt, noise.keep)
    moved_rows(cov, (block, d), effects, size)
    moved_rows(cov.T, (block, d), effects, size)
    cov[block, block] += cos * cos * qf + sin * sin * ql
    cov[block + 1, block + 1] += sin * sin * qf + cos * cos * ql
    cov[block, block + 1] += cos * sin * (qf - ql)
    cov[block + 1, block] += cos * sin * (qf - ql)
    cov[block + 2, block + 2] += (dt * scale) * (dt * scale) * qu
    effect = (-0.5 * dt * north, 0.5 * dt * east, 0.0, dt)
    for i in range(4):
        for j in range(4):
            cov[block + i, block + j] += effect[i] * effect[j] * qw
    for i in range(4, d):
        cov[block + i, block + i] += (1.0 - noise.keep * noise.keep) * noise.lasting[i - 4]


@part
def moved_rows(cov: Floats, member: tuple[int, int], effects: Any, columns: int) -> None:
    """F P in the rows of a member; the transposed of it, moved once more, is F P F^T.

    Args:
        cov: P.
        member: its first number, and how many it has.
        effects: displacement east, north and up m, 1 / (1 + s), dt s, and share of s and b that is left.
        columns: how many.
    """
    (block, d), (east, north, up, scale, dt, left) = member, effects
    for j in range(columns):
        cov[block, j] -= north * cov[block + HEADING, j]
        cov[block + 1, j] += east * cov[block + HEADING, j]
    if d > 4:
        for j in range(columns):
            ds, db = -scale * cov[block + 4, j], -dt * cov[block + 5, j]
            cov[block, j] += east * ds - 0.5 * north * db
            cov[block + 1, j] += north * ds + 0.5 * east * db
            cov[block + 2, j] += up * ds
            cov[block + HEADING, j] += db
            cov[block + 4, j] *= left
            cov[block + 5, j] *= left

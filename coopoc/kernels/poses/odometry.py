"""Prediction of poses: odometry of speed and yaw rate moves a member's state and its covariance."""

import math

import numpy as np

from ...arrays import Floats
from ..compiling.compile import part
from ..gate import INITIAL_LOCKOUT
from ..motion import keep_pace, process_variance
from ..odometry_fault import PACES, correct, new_state
from .scalar_update import HEADING, OFFSET, SLOW, PoseNoise, Poses, Three

UNKNOWN_HEADING_RAD2 = math.pi**2 / 3.0
"""rad^2, variance of a heading of which nothing is known: uniform over a turn."""


def new_faults(members: int, noise: PoseNoise, dt: float) -> Floats:
    """(members + 1, paces, SIZE) of `kernels.odometry_fault`, the last of which stays new; no paces where the gate is
    open: odometry is believed. Beside `Poses`, which every row that is used hands on."""
    fresh = new_state(noise.odometer._replace(interval=dt))[: len(PACES) if math.isfinite(noise.gate) else 0]
    return np.tile(fresh, (members + 1, 1, 1))


@part
def predict(
    poses: Poses, fault: Floats, member: int, d: int, velocity: Floats, rate: float, dt: float, noise: PoseNoise
) -> None:
    """Move one member by its odometry.

    th' = th + dt (w - b), p' = p + dt R(th + dt (w - b) / 2) (u - e) / (1 + s), and P' = F P F^T + G Q G^T with the
    derivatives of these; s, b and e decay (Gauss-Markov). Where fixes show that the odometry fails, they correct it.

    Args:
        poses: the state.
        fault: of `kernels.odometry_fault`.
        member: its first number.
        d: numbers of a member.
        velocity: u, forward, left and up m/s.
        rate: w, rad/s.
        dt: s.
        noise: that is assumed.
    """
    x, cov, forward, left, up = poses.x, poses.cov, velocity[0], velocity[1], velocity[2]
    square, q = poses.pace[0, member : member + 3], poses.pace[1, member : member + 3]
    process_variance(noise.odometer, square, velocity, 1.0, q)
    keep_pace(square, velocity, dt)
    scale, bias = 1.0, 0.0
    if d > 4:
        scale, bias = 1.0 / (1.0 + x[member + 4]), x[member + 5]
    if d > SLOW:
        e = member + SLOW
        forward, left, up = forward - x[e], left - x[e + 1], up - x[e + 2]
    heading = x[member + HEADING] + 0.5 * dt * (rate - bias)
    cos, sin, up = dt * scale * math.cos(heading), dt * scale * math.sin(heading), dt * scale * up
    east, north = cos * forward - sin * left, sin * forward + cos * left
    world = poses.pace[2, member : member + 3]
    world[0], world[1] = east / dt, north / dt
    more = correct(fault, world, dt)
    x[member] += dt * world[0]
    x[member + 1] += dt * world[1]
    x[member + 2] += up
    x[member + HEADING] += dt * (rate - bias)
    for i in range(4, d):
        x[member + i] *= noise.keep if i != OFFSET else 1.0
    half, slow = 0.5 * dt, dt * scale
    by = (
        (-north, east, 0.0),
        (-scale * east, -scale * north, -scale * up),
        (half * north, -half * east, 0.0),
        (0.0, 0.0, 0.0),
        (-cos, -sin, 0.0),
        (sin, -cos, 0.0),
        (0.0, 0.0, -slow),
    )
    move_rows(cov, member, d, by, dt, noise.keep)
    move_rows(cov.T, member, d, by, dt, noise.keep)
    symmetrise(cov, member, d)
    cov[member, member] += cos * cos * q[0] + sin * sin * q[1] + more
    cov[member + 1, member + 1] += sin * sin * q[0] + cos * cos * q[1] + more
    cov[member, member + 1] += cos * sin * (q[0] - q[1])
    cov[member + 1, member] += cos * sin * (q[0] - q[1])
    cov[member + 2, member + 2] += slow * slow * q[2]
    effect = (*by[2], -dt)
    for i in range(4):
        for j in range(4):
            cov[member + i, member + j] += effect[i] * effect[j] * noise.yaw_rate
    for i in range(4, d):
        if i != OFFSET:
            cov[member + i, member + i] += (1.0 - noise.keep * noise.keep) * noise.lasting[i - 4]


@part
def move_rows(cov: Floats, member: int, d: int, by: tuple[Three, ...], dt: float, keep: float) -> None:
    """F P in the rows of a member; the transposed of it, moved once more, is F P F^T.

    Args:
        cov: P.
        member: its first number.
        d: numbers of a member.
        by: derivatives of the motion by the numbers behind the position.
        dt: s.
        keep: share of s, b and e that is left.
    """
    for i in range(HEADING, d):
        for c in range(3):
            f = by[i - HEADING][c]
            for j in range(len(cov)):
                cov[member + c, j] += f * cov[member + i, j]
    for i in range(4, d):
        for j in range(len(cov)):
            if i == 5:
                cov[member + HEADING, j] -= dt * cov[member + i, j]
            if i != OFFSET:
                cov[member + i, j] *= keep


@part
def symmetrise(cov: Floats, member: int, d: int) -> None:
    """The mean of P and P^T in the rows and columns of a member: updates leave the difference, which rounding makes, as
    it is, however small they make P, and fusion magnifies it."""
    for i in range(member, member + d):
        for j in range(len(cov)):
            cov[i, j] = cov[j, i] = 0.5 * (cov[i, j] + cov[j, i])


@part
def join(poses: Poses, member: int, d: int, own: Floats, noise: PoseNoise) -> None:
    """Begin a member where its fix and compass place it, and know nothing of it yet."""
    poses.hits[member] = poses.hits[member + 1] = INITIAL_LOCKOUT
    for i in range(member, member + d):
        for j in range(len(poses.x)):
            poses.cov[i, j] = poses.cov[j, i] = 0.0
        poses.x[i] = 0.0
    for i in range(3):
        poses.pace[0, member + i] = own[4 + i] * own[4 + i]
    for i in range(4):
        poses.x[member + i] = 0.0 if math.isnan(own[i]) else own[i]
        poses.cov[member + i, member + i] = noise.flat if i < HEADING else UNKNOWN_HEADING_RAD2
    for i in range(4, d):
        poses.cov[member + i, member + i] = noise.lasting[i - 4]

"""Rows of a star's measurements at one step of a window, for a dense nonlinear least-squares problem of one run.

Relative measurements are rows (h(x_j - x_0) - z) / std in range, azimuth and inclination, or with unit matrices the
vector itself; a component that is NaN is no row.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from coopoc.arrays import Floats
from coopoc.methods.noise_model import NoiseModel
from coopoc.world.inbox import Inbox
from coopoc.world.recording import Recording

Row = tuple[dict[Any, Floats], Floats, Any]
"""Coefficient (3, 3) of each point, right-hand side (3,), and the group of the row."""
ACCELERATION_STD, UNKNOWN = 1.0, 1e6
"""m/s^2, change of a velocity since it was sent; m^2, variance of an unknown motion."""


def message(
    recording: Recording, noise_model: NoiseModel, process: Floats, run: int, vehicle: int, t: int, sent: int
) -> tuple[Floats, ...]:
    """Fix brought forward from step `sent`, its variance, motion of one step, and its variance without repetition."""
    dt, age = recording.dt, t - sent
    u = recording.velocity[run, sent, vehicle]
    step_variance = process[sent, vehicle] + (dt**2 * age * ACCELERATION_STD) ** 2
    s, moved, grown = sent, np.zeros(3), np.zeros(3)
    while s > 0 and np.isnan(recording.gnss[run, s, vehicle]).any():  # dead reckoning of the sender since its last fix
        moved, grown, s = moved + dt * recording.velocity[run, s, vehicle], grown + process[s, vehicle], s - 1
    fix = recording.gnss[run, s, vehicle] + moved + age * dt * u
    return fix, noise_model.gnss_variance + grown + age**2 * step_variance, dt * u, step_variance


def relative_rows(
    recording: Recording, box: Inbox, noise_model: NoiseModel, run: int, ego: int, x: Any, t: int
) -> list[Row]:
    """Relative measurements of a step, linear at the points x: J d = z - h, in terms of the points themselves."""
    rows: list[Row] = []
    for k in range(box.start[t], box.start[t + 1]):
        z, j = recording.relative[run, box.link[k]], int(recording.links.neighbour[box.link[k]])
        v = x[j, t] - x[ego, t]
        if noise_model.sensors is None:
            if np.isfinite(z).all():
                vector = z[0] * np.array([np.sin(z[2]) * np.cos(z[1]), np.sin(z[2]) * np.sin(z[1]), np.cos(z[2])])
                rows.append(({(j, t): np.eye(3), (ego, t): -np.eye(3)}, vector, "relative"))
            continue
        d, flat = np.linalg.norm(v), np.hypot(v[0], v[1])
        h = np.array([d, np.arctan2(v[1], v[0]), np.arctan2(flat, v[2])])
        jacobian = np.array(
            [
                v / d,
                [-v[1] / flat**2, v[0] / flat**2, 0.0],
                [v[0] * v[2] / (flat * d**2), v[1] * v[2] / (flat * d**2), -flat / d**2],
            ]
        )
        off = z - h
        off[1:] = (off[1:] + np.pi) % (2 * np.pi) - np.pi
        wide = 1.0 if np.isnan(z[0]) else max(noise_model.sensors.min_range / z[0], 1.0)
        std = np.minimum(noise_model.sensors.relative_std * [1.0, wide, wide], [np.inf, np.pi, np.pi])
        root = jacobian / std[:, None]
        root[np.isnan(z)], off[np.isnan(z)] = 0.0, 0.0
        rows.append(({(j, t): root, (ego, t): -root}, root @ v + off / std, "relative"))
    return rows


def solve_rows(rows: Sequence[Row], x: Any, ridge: float = 1e-12) -> tuple[Any, Floats]:
    """Points of least squares, and the covariance of all; a tiny ridge holds what no row touches at its place."""
    place = {key: 3 * i for i, key in enumerate(x)}
    a, b = np.zeros((3 * len(rows), 3 * len(x))), np.zeros(3 * len(rows))
    for i, (terms, right, _) in enumerate(rows):
        b[3 * i : 3 * i + 3] = right - sum(c @ x[key] for key, c in terms.items())
        for key, c in terms.items():
            a[3 * i : 3 * i + 3, place[key] : place[key] + 3] += c
    information = a.T @ a + ridge * np.eye(3 * len(x))
    cov = np.linalg.inv(information)
    move = (cov @ (a.T @ b)).reshape(-1, 3)
    return {key: x[key] + move[i] for i, key in enumerate(x)}, cov

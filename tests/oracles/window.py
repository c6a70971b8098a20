"""The window of a star as one dense nonlinear least-squares problem of one run, written out factor by factor.

Rows r and Jacobian J of the whitened factors: fixes (x - z) / std, motions (x_t - x_{t-1} - dt u) / std, relative
measurements (h(x_j - x_0) - z) / std in range, azimuth and inclination, or with unit matrices the vector itself. A
message counts at the first step at which it is held in the window; a component that is NaN is no row.
"""

from __future__ import annotations

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
    recording: Recording, noise_model: NoiseModel, run: int, vehicle: int, t: int, sent: int
) -> tuple[Floats, ...]:
    """Fix brought forward from step `sent`, its variance, motion of one step, and its variance without repetition."""
    dt, age = recording.dt, t - sent
    u = recording.velocity[run, sent, vehicle]
    process = np.broadcast_to(noise_model.process_variance(recording), recording.velocity.shape)
    step_variance = process[run, sent, vehicle] + (dt**2 * age * ACCELERATION_STD) ** 2
    s, moved, grown = sent, np.zeros(3), np.zeros(3)
    while s > 0 and np.isnan(recording.gnss[run, s, vehicle]).any():  # dead reckoning of the sender since its last fix
        moved, grown, s = moved + dt * recording.velocity[run, s, vehicle], grown + process[run, s, vehicle], s - 1
    fix = recording.gnss[run, s, vehicle] + moved + age * dt * u
    return fix, noise_model.gnss_variance + grown + age**2 * step_variance, dt * u, step_variance


def linear_rows(
    recording: Recording, box: Inbox, noise_model: NoiseModel, run: int, ego: int, span: Sequence[int]
) -> list[Row]:
    """Fixes and motions as rows A x = b, whitened; keys of the points are (vehicle, step)."""
    rows: list[Row] = []
    held: dict[int, tuple[int, int, int]] = {}  # vehicle -> last step in the star, message, uses
    for t in range(span[-1] + 1):
        links = range(box.start[t], box.start[t + 1])
        star = [(ego, t, True)] + [
            (int(recording.links.neighbour[box.link[k]]), int(box.newest[run, k]), bool(box.fresh[run, k]))
            for k in links
        ]
        for vehicle, sent, fresh in star:
            last, before, uses = held.get(vehicle, (-2, -2, 0))
            uses = uses + 1 if last == t - 1 and before == sent else 1
            held[vehicle] = (t, sent, uses)
            if t < span[0]:
                continue
            fix, variance, moved, step_variance = message(
                recording, noise_model, run, vehicle, t, max(sent, 0) if sent >= 0 else t
            )
            had = np.isfinite(recording.gnss[run, sent, vehicle]).all()
            if sent >= 0 and ((fresh and had) or last < span[0]) and np.isfinite(fix).all():
                rows.append(({(vehicle, t): np.diag(variance**-0.5)}, fix * variance**-0.5, vehicle))
            if last == t - 1 >= span[0]:
                moved, step_variance = (
                    (moved, (2 * uses - 1) * step_variance) if sent >= 0 else (np.zeros(3), np.full(3, UNKNOWN))
                )
                weight = np.diag(step_variance**-0.5)
                rows.append(({(vehicle, t): weight, (vehicle, t - 1): -weight}, moved * step_variance**-0.5, "motion"))
    return rows


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


def window(
    recording: Recording, box: Inbox, noise_model: NoiseModel, run: int, ego: int, span: Sequence[int], x: Any
) -> Any:
    """Minimum and covariance of the window from the points x, by dense Gauss-Newton."""
    rows = linear_rows(recording, box, noise_model, run, ego, span)
    return descend(
        rows, lambda at: [r for t in span for r in relative_rows(recording, box, noise_model, run, ego, at, t)], x
    )


def descend(rows: Sequence[Row], relative: Any, x: Any) -> Any:
    """Gauss-Newton until the last step is below a nanometre."""
    for _ in range(100):
        new, cov = solve_rows([*rows, *relative(x)], x)
        moved = max(np.abs(new[key] - x[key]).max() for key in x)
        x = new
        if moved < 1e-9:
            break
    return x, cov


def points(recording: Recording, box: Inbox, ego: int, span: Sequence[int], position: Floats) -> Any:
    """Start: every point of the window at a given position (T, N, 3)."""
    newest = {}
    for t in span:
        for vehicle in [ego, *recording.links.neighbour[box.link[box.start[t] : box.start[t + 1]]]]:
            newest[int(vehicle), t] = position[t, vehicle].copy()
    return newest

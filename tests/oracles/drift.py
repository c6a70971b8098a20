"""The filter of a star whose receivers drift, in covariance form with dense matrices, one run.

State (x_0, b_0, x_1, b_1, ..., c): positions, each receiver's error, the common one. z_j = x_j + b_j + c + white noise;
an error is Gauss-Markov, e_t = keep e_{t-1} + w, var e = `own` or `common` m^2 in steady state.
"""

from __future__ import annotations

import numpy as np

from coopoc import NoiseModel
from coopoc.arrays import Floats
from coopoc.kernels.stars.messages import FORGOTTEN
from oracles.joint import converted, first_place, placed, whitened
from oracles.messages import Member


def follow(
    stars: list[list[Member]], noise_model: NoiseModel, white: Floats, errors: tuple[float, float, float]
) -> tuple[Floats, Floats, list[Floats]]:
    """x (T, 3), covariance (T, 3, 3) and the neighbours (k, 3) at each step.

    Args:
        white: (3,) m^2, what a fix's white variance is more than the noise model says. errors: own, common, keep.
    """
    x, p, estimates = np.zeros(3), np.diag(np.full(3, errors[1])), []
    for t, star in enumerate(stars):
        x, p = predict(x, p, star, errors, t == 0)
        x, p = update(x, p, star, noise_model, white)
        estimates.append((x, p[:3, :3]))
    others = [x[:-3].reshape(-1, 6)[1:, :3] for x, _ in estimates]
    return np.array([x[:3] for x, _ in estimates]), np.array([p for _, p in estimates]), others


def predict(
    x: Floats, p: Floats, star: list[Member], errors: tuple[float, float, float], first: bool
) -> tuple[Floats, Floats]:
    """x' = F x + moved, P' = F P F^T + Q, with the rows of members that left dropped and those that join added."""
    own, common, keep = errors
    n, size = len(star), len(x)
    f, move = np.zeros((6 * n + 3, size)), np.zeros(6 * n + 3)
    q = np.zeros(6 * n + 3)
    for k, member in enumerate(star):
        at, drift = slice(6 * k, 6 * k + 3), slice(6 * k + 3, 6 * k + 6)
        if member.before is None:
            q[at], q[drift] = FORGOTTEN, own
            continue
        b = 6 * member.before
        f[at, b : b + 3], f[drift, b + 3 : b + 6] = np.eye(3), keep * np.eye(3)
        move[at], q[at], q[drift] = member.moved, member.process, own * (1 - keep**2)
    f[-3:, -3:], q[-3:] = (1.0 if first else keep) * np.eye(3), 0.0 if first else common * (1 - keep**2)
    new = f @ x + move
    for k, member in enumerate(star):
        if member.before is None:
            new[6 * k : 6 * k + 3] = member.position if k == 0 else first_place(member, new[:3])
    return new, f @ p @ f.T + np.diag(q)


def update(x: Floats, p: Floats, star: list[Member], noise_model: NoiseModel, white: Floats) -> tuple[Floats, Floats]:
    """P^-1 += H^T R^-1 H with fixes and converted vectors, then with range and angles linear at that solution."""
    at, cov = x, p
    for model in (converted, whitened):
        information, eta = np.linalg.inv(p), np.zeros(len(x))
        for k, member in enumerate(star):
            if member.new:
                h = np.zeros((3, len(x)))
                h[:, 6 * k : 6 * k + 3] = h[:, 6 * k + 3 : 6 * k + 6] = h[:, -3:] = np.eye(3)
                weight = np.diag(1 / (member.variance + white))
                information += h.T @ weight @ h
                eta += h.T @ weight @ (member.position - h @ x)
            if k and placed(member, information[6 * k, 6 * k]):
                b = np.zeros((3, len(x)))
                b[:, 6 * k : 6 * k + 3], b[:, :3] = np.eye(3), -np.eye(3)
                if model is converted:
                    h, weight, z = converted(member.relative, b @ x, noise_model)
                else:
                    h, z = whitened(member.relative, b @ at, noise_model)
                    weight, z = np.eye(len(z)), z + h @ b @ (at - x)
                information += b.T @ h.T @ weight @ h @ b
                eta += b.T @ h.T @ weight @ z
        cov = np.linalg.inv(information)
        at = x + cov @ eta
    return at, cov

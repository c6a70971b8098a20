"""The joint filter in covariance form with dense matrices, one run: state (x_0, x_1, ..., x_k), the ego first.

Predict x_j += moved_j, P += Q. Update in information form with H and R as they stand; then, for exact measurements, one
Gauss-Newton step of the same cost at the solution of the linear update, with range and angles themselves.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy import array, diag, isfinite, zeros
from numpy.linalg import inv, solve

from coopoc import NoiseModel
from coopoc.arrays import Floats
from coopoc.kernels.stars.messages import FORGOTTEN
from coopoc.world.links import spherical, to_vector, wrap
from oracles.messages import Member, directions, slopes


def follow(stars: list[list[Member]], updated: Callable[..., Any]) -> tuple[Floats, Floats, list[Floats]]:
    """x (T, 3), covariance (T, 3, 3) and the neighbours (k, 3) at each step."""
    x, p, estimates = zeros((0, 3)), zeros((0, 0)), []
    for star in stars:
        x, p = updated(*predict(x, p, star), star)
        estimates.append((x, p[:3, :3]))
    xs, covariances = zip(*estimates, strict=True)
    return array([x[0] for x in xs]), array(covariances), [x[1:] for x in xs]


def predict(x: Floats, p: Floats, star: list[Member]) -> tuple[Floats, Floats]:
    """Members that stay move; a member that joins is where the ego measures it, with a flat prior."""
    n, m = len(star), len(x)
    new = zeros((n, 3))
    q = np.concatenate([np.full(3, FORGOTTEN) if member.before is None else member.process for member in star])
    pick = zeros((3 * n, 3 * m))
    for k, member in enumerate(star):
        if member.before is not None:
            pick[3 * k : 3 * k + 3, 3 * member.before : 3 * member.before + 3] = np.eye(3)
            new[k] = x[member.before] + member.moved
        else:
            new[k] = member.position if k == 0 else first_place(member, new[0])
    return new, pick @ p @ pick.T + diag(q)


def first_place(member: Member, ego: Floats) -> Floats:
    """As measured; if a component is missing, as broadcast; without a fix somewhere near."""
    if isfinite(member.relative).all():
        return ego + to_vector(member.relative)
    if member.new:
        return array(member.position)
    return ego + array([1.0, 1.0, 0.1]) * (1.0 + (0.0 if np.isnan(member.relative[0]) else member.relative[0]))


def placed(member: Member, information: Floats) -> bool:
    """Whether an incomplete measurement has a known geometry: 1e-4 /m^2 and more along x."""
    return bool(isfinite(member.relative).all() or information > 1e-4)


def update(x: Floats, p: Floats, star: list[Member], noise_model: NoiseModel, exact: bool) -> tuple[Floats, Floats]:
    """Fixes and converted vectors at the predicted geometry; then one exact step."""
    n = len(star)
    information, eta = inv(p), zeros(3 * n)
    for k, member in enumerate(star):
        if member.new:
            at = slice(3 * k, 3 * k + 3)
            information[at, at] += diag(1 / member.variance)
            eta[at] += (member.position - x[k]) / member.variance
    linear, linear_eta = information.copy(), eta.copy()
    used = [k for k in range(1, n) if placed(star[k], information[3 * k, 3 * k])]
    for k in used:
        h, r, z = converted(star[k].relative, x[k] - x[0], noise_model)
        add(linear, linear_eta, k, h.T @ r @ h, h.T @ r @ z)
    move = solve(linear, linear_eta)
    if not exact:
        return x + move.reshape(-1, 3), inv(linear)
    at = x + move.reshape(-1, 3)
    for k in used:
        jacobian, residual = whitened(star[k].relative, at[k] - at[0], noise_model)
        ahead = move[3 * k : 3 * k + 3] - move[:3]
        add(information, eta, k, jacobian.T @ jacobian, jacobian.T @ (residual + jacobian @ ahead))
    p = inv(information)
    return x + (p @ eta).reshape(-1, 3), p


def add(information: Floats, eta: Floats, k: int, weight: Floats, push: Floats) -> None:
    """Information about x_k - x_0."""
    b = zeros((3, len(eta)))
    b[:, 3 * k : 3 * k + 3], b[:, :3] = np.eye(3), -np.eye(3)
    information += b.T @ weight @ b
    eta += b.T @ push


def converted(relative: Floats, gap: Floats, noise_model: NoiseModel) -> tuple[Floats, Floats, Floats]:
    """Unit directions of range, azimuth and inclination (rows) at `gap`, their information, and the converted vector
    less `gap` along them; a missing component has no row."""
    there = isfinite(relative)
    expected = array(spherical(*gap))
    measured = np.where(there, relative, expected)
    rows = directions(*expected[1:])
    cov = rows @ np.atleast_2d(noise_model.relative_cov(expected)) @ rows.T
    return rows[there], diag(1 / diag(cov)[there]), rows[there] @ (to_vector(measured) - gap)


def whitened(relative: Floats, gap: Floats, noise_model: NoiseModel) -> tuple[Floats, Floats]:
    """Jacobian and residual of what was measured, in standard deviations."""
    assert noise_model.sensors is not None
    residual = relative - array(spherical(*gap))
    residual[1:] = wrap(residual[1:])
    there, std = isfinite(relative), noise_model.sensors.relative_std
    return (slopes(gap, noise_model.sensors.min_range) / std[:, None])[there], (residual / std)[there]

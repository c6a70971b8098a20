"""The paper's scenario 2 in one dense simulation that shares no code with the toolkit: NumPy and the fleet's arrays.

Each run draws fixes, velocities and relative measurements, and follows one ego by a Kalman filter (K = 0), by LKF-SA
with unit covariances, and by the joint filter of its star with the acting noise. arXiv 2411.05847, IV.
"""

from typing import Any

import numpy as np
from numpy import eye, inf, pi, zeros
from numpy.linalg import inv, solve

Array = Any
FIX, RATIO, RANGE, ANGLE, FLOOR, DT = 3.5, 0.15, 1.0, np.deg2rad(4.0), 0.05, 0.1
FLAT = 1e8


def polar(v: Array) -> Array:
    """Range, azimuth and inclination from +z of vectors (..., 3)."""
    d = np.sqrt((v**2).sum(-1))
    return np.stack([d, np.arctan2(v[..., 1], v[..., 0]), np.arccos(v[..., 2] / d)], -1)


def cartesian(m: Array) -> Array:
    """The vector of a range, an azimuth and an inclination."""
    d, a, i = m
    return d * np.array([np.sin(i) * np.cos(a), np.sin(i) * np.sin(a), np.cos(i)])


def nearest(position: Array, ego: int, most: int) -> list[int]:
    """Columns of the vehicles within 30 m, and further than 2 m, nearest first."""
    gap = np.sqrt(((position - position[ego]) ** 2).sum(-1))
    gap[ego] = inf
    return [j for j in np.argsort(gap) if gap[j] <= 30.0][:most]


def step(
    x: Array, p: Array, star: list[int], before: list[int], moves: Array, q: Array
) -> tuple[Array, Array, list[int]]:
    """Prediction of the members of a star from the last one's estimate; who joins has a flat prior."""
    n = len(star)
    mean, cov = zeros((n, 3)), FLAT * eye(3 * n)
    rows = [(k, before.index(j)) for k, j in enumerate(star) if j in before]
    for k, a in rows:
        mean[k] = x[a] + moves[star[k]]
        for m, b in rows:
            cov[3 * k : 3 * k + 3, 3 * m : 3 * m + 3] = p[3 * a : 3 * a + 3, 3 * b : 3 * b + 3]
        cov[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += np.diag(q[star[k]])
    return mean, cov, [k for k in range(n) if k not in [r[0] for r in rows]]


def joint(x: Array, p: Array, fixes: Array, relative: list[Array], new: list[int]) -> tuple[Array, Array]:
    """argmin of prior, fixes and exact range, azimuth and inclination by Gauss-Newton, and its covariance."""
    for k in new:
        x[k] = fixes[k] if k == 0 or relative[k] is None else x[0] + cartesian(relative[k])
    prior, at = x.ravel().copy(), x.ravel().copy()
    weight = inv(p)
    for _ in range(4):
        h, r = weight + eye(len(at)) / FIX**2, weight @ (prior - at) + (fixes.ravel() - at) / FIX**2
        for k, m in enumerate(relative):
            if m is not None:
                v = at[3 * k : 3 * k + 3] - at[:3]
                gap = m - polar(v)
                gap[1] = (gap[1] + pi) % (2 * pi) - pi
                slope = np.array([(polar(v + e) - polar(v - e)) / 2e-5 for e in 1e-5 * eye(3)]).T
                j = zeros((3, len(at)))
                j[:, :3], j[:, 3 * k : 3 * k + 3] = -slope, slope
                w = np.diag([RANGE**-2, ANGLE**-2, ANGLE**-2])
                h, r = h + j.T @ w @ j, r + j.T @ w @ gap
        at = at + solve(h, r)
    return at.reshape(-1, 3), inv(h)


def laplacian(x: Array, p: Array, fixes: Array, relative: list[Array], new: list[int]) -> tuple[Array, Array]:
    """z = [L x; x] with unit covariances, prior and all; L is the Laplacian of the star of those that are seen."""
    n, vectors = len(x), {k: cartesian(m) for k, m in enumerate(relative) if m is not None}
    for k in new:
        x[k] = x[0] + vectors[k] if k in vectors else fixes[k]
    lap, delta = zeros((n, n)), zeros((n, 3))
    for k, v in vectors.items():
        lap[[0, k], [0, k]] += 1.0
        lap[[0, k], [k, 0]] -= 1.0
        delta[0], delta[k] = delta[0] - v, delta[k] + v
    h = np.kron(np.vstack([lap, eye(n)]), eye(3))
    p = inv(inv(p) + h.T @ h)
    return (x.ravel() + p @ h.T @ (np.vstack([delta, fixes]).ravel() - h @ x.ravel())).reshape(-1, 3), p


def simulate(position: Array, velocity: Array, ego: int, most: int, rng: np.random.Generator) -> Array:
    """RT-LE m of fixes, LKF-SA with unit covariances and the joint filter; K = 0 makes both Kalman filters."""
    error = zeros((3, len(position)))
    state: dict[int, Any] = {}
    for t, (at, speed) in enumerate(zip(position, velocity, strict=True)):
        there = np.isfinite(at[:, 0])
        fixes = at + rng.normal(0, FIX, at.shape)
        measured = speed * (1 + RATIO * rng.normal(size=speed.shape))
        std = np.maximum(RATIO * abs(measured), FLOOR)
        star = [ego, *(j for j in nearest(np.where(there[:, None], at, inf), ego, most))]
        truth = [polar(at[j] - at[ego]) for j in star[1:]]
        noisy = [m + rng.normal(size=3) * [RANGE, ANGLE, ANGLE] for m in truth]
        relative = [None, *(m if d[0] >= 2.0 else None for m, d in zip(noisy, truth, strict=True))]
        error[0, t] = ((fixes[ego] - at[ego]) ** 2).sum()
        for k, (update, unit) in enumerate(((laplacian, True), (joint, False)), 1):
            q = np.ones_like(std) if unit else (DT * std) ** 2
            x, p, before = state.get(k, (zeros((0, 3)), zeros((0, 0)), []))
            mean, cov, new = step(x, p, star, before, DT * measured, q)
            if t == 0:
                mean[0] = fixes[ego]
            x, p = update(mean, cov, fixes[star], relative, new)
            state[k] = (x, p, star)
            error[k, t] = ((x[0] - at[ego]) ** 2).sum()
    return np.sqrt(error.mean(1))

"""LKF-SA with dense matrices, one run, axis by axis: z = [delta; fixes], H = [L; I], L the Laplacian of the star.

delta_i = -sum_j (x_j - x_i) as measured, of variance 1, or deg_i times the mean variance per axis of the measured
vectors. A member whose measurement is incomplete has no edge.
"""

import numpy as np

from coopoc import NoiseModel
from coopoc.arrays import Floats
from coopoc.kernels.stars.messages import FORGOTTEN
from coopoc.world.links import to_vector
from oracles.messages import Member, separate


def follow(stars: list[list[Member]], noise_model: NoiseModel) -> tuple[Floats, Floats, list[Floats]]:
    """x (T, 3), variance (T, 3) and the neighbours (k, 3) at each step."""
    x, p, estimates = np.zeros((0, 3)), np.zeros((3, 0, 0)), []
    for star in stars:
        x, p = update(*predict(x, p, star), star, noise_model)
        estimates.append((x, p[:, 0, 0]))
    return separate(estimates)


def predict(x: Floats, p: Floats, star: list[Member]) -> tuple[Floats, Floats]:
    """Members that stay move; one that joins is where the ego measures it, with a flat prior."""
    n, pick = len(star), np.zeros((len(star), len(x)))
    new, q = np.zeros((n, 3)), np.full((n, 3), FORGOTTEN)
    for k, member in enumerate(star):
        if member.before is None:
            new[k] = member.position if k == 0 else new[0] + to_vector(member.relative)
        else:
            pick[k, member.before] = 1.0
            new[k], q[k] = x[member.before] + member.moved, member.process
    return new, np.array([pick @ p[c] @ pick.T + np.diag(q[:, c]) for c in range(3)])


def update(x: Floats, p: Floats, star: list[Member], noise_model: NoiseModel) -> tuple[Floats, Floats]:
    """Each axis by itself: P^-1 += L W L + diag(1/r)."""
    n = len(star)
    edges = [k for k in range(1, n) if np.isfinite(star[k].relative).all()]
    laplacian, vectors = np.zeros((n, n)), {k: to_vector(star[k].relative) for k in edges}
    for k in edges:
        b = np.zeros(n)
        b[0], b[k] = -1.0, 1.0
        laplacian += np.outer(b, b)
    delta = np.zeros((n, 3))
    for k, vector in vectors.items():
        delta[0] -= vector
        delta[k] += vector
    variance = np.ones(n)
    if noise_model.sensors is not None and edges:
        mean = np.mean([np.trace(noise_model.relative_cov(star[k].relative)) / 3 for k in edges])
        variance = np.maximum(np.diag(laplacian), 1.0) * mean
    estimates = []
    for c in range(3):
        fixes = np.array([1 / member.variance[c] if member.new else 0.0 for member in star])
        position = np.array([member.position[c] for member in star])
        weight = laplacian @ np.diag(1 / variance)
        cov = np.linalg.inv(np.linalg.inv(p[c]) + weight @ laplacian + np.diag(fixes))
        eta = weight @ (delta[:, c] - laplacian @ x[:, c]) + fixes * (position - x[:, c])
        estimates.append((x[:, c] + cov @ eta, cov))
    return np.stack([x for x, _ in estimates], axis=1), np.array([p for _, p in estimates])

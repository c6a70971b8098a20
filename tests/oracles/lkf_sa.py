"""LKF-SA with dense matrices, one run: z = [delta; fixes], H = [L; I] on each axis, L the Laplacian of the star.

delta_i = -sum_j (x_j - x_i) as measured, of variance 1, or deg_i times the mean variance per axis of the measured
vectors. A member whose measurement is incomplete has no edge.
"""

import numpy as np
from numpy import eye
from numpy.linalg import inv

from coopoc import NoiseModel
from coopoc.arrays import Floats
from coopoc.world.links import to_vector
from oracles.messages import Member


def update(x: Floats, p: Floats, star: list[Member], noise_model: NoiseModel) -> tuple[Floats, Floats]:
    """P^-1 += L W L + diag(1/r)."""
    n = len(star)
    edges = [k for k in range(1, n) if np.isfinite(star[k].relative).all()]
    incidence = (eye(n) - eye(1, n).T)[:, edges]
    laplacian, variance = incidence @ incidence.T, np.ones(n)
    delta = incidence @ np.reshape([to_vector(star[k].relative) for k in edges], (-1, 3))
    if noise_model.sensors is not None and edges:
        mean = np.mean([np.trace(noise_model.relative_cov(star[k].relative)) / 3 for k in edges])
        variance = np.maximum(np.diag(laplacian), 1.0) * mean
    fixes = [1 / member.variance if member.new else np.zeros(3) for member in star]
    weight = np.concatenate([np.repeat(1 / variance, 3), *fixes])
    h = np.kron(np.vstack([laplacian, eye(n)]), eye(3))
    z = np.concatenate([delta, [member.position for member in star]]).ravel()
    p = inv(inv(p) + h.T * weight @ h)
    return x + (p @ h.T @ (weight * (z - h @ x.ravel()))).reshape(-1, 3), p

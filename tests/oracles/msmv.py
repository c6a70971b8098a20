"""MSMV-R, one run: P^-1 = P_prior^-1 + C_p^-1 + sum_j C_j^-1, each neighbour a pseudo-fix y_j = p_j - rho(r_ij)."""

import numpy as np
from numpy import zeros
from numpy.linalg import inv, solve

from coopoc import NoiseModel
from coopoc.arrays import Floats
from coopoc.kernels.stars.messages import FORGOTTEN
from coopoc.world.links import to_vector
from oracles.messages import Member


def follow(stars: list[list[Member]], noise_model: NoiseModel) -> tuple[Floats, Floats]:
    """x (T, 3) and covariance (T, 3, 3); a position in a message is the sender's own estimate."""
    x, p, estimates = zeros(3), zeros((3, 3)), []
    for star in stars:
        ego = star[0]
        x, p = (
            (ego.position, FORGOTTEN * np.eye(3)) if ego.before is None else (x + ego.moved, p + np.diag(ego.process))
        )
        sources = [(ego.position, np.diag(ego.variance))] if ego.new else []
        for member in star[1:]:
            if member.new:
                cov = (
                    np.eye(3)
                    if noise_model.sensors is None
                    else noise_model.relative_cov(member.relative) + np.diag(member.variance)
                )
                sources.append((member.position - to_vector(member.relative), cov))
        information = inv(p) + sum((inv(c) for _, c in sources), zeros((3, 3)))
        eta = sum((solve(c, y - x) for y, c in sources), zeros(3))
        p = inv(information)
        x = x + p @ eta
        estimates.append((x, p))
    return np.array([x for x, _ in estimates]), np.array([p for _, p in estimates])

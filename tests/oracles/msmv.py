"""MSMV-R, one run: P^-1 = P_prior^-1 + C_p^-1 + sum_j C_j^-1, each neighbour a pseudo-fix y_j = p_j - rho(r_ij)."""

from __future__ import annotations

import numpy as np

from coopoc import NoiseModel
from coopoc.arrays import Floats
from coopoc.kernels.stars.messages import FORGOTTEN
from coopoc.world.links import to_vector
from oracles.messages import Member


def follow(stars: list[list[Member]], known: NoiseModel) -> tuple[Floats, Floats]:
    """x (T, 3) and covariance (T, 3, 3); a position in a message is the sender's own estimate."""
    x, p, found = np.zeros(3), np.zeros((3, 3)), []
    for star in stars:
        ego = star[0]
        x, p = (
            (ego.position, FORGOTTEN * np.eye(3)) if ego.before is None else (x + ego.moved, p + np.diag(ego.process))
        )
        sources = [(ego.position, np.diag(ego.variance))] if ego.new else []
        for one in star[1:]:
            if one.new:
                cov = np.eye(3) if known.sensors is None else known.relative_cov(one.relative) + np.diag(one.variance)
                sources.append((one.position - to_vector(one.relative), cov))
        information = np.linalg.inv(p) + sum((np.linalg.inv(c) for _, c in sources), np.zeros((3, 3)))
        eta = sum((np.linalg.solve(c, y - x) for y, c in sources), np.zeros(3))
        p = np.linalg.inv(information)
        x = x + p @ eta
        found.append((x, p))
    return np.array([x for x, _ in found]), np.array([p for _, p in found])

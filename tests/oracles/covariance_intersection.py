"""Split covariance intersection with dense matrices, one run: errors that are correlated by an unknown amount.

Every error is the sum of a dependent and an independent one, P = Pd + Pi. What is measured is z = H x + e, of each
neighbour the rows of its pseudo-fix that were measured, H_j = (radial; azimuthal; polar unit vector):

    P1 = Pd / w + Pi,   P2 = H D H^T / (1 - w) + R,   K = P1 H^T (H P1 H^T + P2)^-1,   P = (1 - K H) P1,
    Pi = (1 - K H) Pi (1 - K H)^T + K R K^T,   Pd = P - Pi = (1 - K H) Pd (1 - K H)^T / w + K H D H^T K^T / (1 - w),

with the w in (0, 1] of least trace of P. The ego's own fix has no dependent error. Plain covariance intersection takes
all other errors as dependent (Li, Nashashibi, Yang, 2013; Julier and Uhlmann, 2001).
"""

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import brentq

from coopoc import NoiseModel
from coopoc.arrays import Floats
from coopoc.world.links import spherical, to_vector
from oracles.messages import Member, directions

LEAST = 1e-9
"""Least weight of one's own estimate: at zero nothing might be left to invert."""


def follow(stars: list[list[Member]], noise_model: NoiseModel, split: bool) -> tuple[Floats, Floats]:
    """x (T, 3) and covariance (T, 3, 3); a position in a message is the sender's own estimate."""
    nothing, fix_noise, steps = np.zeros((3, 3)), np.diag(noise_model.gnss_variance), []
    for ego, *others in stars:
        sources = []
        if steps:
            x, dependent, independent = steps[-1]
            x, independent = x + ego.moved, independent + np.diag(ego.process)
            sources = [(np.eye(3), ego.position, nothing, fix_noise)] if ego.new else []
        else:
            x, dependent, independent = ego.position, nothing, fix_noise
        sources += [
            pseudo_fix(member, x, noise_model, split) for member in others if np.isfinite(member.variance).all()
        ]
        if not split:
            dependent, independent = dependent + independent, nothing
        steps.append(fuse(x, dependent, independent, sources) if sources else (x, dependent, independent))
    return np.array([x for x, _, _ in steps]), np.array([d + i for _, d, i in steps])


def pseudo_fix(member: Member, x: Floats, noise_model: NoiseModel, split: bool) -> tuple[Floats, ...]:
    """H, z, D and R of the ego's position by a neighbour's estimate: rows of what was measured, at the predicted
    geometry."""
    predicted = np.array(spherical(*(member.position - x)))
    there = ~np.isnan(member.relative)
    H = directions(*predicted[1:])[there]
    D, R = H @ np.diag(member.variance) @ H.T, H @ noise_model.relative_cov(predicted) @ H.T
    z = H @ (member.position - to_vector(np.where(there, member.relative, predicted)))
    return (H, z, D, R) if split else (H, z, D + R, 0.0 * R)


def fuse(x: Floats, Pd: Floats, Pi: Floats, sources: list[tuple[Floats, ...]]) -> tuple[Floats, Floats, Floats]:
    """x, Pd and Pi after all sources at once."""
    H, z = (np.concatenate([source[k] for source in sources]) for k in (0, 1))
    D, R = (block_diag(*(source[k] for source in sources)) for k in (2, 3))

    def gain(w: float) -> tuple[Floats, Floats]:
        P1, P2 = Pd / w + Pi, D / max(1.0 - w, 1e-15) + R
        K = P1 @ H.T @ np.linalg.inv(H @ P1 @ H.T + P2)
        return K, np.eye(3) - K @ H

    def slope(w: float) -> float:
        """d tr P / dw: K is the best gain at every w, so that only P1 and P2 change."""
        K, rest = gain(w)
        return float(np.trace(K @ D @ K.T) / max(1.0 - w, 1e-15) ** 2 - np.trace(rest @ Pd @ rest.T) / w**2)

    low, high = LEAST, 1.0 - LEAST
    w = 1.0 if slope(high) <= 0 else low if slope(low) >= 0 else brentq(slope, low, high, xtol=1e-13)
    K, rest = gain(w)
    dependent = rest @ Pd @ rest.T / w + K @ D @ K.T / max(1.0 - w, 1e-15)
    return x + K @ (z - H @ x), dependent, rest @ Pi @ rest.T + K @ R @ K.T

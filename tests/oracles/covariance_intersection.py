"""Split covariance intersection: the fusion of estimates whose errors are correlated by an unknown amount.

P^-1 = (Pd / w + Pi)^-1 + sum_j (Cd_j / (1 - w) + Ci_j)^-1 with the w in (0, 1] of least trace of P, and x the mean that
belongs to it. Plain covariance intersection takes all error as dependent: P^-1 = w Pa^-1 + (1 - w) Pb^-1.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from coopoc import NoiseModel
from coopoc.arrays import Floats
from coopoc.world.links import spherical, to_vector
from oracles.messages import Member

LEAST = 1e-9
"""Least weight of one's own estimate: at zero nothing might be left to invert."""


class Belief(NamedTuple):
    """x (3,) m, and the covariances (3, 3) m^2 of its possibly correlated and of its independent error."""

    x: Floats
    dependent: Floats
    independent: Floats


def follow(stars: list[list[Member]], known: NoiseModel, split: bool) -> tuple[Floats, Floats]:
    """x (T, 3) and covariance (T, 3, 3); a position in a message is the sender's own estimate."""
    own, nothing, estimates = None, np.zeros((3, 3)), []
    for star in stars:
        ego, fix = star[0], Belief(star[0].position, nothing, np.diag(known.gnss_variance))
        prior = fix
        if own is not None:
            prior = Belief(own.x + ego.moved, own.dependent, own.independent + np.diag(ego.process))
        sources = [fix] if ego.new and own is not None else []
        for one in star[1:]:
            if np.isfinite(one.variance).all():
                seen = np.array(spherical(*(one.position - prior.x)))
                position = one.position - to_vector(np.where(np.isnan(one.relative), seen, one.relative))
                sources.append(joined(Belief(position, np.diag(one.variance), known.relative_cov(seen)), split))
        own = intersect(joined(prior, split), sources)[0]
        estimates.append((own.x, own.dependent + own.independent))
    return np.array([x for x, _ in estimates]), np.array([p for _, p in estimates])


def joined(belief: Belief, split: bool) -> Belief:
    """Plain covariance intersection takes all error as dependent."""
    return belief if split else Belief(belief.x, belief.dependent + belief.independent, 0.0 * belief.independent)


def intersect(own: Belief, others: list[Belief]) -> tuple[Belief, float]:
    """One's own estimate fused with others, consistent for any correlation of own with other dependent errors; and w.

    The information of a source is L = s K, K = (D + s I)^-1, and its derivative by s is K D K.
    """

    def sources(w: float) -> list[tuple[Floats, Floats, Floats, float]]:
        each = [(own, w, 1.0), *((other, max(1.0 - w, 1e-15), -1.0) for other in others)]
        inverse = [(b, s, sign, np.linalg.inv(b.dependent + s * b.independent)) for b, s, sign in each]
        return [(b.x, s * k, s * k @ b.dependent @ k, sign / s) for b, s, sign, k in inverse]

    def derivative(w: float) -> float:
        cov = np.linalg.inv(sum(information for _, information, _, _ in sources(w)))
        return -float(np.trace(cov @ sum(sign * change for _, _, change, sign in sources(w)) @ cov))

    low, high = LEAST, 1.0
    w = high if derivative(high) <= 0 else low if derivative(low) >= 0 else brentq(derivative, low, high, xtol=1e-13)
    parts = sources(w)
    cov = np.linalg.inv(sum(information for _, information, _, _ in parts))
    x = own.x + cov @ sum(information @ (y - own.x) for y, information, _, _ in parts)
    dependent = cov @ sum(change for _, _, change, _ in parts) @ cov
    return Belief(x, dependent, cov - dependent), w

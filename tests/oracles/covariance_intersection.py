"""Split covariance intersection: the fusion of estimates whose errors are correlated by an unknown amount.

`follow` is the filter of `coopoc.CovarianceIntersection`, one run; `intersect` its fusion, with dense matrices.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from coopoc import NoiseModel
from coopoc.arrays import Bools, Floats
from coopoc.methods.covariance_intersection import Criterion
from coopoc.world.links import spherical, to_vector
from oracles.messages import Member

LEAST = 1e-9
"""Least weight of one's own estimate: at zero nothing might be left to invert."""
ROUNDS, TOLERANCE = 40, 1e-8
"""Of the search for the weight; its last step is Newton's, so that the error is far below the tolerance."""
NEGLIGIBLE = 1e-12
"""A dependent share below this is none."""


class Belief(NamedTuple):
    """x (..., 3) m, and the covariances (..., 3, 3) m^2 of its possibly correlated and of its independent error."""

    x: Floats
    dependent: Floats
    independent: Floats


def follow(stars: list[list[Member]], known: NoiseModel, split: bool, criterion: Criterion) -> tuple[Floats, Floats]:
    """x (T, 3) and covariance (T, 3, 3); a position in a message is the sender's own estimate."""
    own, nothing, found = None, np.zeros((3, 3)), []
    for star in stars:
        ego, r = star[0], np.diag(known.gnss_variance)
        sources = [Belief(ego.position, nothing, r)] if ego.new and own is not None else []
        prior = ego.position if own is None else own.x[0] + ego.moved
        before = (
            Belief(prior, nothing, r)
            if own is None
            else Belief(prior, own.dependent[0], own.independent[0] + np.diag(ego.process))
        )
        for one in star[1:]:
            if np.isfinite(one.variance).all():
                seen = np.array(spherical(*(one.position - prior)))
                fix = one.position - to_vector(np.where(np.isnan(one.relative), seen, one.relative))
                sources.append(joined(Belief(fix, np.diag(one.variance), known.relative_cov(seen)), split))
        before = joined(before, split)
        others = Belief(
            *(np.array([np.array(s[i]) for s in sources]).reshape(1, -1, *before[i].shape) for i in range(3))
        )
        own, _ = intersect(Belief(*(part[None] for part in before)), others, None, criterion)
        found.append((own.x[0], (own.dependent + own.independent)[0]))
    return np.array([x for x, _ in found]), np.array([p for _, p in found])


def joined(belief: Belief, split: bool) -> Belief:
    """Plain covariance intersection takes all error as dependent."""
    return belief if split else Belief(belief.x, belief.dependent + belief.independent, 0.0 * belief.independent)


def intersect(
    own: Belief, others: Belief, used: Bools | None = None, criterion: Criterion = "trace"
) -> tuple[Belief, Floats]:
    """One's own estimate fused with k others, consistent for any correlation of own with other dependent errors.

    P^-1 = (Pd / w + Pi)^-1 + sum_j (Cd_j / (1 - w) + Ci_j)^-1, x = P [(Pd / w + Pi)^-1 x + sum_j (...)^-1 y_j], with
    the w in (0, 1] of least trace or determinant of P. Dependent errors of
    *different* others must be uncorrelated. All error dependent: covariance intersection,
    P^-1 = w Pa^-1 + (1 - w) Pb^-1. None: the Kalman update, whatever w.

    Args:
        own: (R, 3) m with (R, 3, 3) m^2. others: (R, k, 3) m with (R, k, 3, 3) m^2; all totals positive definite.
        used: (R, k) False where another sends nothing; its numbers must be finite all the same. criterion: of P.

    Returns:
        the fused belief, split again (P = Pd + Pi), and w (R,).

    """
    root, share = _modes(own, others, used)
    w = _best_weight(root, share, criterion)
    scale, bottom = _scales(w, share)
    kept = np.where(share > 0, scale / bottom, 1.0)
    cov = np.linalg.inv(_gram(root, kept))
    gap = np.concatenate([np.zeros_like(own.x)[:, None], others.x - own.x[:, None]], axis=1)
    seen = (root * np.swapaxes(np.repeat(gap, 3, axis=1), 1, 2)).sum(axis=1)
    x = own.x + (cov @ (root @ (kept * seen)[..., None]))[..., 0]
    dependent = cov @ _gram(root, share * scale / bottom**2) @ cov
    independent = cov @ _gram(root, kept**2 * (1.0 - share)) @ cov
    return Belief(x, dependent, independent), w


def _modes(own: Belief, others: Belief, used: Bools | None) -> tuple[Floats, Floats]:
    """Axes M (R, 3, 3 (k+1)) and shares f (R, 3 (k+1)) in which (Cd / s + Ci)^-1 = M diag(s / (f + s (1 - f))) M^T.

    With C = Cd + Ci = L L^T and L^-1 Cd L^-T = U diag(f) U^T, M = L^-T U: f is the dependent share of a direction.
    """
    dependent = np.concatenate([own.dependent[:, None], others.dependent], axis=1)
    independent = np.concatenate([own.independent[:, None], others.independent], axis=1)
    whiten = np.linalg.inv(np.linalg.cholesky(dependent + independent))
    share, turn = np.linalg.eigh(whiten @ dependent @ np.swapaxes(whiten, -1, -2))
    root = np.swapaxes(whiten, -1, -2) @ turn
    if used is not None:
        root[:, 1:] *= used[..., None, None]
    share = np.where(share < NEGLIGIBLE, 0.0, np.minimum(share, 1.0))
    runs = len(share)
    return np.moveaxis(root, 1, 2).reshape(runs, 3, -1), share.reshape(runs, -1)


def _gram(root: Floats, weight: Floats) -> Floats:
    """M diag(weight) M^T, (..., R, 3, 3)."""
    product: Floats = (root * weight[..., None, :]) @ np.swapaxes(root, -1, -2)
    return product


def _scales(w: Floats, share: Floats) -> tuple[Floats, Floats]:
    """s = w for one's own three axes and 1 - w for the others', and f + s (1 - f) (1 where f = 0), both (R, m)."""
    scale = np.repeat(1.0 - w[:, None], share.shape[1], axis=1)
    scale[:, :3] = w[:, None]
    return scale, np.where(share > 0, share + scale * (1.0 - share), 1.0)


def _best_weight(root: Floats, share: Floats, criterion: Criterion) -> Floats:
    """w (R,) in [LEAST, 1] by Newton's method within a bracket.

    Each s / (f + s (1 - f)) is concave in s, so the information is concave in w, and the trace and -log det of a
    concave information's inverse are convex: there is one minimum.
    """
    runs = len(share)
    low, high = np.full(runs, LEAST), np.ones(runs)
    at_one = _derivative(high, root, share, criterion)[0] <= 0
    at_zero = _derivative(low, root, share, criterion)[0] >= 0
    low, high = np.where(at_one, 1.0, LEAST), np.where(at_zero & ~at_one, LEAST, 1.0)
    w = (low + high) / 2
    for _ in range(ROUNDS):
        first, second = _derivative(w, root, share, criterion)
        low, high = np.where(first <= 0, w, low), np.where(first >= 0, w, high)
        newton = w - first / np.where(second > 0, second, np.inf)
        before, w = w, np.where((newton >= low) & (newton <= high), newton, (low + high) / 2)
        if np.abs(w - before).max() < TOLERANCE:
            break
    return w


def _derivative(w: Floats, root: Floats, share: Floats, criterion: Criterion) -> tuple[Floats, Floats]:
    """First and second derivative (R,) of tr P or of log det P by w, from those of the information."""
    scale, bottom = _scales(w, share)
    sign = np.where(np.arange(share.shape[1]) < 3, 1.0, -1.0)
    value = np.where(share > 0, scale / bottom, 1.0)
    information, derivative, curvature = _gram(
        root, np.stack([value, sign * share / bottom**2, -2.0 * share * (1.0 - share) / bottom**3])
    )
    cov = np.linalg.inv(information)
    climb = cov @ derivative
    outer = cov if criterion == "trace" else np.eye(3)
    twice = 2.0 if criterion == "trace" else 1.0
    first = -np.trace(climb @ outer, axis1=-2, axis2=-1)
    second = twice * np.trace(climb @ climb @ outer, axis1=-2, axis2=-1)
    return first, second - np.trace(cov @ curvature @ outer, axis1=-2, axis2=-1)

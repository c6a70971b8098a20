"""Loop closures by gating: candidates join known inliers where these predict them, as a start of GNC."""

import numpy as np

from ...arrays import Floats, Ints
from ..algebra.sparse import pairs_of, sparse
from ..descent.levenberg_marquardt import arrive
from ..model.derivatives import linearise
from ..model.factor import taken
from ..starts.graph_starts import parts
from ..starts.initial import along_poses, initial_guess
from .graduated import Inner, Marked

MAX_JOINS = 2
"""Times that a candidate may join: one that a wrong neighbour has displaced returns once that is gone."""
NONLINEAR_FACTOR = 10.0
"""Times its bound up to which a d^2 is checked by a solve: predictions along a drive are linear, its arc is not."""
MAX_RESOLVES = 10
"""Solves of these at most, the least certain predictions first."""


def known_start(marked: Marked, inner: Inner) -> tuple[Floats, Floats] | None:
    """Where known inliers lead, (n, ambient), and weights (G,) of the candidates, which join where the others predict
    them; None where known inliers do not join every node to a fixed one or to the world.

    A candidate fits where d^2 = r^T (J P J^T + cov)^-1 r is within its bound, P the covariance of its nodes given all
    that has joined. Of those that fit the half that is predicted best, by log det(J P J^T + cov), joins in each round,
    so that a loop is judged by what little the odometry of its own length has drifted. One whose residual leaves the
    bound leaves, and when it leaves again stays rejected. Of a group the d^2 are added, as if independent. Where none
    fits, the least certain are solved for: the cost must grow by no more than half the bound.

    Args:
        marked: the problem and its candidates.
        inner: solves a weighted problem.

    References:
        Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 5.4: the
        gate of a predicted measurement. Olson, Agarwal, IJRR 2013, on graphs.
    """
    problem, bound = marked.problem, marked.bound
    weight, left = np.zeros(len(bound)), np.zeros(len(bound), int)
    x = along_poses(marked.reweigh(weight, initial_guess(problem)))
    if len(_free(marked, weight)[1]):
        return None
    sparse(problem)  # is kept as long as the problem is, so that all rounds share its analysis
    most_joins = 1
    for _ in range(100):  # about 15 are needed: half of those that fit join in each
        x = inner(marked.reweigh(weight, x))
        leaving = (weight > 0) & (marked.squares(x) > bound)
        left[leaving], weight[leaving] = left[leaving] + 1, 0.0
        distance, volume = predicted(marked, weight, x)
        others = (weight == 0) & (left < most_joins)
        fits = others & (distance <= bound)
        if fits.any():
            weight[fits & (volume <= np.median(volume[fits]))] = 1.0
        elif most_joins < MAX_JOINS:
            most_joins = MAX_JOINS
        else:
            some = np.flatnonzero(others & (distance <= NONLINEAR_FACTOR * bound))
            some = some[np.argsort(-volume[some], kind="stable")][:MAX_RESOLVES]
            if not any(_explained(marked, x, weight, group) for group in some.tolist()):
                break
    return x, weight


def _free(marked: Marked, weight: Floats) -> tuple[Ints, Ints]:
    """(n,) parts that known inliers and candidates with a weight (G,) join, and the nodes that they join to no fixed
    one and not to the world."""
    problem = marked.problem
    guess = initial_guess(problem)
    measured = [factor.nodes[factor.informative] for factor in marked.reweigh(weight, guess).factors]
    part, alone = parts(len(problem.names), *measured), [nodes[:, 0] for nodes in measured if nodes.shape[1] == 1]
    held: Ints = np.concatenate([problem.fixed, *alone]).astype(int)
    return part, np.flatnonzero(~np.isin(part, part[held]))


def unconfirmed(marked: Marked, weight: Floats) -> list[str]:
    """A note for each of the candidates with a weight (G,) without which nodes are free: no other agrees with it."""
    part, free = _free(marked, 0.0 * weight)
    if not len(free):
        return []
    pairs = zip(marked.factor, marked.row, strict=True)
    ends = np.sort([part[marked.problem.factors[k].nodes[row, [0, -1]]] for k, row in pairs], axis=1)
    kept = weight[marked.group] > 0.0
    _, which, count = np.unique(ends[kept], axis=0, return_inverse=True, return_counts=True)
    names = dict[str, None]()
    for group in marked.group[kept][count[which.ravel()] == 1].tolist():
        without = weight * (np.arange(len(weight)) != group)
        names |= {marked.problem.names[k]: None for k in _free(marked, without)[1][:1]}
    return [f"{name} is joined to the others by one candidate alone: nothing confirms it" for name in names]


def _explained(marked: Marked, x: Floats, weight: Floats, group: int) -> bool:
    """Whether twice the cost grows by no more than the bound where a group joins, which it then does.

    Where the model is linear that growth is d^2. Far along a drive whose heading has become uncertain it is less.
    """
    costs = []
    for joins in (0.0, 1.0):
        weight[group] = joins
        system = sparse(marked.reweigh(weight, x))
        costs.append(system.cost(arrive(system, x, 20, 1e-3).x if joins else x))
    good = 2.0 * (costs[1] - costs[0]) <= marked.bound[group]
    weight[group] = good
    return bool(good)


def predicted(marked: Marked, weight: Floats, x: Floats) -> tuple[Floats, Floats]:
    """d^2 and log det(J P J^T + cov), in units of cov, of each group (G,), given what has a weight (G,) at x;
    infinite where that leaves nodes free."""
    problem, system = marked.problem, sparse(marked.reweigh(weight, x))
    distance, volume = np.full(len(marked.row), np.inf), np.zeros(len(marked.row))
    if not system.cholesky.factor(system.quadratic(x, "gauss-newton")[2]):
        return marked.sums(distance), marked.sums(volume)
    for k in np.unique(marked.factor):
        here = marked.factor == k
        factor = taken(problem.factors[k], marked.row[here])
        free, *pairs = pairs_of(system.entries.number[factor.nodes].reshape(len(factor.nodes), -1))
        P = np.zeros(free.shape)
        P[free] = system.cholesky.inverse(*pairs)
        with np.errstate(all="ignore"):
            linear = linearise(problem.space, [factor], x)
            (J,), (r,) = linear.jacobian, linear.residual
            S = J @ P @ J.mT + np.eye(factor.size)
        # an angle between nodes that coincide has no derivative
        lost = np.asarray(~np.isfinite(np.dstack([r, S])).all(axis=(1, 2)))
        variance, axes = np.linalg.eigh(np.where(lost[:, None, None], np.eye(factor.size), S))
        variance = np.maximum(variance, 1.0)  # as it is but for rounding, of nodes that are nearly free
        distance[here] = np.where(lost, np.inf, (np.einsum("mkj,mk->mj", axes, r) ** 2 / variance).sum(1))
        volume[here] = np.log(variance).sum(1)
    return marked.sums(distance), marked.sums(volume)

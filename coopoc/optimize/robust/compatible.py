"""Candidates that known inliers predict: a start of GNC that no outlier has pulled."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ...arrays import Floats
from ...errors import InputError
from ..algebra.sparse import sparse
from ..model.problem import Problem
from .outliers import Marked, reweigh, squares

ROUNDS = 100
"""About 15 are needed: half of those that fit join in each."""
HINT = 'Leave fewer measurements to doubt, or use start="all".'


def compatible(
    problem: Problem, marked: Marked, bound: Floats, inner: Callable[[Problem], Floats]
) -> tuple[Floats, Floats, int]:
    """Nodes (1, n, ambient), weights (1, G) and rounds: candidates join where the others predict them.

    A candidate fits where d^2 = r^T (J P J^T + cov)^-1 r is within its bound, P the covariance of its nodes given all
    that has joined. Of those that fit the half that is predicted best, by log det(J P J^T + cov), joins in each round,
    so that a loop is judged by what little the odometry of its own length has drifted. One whose residual leaves the
    bound is out for good. Of a group the d^2 are added, as if independent.

    Args:
        problem: a single one.
        marked: the candidates.
        bound: (1, G) c^2.
        inner: solves a weighted problem, x (1, n, ambient).

    Raises:
        InputError: the known inliers leave nodes free.

    References:
        Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 5.4: the
        gate of a predicted measurement. Olson, Agarwal, IJRR 2013, and Mangelson et al., ICRA 2018, on graphs.
    """
    weight = np.zeros((1, bound.shape[1]))
    out = np.zeros(bound.shape[1], dtype=bool)
    x = along_poses(reweigh(problem, marked, weight, _start(problem)).pick(0))
    rounds = 0
    while rounds < ROUNDS:
        x, rounds = inner(reweigh(problem, marked, weight, x)), rounds + 1
        out |= (weight[0] > 0) & (squares(problem, marked, x)[0] > bound[0])
        weight[0, out] = 0.0
        distance, spread = predicted(problem, marked, weight, x)
        fits = ~out & (weight[0] == 0) & (distance <= bound[0])
        if not fits.any():
            break
        weight[0, fits & (spread <= np.median(spread[fits]))] = 1.0
    return x, weight, rounds


def predicted(problem: Problem, marked: Marked, weight: Floats, x: Floats) -> tuple[Floats, Floats]:
    """d^2 and log det(J P J^T + cov), in units of cov, of each group (G,), given what has a weight (1, G) at x.

    Raises:
        InputError: that leaves nodes free.
    """
    system = sparse(reweigh(problem, marked, weight, x).pick(0), least=0)
    if system is None or not system.cholesky.factor(system.quadratic(x[0], "gauss-newton")[2]):
        raise InputError("candidates", repr(problem), "must leave known inliers that hold all nodes", HINT)
    linear = problem.linearise(x)
    jacobians = linear.by_node(problem.factors)
    distance, spread = ([np.empty(0)] * len(problem.factors) for _ in range(2))
    for k in np.unique(marked.factor):
        factor = problem.factors[k]
        shape = (len(factor.nodes), factor.size, problem.space.dof)
        J = np.concatenate([np.broadcast_to(own[0], shape) for own in jacobians[k]], axis=2)
        number = system.entries.number[factor.nodes].reshape(len(J), -1)
        row, column = np.broadcast_arrays(number[:, :, None], number[:, None])
        free = (row >= 0) & (column >= 0)
        P = np.zeros(row.shape)
        P[free] = system.cholesky.inverse(row[free], column[free])
        S = J @ P @ np.swapaxes(J, 1, 2) + np.eye(factor.size)
        r = linear.residual[k][0]
        distance[k] = np.einsum("mk,mk->m", r, np.linalg.solve(S, r[..., None])[..., 0])
        spread[k] = np.linalg.slogdet(S)[1]
    return marked.sums(distance)[0], marked.sums(spread)[0]


def along_poses(problem: Problem) -> Floats:
    """x0 (1, n, ambient) with poses that relative poses reach where these lead, from fixed poses and then from others.

    The start of a graph may follow measurements that have no weight here.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import breadth_first_order

    space, x = problem.space, _start(problem)[0]
    moves = [f for f in problem.factors if f.kind.startswith("relative_pose")]
    if not moves:
        return np.asarray(x[None])
    n, known = len(x), np.zeros(len(x), dtype=bool)
    rows = [f.informative for f in moves]
    pairs = np.concatenate([f.nodes[used] for f, used in zip(moves, rows, strict=True)])
    z = np.concatenate([f.z[used] for f, used in zip(moves, rows, strict=True)])
    which = {(i, j): k for k, (i, j) in enumerate(pairs.tolist())}
    ways = csr_array((np.ones(len(pairs)), pairs.T), shape=(n, n))
    for root in (*problem.fixed, *problem.poses):
        if known[root]:
            continue
        order, before = breadth_first_order(ways, root, directed=False)
        known[order] = True
        for j in order[1:].tolist():
            i = int(before[j])
            moved = z[which[i, j]] if (i, j) in which else _inverse(problem, z[which[j, i]])
            turn = space.rotation(x[i])
            x[j] = space.join(x[i, : space.dimension] + turn @ space.position(moved), turn @ space.rotation(moved))
    return np.asarray(x[None])


def _inverse(problem: Problem, moved: Floats) -> Floats:
    back = problem.space.rotation(moved).T
    return problem.space.join(-back @ problem.space.position(moved), back)


def _start(problem: Problem) -> Floats:
    from ..initialisation.initial import initial_guess

    return initial_guess(problem)

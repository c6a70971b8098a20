"""What the measurements so far predict of others, with the covariance of the prediction."""

from __future__ import annotations

import numpy as np

from ...arrays import Floats
from ...errors import InputError
from ..algebra.sparse import sparse
from ..model.linear import linearise
from ..model.part import taken
from ..model.problem import Problem
from .outliers import Marked, reweigh

HINT = 'Leave fewer measurements to doubt, or use start="all".'


def predicted(problem: Problem, marked: Marked, weight: Floats, x: Floats) -> tuple[Floats, Floats]:
    """d^2 and log det(J P J^T + cov), in units of cov, of each group (G,), given what has a weight (1, G) at x.

    Raises:
        InputError: that leaves nodes free.
    """
    system = sparse(reweigh(problem, marked, weight, x).pick(0), least=0)
    if system is None or not system.cholesky.factor(system.quadratic(x[0], "gauss-newton")[2]):
        raise InputError("candidates", repr(problem), "must leave known inliers that hold all nodes", HINT)
    distance, spread = np.zeros(len(marked.row)), np.zeros(len(marked.row))
    for k in np.unique(marked.factor):
        here = marked.factor == k
        factor = taken(problem.factors[k], marked.row[here])
        with np.errstate(all="ignore"):
            linear = linearise(problem.space, [factor], None, x)
        shape = (len(factor.nodes), factor.size, problem.space.dof)
        J = np.concatenate([np.broadcast_to(own[0], shape) for own in linear.by_node([factor])[0]], axis=2)
        r = linear.residual[0][0]
        # an angle between nodes that coincide has no derivative
        lost = ~np.isfinite(r).all(axis=1) | ~np.isfinite(J).all(axis=(1, 2))
        r, J = np.where(lost[:, None], 0.0, r), np.where(lost[:, None, None], 0.0, J)
        number = system.entries.number[factor.nodes].reshape(len(J), -1)
        row, column = np.broadcast_arrays(number[:, :, None], number[:, None])
        free = (row >= 0) & (column >= 0)
        P = np.zeros(row.shape)
        P[free] = system.cholesky.inverse(row[free], column[free])
        S = J @ P @ np.swapaxes(J, 1, 2) + np.eye(factor.size)
        distance[here] = np.einsum("mk,mk->m", r, np.linalg.solve(S, r[..., None])[..., 0]) + np.where(
            lost, np.inf, 0.0
        )
        spread[here] = np.linalg.slogdet(S)[1]
    distance, spread = (np.asarray(np.bincount(marked.group, v, weight.shape[1]), float) for v in (distance, spread))
    return distance, spread

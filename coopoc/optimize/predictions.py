"""What the measurements so far predict of others, with the covariance of the prediction."""

from __future__ import annotations

import numpy as np

from ..arrays import Floats
from ..errors import InputError
from .factor import Factor, unchecked
from .linear import linearise
from .local import swing
from .outliers import Marked, reweigh
from .part import taken
from .problem import Problem
from .space import Space, log_pose
from .sparse import sparse

HINT = 'Leave fewer measurements to doubt, or use start="all".'


def predicted(
    problem: Problem, marked: Marked, weight: Floats, x: Floats, whole: bool = False
) -> tuple[Floats, Floats]:
    """d^2 = r^T S^-1 r and log det S of each group (G,), S = J P J^T + 1 in units of the noise.

    Args:
        problem: a single one.
        marked: the candidates.
        weight: (1, G) those that have joined.
        x: (1, n, ambient) a minimum given these.
        whole: the error of a relative pose is the logarithm of the whole pose, which is normal along longer drives.

    Raises:
        InputError: they leave nodes free.
    """
    system = sparse(reweigh(problem, marked, weight, x).pick(0), least=0)
    if system is None or not system.cholesky.factor(system.quadratic(x[0], "gauss-newton")[2]):
        raise InputError("candidates", repr(problem), "must leave known inliers that hold all nodes", HINT)
    distance, spread = np.zeros(len(marked.row)), np.zeros(len(marked.row))
    for k in np.unique(marked.factor):
        here = marked.factor == k
        factor = taken(problem.factors[k], marked.row[here])
        poses = whole and factor.kind.startswith("relative_pose")
        r, J = (_of_poses if poses else _linear)(problem, factor, x)
        number = system.entries.number[factor.nodes].reshape(len(J), -1)
        row, column = np.broadcast_arrays(number[:, :, None], number[:, None])
        free = (row >= 0) & (column >= 0)
        P = np.zeros(row.shape)
        P[free] = system.cholesky.inverse(row[free], column[free])
        S = J @ P @ np.swapaxes(J, 1, 2) + np.eye(r.shape[1])
        distance[here] = np.einsum("mk,mk->m", r, np.linalg.solve(S, r[..., None])[..., 0])
        spread[here] = np.linalg.slogdet(S)[1]
    groups = weight.shape[1]
    return np.bincount(marked.group, distance, groups), np.bincount(marked.group, spread, groups)


def _linear(problem: Problem, factor: Factor, x: Floats) -> tuple[Floats, Floats]:
    """Whitened residuals (M, size) and their derivative (M, size, arity dof) by the steps of their nodes."""
    linear = linearise(problem.space, [factor], None, x)
    shape = (len(factor.nodes), factor.size, problem.space.dof)
    return linear.residual[0][0], np.concatenate(
        [np.broadcast_to(own[0], shape) for own in linear.by_node([factor])[0]], axis=2
    )


def _of_poses(problem: Problem, factor: Factor, x: Floats) -> tuple[Floats, Floats]:
    """The same of relative poses, by the logarithm of the whole pose between prediction T and measurement Z.

    Along a drive whose heading is uncertain positions lie on an arc, and (dp, w) with T Exp(dp, w) is normal on it: the
    error is Log(T^-1 Z), weighted as the residual of Z Exp(dp, w) is.

    References:
        Barfoot, Furgale, Associating uncertainty with three-dimensional poses, T-RO 2014.
    """
    space, d = problem.space, problem.dimension
    first, last = x[0, factor.nodes[:, 0]], x[0, factor.nodes[:, 1]]
    own, other = space.rotation(first), space.rotation(last)
    back = np.swapaxes(own, 1, 2)
    gap = np.einsum("mab,mb->ma", back, space.position(last) - space.position(first))
    turned, z = np.swapaxes(back @ other, 1, 2), factor.z
    error = log_pose(space, np.einsum("mab,mb->ma", turned, space.position(z) - gap), turned @ space.rotation(z))
    by_first = np.zeros((len(z), space.dof, space.dof))
    by_first[:, :d, :d], by_first[:, :d, d:] = -np.swapaxes(other, 1, 2), turned @ swing(gap)
    by_first[:, d:, d:] = -turned if d == 3 else -1.0
    by_last = np.zeros_like(by_first)
    by_last[:, :d, :d], by_last[:, d:, d:] = np.swapaxes(other, 1, 2), np.eye(space.angles)
    weigh = _weights(space, factor)
    return np.einsum("mij,mj->mi", weigh, error), weigh @ np.concatenate([by_first, by_last], axis=2)


def _weights(space: Space, factor: Factor) -> Floats:
    """(M, dof, dof) W with W^T W the information of (dp, w) in Z Exp(dp, w), Z the measurement."""
    count, d = len(factor.nodes), space.dimension
    nodes = np.arange(2 * count).reshape(count, 2)
    x = np.zeros((1, 2 * count, space.ambient))
    x[0, ::2], x[0, 1::2] = space.join(np.zeros(d)), factor.z
    by_step = np.array(linearise(space, [unchecked(factor, nodes=nodes)], None, x).jacobian[0][1][0])
    by_step[..., :d] = by_step[..., :d] @ space.rotation(factor.z)
    return np.swapaxes(np.linalg.cholesky(np.swapaxes(by_step, 1, 2) @ by_step), 1, 2)

"""Chordal initialisation: rotations relaxed to matrices together with all positions, then positions alone."""

import numpy as np

from ...arrays import Floats, Ints
from ..algebra.cholesky import cholesky_of, columns_solved
from ..model.factor import stacked
from ..model.problem import Problem
from ..starts.graph_starts import loose_firsts, parts
from .qcqp import TERMS, quadratic

TIE = 1e-6
"""Weight of the start that is given beside the least weight of a measurement: it decides only what nothing measures."""
PROXIMAL = 1e-4
"""Weight of the last rotations beside that of a median relative rotation: it acts over a hundred poses of a chain."""
SWEEPS = 10
"""Solves with the rotations of the one before; the matrix is factored once."""


RELAXED = frozenset(TERMS) - {"range", "displacement"}
"""Kinds that take part."""


def chordal_start(problem: Problem) -> Floats:
    """(n, ambient): the least squares of relative poses, seen landmarks and priors over any matrices R_i, which
    are then projected to rotations; last over the positions with these rotations.

    sum kappa |R_j - R_i R_ij|_F^2 + tau |t_j - t_i - R_i t_ij|^2 + tau |l_k - t_i - R_i z_ik|^2 + mu |R_i - P_i|_F^2,
    P the rotations before, which is |A X - goal|^2 with the rows of the problem's QCQP. Without the last term matrices
    shrink towards zero along a chain, and what is left of them turns at random; with it each sweep is a step of a
    projected inverse power iteration, which lengthens them again. Ranges have no linear form; what they alone hold
    stays at x0.

    Args:
        problem: of chordal kinds, with an x0.

    References:
        Carlone, Tron, Daniilidis, Dellaert, Initialization techniques for 3D SLAM, ICRA 2015 (chordal relaxation);
        Boumal, Nonconvex phase synchronization, SIAM J. Optim. 2016 (generalized power method).

    >>> x0 = np.tile([0.0, 0, 1, 0, 0, 1], (4, 1))
    >>> z = [[1, 0, 1, 0, 0, 1], [1, 0, 1, 0, 0, 1], [3, 1, 0.8, -0.6, 0.6, 0.8]]
    >>> problem = Problem(tuple("abcl"), x0=x0, dimension=2, poses=(0, 1, 2)).add("pose_chordal", 0, x0[0], std=1.0)
    >>> problem = problem.add("relative_pose_chordal", [(0, 1), (1, 2), (0, 2)], z, std=1.0)
    >>> chordal_start(problem)[1, :2].round(4)  # a third of what the loop does not close is added to (1, 0)
    array([1.3438, 0.2505])
    """
    from scipy.sparse import csr_array, eye_array, vstack

    factors = tuple(factor for factor in problem.factors if factor.kind in RELAXED)
    if not factors or problem.x0 is None:
        return np.array(problem.x0)
    form, space, d = quadratic(problem.replace_unchecked(factors=factors, fixed=())), problem.space, problem.dimension
    frame = np.eye(d)[: d * form.framed]
    A, count = csr_array(form.rows[:, len(frame) :]), d * len(form.poses)
    goal = np.zeros((A.shape[0], d)) - form.rows[:, : len(frame)] @ frame
    X = form.lift(space.position(problem.x0), space.rotation(problem.x0))[len(frame) :]
    every, tie = (
        eye_array(len(X), format="csr"),
        TIE * min(float(factor.root.max(axis=(1, 2)).min()) for factor in factors) ** 2,
    )
    moved = [factor.root[:, -1, -1] for factor in factors if factor.kind == "relative_pose_chordal"]
    weight = np.sqrt(PROXIMAL) * (np.median(np.concatenate(moved)) if moved else 1.0)
    wide = vstack([A, weight * every[:count]], format="csr")
    gram = cholesky_of(wide.T @ wide + tie * every)
    for _ in range(SWEEPS):
        if gram is None:
            break
        X = columns_solved(gram, tie * X + wide.T @ np.concatenate([goal, weight * X[:count]]))
        _, rotation = form.drop(np.concatenate([frame, X]))
        X[:count] = np.swapaxes(rotation[form.poses], 1, 2).reshape(count, d)
    places = A[:, count:]
    anchors = every[:, count:][count + _anchors(problem)]
    heavy = max(float(factor.root.max()) for factor in factors)
    wide = vstack([places, heavy * anchors], format="csr")
    gram = cholesky_of(wide.T @ wide + tie * every[count:, count:])
    if gram is not None:
        right = np.concatenate([goal - A[:, :count] @ X[:count], heavy * (anchors @ X[count:])])
        X[count:] = columns_solved(gram, tie * X[count:] + wide.T @ right)
    return space.join(*form.drop(np.concatenate([frame, X])))


def _anchors(problem: Problem) -> Ints:
    """One pose of each part of the problem that nothing joins to the world or, linearly, to another."""
    linear = [factor.nodes for factor in problem.factors if factor.kind in RELAXED]
    part = parts(len(problem.names), *linear)
    return loose_firsts(part, np.array(problem.poses, np.int64), stacked(n[:, 0] for n in linear if n.shape[1] == 1))

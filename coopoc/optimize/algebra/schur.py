"""Star elimination: nodes that only meet at a separator of one node, by its Schur complement, B problems at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ...arrays import Floats
from ..model.derivatives import Linear
from ..model.problem import Problem

COFACTORS = np.array(
    [[4, 2, 1, 5, 0, 2, 3, 1, 0], [8, 7, 5, 6, 8, 3, 7, 6, 4], [5, 1, 2, 3, 2, 0, 4, 0, 1], [7, 8, 4, 8, 6, 5, 6, 7, 3]]
)
"""Entries a, b, c, d of a 3 x 3 matrix, row by row, with a b - c d its adjugate."""


@dataclass(frozen=True, eq=False)
class Star:
    """Normal equations of B stars of n points in d dimensions.

    Args:
        separator: the point in the middle.
        own: (B, n, d, d) block of J^T J of each point.
        arm: (B, n, d, d) block of each point and the separator.
        gradient: (B, n, d) J^T r.
    """

    separator: int
    own: Floats
    arm: Floats
    gradient: Floats

    def solve(self, damping: Floats | float = 0.0) -> tuple[Floats, Callable[[], Floats]]:
        """dx (B, n, d) of (J^T J + diag(damping)) dx = -J^T r, and a function that gives each point's block
        (B, n, d, d) of the inverse; NaN where a block is singular.

        With a point's own block H, its arm A to the separator and its gradient g: T = H^-1 A, u = H^-1 g,
        S = corner - sum A^T T. The separator moves by dx = S^-1 (sum A^T u - its gradient), a point by -(u + T dx);
        their covariances are S^-1 and H^-1 + T S^-1 T^T.
        """
        B, n, d = self.gradient.shape
        others, index, own = np.arange(n) != self.separator, np.arange(d), self.own
        if np.any(damping):
            own = own.copy()
            own[..., index, index] += damping
        arm, inverse = self.arm[:, others], inverted(own[:, others])
        reduced = inverse @ np.concatenate([arm, self.gradient[:, others, :, None]], axis=-1)
        flat = reduced.reshape(B, -1, d + 1)
        taken = arm.reshape(B, -1, d).swapaxes(-1, -2) @ flat
        corner = inverted(own[:, self.separator] - taken[..., :d])
        step = corner @ (taken[..., d:] - self.gradient[:, self.separator, :, None])
        dx = np.empty_like(self.gradient)
        dx[:, self.separator] = step[..., 0]
        dx[:, others] = -(flat[..., d:] + flat[..., :d] @ step).reshape(B, -1, d)

        def marginals() -> Floats:
            cov, turned = np.empty_like(own), reduced[..., :d]
            cov[:, self.separator] = corner
            cov[:, others] = inverse + turned @ corner[:, None] @ turned.swapaxes(-1, -2).copy()
            return cov

        return dx, marginals


def inverted(matrix: Floats) -> Floats:
    """Inverses (..., d, d); of 3 x 3 by the adjugate, which takes a quarter of LAPACK's time; NaN where singular."""
    with np.errstate(all="ignore"):
        if matrix.shape[-1] == 3:
            entries = matrix.reshape(*matrix.shape[:-2], 9)
            a, b, c, d = (entries.take(chosen, axis=-1) for chosen in COFACTORS)
            adjugate = a * b - c * d
            determinant = (entries[..., :3] * adjugate[..., ::3]).sum(axis=-1, keepdims=True)
            return np.asarray(adjugate / determinant).reshape(matrix.shape)
    singular = ~(np.linalg.det(matrix) > 0.0)[..., None, None]
    return np.where(singular, np.nan, np.linalg.inv(np.where(singular, np.eye(matrix.shape[-1]), matrix)))


def is_star(problem: Problem) -> bool:
    """Whether a problem is of points that can all move and are only measured from, or by, one separator."""
    if len(problem.separator) != 1 or problem.movable is not None or problem.poses:
        return False
    pairs = (factor.nodes for factor in problem.factors if factor.nodes.shape[1] == 2)
    return all((nodes == problem.separator[0]).any(axis=1).all() for nodes in pairs)


def star_at(problem: Problem, linear: Linear) -> Star:
    """The normal equations of a problem that `is_star`, linearised."""
    count, n, d = linear.x.shape
    separator = problem.separator[0]
    own, arm = np.zeros((2, count, n, d, d))
    gradient = np.zeros((count, n, d))
    for factor, residual, (*_, jacobian) in zip(problem.factors, linear.residual, linear.jacobian, strict=True):
        nodes, transposed = factor.nodes, jacobian.swapaxes(-1, -2).copy()  # BLAS takes longer for a view
        square = np.broadcast_to(transposed @ jacobian, (len(jacobian), len(nodes), d, d))
        slope = (transposed @ residual[..., None])[..., 0]
        other = np.where(nodes[:, 0] == separator, nodes[:, -1], nodes[:, 0])
        if nodes.shape[1] == 2:
            own[:, separator] += square.sum(axis=1)
            slope = slope * np.where(nodes[:, 1] == separator, -1.0, 1.0)[:, None]
            gradient[:, separator] -= slope.sum(axis=1)
        chosen = (np.arange(n)[:, None] == other).astype(np.float64)  # (n, M)
        of_each = (chosen @ square.reshape(len(square), len(nodes), d * d)).reshape(-1, n, d, d)
        own += of_each
        gradient += chosen @ slope
        if nodes.shape[1] == 2:
            arm -= of_each
    return Star(separator, own, arm, gradient)

"""Star elimination: nodes that only meet at a separator of one node, by its Schur complement, B problems at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...arrays import Floats
from ..model.linear import Linear
from ..model.problem import Problem


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

    def solve(self, damping: Floats | float = 0.0) -> tuple[Floats, Floats]:
        """dx (B, n, d) of (J^T J + diag(damping)) dx = -J^T r, and the blocks (B, n, d, d) of the inverse of each point.

        With a point's own block H and its arm A: T = H^-1 A, S = corner - sum A^T T. The separator's covariance is
        S^-1, a point's H^-1 + T S^-1 T^T.

        Raises:
            numpy.linalg.LinAlgError: a singular block.
        """
        index, own = np.arange(self.own.shape[-1]), self.own.copy()
        own[..., index, index] += damping
        cov, dx = np.empty_like(own), np.empty_like(self.gradient)
        others = np.arange(own.shape[1]) != self.separator
        arm, eta = self.arm[:, others], self.gradient[:, others, :, None]
        inverse = np.linalg.inv(own[:, others])
        reduced = inverse @ arm
        back = reduced.swapaxes(-1, -2)
        corner = np.linalg.inv(own[:, self.separator] - (arm.swapaxes(-1, -2) @ reduced).sum(axis=1))
        step = corner @ ((back @ eta).sum(axis=1) - self.gradient[:, self.separator, :, None])
        dx[:, self.separator], cov[:, self.separator] = step[..., 0], corner
        dx[:, others] = -(inverse @ eta + reduced @ step[:, None])[..., 0]
        cov[:, others] = inverse + reduced @ corner[:, None] @ back
        return dx, cov


def is_star(problem: Problem) -> bool:
    """Whether a problem is of points that can all move and are only measured from, or by, one separator."""
    if len(problem.separator) != 1 or problem.movable is not None or problem.poses:
        return False
    pairs = (factor.nodes for factor in problem.factors if factor.nodes.shape[1] == 2)
    return all((nodes == problem.separator[0]).any(axis=1).all() for nodes in pairs)


def star_at(problem: Problem, linear: Linear) -> Star:
    """The normal equations of a problem that `is_star`, linearised."""
    count, n, d = linear.x.shape
    separator, nodes_of = problem.separator[0], np.arange(n)[:, None]
    star = Star(separator, np.zeros((count, n, d, d)), np.zeros((count, n, d, d)), np.zeros((count, n, d)))
    for factor, residual, (jacobian, *_) in zip(problem.factors, linear.residual, linear.jacobian, strict=True):
        transposed, M = jacobian.swapaxes(-1, -2), len(factor.nodes)
        square = np.broadcast_to(transposed @ jacobian, (len(jacobian), M, d, d)).reshape(len(jacobian), M, d * d)
        slope = (transposed @ residual[..., None])[..., 0]
        last = (nodes_of == factor.nodes[:, -1]).astype(np.float64)  # (n, M), 1 where a measurement is of a node
        first = (nodes_of == factor.nodes[:, 0]) * float(factor.nodes.shape[1] == 2)
        star.own[:] += ((first + last) @ square).reshape(-1, n, d, d)
        star.arm[:] -= ((nodes_of != separator) * (first + last) @ square).reshape(-1, n, d, d) * first.any()
        star.gradient[:] += (last - first) @ slope
    return star

"""LocalProblem: a problem around a point as least squares over a flat vector, for any solver of such problems."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from ...arrays import Floats, Ints
from ..assess.active import Rows, constraint_rows
from ..model.derivatives import linearise
from ..model.factor import Loss, unchecked
from ..model.problem import Problem
from ..model.space import cross


@dataclass(frozen=True, eq=False)
class LocalProblem:
    """A single problem as min 1/2 |r(v)|^2 over v (m,), the m numbers that can move, with v = 0 at the centre.

    Points and poses, fixed nodes and robust losses are taken care of: `point` retracts v, fixed nodes have no numbers
    in v, and the rows of a robust measurement are scaled so that 1/2 |r|^2 is the cost and J^T r its gradient
    everywhere (Triggs et al., Bundle Adjustment, 2000, section 4.3).

    Args:
        problem: a single realisation.
        centre: (n, ambient) nodes.

    >>> problem = Problem(("a", "b")).add("position", ["a", "b"], [[0, 0, 0], [9, 0, 0]], std=1.0)
    >>> local = LocalProblem(problem.add("range", ("a", "b"), 10.0, std=1.0), np.eye(2, 3))
    >>> J, r = local.jacobian(np.zeros(local.size)), local.residual(np.zeros(local.size))
    >>> J.shape, r.shape
    ((7, 6), (7,))
    """

    problem: Problem
    centre: Floats

    @cached_property
    def moving(self) -> Ints:
        """(m,) places of v among the n dof directions."""
        every = np.arange(len(self.centre) * self.problem.space.dof)
        return every if self.problem.movable is None else every[self.problem.movable.ravel()]

    @property
    def size(self) -> int:
        """m."""
        return len(self.moving)

    def point(self, v: Floats) -> Floats:
        """Nodes (n, ambient) at v: p + dp and R Exp(w) of each."""
        return self.problem.space.retract(self.centre, self._steps(v))

    def residual(self, v: Floats) -> Floats:
        """(rows,) whitened residuals r, 1/2 |r|^2 the cost."""
        return self._rows(v)[0]

    def jacobian(self, v: Floats) -> Any:
        """(rows, m) dr/dv, sparse (CSR)."""
        return self._columns(self._rows(v)[1], v)

    def constraints(self, v: Floats) -> Rows:
        """The constraints lower <= value <= upper at v and their sparse derivative by v."""
        rows = constraint_rows(self.problem, self.point(v))
        return replace(rows, matrix=self._columns(rows.matrix, v))

    def _rows(self, v: Floats) -> tuple[Floats, Any]:
        problem = self.problem
        bare = [unchecked(f, loss=None) for f in problem.factors]
        linear = linearise(problem.space, bare, problem.movable, self.point(v)[None])
        residuals, jacobians = list(linear.residual), list(linear.jacobian)
        for k, factor in enumerate(problem.factors):
            if factor.loss is not None:
                phi, scale = _scales(factor.loss, residuals[k])
                residuals[k] = phi * residuals[k]
                jacobians[k] = tuple(scale @ jacobian for jacobian in jacobians[k])
        scaled = replace(linear, residual=tuple(residuals), jacobian=tuple(jacobians))
        return np.concatenate([r.ravel() for r in residuals]), problem.jacobian(scaled)

    def _columns(self, J: Any, v: Floats) -> Any:
        """The derivative by v of rows whose derivative by a step at the point is J: Exp(w + dw) = Exp(w) Exp(Jr dw)."""
        w = self._steps(v)[:, self.problem.dimension :]
        if w.shape[1] == 3 and w.any():
            from scipy.sparse import block_diag

            blocks = [part for turn in right_jacobian(w) for part in (np.eye(3), turn)]
            J = J @ block_diag(blocks, format="csr")
        return J[:, self.moving]

    def _steps(self, v: Floats) -> Floats:
        steps = np.zeros(len(self.centre) * self.problem.space.dof)
        steps[self.moving] = v
        return steps.reshape(len(self.centre), -1)


def right_jacobian(w: Floats) -> Floats:
    """(..., 3, 3) Jr with Exp(w + dw) = Exp(w) Exp(Jr dw), |w| < pi rad (Sola et al., arXiv 1812.01537, eq. 143)."""
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    first = np.where(small, 0.5, (1.0 - np.cos(safe)) / safe**2)
    second = np.where(small, 1.0 / 6.0, (safe - np.sin(safe)) / safe**3)
    turn = cross(w)
    matrix: Floats = np.eye(3) - first * turn + second * (turn @ turn)
    return matrix


def _scales(loss: Loss, residual: Floats) -> tuple[Floats, Floats]:
    """phi (1, M, 1) with |phi r|^2 = rho(s), s = |r|^2, and T (1, M, k, k) with d(phi r) = T dr.

    phi = sqrt(rho / s), T = phi I + (rho' / phi - phi) r r^T / s.
    """
    square = np.maximum(np.square(residual).sum(axis=-1, keepdims=True), 1e-16)
    phi = np.sqrt(loss.cost(square) / square)
    share = (loss.weight(square) / phi - phi) / square
    outer = residual[..., :, None] * residual[..., None, :]
    return phi, phi[..., None] * np.eye(residual.shape[-1]) + share[..., None] * outer

"""Minimising 1/2 <C, X X^T> over Stiefel blocks and spheres: Riemannian trust region, truncated conjugate gradients.

Absil, Baker, Gallivan, "Trust-region methods on Riemannian manifolds", Found. Comput. Math. 7(3), 2007, with the metric
of the surrounding space: grad = S X, Hess[V] = P(S V), S = C - L(X), where L holds the multipliers of the constraints

    L_B = sym((C X)_B X_B^T) on a Stiefel block,     L_B = <(C X)_B, X_B> I on a sphere.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...arrays import Floats
from .qcqp import Multipliers, Quadratic, multipliers
from .schur import Dense, Reduced

MAX_ITERATIONS = 300
INNER = 200
"""Conjugate gradient steps per trust region step."""
SMALL = 150
"""Numbers in X up to which the Hessian on the tangent space is decomposed."""
FLAT = 1e-12
"""Share of the largest curvature below which a direction counts as a common rotation, which changes nothing."""
ROUNDING = 1e-12
"""Share of the cost (at least of 1) that its evaluation may be off."""


def tangent(problem: Quadratic, X: Floats, V: Floats) -> Floats:
    """The part of V (bound, p) that keeps the constraints to first order: V - L(V, X) X."""
    return V - multipliers(problem, X, V).times(X)


def retract(problem: Quadratic, X: Floats, V: Floats) -> Floats:
    """X + V, put back on the manifolds: (Y Y^T)^-1/2 Y with Y = (X + V)_B, or Y / |Y|.

    Unlike Y's triangular factor the polar one turns all blocks alike where V does, so that a robot's chain stays rigid.
    """
    out = X + V
    block = out[problem.stiefel]
    values, vectors = np.linalg.eigh(block @ np.swapaxes(block, 1, 2))
    out[problem.stiefel] = (vectors / np.sqrt(values)[:, None]) @ (np.swapaxes(vectors, 1, 2) @ block)
    s = out[problem.sphere]
    out[problem.sphere] = s / np.sqrt(np.square(s).sum(axis=(1, 2), keepdims=True))
    return out


@dataclass(frozen=True, eq=False)
class Stationary:
    """Where a minimisation ended: X (bound, p), cost, multipliers, iterations; whether the tolerance was met."""

    X: Floats
    cost: float
    multipliers: Multipliers
    iterations: int
    converged: bool


def minimise(
    problem: Quadratic,
    reduced: Reduced,
    X: Floats,
    tolerance: float = 1e-13,
    max_iterations: int = MAX_ITERATIONS,
    tick: Callable[[], object] = lambda: None,
) -> Stationary:
    """A stationary point near X (bound, p), to second order: Newton's steps converge quadratically.

    Args:
        tolerance: of the decrease that a step promises, as a share of the cost (at least of 1); it is still taken.
        tick: called after every step.
    """
    CX = reduced.times(X)
    cost, radius, count = 0.5 * float(np.sum(X * CX)), 0.0, 0
    while True:
        here = _Tangent(problem, reduced, X, multipliers(problem, X, CX))
        step, promised, radius, edge = _truncated(here, CX - here.L.times(X), radius)
        trial = retract(problem, X, step)
        tick()
        CT = reduced.times(trial)
        after = 0.5 * float(np.sum(trial * CT))
        slack = ROUNDING * max(cost, 1.0)
        share = (cost - after + slack) / (promised + slack)
        converged = promised <= (ROUNDING if edge else tolerance) * max(cost, 1.0)
        if share > 0.1:
            X, CX, cost = trial, CT, after
        if converged or count >= max_iterations:
            return Stationary(X, cost, multipliers(problem, X, CX), count, converged)
        radius *= 0.25 if share < 0.25 else 2.0 if share > 0.75 and edge else 1.0
        count += 1


@dataclass(frozen=True, eq=False)
class _Tangent:
    """The tangent space at X, without the common rotations X W, W skew, which change no cost.

    Away from a minimum the Hessian bends along X W by as much as the gradient is long, and would lead steps astray.
    """

    problem: Quadratic
    reduced: Reduced
    X: Floats
    L: Multipliers

    def project(self, V: Floats) -> Floats:
        """The tangent part of V whose X^T V is symmetric."""
        V = tangent(self.problem, self.X, V)
        turns = self._turns
        return np.asarray(V - (turns @ (V.ravel() @ turns)).reshape(V.shape))

    @cached_property
    def _turns(self) -> Floats:
        """Orthonormal (X.size, up to p (p - 1) / 2): X U (e_i e_j^T - e_j e_i^T) U^T, U the eigenvectors of X^T X."""
        values, vectors = np.linalg.eigh(self.X.T @ self.X)
        i, j = np.triu_indices(len(values), 1)
        length = values[i] + values[j]
        i, j, length = (part[length > FLAT * values[-1]] for part in (i, j, length))
        XU = self.X @ vectors
        turns = XU[:, None, i] * vectors[:, j] - XU[:, None, j] * vectors[:, i]
        return np.asarray(turns.reshape(self.X.size, -1) / np.sqrt(length))

    def second_derivative(self, V: Floats) -> Floats:
        """Hess[V]."""
        return self.project(self.reduced.times(V) - self.L.times(V))

    def precondition(self, V: Floats) -> Floats:
        """About |Hess|^-1 V: exactly where X is small, so that a step is Newton's."""
        return self.project(self.reduced.precondition(V) if self._exact is None else self._exact(V))

    @cached_property
    def _exact(self) -> Callable[[Floats], Floats] | None:
        if not isinstance(self.reduced, Dense) or self.X.size > SMALL:
            return None
        normal = np.column_stack([_normals(self.problem, self.X), self._turns])
        hessian: Floats = np.kron(self.reduced.matrix - self.L.dense, np.eye(self.X.shape[1]))
        for _ in range(2):  # from the left and from the right
            hessian = (hessian - normal @ (normal.T @ hessian)).T
        values, vectors = np.linalg.eigh(hessian)
        size = np.abs(values)
        inverse = np.where(size > FLAT * size.max(), 1.0 / np.maximum(size, 1e-300), 0.0)
        return lambda V: np.asarray(vectors @ (inverse * (V.ravel() @ vectors))).reshape(V.shape)


def _normals(problem: Quadratic, X: Floats) -> Floats:
    """Orthonormal (X.size, k): the directions that the constraints forbid at X."""
    n, k = problem.stiefel.shape
    a, b = np.triu_indices(k)
    out = np.zeros((*X.shape, n * len(a) + len(problem.sphere)))
    column = np.arange(n * len(a)).reshape(n, len(a))
    weight = np.where(a == b, 0.5, np.sqrt(0.5))[:, None]
    for here, there in ((a, b), (b, a)):
        out[problem.stiefel[:, here], :, column] += weight * X[problem.stiefel[:, there]]
    column = n * len(a) + np.arange(len(problem.sphere))[:, None]
    out[problem.sphere, :, column] = X[problem.sphere]
    return out.reshape(X.size, -1)


def _truncated(here: _Tangent, gradient: Floats, radius: float) -> tuple[Floats, float, float, bool]:
    """Steihaug's step within `radius` (in the preconditioner's norm), the decrease it promises, and if it hit the edge.

    A radius of 0 stands for the length of the preconditioned gradient, and is returned as that.
    """
    step: Floats = np.zeros_like(gradient)
    moved: Floats = np.zeros_like(gradient)
    residual: Floats = gradient
    direction: Floats = -here.precondition(residual)
    strength = start = -float(np.sum(residual * direction))
    radius = radius or np.sqrt(max(start, 0.0))
    size, along, reach, edge = 0.0, 0.0, strength, False
    for _ in range(INNER * (start > 1e-30)):
        bent = here.second_derivative(direction)
        curvature = float(np.sum(direction * bent))
        alpha = strength / curvature if curvature > 0 else 0.0
        edge = curvature <= 0 or size + 2 * alpha * along + alpha * alpha * reach >= radius * radius
        if edge:
            alpha = (np.sqrt(along * along + reach * (radius * radius - size)) - along) / reach
        step, moved = step + alpha * direction, moved + alpha * bent
        size += 2 * alpha * along + alpha * alpha * reach
        residual = residual + alpha * bent
        eager = here.precondition(residual)
        before, strength = strength, float(np.sum(residual * eager))
        if edge or strength <= start * min(0.01, start):
            break
        beta = strength / before
        direction = beta * direction - eager
        along, reach = beta * (along + alpha * reach), strength + beta * beta * reach
    return step, -float(np.sum(step * (gradient + 0.5 * moved))), radius, edge

"""Levenberg-Marquardt: the outer loop that every backend with a linear step shares, for B problems at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..arrays import Bools, Floats, Ints
from ..errors import InputError
from .backend import SolverResult
from .linear import Linear
from .problem import Problem

Step = Callable[[Linear, Floats], Floats]
"""(linearisation, damping (B, n, dof)) -> dx (B, n, dof): (J^T J + diag(damping)) dx = -J^T r, else LinAlgError."""

MAX_ITERATIONS = 500
"""About 6 are needed with angles, some 50 for range-only problems of flat geometry."""
TOLERANCE = 1e-8
"""m or rad, largest move of a node in the last step."""
LINEAR = 1e-6
"""Share by which a step may be off where the problem is linear: one that is not longer than TOLERANCE over it is the
last."""
GIVE_UP = 1e12
"""Damping beyond which no step can help."""


@dataclass(frozen=True, eq=False)
class Descent:
    """Where the loop ended.

    Args:
        x: (B, n, ambient).
        iterations: (B,) linear steps taken.
        converged: (B,) the last step was below the tolerance.
    """

    x: Floats
    iterations: Ints
    converged: Bools


def descend(
    problem: Problem, step: Step, x: Floats, max_iterations: int = MAX_ITERATIONS, tolerance: float = TOLERANCE
) -> Descent:
    """Gauss-Newton steps, damped where the linear model does not hold (Levenberg-Marquardt with Marquardt's scaling).

    (J^T J + mu diag(J^T J)) dx = -J^T r, mu = 0 at first. A step that raises the cost is refused; mu then grows, and
    also where the cost falls by less than a quarter of what the model promised: plain Gauss-Newton overshoots for ever
    where the true curvature exceeds twice that of J^T J, as in range-only problems of flat geometry. A realisation
    leaves the batch when no point of it moves by more than `tolerance`.

    Args:
        problem: one or B realisations.
        step: the backend's linear solver.
        x: (B, n, ambient) start.
        max_iterations: of linear steps.
        tolerance: m.

    Raises:
        InputError: max_iterations that is no whole number >= 0, tolerance that is not > 0.
    """
    check_limits(max_iterations, tolerance)
    best, count = x.copy(), np.zeros(len(x), dtype=np.int64)
    done, mu = np.zeros(len(x), dtype=bool), np.zeros(len(x))
    active, now = np.arange(len(x)), problem
    linear, near = problem.linearise(best), tolerance / LINEAR if problem.linear else tolerance
    for _ in range(max_iterations):
        dx, solved = _try(step, problem, linear, mu[active])
        count[active] += 1
        with np.errstate(all="ignore"):
            trial = now.linearise(problem.space.retract(linear.x, dx))
            small = solved & (np.abs(dx).max(axis=(1, 2)) <= np.where(mu[active] > 0, tolerance, near))
            better = solved & (trial.cost <= linear.cost * (1.0 + 1e-13)) | small & np.isfinite(trial.cost)
        promised = trial.cost if problem.linear else _promised(problem, linear, dx)
        mu[active] = _damping(mu[active], better, linear.cost, trial.cost, promised)
        best[active[better]] = trial.x[better]
        done[active[better & small]] = True
        going = ~(better & small) & (mu[active] < GIVE_UP)
        if not going.any():
            break
        if not better[going].all():
            linear = now.linearise(best[active]).pick(going)
        else:
            linear = trial if going.all() else trial.pick(going)
        if not going.all():
            active = active[going]
            now = problem.pick(active) if problem.batch else problem
    return Descent(best, count, done)


def one_step(problem: Problem, step: Step, x: Floats) -> SolverResult:
    """The result from x (B, n, ambient) of all that a linear problem needs, one step; what is singular stays."""
    count = np.ones(len(x), dtype=np.int64)
    try:
        dx = step(problem.linearise(x), np.zeros((*x.shape[:2], problem.space.dof)))
    except np.linalg.LinAlgError:
        return SolverResult(x, count)
    dx[~np.isfinite(dx).all(axis=(1, 2))] = 0.0
    return SolverResult(problem.space.retract(x, dx), count)


def minimise(problem: Problem, step: Step, x: Floats, max_iterations: int, tolerance: float) -> SolverResult:
    """The result from x (B, n, ambient) of one step where the problem is linear, else of `descend`."""
    if problem.linear and max_iterations:
        return one_step(problem, step, x)
    end = descend(problem, step, x, max_iterations, tolerance)
    return SolverResult(end.x, end.iterations)


def check_limits(max_iterations: int, tolerance: float) -> None:
    """InputError unless max_iterations is a whole number >= 0 and tolerance a number > 0."""
    if not isinstance(max_iterations, int | np.integer) or max_iterations < 0:
        raise InputError("max_iterations", repr(max_iterations), "must be a whole number >= 0", "Leave it out for 500.")
    if not isinstance(tolerance, float | int) or not tolerance > 0:
        raise InputError("tolerance", repr(tolerance), "must be a number > 0 (m)", "Leave it out for 1e-8.")


def _promised(problem: Problem, linear: Linear, dx: Floats) -> Floats:
    """(B,) cost that the linear model expects after the step, 1/2 |r + J dx|^2 in place of 1/2 |r|^2."""
    expected = linear.cost.copy()
    for factor, r, jacobians in zip(problem.factors, linear.residual, linear.by_node(problem.factors), strict=True):
        moved = sum((s @ dx[:, column, :, None])[..., 0] for s, column in zip(jacobians, factor.nodes.T, strict=True))
        expected += np.einsum("bmk,bmk->b", r + 0.5 * moved, np.broadcast_to(moved, r.shape))
    return expected


def _damping(mu: Floats, better: Bools, before: Floats, after: Floats, promised: Floats) -> Floats:
    """The next mu (B,): by the share of the promised decrease that came true, where it stands out from rounding."""
    decrease = before - promised
    telling = decrease > 1e-9 * before
    share = np.where(telling, (before - after) / np.where(telling, decrease, 1.0), 0.5)
    lower = np.where(mu > 1e-5, mu / 5.0, 0.0)
    kept = np.where(share > 0.75, lower, np.where(share < 0.25, np.maximum(4.0 * mu, 1e-2), mu))
    return np.where(better, kept, np.maximum(10.0 * mu, 1e-3))


def _try(step: Step, problem: Problem, linear: Linear, mu: Floats) -> tuple[Floats, Bools]:
    """The step, and for which realisations it is finite; a singular system counts as none."""
    damping = np.zeros((*linear.x.shape[:2], problem.space.dof))
    if mu.any():
        damping = mu[:, None, None] * np.maximum(diagonal(problem, linear), 1e-9)
    try:
        with np.errstate(all="ignore"):
            dx = step(linear, damping)
    except np.linalg.LinAlgError:
        return np.zeros_like(damping), np.zeros(len(linear.x), dtype=bool)
    finite = np.asarray(np.isfinite(dx).all(axis=(1, 2)))
    return np.where(finite[:, None, None], dx, 0.0), finite


def diagonal(problem: Problem, linear: Linear) -> Floats:
    """(B, n, dof) diagonal of J^T J."""
    total = np.zeros((*linear.x.shape[:2], problem.space.dof))
    for factor, jacobians in zip(problem.factors, linear.by_node(problem.factors), strict=True):
        for column, jacobian in zip(factor.nodes.T, jacobians, strict=True):
            np.add.at(total.swapaxes(0, 1), column, np.square(jacobian).sum(axis=-2).swapaxes(0, 1))
    return total

"""Levenberg-Marquardt: of B problems at once by any linear step, and of a single one by sparse factors and Hessians."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np

from ...arrays import Bools, Floats, Ints
from ...errors import InputError
from ..algebra.sparse import Sparse
from ..backend import SolverResult
from ..model.derivatives import Linear, Model
from ..model.problem import Problem

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
LEAST_DAMPING = 1e-9
"""Damping below which none is left: far below any diagonal it changes no digit of a step."""
HIDDEN = 1e-9
"""Share of the cost below which rounding hides how much of a promised decrease came true."""
FLAT = 1e-15
"""Share of the cost below which a promised decrease is rounding: no step can be judged there."""
OFF = 0.2
"""A share of the promised decrease this far from 1 casts doubt on J^T J."""
DOUBT = 2
"""Doubtful steps before the exact Hessian takes over."""
GROWTH, DECAY = 10.0, 5.0
"""Factors by which damping grows after a refused step and falls after a good one; two that share no power find the
middle where a step overshoots."""
FIRST = 1e-8
"""Damping once some is needed, relative to the diagonal: the smooth modes of a chain of thousands of poses, which need
it first, have that share of a pose's information."""
ROUNDED = 1e-18
"""Share of the cost, or of 1, whose promise ends the loop: some 1e-8 standard deviations to go, before the step that is
taken."""
LEAST_INFORMATION = 1e-9
"""1/m^2 or 1/rad^2: the scale of what no measurement holds."""
SLOW = 0.2
"""A promise above this share of the one before shows that J^T J converges slowly, which casts doubt, too."""
NEAR = 1e-3
"""Share of the cost from which on the exact Hessian makes the last steps."""
STILL = 12
"""Hidden steps in a row that end the loop: damping has fallen from FIRST to none, or the matrix is singular without."""


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
    problem: Problem,
    step: Step,
    x: Floats,
    max_iterations: int = MAX_ITERATIONS,
    tolerance: float = TOLERANCE,
) -> Descent:
    """Gauss-Newton steps, damped where the linear model does not hold (Levenberg-Marquardt with Marquardt's scaling).

    (J^T J + mu diag(J^T J)) dx = -J^T r, mu = 0 at first. A step that raises the cost is refused; mu then grows, and
    also where the cost falls by less than a quarter of what the model promised: plain Gauss-Newton overshoots for ever
    where the true curvature exceeds twice that of J^T J, as in range-only problems of flat geometry. A realisation
    leaves the batch when no point of it moves by more than `tolerance`, or where the promise is lost in rounding.

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
    with progress("solve") as counted:
        for _ in range(max_iterations):
            counted(float(linear.cost.sum()))
            dx, solved = _try(step, problem, linear, mu[active])
            count[active] += 1
            with np.errstate(all="ignore"):
                trial = now.linearise(problem.space.retract(linear.x, dx))
                small = solved & (np.abs(dx).max(axis=(1, 2)) <= np.where(mu[active] > 0, tolerance, near))
                better = solved & (trial.cost <= linear.cost * (1.0 + 1e-13)) | small & np.isfinite(trial.cost)
            promised = linear.cost - trial.cost if problem.linear else _promised(problem, linear, dx)
            telling = promised > HIDDEN * linear.cost
            share = np.where(telling, (linear.cost - trial.cost) / np.where(telling, promised, 1.0), 0.5)
            mu[active] = _damping(mu[active], better, share)
            best[active[better]] = trial.x[better]
            flat = solved & (promised <= FLAT * linear.cost) & (not problem.constraints)
            there = (better & small) | flat
            done[active[there]] = True
            going = ~there & (mu[active] < GIVE_UP)
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


def minimise(problem: Problem, step: Step, x: Floats, max_iterations: int, tolerance: float) -> SolverResult:
    """The result from x (B, n, ambient) of one step where the problem is linear, else of `descend`; what is singular
    stays."""
    if problem.linear and max_iterations:
        dx, _ = _try(step, problem, problem.linearise(x), np.zeros(len(x)))
        return SolverResult(problem.space.retract(x, dx), np.ones(len(x), dtype=np.int64))
    end = descend(problem, step, x, max_iterations, tolerance)
    return SolverResult(end.x, end.iterations)


def check_limits(max_iterations: int, tolerance: float) -> None:
    """InputError unless max_iterations is a whole number >= 0 and tolerance a number > 0."""
    if not isinstance(max_iterations, int | np.integer) or max_iterations < 0:
        raise InputError("max_iterations", repr(max_iterations), "must be a whole number >= 0", "Leave it out for 500.")
    if not isinstance(tolerance, float | int) or not tolerance > 0:
        raise InputError("tolerance", repr(tolerance), "must be a number > 0 (m)", "Leave it out for 1e-8.")


def _promised(problem: Problem, linear: Linear, dx: Floats) -> Floats:
    """(B,) decrease of the cost that the linear model expects of any step: 1/2 |r|^2 - 1/2 |r + J dx|^2."""
    promised = np.zeros(len(dx))
    for factor, r, jacobians in zip(problem.factors, linear.residual, linear.jacobian, strict=True):
        moved = sum((s @ dx[:, column, :, None])[..., 0] for s, column in zip(jacobians, factor.nodes.T, strict=True))
        promised -= np.einsum("bmk,bmk->b", r + 0.5 * moved, np.broadcast_to(moved, r.shape))
    return promised


def _damping(mu: Floats, better: Bools, share: Floats) -> Floats:
    """The next mu (B,) by the share of the promised decrease that came true; once there is some it moves by factors, so
    that the range below the first is tried, too."""
    lower = np.where(mu > LEAST_DAMPING, mu / 5.0, 0.0)
    kept = np.where(share > 0.75, lower, np.where(share < 0.25, np.where(mu > 0, 4.0 * mu, 1e-2), mu))
    return np.where(better, kept, np.where(mu > 0, 10.0 * mu, 1e-3))


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
    for factor, jacobians in zip(problem.factors, linear.jacobian, strict=True):
        for column, jacobian in zip(factor.nodes.T, jacobians, strict=True):
            np.add.at(total.swapaxes(0, 1), column, np.square(jacobian).sum(axis=-2).swapaxes(0, 1))
    return total


@dataclass(frozen=True, eq=False)
class Arrival:
    """Where the loop ended.

    Args:
        x: (n, ambient).
        iterations: factorisations.
        converged: the last step was below the tolerance, or what it promised is rounding.
        record: (iterations, 3) the cost before each, its damping, and which share of the promised decrease came true
            (NaN where the matrix was not positive definite).
        newton_steps: how many iterations used the exact Hessian.
    """

    x: Floats
    iterations: int
    converged: bool
    record: Floats
    newton_steps: int


def arrive(system: Sparse, x: Floats, max_iterations: int, tolerance: float) -> Arrival:
    """A minimum from x (n, ambient): (H + mu D) dx = -g, D the diagonal of J^T J, which scales by the geometry.

    H = J^T J, until two of its promises failed by more than a fifth or hardly fell, or the end is NEAR; then the exact
    Hessian, with which the last steps converge quadratically however large the residuals are. Where that is not
    positive definite J^T J takes over for some steps. mu is the multiplier of a trust region |D^1/2 dx|: it grows where
    less than a quarter of the promised decrease comes true and falls where more than three quarters do.

    References:
        More, The Levenberg-Marquardt algorithm, 1978; Nocedal and Wright, Numerical Optimization, section 10.3.
    """
    cholesky, mu, doubt = system.cholesky, 0.0, 0
    model: Model = "gauss-newton"
    record: list[tuple[float, float, float]] = []
    newton, converged, last, still = 0, False, np.inf, 0
    cost, gradient, values = undamped = system.quadratic(x, "gauss-newton")
    with progress("solve") as counted:
        while len(record) < max_iterations and not converged and mu < GIVE_UP:
            counted(cost)
            newton += model == "newton"
            damping = _marquardt(system, undamped[2], mu)
            definite = cholesky.factor(values if damping is None else _damped(system, values, damping))
            if not definite:
                record.append((cost, mu, np.nan))
                if model == "newton":
                    doubt, model = -DOUBT, "gauss-newton"
                    cost, gradient, values = undamped = system.quadratic(x, model)
                else:
                    mu = _grown(mu)
                continue
            dx = -cholesky.solve(gradient)
            promised = 0.5 * float((0.0 if damping is None else damping @ (dx * dx)) - gradient @ dx)
            there = system.retract(x, dx)
            near = promised <= NEAR * cost and doubt >= 0
            used: Model = "newton" if near else model
            trial = system.quadratic(there, used)
            after = trial[0]
            hidden = promised <= HIDDEN * cost and after <= cost * (1.0 + 1e-13)
            share = 1.0 if hidden else (cost - after) / promised
            still = still + 1 if hidden else 0
            record.append((cost, mu, share))
            converged = (
                promised <= ROUNDED * max(cost, 1.0)
                or still > STILL
                or (hidden and np.abs(dx).max(initial=0.0) <= tolerance)
            )
            if not share > 0.0:
                mu = _grown(mu)
                continue
            x = there
            mu = _next(mu, share)
            if model == "gauss-newton":
                off = abs(share - 1.0) > OFF or (record[-1][1] == 0.0 and promised > SLOW * last)
                doubt = doubt + 1 if doubt < 0 or off else max(doubt - 1, 0)
                doubt = DOUBT if near else doubt
                model = "newton" if doubt >= DOUBT else model
            last = promised
            if not converged:
                cost, gradient, values = trial if model == used else system.quadratic(x, model)
                undamped = (cost, gradient, values) if model == "gauss-newton" else undamped
    return Arrival(x, len(record), bool(converged), np.array(record).reshape(-1, 3), newton)


def _grown(mu: float) -> float:
    return GROWTH * mu if mu > 0.0 else FIRST


def _next(mu: float, share: float) -> float:
    if share > 0.75:
        return mu / DECAY if mu > LEAST_DAMPING else 0.0
    return _grown(mu) if share < 0.25 else mu


def _marquardt(system: Sparse, values: Floats, mu: float) -> Floats | None:
    """(m,) mu times the diagonal of J^T J of `values`, and 1 where that is zero: what nothing measures stays where it
    is. None where all is zero."""
    diagonal = values[system.entries.diagonal]
    unmeasured = diagonal == 0.0
    if not mu and not unmeasured.any():
        return None
    return np.asarray(mu * np.maximum(diagonal, LEAST_INFORMATION) + unmeasured)


def _damped(system: Sparse, values: Floats, damping: Floats) -> Floats:
    whole = values.astype(np.float64)
    whole[system.entries.diagonal] += damping
    return whole


DELAY = 2.0
"""s before the bar is shown: most solves are over by then, and a bar takes longer to make than a small one."""


@contextmanager
def progress(name: str) -> Iterator[Callable[[float], None]]:
    """A function that counts a step and takes its cost.

    >>> with progress("solve") as step:
    ...     step(1.5)
    """
    began, count, bars = perf_counter(), 0, list[Any]()

    def step(cost: float) -> None:
        nonlocal count
        count += 1
        if not bars and perf_counter() - began > DELAY:
            from tqdm import tqdm

            bars.append(tqdm(desc=name, unit=" steps", initial=count - 1))
        for bar in bars:
            bar.set_postfix_str(f"cost {cost:.6g}", refresh=False)
            bar.update()

    try:
        yield step
    finally:
        for bar in bars:
            bar.close()

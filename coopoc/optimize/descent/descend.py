"""Levenberg-Marquardt: the outer loop that every backend with a linear step shares, for B problems at once."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any

import numpy as np

from ...arrays import Bools, Floats, Ints
from ...errors import InputError
from ..backend import SolverResult
from ..model.linear import Linear
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


@dataclass(frozen=True, eq=False)
class Descent:
    """Where the loop ended.

    Args:
        x: (B, n, ambient).
        iterations: (B,) linear steps taken.
        converged: (B,) the last step was below the tolerance.
        record: (iterations, 3) of a single problem: the cost before each step, its damping, and which share of the
            promised decrease came true; empty for B realisations.
    """

    x: Floats
    iterations: Ints
    converged: Bools
    record: Floats = field(default_factory=lambda: np.empty((0, 3)))


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
    record: list[tuple[float, float, float]] = []
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
            if problem.batch is None:
                record.append((linear.cost[0], mu[0], share[0]))
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
    return Descent(best, count, done, np.array(record).reshape(-1, 3))


def minimise(problem: Problem, step: Step, x: Floats, max_iterations: int, tolerance: float) -> SolverResult:
    """The result from x (B, n, ambient) of one step where the problem is linear, else of `descend`; what is singular
    stays."""
    if problem.linear and max_iterations:
        dx, _ = _try(step, problem, problem.linearise(x), np.zeros(len(x)))
        return SolverResult(problem.space.retract(x, dx), np.ones(len(x), dtype=np.int64))
    end = descend(problem, step, x, max_iterations, tolerance)
    return SolverResult(end.x, end.iterations, extras={"record": end.record})


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

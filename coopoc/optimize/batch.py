"""solve_batch: B noise realisations of one problem at once, by gauss-newton or by one solver of a library."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from ..arrays import Bools, Floats, Ints
from ..errors import InputError
from .arrowhead import Arrow, marginals, structure
from .assess import bounded
from .descend import Descent, Step, descend, one_step
from .initial import initial_guess, somewhere
from .normal import normal_equations
from .problem import Problem
from .solve import POSITION_TOLERANCE, backend_module, second_way

CHUNK = 40_000
"""Blocks of 3x3 numbers that one chunk may hold, so that a batch stays in the cache."""


@dataclass(frozen=True, eq=False)
class Batch:
    """Solutions of B realisations: x (B, n, width), covariance (B, n, dof, dof), the others (B,).

    again: the backend's first way did not converge, and its second was taken (see `solve`).
    Not converged: the last step was still long, or a point is free; then the covariance is NaN. Unlike `solve` it does
    not look whether the stationary point is a saddle.
    """

    x: Floats
    covariance: Floats
    cost: Floats
    iterations: Ints
    converged: Bools
    again: Bools


def solve_batch(problem: Problem, backend: str = "gauss-newton", **options: Any) -> Batch:
    """Minima of all realisations, each as `solve` finds it.

    What they share is made once: a backend's solver of their structure, and the check of its answers.

    Args:
        problem: with a batch axis B (a single problem is a batch of one).
        backend, options: as in `solve`.

    Raises:
        InputError: no measurements, constraints, an unknown backend or option. MissingLibraryError: no such library.

    >>> problem = Problem(("a",)).add("position", [["a"]], np.arange(6.0).reshape(2, 1, 3), std=1.0)
    >>> solve_batch(problem).x.shape
    (2, 1, 3)
    """
    if not problem.factors:
        raise InputError("problem", repr(problem), "has no measurements", "Add factors: problem.add(...).")
    if problem.constraints:
        mend = 'Use solve(problem.pick(run), "casadi").'
        raise InputError("problem", repr(problem), "has constraints, which a batch cannot hold", mend)
    run = _runner(problem, backend, options)
    scheme, frame = structure(problem)
    count = problem.batch or 1
    per = max(1, CHUNK // (len(scheme.rows) + frame.group.size * max(len(frame.hub), 1)))
    parts = []
    for first in range(0, count, per):
        part = problem.pick(np.arange(first, min(first + per, count))) if problem.batch else problem
        end = run(part)
        linear = part.linearise(end.x)
        blocks, gradient = normal_equations(scheme, linear, [f.nodes for f in part.factors])
        cov, left = _marginals(frame, blocks, gradient, linear.many)
        sound = bounded(scheme, blocks, cov)
        cov[~sound] = np.nan
        there = end.converged | (np.abs(left).max(axis=(1, 2)) <= POSITION_TOLERANCE)
        parts.append((end.x, cov, linear.cost, end.iterations, there & sound, np.zeros(len(sound), dtype=bool)))
    found = Batch(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    other = None if found.converged.all() else second_way(backend_module(backend, options), problem, options)
    return found if other is None else _repeated(found, problem, backend, other)


def _repeated(found: Batch, problem: Problem, backend: str, options: dict[str, Any]) -> Batch:
    """The batch with what did not converge solved with other options."""
    which = np.flatnonzero(~found.converged)
    better = solve_batch(problem.pick(which) if problem.batch else problem, backend, **options)
    for field in fields(Batch):
        getattr(found, field.name)[which] = getattr(better, field.name)
    found.again[which] = True
    return found


def _runner(problem: Problem, backend: str, options: dict[str, Any]) -> Callable[[Problem], Descent]:
    """From some realisations to where they end."""
    module = backend_module(backend, options)
    if not hasattr(module, "linear_step") or "optimizer" in options:
        return lambda part: _claimed(module, part, options)
    limits = {name: options[name] for name in ("max_iterations", "tolerance") if name in options}
    step = module.linear_step(problem, **{name: v for name, v in options.items() if name not in limits})
    if problem.linear and backend != "gauss-newton":
        return lambda part: _one_step(part, step)
    return lambda part: descend(part, step, initial_guess(part), **limits)


def _one_step(part: Problem, step: Step) -> Descent:
    """One step, whose answer is not said to have converged."""
    x = one_step(part, step, somewhere(part))
    return Descent(x, np.ones(len(x), dtype=np.int64), np.zeros(len(x), dtype=bool))


def _claimed(module: Any, part: Problem, options: dict[str, Any]) -> Descent:
    """Where a backend ends, all realisations together if it can; whether it has converged it is not asked."""
    start = initial_guess(part)
    if hasattr(module, "each"):
        ended = module.each(part, start, **options)
    else:
        ended = [module.build(part.pick(b) if part.batch else part, **options)(x) for b, x in enumerate(start)]
    found = np.stack([each.x for each in ended])
    return Descent(found, np.array([each.iterations for each in ended]), np.zeros(len(found), dtype=bool))


def _marginals(frame: Arrow, blocks: Floats, gradient: Floats, many: bool) -> tuple[Floats, Floats]:
    """Marginals and Gauss-Newton steps of the realisations, NaN where one is singular."""
    try:
        return marginals(frame, blocks, gradient, many)
    except np.linalg.LinAlgError:
        if len(blocks) == 1:
            return np.full((*gradient.shape, blocks.shape[-1]), np.nan), np.full_like(gradient, np.nan)
        each = [_marginals(frame, a[None], b[None], many) for a, b in zip(blocks, gradient, strict=True)]
        return np.concatenate([cov for cov, _ in each]), np.concatenate([dx for _, dx in each])

"""solve_batch: B noise realisations of one problem at once, by gauss-newton."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import Bools, Floats, Ints
from ..errors import InputError
from .arrowhead import Arrow, marginals, structure
from .assess import bounded
from .backends.gauss_newton import linear_step
from .descend import MAX_ITERATIONS, TOLERANCE, descend
from .initial import initial_guess
from .normal import normal_equations
from .problem import Problem

CHUNK = 40_000
"""Blocks of 3x3 numbers that one chunk may hold, so that a batch stays in the cache."""


@dataclass(frozen=True, eq=False)
class Batch:
    """Solutions of B realisations: x (B, n, width), covariance (B, n, dof, dof), the others (B,).

    Not converged: the last step was still long, or a point is free; then the covariance is NaN. Unlike `solve` it does
    not look whether the stationary point is a saddle.
    """

    x: Floats
    covariance: Floats
    cost: Floats
    iterations: Ints
    converged: Bools


def solve_batch(problem: Problem, max_iterations: int = MAX_ITERATIONS, tolerance: float = TOLERANCE) -> Batch:
    """Minima of all realisations, each as `solve` finds it.

    Args:
        problem: with a batch axis B (a single problem is a batch of one).
        max_iterations: of Gauss-Newton steps. tolerance: m, largest move of a point in the last step.

    Raises:
        InputError: no measurements, or constraints.
    >>> problem = Problem(("a",)).add("position", [["a"]], np.arange(6.0).reshape(2, 1, 3), std=1.0)
    >>> solve_batch(problem).x.shape
    (2, 1, 3)
    """
    if not problem.factors:
        raise InputError("problem", repr(problem), "has no measurements", "Add factors: problem.add(...).")
    if problem.constraints:
        mend = 'Use solve(problem.pick(run), "casadi").'
        raise InputError("problem", repr(problem), "has constraints, which a batch cannot hold", mend)
    step = linear_step(problem)
    scheme, frame = structure(problem)
    count = problem.batch or 1
    per = max(1, CHUNK // (len(scheme.rows) + frame.group.size * max(len(frame.hub), 1)))
    parts = []
    for first in range(0, count, per):
        part = problem.pick(np.arange(first, min(first + per, count))) if problem.batch else problem
        end = descend(part, step, initial_guess(part), max_iterations, tolerance)
        linear = part.linearise(end.x)
        blocks, _ = normal_equations(scheme, linear, [f.nodes for f in part.factors])
        cov = _marginals(frame, blocks)
        sound = bounded(scheme, blocks, cov)
        cov[~sound] = np.nan
        parts.append((end.x, cov, linear.cost, end.iterations, end.converged & sound))
    return Batch(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _marginals(frame: Arrow, blocks: Floats) -> Floats:
    """Marginals of the realisations, NaN where one is singular."""
    try:
        return marginals(frame, blocks)
    except np.linalg.LinAlgError:
        if len(blocks) == 1:
            return np.full((1, len(frame.hub) + int((frame.group >= 0).sum()), *blocks.shape[-2:]), np.nan)
        return np.concatenate([_marginals(frame, block[None]) for block in blocks])

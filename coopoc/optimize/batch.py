"""solve_batch: B noise realisations of one problem at once, by one solver of their structure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arrays import Bools, Floats, Ints, instance
from ..errors import InputError
from ..short_repr import short_repr
from .algebra.star import is_star, star_at
from .assess.assess import INFLATION, assess
from .backend import Backend, require_backend
from .model.problem import Problem
from .solve import POSITION_TOLERANCE
from .starts.initial import initial_guess, somewhere

CHUNK = 40_000
"""Nodes of measurements that one chunk may hold, so that a batch stays in the cache."""


@dataclass(frozen=True, eq=False)
class Batch:
    """Solutions of B realisations: x (B, n, ambient), covariance (B, n, dof, dof), the others (B,).

    converged: a Gauss-Newton step from x would move no node by more than the tolerance of the options (at least
    1e-6 m); where a node is unobservable it is False and the covariance NaN. Unlike `solve` it does not check whether
    the stationary point is a saddle.
    """

    x: Floats
    covariance: Floats
    cost: Floats
    iterations: Ints
    converged: Bools

    __repr__ = short_repr


def solve_batch(problem: Problem, backend: str | Backend = "gauss-newton", **options: Any) -> Batch:
    """Minima of all realisations, each as `solve` finds it.

    The solver of their structure and the pattern of the checks are made once. A backend that is not batched is called
    once per realisation.

    Args:
        problem: with a batch axis B (a single problem is a batch of one).
        backend: as in `solve`.
        options: of the backend.

    Raises:
        InputError: no measurements, constraints, an unknown backend or option, a problem beyond its capabilities.
        MissingLibraryError: the backend's library is not installed.

    >>> problem = Problem(("a",)).add("position", [["a"]], np.arange(6.0).reshape(2, 1, 3), std=1.0)
    >>> solve_batch(problem).x.shape
    (2, 1, 3)
    """
    solver_backend = require_backend(backend)
    instance("problem", problem, Problem)
    if not problem.factors:
        raise InputError("problem", repr(problem), "has no measurements", "Add factors: problem.add(...).")
    if problem.constraints:
        hint = "Solve one realisation after the other: solve(problem.pick(run), ...)."
        raise InputError("problem", repr(problem), "has constraints, which a batch cannot hold", hint)
    solver = solver_backend.solver(problem, options)
    count, reach = problem.batch or 1, max(POSITION_TOLERANCE, options.get("tolerance", 0.0))
    per = max(1, CHUNK // sum(factor.nodes.size for factor in problem.factors))
    parts = []
    for first in range(0, count, per):
        part = problem.pick(np.arange(first, min(first + per, count))) if problem.batch else problem
        end = solver(part, (somewhere if part.linear else initial_guess)(part))
        cost, cov, left = (_checked_stars if is_star(part) else _checked)(part, end.x)
        there = ~np.isnan(left) & (left <= reach)
        parts.append((end.x, cov, cost, end.iterations, there))
    return Batch(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _checked(problem: Problem, x: Floats) -> tuple[Floats, Floats, Floats]:
    """Cost, covariance and largest move of a Gauss-Newton step of each realisation; NaN where one is unobservable."""
    singles = problem.realisations
    assessments = [assess(single, at) for single, at in zip(singles, x, strict=True)]
    cov = np.stack([assessment.covariance for assessment in assessments])
    cost = np.array([assessment.cost for assessment in assessments])
    return cost, cov, np.array([assessment.remaining for assessment in assessments])


def _checked_stars(problem: Problem, x: Floats) -> tuple[Floats, Floats, Floats]:
    """The same of stars, all at once."""
    linear = problem.linearise(x)
    star = star_at(problem, linear)
    dx, marginals = star.solve()
    cov = marginals()
    inflation = np.einsum("bnii,bnii->bni", star.own, cov)
    sound = ((inflation > 0) & (inflation < INFLATION)).all(axis=(1, 2))
    cov[~sound], left = np.nan, np.abs(dx).max(axis=(1, 2))
    return linear.cost, cov, np.where(sound, left, np.nan)

"""SOLVED is a minimum: the curvature against CasADi's own Hessian, and a saddle that every backend stops at."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.linalg import eigvalsh
from oracles.whitened import hessian

from coopoc.optimize import Problem, SolveError, Status, backends, solve
from coopoc.optimize.starts import race


@pytest.mark.parametrize("backend", sorted(set(backends()) - {"cvxpy"}))
def test_a_saddle_is_not_solved(backend):
    """An ego whose fix lies on the line of 10 m between two others, which are both 10 m away: it stands beside it."""
    fixes, stds = [[0, 0, 0], [-5, 0, 0], [5, 0, 0]], np.outer([10, 0.1, 0.1], np.ones(3))
    problem = Problem([*"cab"]).add("position", range(3), fixes, std=stds)
    problem = problem.add("range", [(0, 1), (0, 2)], [10.0, 10.0], std=0.5)
    freely = solve(problem, backend)  # without an x0 its start is left, to one side or the other
    assert freely.notes[0] == race.ELSEWHERE
    problem = replace(problem, x0=problem.factors[0].z)
    stuck = solve(problem, backend, throw=False)
    assert stuck.status is Status.SADDLE
    assert eigvalsh(hessian(problem, stuck.x)).min() < -0.1
    with pytest.raises(SolveError, match="to the side"):
        solve(problem, backend)
    assert freely.cost < stuck.cost / 100

"""SOLVED is a minimum: the curvature against CasADi's own Hessian, and a saddle that every backend stops at."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.linalg import eigvalsh
from oracles.whitened import hessian

from coopoc.optimize import Problem, SolveError, Status, backends, solve
from coopoc.optimize.assess.assess import newton_decrease
from coopoc.optimize.starts import race


def tangle(seed):
    """Every nonlinear kind, measured far from where the points are: curvature of either sign."""
    rng = np.random.default_rng(seed)
    problem = Problem([*"abcd"], x0=rng.normal(size=(4, 3)) * 10)
    problem = problem.add("position", list("abcd"), problem.x0, std=rng.uniform(2, 6))
    problem = problem.add("range", [("a", "b"), ("c", "d")], rng.uniform(5, 30, (2, 1)), std=2.0)
    problem = problem.add("spherical", ("b", "c"), [rng.uniform(5, 30), 0.3, 1.4], std=[3.0, 0.6, 0.6])
    root = np.tril(rng.uniform(0.2, 0.5, (3, 3)))
    problem = problem.add("spherical", ("d", "a"), [rng.uniform(5, 30), 2.0, 1.7], sqrt_information=root)
    return problem.add("azimuth", ("a", "c"), 1.0, std=0.5).add("inclination", ("b", "d"), 1.5, std=0.5)


def test_the_sign_of_the_curvature_is_that_of_casadis_hessian():
    signs = []
    for seed in range(40):
        problem = tangle(seed)
        lowest = eigvalsh(hessian(problem, problem.x0)).min()
        assert abs(lowest) > 1e-4
        assert (newton_decrease(problem, problem.x0) is not None) == (lowest > 0)
        signs.append(lowest > 0)
    assert 5 < sum(signs) < 35


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

"""Graphs of poses, landmarks and ranges: that the loop arrives, from which start, and that no status lies."""

from __future__ import annotations

import numpy as np
import pytest
from random_graphs import random_graph
from scipy.optimize import least_squares

from coopoc.optimize import Problem, Status, solve
from coopoc.optimize.curvature import newton_decrease
from coopoc.optimize.graphs import from_graph
from coopoc.optimize.local_problem import LocalProblem


def flat_valley() -> Problem:
    """A point whose ranges from afar leave it nearly free across: J^T J has little of the curvature there."""
    names = ("a", "b", "p")
    problem = Problem(names, x0=np.array([[-100.0, 0.0], [100.0, 0.0], [3.0, 4.0]]), dimension=2, fixed=("a", "b"))
    return problem.add("range", [("a", "p"), ("b", "p")], [100.5, 100.5], std=0.1)


@pytest.mark.parametrize("backend", ["gauss-newton", "gtsam", "osqp"])
def test_a_record_tells_every_iteration(backend: str) -> None:
    found = solve(flat_valley(), backend)
    record = found.extras["record"]
    assert record.shape == (found.iterations, 3)
    assert np.diff(record[:, 0]).max() <= 0.0
    assert record[0, 0] == pytest.approx(flat_valley().cost(flat_valley().x0))


def test_a_newton_step_promises_the_square_of_its_decrement() -> None:
    """Against the dense Hessian by differences of the gradient."""
    problem = from_graph(random_graph(11, steps=8, landmarks=2, ranges=12, seen=8, loops=3), start="file")
    local = LocalProblem(problem, problem.x0)

    def gradient(v: np.ndarray) -> np.ndarray:
        return local.jacobian(v).T @ local.residual(v)

    step = 1e-5 * np.eye(local.size)
    H = np.array([(gradient(e) - gradient(-e)) / 2e-5 for e in step])
    g = gradient(np.zeros(local.size))
    assert np.linalg.eigvalsh(H).min() > 0
    assert newton_decrease(problem, problem.x0) == pytest.approx(0.5 * g @ np.linalg.solve(H, g), rel=1e-5)


@pytest.mark.parametrize("seed", [101, 102])
def test_what_is_solved_is_scipys_minimum(seed: int) -> None:
    problem = from_graph(random_graph(seed, steps=30, ranges=60))
    found = solve(problem)
    local = LocalProblem(problem, found.x)
    theirs = least_squares(
        lambda v: local.residual(v), np.zeros(local.size), lambda v: local.jacobian(v).toarray(), xtol=1e-14, ftol=1e-15
    )
    assert found.status is Status.SOLVED
    assert theirs.cost == pytest.approx(found.cost, rel=1e-9)
    assert np.abs(theirs.x).max() < 1e-5


def test_a_step_that_stops_early_is_not_solved() -> None:
    problem = from_graph(random_graph(103, steps=30, ranges=60, turn_std=0.1))
    assert solve(problem, throw=False, max_iterations=2).status is Status.MAX_ITERATIONS

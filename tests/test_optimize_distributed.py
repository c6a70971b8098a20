"""Graphs solved by their robots, against the whole solved at once: cost, answer, bytes, losses, outliers."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from random_graphs import random_graph
from scipy.optimize import least_squares

from coopoc import InputError
from coopoc.formats.graph import RangeEdges
from coopoc.optimize import Loss, Problem, Status, solve
from coopoc.optimize.distributed import owners, solve_distributed
from coopoc.optimize.graph_problems import from_graph


def chain(robots: int = 3, length: int = 4) -> Problem:
    """Points of several robots, each with a fix at its first, displacements along and between them: linear."""
    rng, names = np.random.default_rng(0), [f"{chr(97 + r)}{k}" for r in range(robots) for k in range(length)]
    problem = Problem(names, x0=rng.normal(size=(len(names), 2)), dimension=2)
    problem = problem.add("position", names[::length], 10 * rng.normal(size=(robots, 2)), std=1.0)
    along = [(a, b) for a, b in pairwise(names) if a[0] == b[0]]
    across = [(f"{chr(97 + r)}{k}", f"{chr(98 + r)}{k}") for r in range(robots - 1) for k in range(length)]
    problem = problem.add("displacement", along, rng.normal(size=(len(along), 2)), std=0.3)
    return problem.add("displacement", across, rng.normal(size=(len(across), 2)), std=0.2)


def meeting(seed: int, dimension: int = 2, ranges: bool = False) -> Problem:
    """Three robots that measure one another's poses, and landmarks and distances if wanted, from chained odometry."""
    graph = random_graph(
        seed, dimension, robots=3, steps=20, landmarks=3 * ranges, loops=30, ranges=40 * ranges, seen=20 * ranges
    )
    return from_graph(graph if ranges else replace(graph, ranges=RangeEdges()), start="odometry")


def test_a_linear_problem_ends_at_numpys_least_squares() -> None:
    problem = chain()
    r, J = problem.whiten(np.array(problem.x0))
    step = np.linalg.lstsq(J.toarray(), -r)[0]
    found = solve_distributed(problem, rounds=400, rho=0.1)
    assert found.x == pytest.approx(problem.x0 + step.reshape(-1, 2), abs=1e-6)
    assert found.apart[-1] < 1e-6
    assert found.robots == ("a", "b", "c")


@pytest.mark.parametrize("dimension", [2, pytest.param(3, marks=pytest.mark.slow)])
@pytest.mark.parametrize("ranges", [False, True])
def test_robots_end_where_the_whole_is_solved(dimension: int, ranges: bool) -> None:
    """Referee: SciPy's least squares on the residuals, from the central answer; and the central answer itself."""
    problem = meeting(1, dimension, ranges)
    central = solve(problem)
    flat = np.flatnonzero(problem.movable.ravel())

    def residual(step: np.ndarray) -> np.ndarray:
        whole = np.zeros(problem.movable.size)
        whole[flat] = step
        return problem.whiten(problem.space.retract(central.x, whole.reshape(problem.movable.shape)))[0]

    best = least_squares(residual, np.zeros(len(flat)), xtol=1e-12, ftol=1e-12).cost
    found = solve_distributed(problem, rounds=300)
    assert found.cost[0] > 2 * best
    assert best * (1 - 1e-9) <= found.cost[-1] < best * (1 + 2e-3)
    assert problem.cost(found.x) == pytest.approx(found.cost[-1], rel=1e-9)
    assert np.abs(problem.space.position(found.x - central.x)).max() < 0.1


def test_lost_exchanges_slow_it_down_and_no_more() -> None:
    problem = chain()
    best = solve(problem).cost
    lossless, lossy = (solve_distributed(problem, rounds=100, loss=p, seed=1) for p in (0.0, 0.5))
    assert best < lossless.cost[60] < lossy.cost[60]
    assert solve_distributed(problem, rounds=1000, loss=0.5).cost[-1] == pytest.approx(best, rel=1e-9)
    again = solve_distributed(problem, rounds=100, loss=0.5, seed=1)
    assert np.array_equal(lossy.x, again.x)


def test_bytes_are_those_of_the_copies() -> None:
    """Two points of another robot in the plane: two numbers each, eight bytes, both ways, in one message each way."""
    problem = Problem(("a0", "b0", "b1"), x0=np.zeros((3, 2)), dimension=2)
    problem = problem.add("position", ["a0", "b0", "b1"], np.eye(3)[:, :2], std=1.0)
    problem = problem.add("displacement", [("a0", "b0"), ("a0", "b1"), ("b0", "b1")], np.ones((3, 2)), std=1.0)
    found = solve_distributed(problem, rounds=5)
    assert found.messages.tolist() == [0, 2, 4, 6, 8, 10]
    assert found.sent_bytes.tolist() == [64 * k for k in range(6)]


def test_a_landmark_with_a_prior_goes_to_the_robot_that_measured_it_first() -> None:
    problem = from_graph(random_graph(3, robots=2, steps=20, landmarks=4, loops=0, ranges=20, seen=0, priors=True))
    pairs = np.concatenate([factor.nodes for factor in problem.factors if factor.nodes.shape[1] == 2])
    for node, (name, owner) in enumerate(zip(problem.names, owners(problem), strict=True)):
        first = pairs[(pairs == node).any(axis=1)][0]
        assert owner == (name[0] if node in problem.poses else problem.names[first[first != node][0]][0])


def test_a_robust_loss_rejects_what_one_robot_measured_wrongly() -> None:
    problem = meeting(4)
    factor = problem.factors[0]
    wrong = int(np.flatnonzero(np.abs(np.diff(factor.nodes[:, :2])) > 1)[0])
    z = np.array(factor.z)
    z[wrong, :2] += 20.0
    robust = replace(problem, factors=(replace(factor, z=z, loss=Loss("geman-mcclure", 5.0)),))
    central = solve(robust, throw=False)
    assert central.status is Status.SOLVED
    found = solve_distributed(robust, rounds=300)
    assert found.cost[-1] == pytest.approx(central.cost, rel=2e-3)
    plain = solve(replace(problem, factors=(replace(factor, z=z),)))
    assert np.abs(found.x - central.x).max() < 0.1 * np.abs(plain.x - central.x).max()


@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        ({"x0": None}, {}, "with an x0"),
        ({}, {"rho": 0.0}, "rho = 0.0: must be > 0"),
        ({}, {"loss": 1.0}, "loss = 1.0"),
        ({}, {"loss": float("nan")}, "loss = nan"),
        ({}, {"rounds": 1.5}, "rounds = 1.5"),
        ({}, {"steps": 0}, "steps = 0"),
        ({}, {"seed": "x"}, "seed = 'x'"),
        ({}, {"owner": "ab"}, "owner = 2 labels: must be 12"),
    ],
)
def test_what_it_cannot_do_is_refused(change: dict[str, None], options: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        solve_distributed(replace(chain(), **change), **options)

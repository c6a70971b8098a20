"""casadi: before any refinement by us it ends where gauss-newton and SciPy end; one programme serves a structure."""

from __future__ import annotations

from dataclasses import replace

import casadi
import numpy as np
import pytest
from random_graphs import random_graph
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from coopoc import V2X, Fleet, InputError, Sensors, observe
from coopoc.optimize import Loss, Problem, Status, solve
from coopoc.optimize.backends.casadi import programme
from coopoc.optimize.graph_problems import Objective, from_graph
from coopoc.optimize.model.derivatives import cayley
from coopoc.optimize.starts.initial import initial_guess
from coopoc.world.recording import Recording

ROBUST = [Loss("huber", 1.0), Loss("cauchy", 2.0), Loss("geman-mcclure", 3.0)]


@pytest.fixture(scope="module")
def dense(formation: Fleet) -> Recording:
    return observe(formation.between(0, 40), Sensors.paper_scenario2(), V2X.ideal(10), runs=2, observers=[0])


def graph(dimension: int, objective: Objective) -> Problem:
    """A small graph of poses, landmarks and ranges from its odometry."""
    return from_graph(random_graph(21, dimension, steps=8, landmarks=2, ranges=12), objective, "odometry")


def ranges_only(seed: int) -> Problem:
    rng = np.random.default_rng(seed)
    truth = np.concatenate([np.zeros((1, 3)), rng.uniform(-25, 25, (8, 3)) * [1, 1, 0.2]])
    names = tuple("abcdefghi")
    problem = Problem(names, separator=(0,)).add("position", names, truth + rng.normal(0, 3, truth.shape), std=3.0)
    z = np.linalg.norm(truth[1:], axis=1) + rng.normal(0, 0.5, 8)
    return problem.add("range", [("a", name) for name in names[1:]], z[:, None], std=0.5)


def robust(problem: Problem, loss: Loss) -> Problem:
    return replace(problem, factors=tuple(replace(f, loss=loss) for f in problem.factors))


CASES = {
    "snapshot": lambda rec: Problem.from_snapshot(rec, 10, 0, 1),
    "window": lambda rec: Problem.from_window(rec, 20, 0, 5),
    "full roots": lambda rec: Problem.from_snapshot(rec, 5, 0).add(
        "displacement", (0, 1), [20.0, 3.0, 0.0], sqrt_information=[[2, 0, 0], [0.5, 1, 0], [0.1, 0.2, 1]]
    ),
    "ranges only": lambda rec: ranges_only(1),
    "plane graph": lambda rec: graph(2, "geodesic"),
    "space graph": lambda rec: graph(3, "geodesic"),
    "chordal graph": lambda rec: graph(3, "chordal"),
    **{
        f"snapshot {loss.name}": lambda rec, loss=loss: robust(Problem.from_snapshot(rec, 10, 0), loss)
        for loss in ROBUST
    },
}


@pytest.mark.parametrize("case", CASES)
def test_it_ends_where_gauss_newton_ends(dense: Recording, case: str) -> None:
    problem = CASES[case](dense)
    ours, theirs = solve(problem), solve(problem, "casadi")
    assert theirs.cost == pytest.approx(ours.cost, rel=1e-9)
    assert theirs.x == pytest.approx(ours.x, abs=1e-6)
    assert theirs.covariance == pytest.approx(ours.covariance, abs=1e-6)
    assert theirs.extras["return_status"] in (
        "Solve_Succeeded",
        "Solved_To_Acceptable_Level",
        "Search_Direction_Becomes_Too_Small",
    )
    assert theirs.extras["rounds"] == (2 if problem.poses else 1)


def test_a_structure_is_built_once(dense: Recording) -> None:
    programme.cache_clear()
    for run in (0, 1):
        for step in (3, 10):
            solve(Problem.from_snapshot(dense, step, 0, run), "casadi")
    assert programme.cache_info()[:2] == (3, 1)
    problem = Problem.from_snapshot(dense, 3, 0)
    solve(replace(problem, x0=solve(problem).x + 0.1), "casadi")
    assert programme.cache_info()[:2] == (4, 1)
    for other in (
        robust(problem, ROBUST[0]),
        problem.constrain("position", 0, [1, *[-np.inf] * 2], [1, *[np.inf] * 2]),
        replace(problem, x0=solve(problem).x, fixed=(1,)),
    ):
        before = programme.cache_info().misses
        solve(other, "casadi")
        assert programme.cache_info().misses == before + 1


@pytest.mark.parametrize("start", [None, 20.0])
def test_ranges_end_where_scipy_ends(start: float | None) -> None:
    """From the linear start and from 20 m off; SciPy's trust region may go elsewhere from there."""
    for seed in range(12):
        problem, rng = ranges_only(seed), np.random.default_rng(seed)
        if start is not None:
            problem = replace(problem, x0=problem.factors[0].z + rng.normal(0, start, (9, 3)))
        found = solve(problem, "casadi")
        assert found.status is Status.SOLVED
        if start is None:
            scipys = least_squares(
                lambda v, p=problem: p.whiten(v.reshape(9, 3))[0],
                initial_guess(problem).ravel(),
                lambda v, p=problem: p.whiten(v.reshape(9, 3))[1].toarray(),
                xtol=1e-15,
                ftol=1e-15,
            )
            assert found.cost == pytest.approx(scipys.cost, rel=1e-9)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"max_iterations": -1}, "must be a whole number"),
        ({"tolerance": 0}, "must be a number > 0"),
    ],
)
def test_wrong_options(options: dict[str, object], words: str) -> None:
    with pytest.raises(InputError, match=words):
        solve(ranges_only(0), "casadi", **options)


def test_a_truncated_loss_is_refused_with_the_way_out() -> None:
    with pytest.raises(InputError, match=r"loss truncated: cannot be solved by casadi, only by .*gauss-newton"):
        solve(robust(ranges_only(0), Loss("truncated", 3.0)), "casadi")


@pytest.mark.parametrize("w", [(0.3, -0.2, 0.9), (1e-9, 0.0, 0.0), (-2.0, 1.0, 3.0)])
def test_steps_of_a_rotation_are_scipys(w: tuple[float, float, float]) -> None:
    """Cayley's map turns about w by 2 atan(|w| / 2), to first order by |w|."""
    size = float(np.linalg.norm(w))
    wanted = Rotation.from_rotvec(2.0 * np.arctan(size / 2.0) * np.array(w) / size).as_matrix()
    found = np.array([[float(entry) for entry in row] for row in cayley([casadi.DM(value) for value in w])])
    np.testing.assert_allclose(found, wanted, atol=1e-14)

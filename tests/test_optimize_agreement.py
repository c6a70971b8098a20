"""Every backend on every shared case against one reference, before any refinement; what a backend cannot is named.

The reference is gauss-newton, which test_optimize_backends.py, test_optimize_poses.py and test_optimize_constraints.py
hold against SciPy, GTSAM's marginals and numpy.linalg.lstsq; under an active bound SciPy's SLSQP has the last word.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from scipy.optimize import minimize

from coopoc import V2X, InputError, Sensors, load, observe
from coopoc.optimize import Problem, Solution, Status, backends, pose, solve
from coopoc.optimize.space import exp


def range_only() -> Problem:
    """A noisy star of six in 3-D: fixes of 3.5 m and ranges of 1 m."""
    rng = np.random.default_rng(2)
    truth = np.concatenate([np.zeros((1, 3)), rng.uniform(-25, 25, (6, 3)) * [1, 1, 0.3]])
    names = ("ego", *(f"v{k}" for k in range(6)))
    ranges = np.linalg.norm(truth[1:], axis=1) + rng.normal(size=6)
    problem = Problem(names, hub=(0,)).add("position", names, truth + 3.5 * rng.normal(size=truth.shape), std=3.5)
    return problem.add("range", [("ego", n) for n in names[1:]], ranges[:, None], std=1.0)


def spherical() -> Problem:
    """A snapshot of town10 with up to ten neighbours, range, azimuth and inclination."""
    seen = observe(load("town10").between(0, 40), Sensors.paper_scenario2(), V2X.ideal(10), runs=1, observers=[24])
    return Problem.from_snapshot(seen, 30, 24)


def drive(dimension: int, kind: str) -> Problem:
    """Two robots of six poses each: odometry, ranges between them at every step, the first pose held."""
    rng, d = np.random.default_rng(dimension), dimension
    turn = 0.3 * rng.normal(size=(12, 1 if d == 2 else 3))
    at = np.concatenate([np.arange(6)[:, None] * 4.0 + 9.0 * row + np.zeros((6, d)) for row in (0, 1)])
    at = at + 0.5 * rng.normal(size=at.shape)
    truth = pose(at, turn[:, 0] if d == 2 else turn)
    names = [f"{robot}{k}" for robot in "AB" for k in range(6)]
    problem = Problem(names, x0=truth, dimension=d, poses=names, held=("A0",))
    space, p, R = problem.space, problem.space.position(truth), problem.space.rotation(truth)
    pairs = [(i, i + 1) for i in (*range(5), *range(6, 11))] + [(0, 6)]
    z = []
    for i, j in pairs:
        step = R[i].T @ (p[j] - p[i]) + 0.1 * rng.normal(size=d)
        z.append(space.join(step, R[i].T @ R[j] @ exp(0.02 * rng.normal(size=turn.shape[1]))))
    size = {"relative_pose": d + turn.shape[1], "relative_pose_chordal": d + d * d}[kind]
    problem = problem.add(kind, [(names[i], names[j]) for i, j in pairs], z, std=[0.1] * d + [0.02] * (size - d))
    ranges = np.linalg.norm(p[6:] - p[:6], axis=1) + 0.2 * rng.normal(size=6)
    return problem.add("range", [(f"A{k}", f"B{k}") for k in range(6)], ranges[:, None], std=0.2)


def linear() -> Problem:
    """Fixes and displacements with full covariances."""
    rng = np.random.default_rng(5)
    names = [f"v{k}" for k in range(8)]
    root = rng.normal(size=(7, 3, 3))
    problem = Problem(names).add("position", names, 5.0 * rng.normal(size=(8, 3)), std=[3.0, 3.0, 5.0])
    cov = root @ np.swapaxes(root, 1, 2) + 0.1 * np.eye(3)
    return problem.add("displacement", list(itertools.pairwise(names)), rng.normal(size=(7, 3)), cov=cov)


def bounded() -> Problem:
    """The linear case with a height that must not fall below what it would."""
    free = linear()
    low = solve(free).position[:, 2].min() + 0.8
    return free.constrain("position", free.names, [[-np.inf, -np.inf, low]] * 8)


CASES: dict[str, Callable[[], Problem]] = {
    "range-only": range_only,
    "spherical K = 10": spherical,
    "SE(2) window": lambda: drive(2, "relative_pose"),
    "SE(3) window": lambda: drive(3, "relative_pose"),
    "SE(2) chordal": lambda: drive(2, "relative_pose_chordal"),
    "linear": linear,
    "active bound": bounded,
}
UNSUPPORTED = {
    ("cvxpy", "spherical K = 10"): "spherical",
    ("cvxpy", "SE(2) window"): "relative_pose",
    ("cvxpy", "SE(3) window"): "relative_pose",
    ("gauss-newton", "active bound"): "cannot be held by gauss-newton",
    ("gtsam", "active bound"): "cannot be held by gtsam",
    ("cvxpy", "active bound"): "cannot be held by cvxpy",
}
"""Pairs that are refused, and what the refusal names."""
RELAXED = {("cvxpy", "range-only"), ("cvxpy", "SE(2) chordal")}
"""Where the backend's own answer is a rounded relaxation; only with its refinement does it agree to the last digits."""


@cache
def case(name: str) -> Problem:
    return CASES[name]()


@cache
def reference(name: str) -> Solution:
    if name != "active bound":
        return solve(case(name))
    return solve(case(name), "casadi")


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("backend", backends())
def test_every_backend_agrees_or_is_refused_by_name(backend: str, name: str) -> None:
    if (backend, name) in UNSUPPORTED:
        with pytest.raises(InputError, match=UNSUPPORTED[backend, name]):
            solve(case(name), backend)
        return
    ours, theirs = reference(name), solve(case(name), backend)
    assert theirs.status is Status.SOLVED
    assert theirs.cost == pytest.approx(ours.cost, rel=1e-9)
    assert theirs.x == pytest.approx(ours.x, abs=1e-6)
    assert theirs.covariance == pytest.approx(ours.covariance, abs=1e-6)
    assert theirs.extras.get("refined", False) == ((backend, name) in RELAXED)


@pytest.mark.parametrize("name", sorted(name for _, name in RELAXED))
def test_a_tight_relaxation_is_near_before_it_is_refined(name: str) -> None:
    found = solve(case(name), "cvxpy", throw=False, refine=False)
    ours = reference(name)
    assert found.extras["lower_bound"] <= ours.cost * (1 + 1e-7)
    if found.extras["rank_gap"] < 1e-5:
        assert found.cost == pytest.approx(ours.cost, rel=1e-5)
        assert found.x == pytest.approx(ours.x, abs=2e-2)


def test_the_active_bound_is_scipys() -> None:
    problem, found = case("active bound"), reference("active bound")
    bound = problem.constraints[0].lower[:, 2]
    floor = [(None, None), (None, None), (bound[0], None)] * 8
    theirs = minimize(lambda x: problem.cost(x.reshape(8, 3)), found.x.ravel() + 0.1, method="SLSQP", bounds=floor,
                      options={"ftol": 1e-14, "maxiter": 1000})  # fmt: skip
    assert (found.position[:, 2] <= bound + 1e-6).any()
    assert found.cost == pytest.approx(theirs.fun, rel=1e-8)
    assert found.x.ravel() == pytest.approx(theirs.x, abs=1e-3)


NO_FIX = Problem(("a", "b", "c")).add("range", [("a", "b"), ("b", "c")], [[5.0], [6.0]], std=1.0)
APART = Problem(("a", "b", "c", "d")).add("position", ["a", "b"], [[0, 0, 0], [4, 0, 0]], std=1.0)
ISLAND = APART.add("displacement", [("a", "b"), ("c", "d")], [[4, 0, 0], [1, 0, 0]], std=1.0)
ONE_PLACE = Problem(("a", "b"), x0=np.zeros((2, 3))).add("position", "a", [0, 0, 0], std=1.0)


@pytest.mark.parametrize("backend", backends())
def test_what_cannot_be_solved_is_said_by_every_backend(backend: str) -> None:
    for problem, free in ((NO_FIX, {"a", "b", "c"}), (ISLAND, {"c", "d"})):
        found = solve(problem, backend, throw=False)
        assert found.status is Status.RANK_DEFICIENT
        assert set(found.free) == free
        with pytest.raises(InputError, match=r"must be observable.*Add a position factor"):
            solve(problem, backend)
    with pytest.raises(InputError, match=r"a and b coincide.*keeps them apart"):
        solve(ONE_PLACE.add("range", ("a", "b"), 4.0, std=1.0), backend)

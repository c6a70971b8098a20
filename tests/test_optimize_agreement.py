"""Every backend on every shared case against one reference, before any refinement; what a backend cannot is named.

The reference is gauss-newton, which test_optimize_backends.py, test_optimize_poses.py and test_optimize_constraints.py
hold against SciPy, GTSAM's marginals and numpy.linalg.lstsq; under an active bound SciPy's SLSQP has the last word.
"""

import itertools
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
import pytest
from conftest import refused, same_minimum
from random_graphs import AB, random_graph, star
from shell import ROOT

from coopoc import V2X, Sensors, load_fleet, observe
from coopoc.optimize import Backend, Loss, Problem, Status, backends, solve, solve_gnc
from coopoc.optimize.backend import require_backend
from coopoc.optimize.convex.relaxation import shor
from coopoc.optimize.graph_problems import from_graph


def spherical():
    """A snapshot of town10 with up to ten neighbours, range, azimuth and inclination."""
    seen = observe(load_fleet("town10").between(0, 40), Sensors.paper_scenario2(), V2X(10), runs=1, observers=[24])
    return Problem.from_snapshot(seen, 30, 24)


def drive(dimension, objective):
    """Two robots of six poses each from the truth: odometry, loops, and ranges between them, the first pose held."""
    return from_graph(
        random_graph(3, dimension, steps=6, landmarks=0, loops=4, ranges=8, seen=0, step_std=0.1), objective, "file"
    )


def linear():
    """Fixes and displacements with full covariances."""
    rng = np.random.default_rng(5)
    names = [f"v{k}" for k in range(8)]
    root = rng.normal(size=(7, 3, 3))
    problem = Problem(names).add("position", names, 5.0 * rng.normal(size=(8, 3)), std=[3.0, 3.0, 5.0])
    return problem.add(
        "displacement", list(itertools.pairwise(names)), rng.normal(size=(7, 3)), cov=root @ root.mT + 0.1 * np.eye(3)
    )


def bounded():
    """The linear case with a height that must not fall below what it would."""
    free = linear()
    return free.constrain("position", free.names, [[-np.inf, -np.inf, solve(free).position[:, 2].min() + 0.8]] * 8)


CASES: dict[str, Callable[[], Problem]] = {
    "range-only": partial(star, "range", 2, fix_std=3.5, height=0.3),
    "spherical K = 10": spherical,
    "SE(2) window": lambda: drive(2, "geodesic"),
    "SE(3) window": lambda: drive(3, "geodesic"),
    "SE(2) chordal": lambda: drive(2, "chordal"),
    "linear": linear,
    "active bound": bounded,
}
PAGE = (ROOT / "docs" / "extend.md").read_text()
OWN: dict[str, Any] = {}
exec(next(text for text in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL) if "# least_squares.py" in text), OWN)
PLUG_IN: Backend = OWN["BACKEND"]
"""The backend that docs/extend.md shows."""
EVERY: dict[str, str | Backend] = {**{name: name for name in backends()}, PLUG_IN.name: PLUG_IN}
UNSUPPORTED = {
    ("least-squares", "active bound"): "cannot be solved by least-squares",
    ("cvxpy", "spherical K = 10"): "spherical",
    ("cvxpy", "SE(2) window"): "relative_pose",
    ("cvxpy", "SE(3) window"): "relative_pose",
    ("gauss-newton", "active bound"): "cannot be solved by gauss-newton",
    ("gtsam", "active bound"): "cannot be solved by gtsam",
    ("cvxpy", "active bound"): "cannot be solved by cvxpy",
}
"""Pairs that are refused, and what the refusal names."""
RELAXED = {("cvxpy", "linear"), ("cvxpy", "range-only"), ("cvxpy", "SE(2) chordal")}
"""Where the backend's own answer is a rounded relaxation; only with its refinement does it agree to the last digits."""


@cache
def case(name):
    return CASES[name]()


@cache
def reference(name):
    if name != "active bound":
        return solve(case(name))
    return solve(case(name), "casadi")


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("backend", EVERY)
def test_every_backend_agrees_or_is_refused_by_name(backend, name):
    if (backend, name) in UNSUPPORTED:
        with refused(UNSUPPORTED[backend, name]):
            solve(case(name), EVERY[backend])
        return
    ours, theirs = reference(name), solve(case(name), EVERY[backend])
    assert theirs.status is Status.SOLVED
    same_minimum(theirs, ours)
    assert ("rounded_cost" in theirs.extras) == ((backend, name) in RELAXED)


@pytest.mark.parametrize("name", sorted(name for _, name in RELAXED))
def test_a_tight_relaxation_is_near_before_it_is_refined(name):
    found, ours = shor(case(name)), reference(name)
    assert found.lower_bound <= ours.cost * (1 + 1e-7)
    if found.rank_gap < 1e-5:
        assert found.cost == pytest.approx(ours.cost, rel=1e-5)
        assert found.x == pytest.approx(ours.x, abs=2e-2)


NO_FIX = Problem([*"abc"]).add("range", [AB, ("b", "c")], [[5.0], [6.0]], std=1.0)
APART = Problem([*"abcd"]).add("position", ["a", "b"], [[0, 0, 0], [4, 0, 0]], std=1.0)
DETACHED = APART.add("displacement", [AB, ("c", "d")], [[4, 0, 0], [1, 0, 0]], std=1.0)
ONE_PLACE = Problem([*"ab"], x0=np.zeros((2, 3))).add("position", "a", [0, 0, 0], std=1.0)


@pytest.mark.parametrize("loss", ["huber", "cauchy", "geman-mcclure", "truncated"])
@pytest.mark.parametrize("name", ["spherical K = 10", "SE(2) window", "SE(3) window"])
@pytest.mark.parametrize("backend", EVERY)
def test_every_backend_agrees_on_robust_losses(backend, name, loss):
    """From the least-squares solution, so that all descend into one minimum."""
    plain = case(name)
    problem = replace(
        plain, factors=(*plain.factors[:-1], replace(plain.factors[-1], loss=Loss(loss, 1.5))), x0=reference(name).x
    )
    if require_backend(EVERY[backend]).capabilities.lacking(problem):
        with refused(f"cannot be solved by {backend}"):
            solve(problem, EVERY[backend])
        return
    ours, theirs = solve(problem), solve(problem, EVERY[backend])
    same_minimum(theirs, ours)


def test_graduated_non_convexity_calls_a_plug_in():
    seen = observe(load_fleet("town10").between(0, 40), Sensors.paper_scenario2(), V2X(6), runs=2, observers=[5])
    star = Problem.from_snapshot(seen, 36, 5, run=1)
    wrong = star.add("position", 1, star.factors[0].z[1] + 40.0, std=3.5)
    found, ours = (solve_gnc(wrong, [0, 2], backend=b) for b in (PLUG_IN, "gauss-newton"))
    assert found.extras["weights"] == pytest.approx(ours.extras["weights"], abs=1e-9)
    assert found.x == pytest.approx(ours.x, abs=1e-6)


@pytest.mark.parametrize("backend", backends())
def test_what_cannot_be_solved_is_said_by_every_backend(backend):
    for problem, free in ((NO_FIX, {"a", "b", "c"}), (DETACHED, {"c", "d"})):
        found = solve(problem, backend, throw=False)
        assert found.status is Status.RANK_DEFICIENT
        assert set(found.unobservable) == free
        with refused(r"can move freely.*must be observable.*Add a position factor"):
            solve(problem, backend)
    with refused(r"a and b coincide.*keeps them apart"):
        solve(ONE_PLACE.add("range", AB, 4.0, std=1.0), backend)

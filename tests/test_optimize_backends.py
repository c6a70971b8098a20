"""Backends: they agree with each other and with tools that we did not write, before anything of ours refines them."""

import sys
from importlib.util import find_spec

import numpy as np
import pytest
from conftest import refused
from random_graphs import star
from scipy.optimize import least_squares
from test_optimize_constraints import chain

from coopoc import V2X, MissingLibraryError, Sensors, observe
from coopoc.optimize import Backend, Problem, SolverResult, Status, backends, solve
from coopoc.optimize.backends import osqp
from coopoc.optimize.starts.initial import initial_guess

S2 = Sensors.paper_scenario2()
LOCAL = sorted(set(backends()) - {"cvxpy"})
"""Backends that go downhill from a start; cvxpy relaxes: see test_optimize_agreement.py."""
OTHERS = [name for name in LOCAL if name != "gauss-newton"]


@pytest.fixture(scope="module")
def crossing_recording(crossing):
    """Neighbours that come and go."""
    return observe(crossing, S2, V2X(max_neighbours=6, radius=60), runs=2, observers=[0, 3])


@pytest.mark.parametrize("backend", LOCAL)
def test_where_plain_gauss_newton_overshoots_for_ever(backend):
    """Flat range-only stars: the height's true curvature exceeds twice that of J^T J."""
    cycling = 0
    for seed in range(8):
        problem = star("range", seed, fix_std=4.0, height=0.02)
        assert solve(problem, backend, throw=False).status is Status.SOLVED
        x = initial_guess(problem)
        for _ in range(200):
            residual, J = problem.whiten(x)
            dx = -np.linalg.solve((J.T @ J).toarray(), J.T @ residual).reshape(x.shape)
            x = x + dx
        cycling += abs(dx).max() > 1e-3
    assert cycling > 0


def scipys(problem):
    """SciPy's trust-region solver from the same start, with its own difference Jacobian."""

    def residual(flat):
        return problem.whiten(flat.reshape(-1, 3))[0]

    found = least_squares(residual, initial_guess(problem).ravel(), jac="3-point", xtol=1e-15, ftol=1e-15, gtol=1e-13)
    return found.x.reshape(-1, 3), found.cost


@pytest.mark.parametrize("backend", LOCAL)
@pytest.mark.parametrize("case", ["ten neighbours", "snapshot", "window", "range", "azimuth"])
def test_scipy_finds_the_same_minimum(dense, crossing_recording, case, backend):
    for seed in range(2):
        problem = {
            "ten neighbours": lambda s: Problem.from_snapshot(dense, 20, 0, s),
            "snapshot": lambda s: Problem.from_snapshot(crossing_recording, 10 * s, 3, s),
            "window": lambda s: Problem.from_window(crossing_recording, 20, 0, 3, s),
            "range": lambda s: star("range", s),
            "azimuth": lambda s: star("azimuth", s),
        }[case](seed)
        x, cost = scipys(problem)
        ours = solve(problem, backend)
        assert ours.cost == pytest.approx(cost, rel=1e-9)
        assert ours.x == pytest.approx(x, abs=2e-5)  # difference Jacobians stop there


@pytest.mark.parametrize("backend", LOCAL)
@pytest.mark.parametrize("points", [5, 40, 300])
def test_a_linear_problem_equals_lstsq(points, backend):
    """Dense, sparse (300 points) and osqp's and gtsam's own elimination, against NumPy's lstsq."""
    problem = chain(points, points)
    r, J = problem.whiten(np.zeros((points, 3)))
    x = np.linalg.lstsq(J.toarray(), -r)[0].reshape(-1, 3)
    solution = solve(problem, backend)
    assert solution.x == pytest.approx(x, abs=1e-6)
    cov = np.linalg.inv((J.T @ J).toarray())
    own = np.stack([cov[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] for i in range(points)])
    assert solution.covariance == pytest.approx(own, rel=1e-9, abs=1e-12)


def test_a_solution_is_verified_independently_of_the_solver(dense):
    """A backend that returns its start and claims one iteration is found out."""
    overconfident = Backend("overconfident", lambda problem, x: SolverResult(x + 0.1, 1))
    solution = solve(Problem.from_snapshot(dense, 10, 0), overconfident, throw=False)
    assert solution.status is Status.FAILED
    assert solution.gradient_norm > 0.01


def test_osqp_repairs_what_fails_its_kkt_check(dense):
    problem = Problem.from_window(dense, 20, 0, 5)
    loose = {**osqp.SETTINGS, "eps_abs": 1e-2, "eps_rel": 1e-2, "sigma": 1.0}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(osqp, "SETTINGS", loose)
        solution = solve(problem, "osqp", throw=False)
    assert solution.extras["repairs"] > 0


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda p: solve(p, "ipopt"), "gauss-newton"),
        (lambda p: solve(p, "gtsam", colour="red"), "max_iterations"),
        (lambda p: solve(p, "gtsam", max_iteration=3), r"Did you mean max_iterations\?"),
    ],
)
def test_unknown_names_list_the_known(dense, call, words):
    with refused(words):
        call(Problem.from_snapshot(dense, 0, 0))


@pytest.mark.parametrize("backend", OTHERS)
def test_a_missing_library_says_how_to_install_it(monkeypatch, dense, backend):
    lacking = lambda name: None if name == backend else find_spec(name)  # noqa: E731
    monkeypatch.setattr(sys.modules["coopoc.optimize.backend"], "find_spec", lacking)
    assert not backends()[backend].installed
    assert backends()["gauss-newton"].installed == (backend != "casadi")
    with pytest.raises(MissingLibraryError, match=f"pip install {backend}"):
        solve(Problem.from_snapshot(dense, 0, 0), backend)


@pytest.mark.parametrize("backend", ["gauss-newton", "gtsam", "osqp"])
def test_a_point_that_an_infinite_std_leaves_free_is_named(backend):
    """Its weighted fixes are by hand: the mean of 0 and 4."""
    problem = Problem([*"ab"]).add("position", "a", [[0, 0, 0]], std=1.0).add("position", "a", [4, 4, 4], std=1.0)
    held, free = (solve(problem.add("position", "b", [4, 4, 4], std=s), backend, throw=False) for s in (1.0, np.inf))
    assert (held.status is Status.SOLVED, free.status is Status.SOLVED) == (True, False)
    assert held.x == pytest.approx(np.array([[2.0] * 3, [4.0] * 3]))
    assert free.unobservable == ("b",)
    assert np.isnan(free.covariance[1]).all()

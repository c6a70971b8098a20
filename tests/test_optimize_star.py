"""Stars of B realisations: steps and marginals against numpy.linalg on the dense Jacobian, and solves one by one."""

from __future__ import annotations

import numpy as np
import pytest

from coopoc.optimize import Factor, Problem, pose, solve, solve_batch
from coopoc.optimize.algebra.schur import is_star, star_at
from coopoc.optimize.starts.initial import initial_guess

RUNS = 9


def star(dimension: int = 3, reverse: bool = False) -> Problem:
    """An ego that ranges its neighbours, or is ranged by them; realisations differ in their fixes."""
    rng = np.random.default_rng(1)
    truth = rng.uniform(-20, 20, (5, dimension))
    z = truth + rng.normal(0, 0.5, (RUNS, 5, dimension))
    problem = Problem([f"v{k}" for k in range(5)], separator=(2,), dimension=dimension)
    problem = problem.add("position", range(5), z, std=np.arange(1.0, 1.0 + dimension))
    pairs = [(2, k) if not reverse else (k, 2) for k in (0, 1, 4)]  # v3 is not measured
    gaps = [np.linalg.norm(truth[i] - truth[j]) for i, j in pairs]
    shift = [truth[j] - truth[i] for i, j in pairs]
    full = np.eye(dimension) + 0.1 * np.tri(dimension)
    return problem.add("range", pairs, np.array(gaps)[:, None], std=0.5).add(
        "displacement", pairs, shift, sqrt_information=full
    )


def drive() -> Problem:
    """Poses in the plane, a point among them, one held; measured forwards and backwards."""
    rng = np.random.default_rng(2)
    at, angle = np.cumsum(rng.uniform(2, 4, (4, 2)), axis=0), rng.uniform(-1, 1, 4)
    x0 = np.broadcast_to(pose(at, angle), (RUNS, 4, 6)).copy()
    x0[:, 3] = pose(at, 0.0)[3]
    problem = Problem("abcd", x0=x0, dimension=2, poses="abc", fixed="a")
    problem = problem.add("relative_pose", [("a", "b"), ("c", "b")], pose(np.array([[2.0, 1], [-2, 1]]), 0.1), std=0.2)
    problem = problem.add("range", [("d", "a"), ("c", "d")], [[6.0], [4.0]], std=0.3)
    return problem.add("position", "b", at[1], std=1.0)


@pytest.mark.parametrize("problem", [star(), star(2), star(reverse=True)], ids=["3d", "2d", "reverse"])
def test_steps_and_marginals_of_a_star_are_those_of_the_dense_jacobian(problem: Problem) -> None:
    assert is_star(problem)
    linear = problem.linearise(initial_guess(problem))
    star, damping = star_at(problem, linear), np.random.default_rng(0).uniform(0.1, 1.0, linear.x.shape)
    (dx, marginals), damped = star.solve(), star.solve(damping)[0]
    for b in range(RUNS):
        J = problem.jacobian(linear, b).toarray()
        gradient, inverse = J.T @ np.concatenate([each[b].ravel() for each in linear.residual]), np.linalg.inv(J.T @ J)
        n, d = linear.x.shape[1:]
        own = inverse.reshape(n, d, n, d)[np.arange(n), :, np.arange(n)]
        assert np.allclose(marginals()[b], own, rtol=1e-9)
        assert np.allclose(dx[b].ravel(), -inverse @ gradient, rtol=1e-9, atol=1e-12)
        wanted = np.linalg.solve(J.T @ J + np.diag(damping[b].ravel()), -gradient)
        assert np.allclose(damped[b].ravel(), wanted, rtol=1e-9, atol=1e-12)


def test_a_realisation_that_lacks_a_fix_does_not_spoil_the_others() -> None:
    problem = star()
    fixes, *rest = problem.factors
    std = np.ones((RUNS, 5, 3))
    std[4, 3] = np.inf
    problem = Problem(problem.names, (Factor("position", fixes.nodes, fixes.z, std=std), *rest), separator=(2,))
    batch = solve_batch(problem)
    assert batch.converged.tolist() == [b != 4 for b in range(RUNS)]
    assert np.isnan(batch.covariance[4]).all()


@pytest.mark.parametrize("lost", [0, 2])
def test_a_node_that_nothing_measures_is_found_free(lost: int) -> None:
    z = np.arange(RUNS * 6.0).reshape(RUNS, 2, 3)
    problem = Problem("abc", separator=(0,)).add("position", [k for k in range(3) if k != lost], z, std=1.0)
    batch = solve_batch(problem)
    assert not batch.converged.any()
    assert np.isnan(batch.covariance).all()


@pytest.mark.parametrize("problem", [star(), star(2), drive()], ids=["3d", "2d", "poses"])
def test_a_batch_ends_where_each_problem_ends_alone(problem: Problem) -> None:
    """Problems without realisations are solved in NumPy, by dense matrices or SciPy's sparse ones."""
    batch = solve_batch(problem)
    for b in range(RUNS):
        alone = solve(problem.pick(b))
        assert np.abs(batch.x[b] - alone.x).max() < 1e-7
        assert np.allclose(batch.covariance[b], alone.covariance, rtol=1e-6, atol=1e-14)
    assert batch.converged.all()

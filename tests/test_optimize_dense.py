"""Small problems as one matrix: against numpy.linalg, a Jacobian by differences, and the blocks of larger ones."""

from __future__ import annotations

import numpy as np
import pytest

from coopoc.optimize import Loss, Problem, pose, solve, solve_batch
from coopoc.optimize.algebra.dense import NUMBERS, damped_step, diagonal_blocks, is_small, normal_matrix
from coopoc.optimize.assess.assess import assess
from coopoc.optimize.descent.descend import _damping


def plane() -> Problem:
    """Poses and a landmark in the plane, one pose held, one robust factor."""
    rng = np.random.default_rng(0)
    x0 = np.concatenate([pose(rng.normal(size=(3, 2)) * 5, rng.normal(size=3)), pose(rng.normal(size=(1, 2)) * 9)])
    problem = Problem("abcm", dimension=2, poses=range(3), x0=x0, fixed=(0,))
    steps = pose(rng.normal(size=(2, 2)), rng.normal(size=2))
    problem = problem.add("relative_pose", [(0, 1), (2, 1)], steps, std=[0.3, 0.2, 0.1])
    problem = problem.add("range", [(0, 2), (3, 1)], [[4.0], [6.0]], std=0.5, loss=Loss("huber", 1.0))
    return problem.add("bearing", [(0, 3), (2, 3)], [[0.3], [1.0]], std=0.1)


def space() -> Problem:
    rng = np.random.default_rng(1)
    names = [f"v{k}" for k in range(NUMBERS // 3)]
    problem = Problem(names, x0=rng.normal(size=(len(names), 3)) * 20, separator=(0,))
    problem = problem.add("position", names, problem.x0 + rng.normal(size=problem.x0.shape), std=[1.0, 2.0, 3.0])
    root = np.tril(rng.normal(size=(3, 3))) + 2 * np.eye(3)
    problem = problem.add("displacement", ("v3", "v0"), [9, 9, 0], sqrt_information=root)
    return problem.add("spherical", [("v0", "v1"), ("v2", "v0")], [[20, 0.3, 1.5], [9, 2, 1.6]], std=[1.0, 0.1, 0.1])


def differences(problem: Problem, x: np.ndarray) -> np.ndarray:
    """Jacobian (rows, n dof) of the whitened residuals by central differences; for Huber's, at its fixed weight."""
    free = np.ones((len(x), problem.space.dof), bool) if problem.movable is None else problem.movable
    columns = []
    for place in np.ndindex(free.shape):
        step = np.zeros(free.shape)
        step[place] = 1e-6 * free[place]
        up, down = (problem.whiten(problem.space.retract(x, s))[0] for s in (step, -step))
        columns.append((up - down) / 2e-6)
    return np.stack(columns, axis=1)


@pytest.mark.parametrize("make", [plane, space])
def test_the_matrix_and_the_gradient(make: object) -> None:
    problem = make()
    assert is_small(problem)
    assert not is_small(problem.replace_unchecked(names=(*problem.names, *"abcdefghijklmnopqrstuvwxyz")))
    x = np.asarray(problem.x0)
    residual, jacobian = problem.whiten(x)
    if make is space:
        assert jacobian.toarray() == pytest.approx(differences(problem, x), abs=1e-5)
    still = np.zeros(jacobian.shape[1]) if problem.movable is None else ~problem.movable.ravel()
    J = jacobian.toarray()
    matrix, gradient = normal_matrix(problem, problem.linearise(x[None]))
    assert matrix == pytest.approx(J.T @ J + np.diag(still), rel=1e-12, abs=1e-12)
    assert gradient == pytest.approx(J.T @ residual, rel=1e-12, abs=1e-12)
    damping = np.abs(np.random.default_rng(2).normal(size=(1, *x.shape[:1], problem.space.dof)))
    tall = np.concatenate([J, np.diag(np.sqrt(damping.ravel() + still))])
    wanted = np.linalg.lstsq(tall, -np.concatenate([residual, np.zeros(len(still))]))[0]
    assert damped_step(problem, problem.linearise(x[None]), damping).ravel() == pytest.approx(wanted, abs=1e-9)
    own, inverse = diagonal_blocks(matrix, len(x))
    assert inverse @ matrix == pytest.approx(np.eye(len(matrix)), abs=1e-9)
    second = slice(problem.space.dof, 2 * problem.space.dof)
    assert own[1] == pytest.approx(inverse[second, second])


def test_one_matrix_and_blocks_assess_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    for problem in (plane(), space()):
        x = solve(problem).x
        whole = assess(problem, x)
        monkeypatch.setattr("coopoc.optimize.algebra.dense.NUMBERS", 0)
        blocks = assess(problem, x)
        monkeypatch.undo()
        assert whole.covariance == pytest.approx(blocks.covariance, rel=1e-9, abs=1e-12)
        assert (whole.cost, whole.gradient_norm) == pytest.approx((blocks.cost, blocks.gradient_norm), abs=1e-9)
        assert whole.remaining == pytest.approx(blocks.remaining, abs=1e-9)


def test_damping_follows_the_share_of_the_promise_that_came_true() -> None:
    """Marquardt's rule (Marquardt 1963; Nocedal and Wright 2006, algorithm 4.1): less where the model was good, as it
    was where it was fair, more where it was poor although the cost fell, ten times where it rose."""
    mu = np.array([1e-2, 1e-2, 1e-2, 0.0, 1e-2, 0.0])
    share = np.array([0.9, 0.5, 0.1, 0.1, -1.0, -1.0])
    better = np.array([True, True, True, True, False, False])
    assert _damping(mu, better, share) == pytest.approx([2e-3, 1e-2, 4e-2, 1e-2, 1e-1, 1e-3])


def test_damping_grows_until_a_step_helps_however_much_that_takes() -> None:
    """A range that is too short, seen nearly along the height that is known: J^T J has a 4,000th of the curvature
    across it, so that no step helps below that damping. Closed form: straight above, and the range's share of the
    height is its information's."""
    z = np.array([9.0, 9.5])
    problem = Problem("av", dimension=2, x0=[[0, 0], [0.05, 10]], fixed=(0,))
    problem = problem.add("position", ["v"], np.full((2, 1, 2), [0.0, 10.0]), std=[1e3, 1e-3])
    problem = problem.add("range", [("a", "v")], z[:, None, None], std=1.0)
    found = solve_batch(problem, backend="gauss-newton").x[:, 1]
    assert found == pytest.approx(np.column_stack([0 * z, (1e6 * 10.0 + z) / (1e6 + 1.0)]), abs=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_the_unit_of_the_noise_changes_no_step(seed: int) -> None:
    """A law of damped least squares: all standard deviations times c divide every cost by c^2, and nothing else. One
    step less is taken where it promises 1e-9 standard deviations."""
    rng, names = np.random.default_rng(seed), list("abcde")
    pairs = [(i, j) for i in range(5) for j in range(i)]
    truth, start = rng.normal(0, 10, (2, 5, 3))
    distance = np.linalg.norm([truth[i] - truth[j] for i, j in pairs], axis=1) + rng.normal(0, 0.5, (3, 10))

    def solved(unit: float) -> tuple[list[int], list[float]]:
        problem = Problem(names, x0=start).add("position", names, truth, std=2.0 * unit)
        ends = [(names[i], names[j]) for i, j in pairs]
        one = solve(problem.add("range", ends, distance[0], std=0.1 * unit))
        many = solve_batch(problem.add("range", ends, distance[..., None], std=0.1 * unit))
        cost = np.append(one.cost, many.cost) * unit**2
        return [one.iterations, *many.iterations.tolist()], cost.tolist()

    steps, cost = solved(1.0)
    assert min(steps) > 8  # far from the minimum, so that the damping matters
    for unit in (1e-4, 1e4):
        again, same = solved(unit)
        assert again[1:] == steps[1:]
        assert again[0] in (steps[0], steps[0] - 1)
        assert same == pytest.approx(cost, rel=1e-9)

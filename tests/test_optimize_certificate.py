"""Certificates: a global optimum gets one, a local minimum or a saddle does not, and no bound exceeds any cost."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from coopoc import V2X, Fleet, InputError, Sensors, observe
from coopoc.arrays import Floats
from coopoc.optimize import Problem, Solution, Status, pose, solve
from coopoc.optimize.convex.certificate import certify
from coopoc.optimize.convex.manifold import minimise
from coopoc.optimize.convex.quadratic import quadratic
from coopoc.optimize.convex.relaxation import shor
from coopoc.optimize.convex.schur import Dense, Sparse
from coopoc.optimize.convex.surrogate import surrogate


def anchored(seed: int, anchors: int = 4, vehicles: int = 2, d: int = 2, std: float = 0.1) -> Problem:
    """Surveyed anchors, vehicles without a fix, all ranges to and between vehicles: flips are local minima."""
    rng = np.random.default_rng(seed)
    n = anchors + vehicles
    truth = rng.uniform(-20, 20, (n, d))
    names = [f"a{i}" for i in range(anchors)] + [f"v{i}" for i in range(vehicles)]
    problem = Problem(tuple(names), dimension=d)
    problem = problem.add("position", names[:anchors], truth[:anchors] + 0.3 * rng.standard_normal((anchors, d)), 0.3)
    pairs = [(i, j) for i in range(n) for j in range(max(i + 1, anchors), n)]
    ranges = [np.linalg.norm(truth[i] - truth[j]) + std * rng.standard_normal() for i, j in pairs]
    return problem.add("range", pairs, np.abs(ranges)[:, None], std)


def minima(problem: Problem, starts: int = 15) -> list[Solution]:
    """The minima that Gauss-Newton reaches from random starts, the lowest first."""
    rng, found = np.random.default_rng(0), []
    for _ in range(starts):
        solution = solve(
            replace(problem, x0=rng.uniform(-20, 20, (len(problem.names), problem.dimension))), throw=False
        )
        if solution.status is Status.SOLVED:
            found.append(solution)
    return sorted(found, key=lambda solution: solution.cost)


@pytest.mark.parametrize("seed", [1, 2, 6])
def test_a_local_minimum_is_refused_where_the_global_one_is_certified(seed: int) -> None:
    """Gauss-Newton reports SOLVED at both; scipy.optimize.least_squares finds nothing below the certified one."""
    problem = anchored(seed)
    best, *others = minima(problem)
    local = [solution for solution in others if solution.cost > best.cost + 1.0]
    assert local
    verdict = certify(problem, best)
    assert verdict.certified
    assert str(verdict) == f"certified global optimum of {problem!r}"
    assert verdict.gap <= 1e-6 * max(best.cost, 1.0)
    for solution in local:
        refused = certify(problem, solution)
        assert not refused.certified
        assert refused.lower_bound <= best.cost
        assert refused.smallest_eigenvalue < -1e-3
        assert str(refused).startswith("not certified")
    rng = np.random.default_rng(1)
    for _ in range(8):
        start, jacobian = rng.uniform(-20, 20, 12), lambda y: problem.whiten(y.reshape(6, 2))[1].toarray()
        found = least_squares(lambda y: problem.whiten(y.reshape(6, 2))[0], start, jac=jacobian)
        assert found.cost >= verdict.lower_bound * (1 - 1e-9)


def test_a_point_beside_the_optimum_is_refused_by_default_and_certified_if_asked() -> None:
    """A gap of 1e-5 to 1e-3 of the cost is none of rounding: the tolerance of 1e-6 refuses, one of a tenth does not."""
    problem = anchored(1)
    best = minima(problem)[0]
    away = np.random.default_rng(0).normal(size=best.x.shape)
    gaps = []
    for step in 10.0 ** np.arange(-12.0, -4.0, 0.25):
        x = best.x + step * away
        beside = replace(best, x=x, cost=0.5 * float((problem.whiten(x)[0] ** 2).sum()))
        verdict = certify(problem, beside)
        share = verdict.gap / max(beside.cost, 1.0)
        assert verdict.certified == (share <= 1e-6)
        if 1e-5 < share < 1e-3:
            gaps.append(share)
            assert certify(problem, beside, tolerance=0.1).certified
    assert gaps


@pytest.mark.parametrize("d", [2, 3])
def test_bounds_hold_and_certificates_agree_with_the_relaxation(d: int) -> None:
    """Certified means tight, with the relaxation's bound; what is not certified still has a bound below every cost."""
    verdicts = []
    for seed in range(8):
        problem = anchored(seed, anchors=d + 2, vehicles=1, d=d, std=0.5)
        relaxed = shor(problem)
        assert relaxed.solution is not None
        verdict = certify(problem, relaxed.solution)
        verdicts.append(verdict.certified)
        assert verdict.certified == relaxed.tight
        assert verdict.lower_bound <= relaxed.lower_bound * (1 + 1e-6) + 1e-6
        for solution in minima(problem, starts=8):
            assert certify(problem, solution).lower_bound <= relaxed.solution.cost * (1 + 1e-9)
    assert 2 <= sum(verdicts) < len(verdicts)


def test_the_eigenvalue_is_that_of_the_whole_matrix() -> None:
    """Schur complement and Q - diag(L, 0) are indefinite together; numpy.linalg.eigvalsh on the latter."""
    for seed in range(4):
        problem = anchored(seed)
        form = quadratic(problem)
        for solution in minima(problem, starts=6):
            X = form.lift(solution.x, np.tile(np.eye(2), (6, 1, 1)))
            Q = (form.rows.T @ form.rows).toarray()
            CX = (Q @ X)[: form.bound]
            assert np.abs((Q @ X)[form.bound :]).max() < 1e-4 * np.abs(Q).max()
            S = Q.copy()
            for block in form.stiefel:
                S[np.ix_(block, block)] -= 0.5 * (CX[block] @ X[block].T + X[block] @ CX[block].T)
            for (row,) in form.sphere:
                S[row, row] -= CX[row] @ X[row]
            smallest = certify(problem, solution).smallest_eigenvalue
            tolerance = 1e-9 * np.abs(Q).max()
            assert (np.linalg.eigvalsh(S)[0] < -tolerance) == (smallest < -tolerance)


def test_a_saddle_is_refused() -> None:
    """An ego on the line between two others whose ranges are longer than that line."""
    line = Problem(("ego", "a", "b"), x0=[[0, 0, 0], [-5, 0, 0], [5, 0, 0]])  # type: ignore[arg-type]
    line = line.add(
        "position", ["ego", "a", "b"], [[0, 0, 0], [-5, 0, 0], [5, 0, 0]], [[9.0], [0.1], [0.1]] * np.ones(3)
    )
    problem = line.add("range", [("ego", "a"), ("ego", "b")], [[8.0], [8.0]], 0.5)
    saddle = solve(problem, throw=False)
    assert saddle.status is Status.SADDLE
    assert not certify(problem, saddle).certified
    aside = solve(replace(problem, x0=np.array([[0, 3, 1.0], [-5, 0, 0], [5, 0, 0]])), throw=False)
    assert aside.cost < saddle.cost


def ring(steps: int, d: int, seed: int = 0) -> Problem:
    """Poses around a loop with its closure, and ranges across it; more than DENSE constrained rows for many steps."""
    rng = np.random.default_rng(seed)
    angle = 2 * np.pi * np.arange(steps) / steps
    at = np.zeros((steps, d))
    at[:, :2] = 0.2 * steps * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    truth = pose(at, angle if d == 2 else np.stack([0 * angle, 0 * angle, angle], axis=1))
    names = tuple(f"x{k}" for k in range(steps))
    problem = Problem(names, x0=truth, dimension=d, poses=names, fixed=(0,))  # type: ignore[arg-type]
    pairs = [(k, (k + 1) % steps) for k in range(steps)]
    turned = truth[:, d:].reshape(-1, d, d)
    z = np.array([np.concatenate([turned[i].T @ (at[j] - at[i]), (turned[i].T @ turned[j]).ravel()]) for i, j in pairs])
    z[:, :d] += 0.02 * rng.standard_normal((steps, d))
    problem = problem.add("relative_pose_chordal", pairs, z, [0.02] * d + [0.01] * d * d)
    across = [(k, (k + steps // 2) % steps) for k in range(0, steps // 2, 5)]
    ranges = [np.linalg.norm(at[i] - at[j]) + 0.1 * rng.standard_normal() for i, j in across]
    return problem.add("range", across, np.abs(ranges)[:, None], 0.1)


@pytest.mark.parametrize(("steps", "d"), [(12, 3), (40, 2), (260, 2)])
def test_loops_of_poses_are_certified(steps: int, d: int) -> None:
    problem = ring(steps, d)
    solution = solve(problem)
    verdict = certify(problem, solution)
    assert verdict.certified, str(verdict)
    form = quadratic(problem)
    if steps < 260:  # dense and sparse give the same verdict
        X = form.lift(problem.space.position(solution.x), problem.space.rotation(solution.x))[: form.bound]
        for part in (Dense(form), Sparse(form)):
            end = minimise(form, part, X)
            assert end.cost == pytest.approx(solution.cost, rel=1e-8)
            assert part.smallest(end.multipliers)[0] == pytest.approx(0.0, abs=1e-5)
    else:
        assert form.bound > 500


def test_a_loop_wound_the_wrong_way_is_refused() -> None:
    """Started with every heading turned by one more revolution around the loop: a local minimum of pose graphs."""
    steps = 24
    problem = ring(steps, 2)
    assert problem.x0 is not None
    lap = 2 * np.pi * np.arange(steps) / steps
    wound = pose(problem.x0[:, :2] * 0.2, 2 * lap)
    wound[0] = problem.x0[0]
    local = solve(replace(problem, x0=wound), throw=False)
    best = solve(problem)
    assert certify(problem, best).certified
    assert local.cost > 10 * best.cost
    assert not certify(problem, local).certified


@pytest.fixture(scope="module")
def snapshot(formation: Fleet) -> Problem:
    """Range, azimuth and inclination of six neighbours."""
    recording = observe(formation.between(0, 3), Sensors.paper_scenario2(), V2X.ideal(6), runs=1, observers=[0])
    return Problem.from_snapshot(recording, 0, 0)


def test_angles_are_certified_by_a_surrogate_that_is_named(snapshot: Problem) -> None:
    solution = solve(snapshot)
    with pytest.raises(InputError, match=r"spherical.*not quadratic"):
        certify(snapshot, solution)
    verdict = certify(snapshot, solution, surrogate=True)
    assert verdict.certified
    assert verdict.surrogate == ("spherical -> displacement by its vector d u, covariance rotated",)
    assert verdict.surrogate[0] in str(verdict)
    assert "from the solution" in str(verdict)
    near = solve(surrogate(snapshot).problem)
    assert near.x == pytest.approx(solution.x, abs=1.5)
    assert verdict.cost == pytest.approx(near.cost, rel=1e-9)


def test_weights_that_differ_between_axes_are_averaged_where_poses_turn() -> None:
    """std^2 = trace(cov) / d, as in PyFG; the geodesic relative pose becomes the chordal one with the same optimum
    where there is no noise."""
    turn = np.array([0.0, 0.7, -1.1])
    at: Floats = np.array([[0.0, 0.0], [4.0, 1.0], [3.0, -2.0]])
    truth = pose(at, turn)
    problem = Problem(("a", "b", "c"), x0=truth, dimension=2, poses=(0, 1, 2), fixed=(0,))
    turned = truth[:, 2:].reshape(-1, 2, 2)
    relative = pose(np.einsum("ji,j->i", turned[0], at[1]), turn[1])
    local = turned[1].T @ (at[2] - at[1])
    problem = problem.add("relative_pose", (0, 1), relative, [0.1, 0.3, 0.02])
    problem = problem.add("body_spherical", (1, 2), [np.hypot(*local), np.arctan2(local[1], local[0])], [0.5, 0.05])
    problem = problem.add("relative_pose", (0, 2), pose(at[2], turn[2]), [0.1, 0.1, 0.02])
    other = surrogate(problem)
    assert [f.kind for f in other.problem.factors] == [
        "relative_pose_chordal",
        "relative_position",
        "relative_pose_chordal",
    ]
    first = other.problem.factors[0].std
    assert first is not None
    assert first[0] == pytest.approx([np.sqrt(0.05)] * 2 + [0.02] * 4)
    assert other.replaced == (
        "relative_pose -> relative_pose_chordal by chords in place of angles",
        "body_spherical -> relative_position by its vector d u, one weight for all axes",
    )
    verdict = certify(problem, solve(problem), surrogate=True)
    assert verdict.certified
    assert verdict.cost == pytest.approx(0.0, abs=1e-12)
    with pytest.raises(InputError, match="no quadratic surrogate"):
        surrogate(problem.add("bearing", (0, 1), 0.2, 0.1))
    with pytest.raises(InputError, match="must have an average"):
        surrogate(problem.add("position", "a", [0, 0], [1.0, np.inf]))

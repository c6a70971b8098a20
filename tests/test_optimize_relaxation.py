"""Relaxations and certificates: they bound every cost, agree with models written for CVXPY by hand, and are attained
where tight; a local minimum gets no certificate."""

import time
from dataclasses import replace
from functools import partial

import cvxpy as cp
import numpy as np
import pytest
import range_only
import tightness
from conftest import measured, refused
from numpy import eye
from numpy.linalg import det, eigvalsh, lstsq, qr
from numpy.random import default_rng
from random_graphs import scipys
from scipy.io import mmread
from scipy.optimize import least_squares
from unseen_graphs import World

from coopoc.optimize import Problem, Status, solve
from coopoc.optimize.convex import certify, relaxation, shor
from coopoc.optimize.convex.qcqp import multipliers, quadratic
from coopoc.optimize.convex.relaxation import Reduced
from coopoc.optimize.graph_problems import from_graph, read_graph
from coopoc.optimize.model.problem import Search
from coopoc.optimize.model.space import exp

UP = 0.6
"""Vertical against horizontal std in anisotropic problems."""


swarm = partial(tightness.ranged, vehicles=4, mesh=True)
"""Fixes and the ranges of all pairs."""


def two_robots(seed, d=2, fixed=False, prior=False):
    """Odometry of two robots as chordal relative poses and ranges between them; nothing in the world's frame, but a
    prior of the first pose."""
    rng = default_rng(seed)
    w = World(rng, rng.uniform(-5, 5, (8, d)), exp(rng.uniform(-3, 3, (8, 2 * d - 3))), robots=2, steps=4)
    odometry, ranges = w.relative(w.chain(), 0.05, 0.02), w.ranged(w.near(16, 30.0, others=True), 0.1)
    whole = from_graph(w.graph(relative_pose=odometry, ranges=ranges), "chordal", "file")
    problem = replace(whole, poses=whole.poses[::-1], fixed=(0,) if fixed else ())
    return problem.add("pose_chordal", 0, problem.x0[0], 0.05) if prior else problem


def brute(problem, starts=30, spread=20.0):
    """Smallest cost that scipy finds from random starts, over positions or, in the plane, positions and headings."""
    rng, n, d = default_rng(0), len(problem.names), problem.dimension

    def system(y):
        rows = y.reshape(n, -1)
        return problem.whiten(problem.space.join(rows[:, :d], exp(rows[:, 2:]) if problem.poses else None))

    def found():
        start = rng.uniform(-spread, spread, n * (d + bool(problem.poses)))
        return least_squares(lambda y: system(y)[0], start, jac=lambda y: system(y)[1].toarray()).cost  # type: ignore[no-any-return]

    return min(found() for _ in range(starts))


def by_hand(problem):
    """Shor's relaxation of [1; t; s], no position eliminated, every row of A written out: CVXPY's value."""
    d, n, (fixes, ranges) = problem.dimension, len(problem.names), problem.factors
    m = len(ranges.z)
    size = 1 + d * (n + m)
    rows = []
    for i, z, w in zip(fixes.nodes[:, 0], fixes.z, fixes.root, strict=True):
        row = np.zeros((d, size))
        row[:, 0], row[:, 1 + d * i : 1 + d * i + d] = -w @ z, w
        rows.append(row)
    for e, ((i, j), r, w) in enumerate(zip(ranges.nodes, ranges.z[:, 0], ranges.root[:, 0, 0], strict=True)):
        row = np.zeros((d, size))
        for node, sign in ((i, -w), (j, w)):
            row[:, 1 + d * node : 1 + d * node + d] = sign * eye(d)
        row[:, 1 + d * (n + e) : 1 + d * (n + e) + d] = -w * r * eye(d)
        rows.append(row)
    A = np.concatenate(rows)
    Y = cp.Variable((size, size), PSD=True)
    first = 1 + d * (n + np.arange(m))
    ones = [Y[0, 0] == 1, *(cp.trace(Y[k : k + d, k : k + d]) == 1 for k in first)]
    programme = cp.Problem(cp.Minimize(0.5 * cp.trace(A.T @ A @ Y)), ones)
    return float(programme.solve(solver=cp.CLARABEL, tol_gap_rel=1e-9, tol_feas=1e-9))


def cora(name):
    """One of CORA's unit cases: our QCQP of it and a reader of its expected matrices."""
    folder = measured(f"cora_unit/{name}")
    if name == "single_range":
        problem = Problem(("L0", "L1"), x0=[[11, 19], [11, 21]], dimension=2).add("range", (0, 1), 2.0, 1.0)  # type: ignore[arg-type]
    else:
        problem = replace(read_graph(folder / "factor_graph.pyfg", start="file"), fixed=())
    return quadratic(problem), problem, lambda matrix: np.asarray(mmread(folder / f"{matrix}.mm").todense())


def tangent(form, X, V):
    """The part of V that keeps the constraints to first order."""
    return V - multipliers(form, X, V).matrix @ X


@pytest.mark.parametrize("name", ["single_range", "single_rpm", "small_ra_slam_problem"])
def test_matrices_are_coras(name):
    """Data matrix, lifted truth, gradients, certificate matrix and Hessian product that CORA's own tests expect."""
    form, problem, expected = cora(name)
    Q = (form.rows.T @ form.rows).toarray()
    assert pytest.approx(expected("DataMatrix"), abs=1e-7) == Q
    assert problem.x0 is not None
    x, c = problem.x0, form.bound
    X = form.lift(problem.space.position(x), problem.space.rotation(x))
    assert pytest.approx(expected("X_gt"), abs=1e-6) == X
    assert problem.space.join(*form.drop(X)) == pytest.approx(x, abs=1e-12)
    Y = expected("X_rand_dim2")
    gradient = Q @ Y
    assert gradient == pytest.approx(expected("expected_egrad"), abs=1e-7)
    L = multipliers(form, Y[:c], gradient[:c])
    S = Q.copy()
    S[:c, :c] -= L.matrix.toarray()
    assert pytest.approx(expected("S_rand"), abs=1e-6) == S
    gradient_ = np.concatenate([tangent(form, Y[:c], gradient[:c]), gradient[c:]])
    assert gradient_ == pytest.approx(expected("expected_rgrad"), abs=1e-7)
    bent = S @ expected("rand_dX")
    bent[:c] = tangent(form, Y[:c], bent[:c])
    assert bent == pytest.approx(expected("hessProd"), rel=1e-7, abs=1e-6)


@pytest.mark.parametrize("up", [1.0, UP])
@pytest.mark.parametrize("d", [2, 3])
def test_the_bound_is_that_of_the_programme_written_out(d, up):
    """Matrix form (d + m rows) and stacked form have the value of [1; t; s][1; t; s]^T, solved by CVXPY."""
    for seed in range(3):
        problem = swarm(seed, d=d, vehicles=3, stretch=up)
        assert quadratic(problem).columns == (d if up == 1.0 else 1)
        assert shor(problem).lower_bound == pytest.approx(by_hand(problem), rel=2e-5, abs=1e-6)


SWARMS = (swarm, partial(swarm, d=2), partial(swarm, stretch=UP))


@pytest.mark.parametrize(
    "make",
    [
        *SWARMS,
        partial(swarm, d=2, stretch=3.0),
        two_robots,
        partial(two_robots, d=3, prior=True),
        partial(two_robots, fixed=True),
    ],
)
@pytest.mark.parametrize("seed", range(3))
def test_no_point_beats_the_bounds(make, seed):
    """Random points, minima from random starts and the solution all cost at least what each relaxation says."""
    problem = make(seed)
    began = time.perf_counter()
    relaxation = shor(problem)
    assert 0 < relaxation.seconds <= time.perf_counter() - began
    best = relaxation.lower_bound
    rng, space = default_rng(seed), problem.space
    for _ in range(50):
        turned = qr(rng.standard_normal((len(problem.names), problem.dimension, problem.dimension)))[0]
        turned[:, :, 0] *= np.sign(det(turned))[:, None]
        if problem.x0 is not None and problem.fixed:
            turned[0] = space.rotation(problem.x0)[0]
        point = space.join(rng.normal(0, 10, (len(problem.names), problem.dimension)), turned)
        assert problem.cost(point) >= best
    if problem.poses and not problem.fixed:
        form = quadratic(problem)
        X = form.lift(space.position(point), space.rotation(point))
        assert 0.5 * np.square(form.rows @ X).sum() == pytest.approx(problem.cost(point))
    assert relaxation.solution.status is Status.SOLVED or problem.poses
    assert best <= relaxation.solution.cost * (1 + 1e-9) + 1e-9
    assert relaxation.solution.cost <= relaxation.cost * (1 + 1e-9) + 1e-12


@pytest.mark.parametrize("make", [*SWARMS, partial(two_robots, prior=True)])
@pytest.mark.parametrize("seed", range(2))
def test_tight_relaxations_reach_what_brute_force_reaches(make, seed):
    """scipy.optimize.least_squares from random starts finds nothing better, and its best is our solution."""
    problem = make(seed)
    relaxed = shor(problem)
    found = brute(problem, starts=12, spread=6.0 if problem.poses else 20.0)
    assert found >= relaxed.lower_bound * (1 - 1e-9) - 1e-9
    assert relaxed.solution.cost <= found * (1 + 1e-6)
    if relaxed.tight:
        assert relaxed.lower_bound == pytest.approx(found, rel=1e-5)


@pytest.mark.parametrize("make", [two_robots, partial(two_robots, d=3), partial(two_robots, fixed=True), *SWARMS])
def test_the_elimination_is_numpys(make, monkeypatch):
    """C and its products by numpy.linalg.lstsq, eigenvalues by eigh and by Lanczos."""
    form = quadratic(make(0))
    small, A = Reduced(form), form.rows.toarray()
    rest = A @ np.concatenate([eye(form.bound), -lstsq(A[:, form.bound :], A[:, : form.bound], rcond=None)[0]])
    C = rest.T @ rest
    X = form.project(default_rng(0).standard_normal((form.bound, form.columns)))
    assert small.matrix == pytest.approx(C, abs=1e-9 * abs(C).max())
    assert small.times(X) == pytest.approx(C @ X, abs=1e-9 * abs(C).max())
    assert np.square(A @ small.settle(X)).sum() == pytest.approx(np.sum(X * (C @ X)), rel=1e-9)
    L = multipliers(form, X, small.times(X))
    (a,) = small.smallest(L)
    assert a == pytest.approx(eigvalsh(C - L.matrix.toarray())[0], rel=1e-7)
    monkeypatch.setattr(relaxation, "FORMED_ROWS", 0)
    large = Reduced(form)
    assert large.times(X) == pytest.approx(C @ X, abs=1e-9 * abs(C).max())
    (b,) = large.smallest(L)
    assert a == pytest.approx(b, rel=1e-7)


def test_the_backend_is_held_to_the_same_check_as_the_others():
    """`solve` recomputes cost, gradient and status: gauss-newton's answer, and the bound in the extras."""
    for problem in (swarm(0), swarm(1, d=2), replace(swarm(2), factors=swarm(2).factors[:1])):
        ours, theirs = solve(problem), solve(problem, "cvxpy")
        assert theirs.status is Status.SOLVED
        assert theirs.cost == pytest.approx(ours.cost, rel=1e-9, abs=1e-12)
        assert theirs.x == pytest.approx(ours.x, abs=1e-6)
        assert theirs.extras.get("lower_bound", 0.0) <= ours.cost * (1 + 1e-9) + 1e-12
    with refused("is no option of cvxpy"):
        solve(swarm(0), "cvxpy", max_iterations=3)


def test_what_has_no_relaxation_is_refused():
    problem = swarm(0)
    with refused("not quadratic: it must be one of"):
        shor(problem.add("azimuth", ("v0", "v1"), 0.1, 0.1))
    with refused("constraints"):
        shor(problem.constrain("position", "v0", lower=-1.0))
    with refused("must have at most 60.*certify"):
        shor(swarm(0, vehicles=20))
    poses = two_robots(0)
    with refused("differs between axes"):
        shor(poses.add("position", "A0", [0, 0], [1.0, 2.0]))
    with refused("differs between axes"):
        shor(poses.add("relative_position", ("A0", "B0"), [1, 0], [1.0, 2.0]))


def minima(problem, starts=15):
    """The minima that Gauss-Newton reaches from random starts, the lowest first."""
    rng, found = default_rng(0), []
    for _ in range(starts):
        x0 = rng.uniform(-20, 20, (len(problem.names), problem.dimension))
        solution = solve(replace(problem, x0=x0, search=Search("random", x0=x0)), throw=False)
        if solution.status is Status.SOLVED:
            found.append(solution)
    return sorted(found, key=lambda solution: solution.cost)


@pytest.mark.parametrize("seed", [1, 2, 6])
def test_a_local_minimum_is_refused_where_the_global_one_is_certified(seed):
    """Gauss-Newton reports SOLVED at both; scipy.optimize.least_squares finds nothing below the certified one."""
    problem = tightness.anchored(seed, 4, 2, 2, 0.1)
    best, *others = minima(problem)
    local = [solution for solution in others if solution.cost > best.cost + 1.0]
    assert local
    verdict = certify(problem, best)
    assert verdict.certified
    assert str(verdict) == f"certified global optimum of {problem!r}, and no other point costs as little"
    assert verdict.gap <= 1e-6 * max(best.cost, 1.0)
    for solution in local:
        refused = certify(problem, solution)
        assert not refused.certified
        assert refused.lower_bound <= best.cost
        assert refused.smallest_eigenvalue < -1e-3
        assert str(refused).startswith("not certified")
    rng = default_rng(1)
    for _ in range(8):
        assert scipys(problem, rng.uniform(-20, 20, (6, 2))).cost >= verdict.lower_bound * (1 - 1e-9)


def test_the_eigenvalue_is_that_of_the_whole_matrix():
    """Schur complement and Q - diag(L, 0) are indefinite together; numpy.linalg.eigvalsh on the latter."""
    for seed in range(4):
        problem = tightness.anchored(seed, 4, 2, 2, 0.1)
        form = quadratic(problem)
        for solution in minima(problem, starts=6):
            X = form.lift(solution.x, np.tile(eye(2), (6, 1, 1)))
            Q = (form.rows.T @ form.rows).toarray()
            CX = (Q @ X)[: form.bound]
            assert abs((Q @ X)[form.bound :]).max() < 1e-4 * abs(Q).max()
            S = Q.copy()
            for block in form.stiefel:
                S[np.ix_(block, block)] -= 0.5 * (CX[block] @ X[block].T + X[block] @ CX[block].T)
            for (row,) in form.sphere:
                S[row, row] -= CX[row] @ X[row]
            smallest = certify(problem, solution).smallest_eigenvalue
            tolerance = 1e-9 * abs(Q).max()
            assert (eigvalsh(S)[0] < -tolerance) == (smallest < -tolerance)


def test_the_example_tells_local_from_global(capsys):
    rows = range_only.main()
    printed = capsys.readouterr().out
    assert printed.count("\n") == len(rows) + 3
    local = [row for row in rows if row.blind > row.cost * (1 + 1e-6)]
    assert len(local) >= 2
    assert f"{len(local)} of {len(rows)} blind starts ended in a local minimum" in printed
    assert not any(row.certified for row in local)
    assert sum(row.tight for row in rows) >= 2
    for row in rows:
        assert row.bound <= row.cost * (1 + 1e-9)
        assert row.cost <= row.blind * (1 + 1e-9)
        if row.tight:
            assert row.cost == pytest.approx(row.bound, rel=1e-5)
        if row.certified:
            assert row.blind == pytest.approx(row.cost, rel=1e-6)

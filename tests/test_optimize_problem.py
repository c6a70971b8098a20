"""Problems: built by hand, from a snapshot, from a window; residuals, Jacobian, and what a wrong input says."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from conftest import refused
from numpy import eye, inf, nan, ones, zeros
from numpy.linalg import cholesky, eigvalsh, inv, lstsq
from numpy.random import default_rng
from oracles.whitened import whitened
from random_graphs import AB, PAIR

from coopoc import V2X, NoiseModel, Sensors, load_fleet, observe
from coopoc.optimize import Factor, Loss, Problem, SolveError, Status, pose, solve
from coopoc.optimize.convex.qcqp import quadratic
from coopoc.optimize.model.window import relative_std
from coopoc.optimize.starts.initial import initial_guess
from coopoc.world.links import to_vector, vector_cov

S2 = Sensors.paper_scenario2()


@pytest.fixture(scope="module")
def recording(crossing):
    return observe(crossing, S2, V2X(max_neighbours=4, radius=60), runs=3)


def mixed():
    """One factor of every kind, with std per component, per row and a full root."""
    rng = default_rng(0)
    p = Problem([*"abcd"], x0=rng.normal(size=(4, 3)) * 10)
    p = p.add("position", list("abcd"), rng.normal(size=(4, 3)) * 10, std=rng.uniform(1, 3, (4, 3)))
    p = p.add("displacement", AB, [5, 1, 0], sqrt_information=np.tril(rng.uniform(0.5, 1, (3, 3))))
    p = p.add("spherical", [("a", "c"), ("d", "b")], [[9, 1, 1.5], [12, -3, 1.2]], std=[1, 0.07, 0.07])
    p = p.add("range", ("c", "d"), 7.0, std=0.5).add("azimuth", ("b", "d"), 2.0, std=0.1)
    return p.add("inclination", ("a", "d"), 1.4, std=0.1)


def test_jacobian_equals_casadis():
    problem = mixed()
    x = ca.SX.sym("x", 3, 4)
    residual = whitened(problem, x)
    reference = ca.Function("r", [x], [residual, ca.jacobian(residual, ca.vec(x))])
    r, J = problem.whiten(problem.x0)
    expected, jacobian = (np.asarray(a) for a in reference(problem.x0.T))
    assert r == pytest.approx(expected[:, 0], abs=1e-12)
    assert J.toarray() == pytest.approx(jacobian, abs=1e-12)
    assert problem.cost(problem.x0) == pytest.approx(0.5 * r @ r)


def test_window_chains_who_stays(recording):
    problem = Problem.from_window(recording, step=20, ego=0, length=4)
    moved = next(f for f in problem.factors if f.kind == "displacement")
    for (i, j), z in zip(moved.nodes, moved.z, strict=True):
        (before, s), (after, t) = problem.names[i].split("@"), problem.names[j].split("@")
        assert before == after
        assert int(t) == int(s) + 1
        assert z == pytest.approx(recording.dt * recording.velocity[0, int(t), recording.ids.index(after)])
    assert len(moved.nodes) == sum(
        name.split("@")[0] + f"@{int(name.split('@')[1]) - 1}" in problem.names for name in problem.names
    )
    assert problem.names[problem.shown] == "c0@20"


def test_the_noise_model_sets_the_weights(recording):
    nominal = Problem.from_window(recording, 20, 0, 3)
    stated = Problem.from_window(recording, 20, 0, 3, noise=NoiseModel.nominal(S2))
    x = default_rng(0).normal(size=(len(nominal.names), 3)) * 30
    assert stated.cost(x) == pytest.approx(nominal.cost(x), rel=1e-12)
    more = Problem.from_window(replace(recording, motion_variance=np.full(recording.broadcasts.shape, 9.0)), 20, 0, 3)
    before, after = (next(f.std for f in each.factors if f.kind == "displacement") for each in (nominal, more))
    assert after**2 - before**2 == pytest.approx(9.0 * recording.dt)
    identity = Problem.from_window(recording, 20, 0, 3, noise=NoiseModel.identity())
    assert {f.kind for f in identity.factors} == {"position", "displacement"}
    assert all((f.std == 1).all() for f in identity.factors)


def test_a_range_below_the_gate_widens_its_angles(recording):
    """The tangential std in metres is that at min_range, as in the converted covariance (vector_cov)."""
    near = np.array([[0.5, 0.3, 1.5]])
    std = relative_std(near, S2)[0]
    assert 0.5 * std[2] == pytest.approx(
        np.sqrt(eigvalsh(vector_cov(near[0], S2.relative_std, S2.min_range))[1]), rel=1e-9
    )
    assert relative_std(near * [10, 1, 1], S2).shape == (3,)


def test_infinite_std_is_no_measurement():
    with_blank = PAIR.add("spherical", AB, [9.5, 0.1, 1.5], std=inf).add("range", AB, 10, std=1.0)
    without = PAIR.add("range", AB, 10, std=1.0)
    for backend in ("gauss-newton", "gtsam", "osqp"):
        assert solve(with_blank, backend).x == pytest.approx(solve(without).x, abs=1e-9)


BAD = {
    "nan": (lambda: PAIR.add("position", "a", [0, nan, 0], std=1.0), "finite"),
    "zero std": (lambda: PAIR.add("range", AB, 5.0, std=0.0), "must be > 0"),
    "degrees": (lambda: PAIR.add("azimuth", AB, 270.0, std=0.1), "deg2rad"),
    "zero range": (lambda: PAIR.add("range", AB, 0.0, std=1.0), "Coincident"),
    "unknown node": (lambda: PAIR.add("range", ("a", "c"), 5.0, std=1.0), "one of a, b"),
    "misspelt node": (lambda: Problem(("car", "bus")).add("range", ("car", "buss"), 5.0, std=1.0), "Did you mean bus"),
    "itself": (lambda: PAIR.add("range", ("a", "a"), 5.0, std=1.0), "different points"),
    "unknown kind": (lambda: PAIR.add("doppler", AB, 5.0, std=1.0), "spherical"),
    "no std": (lambda: PAIR.add("range", AB, 5.0), "exactly one of std, cov"),
    "shape of z": (lambda: PAIR.add("spherical", AB, [5.0], std=1.0), "must have 2 or 3"),
    "shape of std": (lambda: PAIR.add("spherical", AB, [5.0, 0.1, 1], std=[1.0, 1.0]), "must have shape"),
    "shape of cov": (lambda: PAIR.add("position", "a", [0, 0, 0], cov=ones((2, 3))), "square matrices"),
    "std of a turn": (lambda: PAIR.add("azimuth", AB, 0.1, std=4.0), "<= pi rad"),
    "another shape of cov": (lambda: PAIR.add("position", "a", [0, 0, 0], cov=eye(2)), "cov of position"),
    "variance in degrees": (lambda: PAIR.add("azimuth", AB, 1.0, cov=[[16.0]]), "<= pi rad"),
    "bound in degrees": (lambda: PAIR.constrain("azimuth", AB, 45.0), "deg2rad"),
    "shape of a root": (lambda: PAIR.add("azimuth", AB, 0.1, sqrt_information=eye(2)), r"\(1, 1\)"),
    "root not finite": (lambda: PAIR.add("azimuth", AB, 0.1, sqrt_information=[[inf]]), "must be finite"),
    "heights in a plane": (
        lambda: Problem([*"ab"], dimension=2).constrain("inclination", AB, 0.0, 1.0),
        "does not exist in two dimensions",
    ),
    "no factor": (lambda: Problem([*"a"], factors=(1,)), "must be Factors"),
    "nodes of a factor": (lambda: Factor("range", [[0]], [[5.0]], std=[[1.0]]), r"must have shape \(M, 2\) for range"),
    "a factor of another problem": (lambda: Problem([*"a"], factors=PAIR.factors), "one of a"),
    "infinite bounds": (lambda: PAIR.constrain("position", "a", [inf, 0, 0], inf), "below infinity"),
    "a text for names": (lambda: Problem("ego"), "names = .ego.: must be a sequence"),
    "no bound": (lambda: PAIR.constrain("position", "a"), "must bound something"),
    "bounds of a pose": (lambda: PAIR.constrain("relative_pose", AB), "cannot bound them"),
    "a loss relaxed": (
        lambda: quadratic(PAIR.add("range", AB, 9.0, std=1.0, loss=Loss("huber", 2.0))),
        "is not quadratic",
    ),
    "arity": (lambda: PAIR.add("range", ("a",), 5.0, std=1.0), "must name 2 points"),
    "columns of nodes": (lambda: PAIR.add("displacement", ones((2, 4), int), ones(3), std=1.0), "must name 2"),
    "a mask": (lambda: Problem([*"ab"], fixed=[True, False]), "node = True"),
    "whole numbers for names": (lambda: Problem((2, 1)), r"names = .2, 1.: must be a sequence of texts"),
    "twice a name": (lambda: Problem([*"baa"]), r"\['a'\]: must be unique"),
    "x0": (lambda: Problem(AB, x0=zeros((3, 3))), "shape"),
    "no factors": (lambda: solve(Problem([*"a"])), "no measurements"),
    "words for z": (lambda: PAIR.add("range", AB, "far", std=1.0), "array of numbers"),
    "node between two": (lambda: PAIR.add("range", (0.2, 1.7), 5.0, std=1.0), "node = 0.2"),
    "shown": (lambda: Problem(AB, shown="c"), "node = .c.: must be one of a, b"),
    "x0 not finite": (lambda: Problem([*"a"], x0=[[nan, 0, 0]]), "x0 = not finite"),
    "shape of x": (lambda: PAIR.cost([0, 0, 0]), r"x = shape \(3,\)"),
    "iterations": (lambda: solve(PAIR, max_iterations=2.5), "max_iterations = 2.5"),
    "tolerance": (lambda: solve(PAIR, tolerance=float("nan")), "tolerance = nan"),
    "coincident, bounded": (
        lambda: solve(replace(PAIR, x0=zeros((2, 3))).constrain("range", AB, 4.0, 5.0)),
        "a and b coincide",
    ),
    "nothing to relax": (lambda: quadratic(Problem([*"a"])), "no measurements"),
    "two runs": (lambda: Problem([*"a"]).add("position", "a", zeros((2, 1, 3)), std=1.0), "a problem for each run"),
}


@pytest.mark.parametrize("case", BAD, ids=str)
def test_wrong_input_says_what_to_do(case):
    wrong, words = BAD[case]
    with refused(words) as caught:
        wrong()
    assert caught.value.hint


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        ((60, 0, 1), "step"),
        ((-1, 0, 1), "step"),
        ((5, 0, 9), "length"),
        ((5, 0, 0), "length"),
        ((5, 99, 1), "egos"),
        ((5, 0, 1, 3), "run"),
    ],
)
def test_a_window_that_does_not_exist(recording, arguments, field):
    with refused(field):
        Problem.from_window(recording, *arguments)


@pytest.mark.parametrize("backend", ["gauss-newton", "gtsam", "osqp"])
def test_the_limit_of_iterations_is_an_error_with_the_solution(backend):
    with pytest.raises(SolveError, match="limit of iterations") as caught:
        solve(mixed(), backend, max_iterations=1)
    assert caught.value.solution.status is Status.MAX_ITERATIONS
    assert caught.value.solution.iterations == 1
    assert solve(mixed(), backend, throw=False, max_iterations=1).status is Status.MAX_ITERATIONS


def test_a_start_is_the_least_squares_of_the_converted_vectors(recording):
    """Against NumPy's least squares with vectors d u and vector_cov; ranges and losses have no part in it."""
    star = Problem.from_snapshot(recording, 20, 0)
    fixes, edges = star.factors
    problem = Problem(star.names, star.factors).add("range", (1, 2), 5.0, std=0.1)
    problem = problem.add("position", 0, fixes.z[0] + 2.0, std=1.0, loss=Loss("cauchy", 1.0))
    rows, goals = [], []
    for factor, z, cov in (
        (fixes, fixes.z, np.diag(np.square(fixes.std[0]))),
        (edges, to_vector(edges.z), vector_cov(edges.z, S2.relative_std)),
        (problem.factors[-1], problem.factors[-1].z, eye(3)),
    ):
        for nodes, value, own in zip(factor.nodes, z, np.broadcast_to(cov, (len(z), 3, 3)), strict=True):
            wide = zeros((3, len(star.names), 3))
            wide[:, nodes[-1]] = eye(3)
            if len(nodes) == 2:
                wide[:, nodes[0]] = -eye(3)
            root = cholesky(inv(own)).T
            rows.append(root @ wide.reshape(3, -1))
            goals.append(root @ value)
    assert initial_guess(problem).ravel() == pytest.approx(
        lstsq(np.concatenate(rows), np.concatenate(goals), rcond=None)[0], abs=1e-5
    )


def test_fine_measurements_do_not_hide_what_is_free():
    """What rounding leaves of J^T J along a free direction looks like a variance of 1e-8 m^2."""
    for fine in default_rng(0).uniform(1e-4, 2e-4, (60, 3, 3)):
        free = Problem([*"ab"]).add("displacement", [(0, 1)] * 3, fine, std=fine)
        assert solve(free, throw=False).status is Status.RANK_DEFICIENT


@pytest.mark.parametrize("backend", ["gauss-newton", "gtsam", "osqp"])
def test_a_point_that_can_turn_around_another_is_free(backend):
    """One range leaves two of its three directions open, and the rounding of J^T J does not hide it."""
    rng = default_rng(0)
    for _ in range(20):
        x0 = np.concatenate([[[0, 0, 0], [9, 0, 0]], rng.normal(0, 9, (1, 3))])
        hanging = Problem([*"abc"], PAIR.factors, x0).add("range", ("b", "c"), 7.3, std=0.3)
        bounded = hanging.constrain("position", "a", upper=50.0) if backend == "osqp" else hanging
        solution = solve(bounded, backend, throw=False)
        assert solution.status is Status.RANK_DEFICIENT
        assert solution.unobservable == ("c",)


@pytest.fixture(scope="module")
def incomplete():
    """Half of the fixes are missing; of the relative measurements some all, some the azimuth, some the range."""
    seen = observe(load_fleet("town10").between(0, 30), Sensors.paper_scenario2(), V2X(6), runs=4, observers=[5])
    rng = default_rng(0)
    gnss, relative = seen.gnss.copy(), seen.relative.copy()
    gnss[rng.random(gnss.shape[:3]) < 0.5] = nan
    for part, share in ((slice(None), 0.1), (1, 0.1), (slice(1, 3), 0.1), (0, 0.05)):
        relative[..., part][rng.random(relative.shape[:2]) < share] = nan
    return replace(seen, gnss=gnss, relative=relative)


@pytest.mark.parametrize("noise", [None, NoiseModel.identity()])
def test_what_is_missing_is_no_factor(incomplete, noise):
    """A window by hand from each number that is there; SciPy's trust region finds the same minimum."""
    steps, solved = range(16, 21), 0
    sensors = incomplete.sensors
    for run in range(incomplete.runs):
        problem = Problem.from_window(incomplete, 20, 5, 5, run, noise)
        hand = replace(problem, factors=(problem.factors[1],))
        assert hand.factors[0].kind == "displacement"
        for t in steps:
            links = incomplete.links.of(5)
            links = links[incomplete.links.step[links] == t]
            for member in (5, *incomplete.links.neighbour[links]):
                fix = incomplete.gnss[run, t, member]
                std = sensors.gnss_std if noise is None else 1.0
                if np.isfinite(fix).all():
                    hand = hand.add("position", f"{incomplete.ids[member]}@{t}", fix, std=std)
            for link, member in zip(links, incomplete.links.neighbour[links], strict=True):
                pair, z = tuple(f"{incomplete.ids[m]}@{t}" for m in (5, member)), incomplete.relative[run, link]
                if noise is not None and np.isfinite(z).all():
                    hand = hand.add("displacement", pair, to_vector(z), std=1.0)
                    continue
                stds = ones(3) if noise is not None else np.broadcast_to(relative_std(z[None], sensors), (1, 3))[0]
                for kind, value, std in zip(("range", "azimuth", "inclination"), z, stds, strict=True):
                    if np.isfinite(value):
                        hand = hand.add(kind, pair, value, std=std)
        ours = solve(problem, throw=False)
        if ours.status is Status.SOLVED:
            solved += 1
            assert solve(replace(hand, x0=ours.x)).x == pytest.approx(ours.x, abs=1e-6)
            assert hand.cost(ours.x) == pytest.approx(ours.cost, rel=1e-9)
    assert solved >= 2


@pytest.mark.parametrize("poses", [(), (1,), (0, 2)])
def test_a_point_among_poses_has_no_rotation_to_move(poses):
    problem = Problem([*"abc"], x0=pose(zeros((3, 2))) if poses else zeros((3, 2)), dimension=2, poses=poses)
    wanted = np.full(3, 2) + np.isin(range(3), poses)
    assert problem.movable.sum(1).tolist() == wanted.tolist()

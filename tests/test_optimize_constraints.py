"""Constraints: closed forms, SciPy's constrained solvers, KKT written out here; sets that are empty; who refuses."""

import sys
from dataclasses import replace
from itertools import pairwise

import casadi as ca
import numpy as np
import pytest
from conftest import refused, same_minimum
from numpy import arange, array, cos, diff, stack, zeros
from numpy.linalg import inv, norm
from numpy.random import default_rng
from random_graphs import AB, PAIR
from scipy.linalg import null_space
from scipy.optimize import LinearConstraint, NonlinearConstraint, lsq_linear, minimize

from coopoc.optimize import (
    MEASUREMENTS,
    Backend,
    Capabilities,
    Loss,
    Problem,
    SolveError,
    SolverResult,
    Status,
    backends,
    measurement,
    pose,
    solve,
)
from coopoc.optimize.assess.active import active_at

INF = np.inf
BOTH = ["osqp", "casadi"]
"""Of linear constraints; others hold in the second alone."""
RANGED = PAIR.add("range", AB, 8.0, std=0.5)


def road(x, y, m=np):
    return 2.0 * m.sin(x / 15.0) + 0.05 * y


@pytest.fixture(scope="module", autouse=True)
def kinds():
    """A road surface and a plane, as a user would register them."""

    @measurement("height", arity=1, components=("coordinate",))
    def height(x, y, z, m=np):
        return (z - road(x, y, m),)

    @measurement("plane", arity=1, components=("coordinate",), constants=3)
    def plane(x, y, z, a, b, c, m=np):
        return (a * x + b * y + c * z,)

    yield
    del MEASUREMENTS["height"], MEASUREMENTS["plane"]


def solved(problem, backend="casadi"):
    solution = solve(problem, backend)
    assert solution.status is Status.SOLVED
    assert solution.violation < 1e-8
    return solution


def gradient(problem, x):
    r, J = problem.whiten(x)
    return J.T @ r


@pytest.mark.parametrize("seed", range(4))
def test_a_fix_on_a_plane_is_projected(seed):
    """Closed form: x = p - S n (n.p - c) / (n.S n), covariance S - S n n^T S / (n.S n)."""
    rng = default_rng(seed)
    n, p, c, std = rng.normal(size=3), rng.normal(size=3) * 5, rng.normal(), rng.uniform(1, 4, 3)
    S = np.diag(std**2)
    solution = solved(Problem([*"a"]).add("position", "a", p, std=std).constrain("plane", "a", c, c, constants=n))
    assert solution.x[0] == pytest.approx(p - S @ n * (n @ p - c) / (n @ S @ n), abs=1e-9)
    assert solution.covariance[0] == pytest.approx(S - np.outer(S @ n, S @ n) / (n @ S @ n), abs=1e-9)
    assert solution.cost == pytest.approx(0.5 * (n @ p - c) ** 2 / (n @ S @ n), rel=1e-9)


def chain(points, seed):
    """A random walk with odometry 1000 times as sure as the fixes: a linear problem."""
    rng = default_rng(seed)
    truth = np.cumsum(rng.normal(size=(points, 3)), axis=0)
    names = tuple(f"p{k}" for k in range(points))
    problem = Problem(names).add("position", names, truth + rng.normal(0, 3, truth.shape), std=3.0)
    return problem.add("displacement", list(pairwise(names)), diff(truth, axis=0), std=0.003)


@pytest.mark.parametrize("backend", BOTH)
@pytest.mark.parametrize("seed", range(3))
def test_a_linear_problem_in_a_box_is_scipys(seed, backend):
    """scipy.optimize.lsq_linear (BVLS); with bounds alone x - clip(x - gradient) vanishes at the minimum."""
    problem = chain(12, seed)
    free = solve(problem).x
    lower, upper = free - 0.2, free + default_rng(seed).uniform(-0.15, 0.5, free.shape)
    r, J = problem.whiten(np.zeros_like(free))
    found = lsq_linear(J.toarray(), -r, (lower.ravel(), upper.ravel()), method="bvls", tol=1e-15)
    solution = solved(problem.constrain("position", problem.names, lower, upper), backend)
    assert solution.x.ravel() == pytest.approx(found.x, abs=1e-6)
    assert solution.cost == pytest.approx(found.cost, rel=1e-9)
    gradient_ = gradient(problem, solution.x).reshape(-1, 3) * 1e-3  # m per unit of cost
    assert solution.x == pytest.approx(np.clip(solution.x - gradient_, lower, upper), abs=1e-6)
    assert solution.covariance == pytest.approx(solve(problem).covariance, abs=1e-9)
    if backend == "osqp":
        assert solution.iterations == 1


@pytest.mark.parametrize("backend", BOTH)
@pytest.mark.parametrize("length", [1, 5])
def test_constraints_that_do_not_push_change_nothing(dense, length, backend):
    problem = Problem.from_window(dense, 20, 0, length)
    free = solve(problem)
    wide = problem.constrain("position", problem.names, free.x - 1.0, free.x + 0.1)
    wide = wide.constrain("displacement", (0, 1), -1e3, 1e3)
    same_minimum(solved(wide, backend), free)


def drive(seed, vehicles=2, steps=4):
    """Vehicles on the road, with fixes, odometry that runs ahead and ranging to the one in front."""
    rng = default_rng(seed)
    t = 0.5 * arange(steps)[:, None]
    x, y = 14.0 * t - 20.0 * arange(vehicles), 0.0 * t + zeros(vehicles)
    truth = stack([x, y, road(x, y)], -1)
    names = [[f"v{v}@{s}" for v in range(vehicles)] for s in range(steps)]
    flat = tuple(n for row in names for n in row)
    moved = [(a, b) for now, then in pairwise(names) for a, b in zip(now, then, strict=True)]
    problem = Problem(flat).add("position", flat, truth.reshape(-1, 3) + rng.normal(0, 2, (len(flat), 3)), std=2.0)
    gone = diff(truth, axis=0).reshape(-1, 3)
    problem = problem.add("displacement", moved, 1.1 * gone + rng.normal(0, 0.3, (len(moved), 3)), std=0.3)
    ahead = [(b, a) for row in names for a, b in pairwise(row)]
    gap = (truth[:, :-1] - truth[:, 1:]).reshape(-1, 3)
    seen = MEASUREMENTS["spherical"].predict(gap) + rng.normal(size=gap.shape) * [0.5, 0.03, 0.03]
    problem = problem.add("spherical", ahead, seen, std=[0.5, 0.03, 0.03])
    problem = problem.constrain("height", flat, 0.0, 0.0)
    problem = problem.constrain("position", flat, [-INF, -0.8, -INF], [INF, 0.8, INF])
    return problem.constrain("speed", moved, upper=14.0, constants=[0.5])


def scipys(problem):
    """SciPy on the same problem: its cost and gradient are ours, the constraints and their derivatives written here."""
    n = len(problem.names)
    moved = next(f.nodes for f in problem.factors if f.kind == "displacement")
    ties = zeros((3 * len(moved), 3 * n))
    for k, (i, j) in enumerate(moved):
        for c in range(3):
            ties[3 * k + c, [3 * i + c, 3 * j + c]] = -1.0, 1.0

    def rise(flat):
        x, y, z = flat.reshape(-1, 3).T
        return z - road(x, y)

    def rise_slope(flat):
        jacobian = zeros((n, 3 * n))
        k = arange(n)
        jacobian[k, 3 * k], jacobian[k, 3 * k + 1], jacobian[k, 3 * k + 2] = (
            -2.0 / 15.0 * cos(flat[::3] / 15.0),
            -0.05,
            1.0,
        )
        return jacobian

    def speed(flat):
        return norm((ties @ flat).reshape(-1, 3), axis=1) / 0.5

    def speed_slope(flat):
        gap = (ties @ flat).reshape(-1, 3)
        return np.einsum("kc,kcn->kn", gap / norm(gap, axis=1, keepdims=True), ties.reshape(-1, 3, 3 * n)) / 0.5

    lane = np.eye(3 * n)[1::3]
    constraints = [
        NonlinearConstraint(rise, 0, 0, rise_slope),
        LinearConstraint(lane, -0.8, 0.8),
        NonlinearConstraint(speed, -INF, 14.0, speed_slope),
    ]
    found = minimize(
        lambda flat: problem.cost(flat.reshape(-1, 3)),
        problem.factors[0].z.ravel(),
        method="SLSQP",
        jac=lambda flat: gradient(problem, flat.reshape(-1, 3)),
        constraints=constraints,
        options={"ftol": 1e-15, "maxiter": 2000},
    )
    return found.x.reshape(-1, 3), found.fun


@pytest.mark.parametrize("seed", range(4))
def test_surface_lane_and_top_speed_are_scipys(seed):
    problem = drive(seed)
    x, cost = scipys(problem)
    solution = solved(problem)
    assert solution.cost == pytest.approx(cost, rel=1e-8)
    assert solution.x == pytest.approx(x, abs=1e-4)
    assert norm(solution.x[2:] - solution.x[:-2], axis=1).max() == pytest.approx(
        7.0, abs=1e-6
    )  # the limit is met, not passed
    assert solution.x[:, 2] == pytest.approx(road(solution.x[:, 0], solution.x[:, 1]), abs=1e-9)
    assert abs(solution.x[:, 1]).max() <= 0.8 + 1e-9


def test_the_covariance_holds_equalities_exactly():
    """Against Z (Z^T J^T J Z)^-1 Z^T with SciPy's null space; the inequalities that push are left out."""
    problem = drive(1)
    solution = solve(problem, "casadi")
    _, J = problem.whiten(solution.x)
    rows = zeros((len(solution.x), J.shape[1]))
    for k, (x, _, _) in enumerate(solution.x):
        rows[k, 3 * k : 3 * k + 3] = -2.0 / 15.0 * cos(x / 15.0), -0.05, 1.0
    Z = null_space(rows)
    cov = Z @ inv(Z.T @ (J.T @ J).toarray() @ Z) @ Z.T
    own = stack([cov[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(len(solution.x))])
    assert solution.covariance == pytest.approx(own, abs=1e-9)


def test_multipliers_are_those_of_ipopt():
    """An NLP written in CasADi here: its multipliers have our signs and values."""
    problem = drive(2)
    solution = solve(problem, "casadi")
    held = active_at(problem, solution.x, gradient(problem, solution.x).reshape(-1, 3))
    x = ca.SX.sym("x", 3, len(problem.names))
    moved = next(f.nodes for f in problem.factors if f.kind == "displacement").tolist()
    r, J = problem.whiten(solution.x)
    step = ca.vec(x) - ca.DM(solution.x.ravel())
    model = 0.5 * ca.sumsqr(ca.DM(r) + ca.DM(J.toarray()) @ step)  # the same gradient at the solution
    rise = ca.vertcat(*(x[2, k] - road(x[0, k], x[1, k], ca) for k in range(x.shape[1])))
    speed = ca.vertcat(*(ca.norm_2(x[:, j] - x[:, i]) / 0.5 for i, j in moved))
    g, n, m = ca.vertcat(rise, x[1, :].T, speed), x.shape[1], len(moved)
    quiet = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-10, "mu_target": 1e-11}}
    found = ca.nlpsol("s", "ipopt", {"x": ca.vec(x), "f": model, "g": g}, quiet)(
        x0=solution.x.ravel(), lbg=[0.0] * n + [-0.8] * n + [-INF] * m, ubg=[0.0] * n + [0.8] * n + [14.0] * m
    )
    assert held.multipliers == pytest.approx(np.asarray(found["lam_g"]).ravel(), abs=1e-6)
    assert abs(held.multipliers[n:]).max() > 0.01


def test_poses_in_a_slab():
    """osqp holds bounds on positions of poses; casadi agrees, and a step of SciPy's BVLS around it moves nothing."""
    rng, n = default_rng(0), 6
    at = np.c_[5.0 * arange(n), rng.normal(0, 1, n)]
    turn = rng.normal(0, 0.3, n)
    c, s = cos(turn[:-1]), np.sin(turn[:-1])
    gap = diff(at, axis=0)
    seen = np.c_[c * gap[:, 0] + s * gap[:, 1], c * gap[:, 1] - s * gap[:, 0]]
    z = pose(seen + rng.normal(0, 0.1, seen.shape), diff(turn) + rng.normal(0, 0.05, n - 1))
    names = tuple("abcdef")
    problem = Problem(names, dimension=2, poses=range(n), x0=pose(at + 0.2, turn + 0.1))
    problem = problem.add("pose", "a", pose(at[0], turn[0]), 0.1).add("relative_pose", list(pairwise(names)), z, 0.1)
    bound = problem.constrain("position", names, [-INF, -0.5], [INF, 0.5])
    first, *others = [solved(bound, backend) for backend in BOTH]
    for other in others:
        same_minimum(other, first)
    same_minimum(solve(replace(bound, x0=pose(-at, 2.0))), first)
    r, J = problem.whiten(first.x)
    room = np.full((n, 3), INF)
    room[:, 1] = 0.5
    y = np.c_[0 * turn, first.x[:, 1], 0 * turn]
    bounds = (np.minimum(-room - y, -1e-12).ravel(), np.maximum(room - y, 1e-12).ravel())
    assert lsq_linear(J.toarray(), -r, bounds, method="bvls", tol=1e-15).x == pytest.approx(0.0, abs=1e-6)
    assert abs(first.position[:, 1]).max() == pytest.approx(0.5, abs=1e-9)


def east(problem, node, lower=-INF, upper=INF):
    return problem.constrain("position", node, [lower, -INF, -INF], [upper, INF, INF])


SHIFTED = RANGED.constrain("displacement", AB, [5, 0, 0], [5, 0, 0])
EMPTY = {
    "what an equality allows": east(east(SHIFTED, "a", upper=0), "b", 10),
    "two boxes": east(east(RANGED, "a", 3), "a", upper=2),
    "by a tenth of a millimetre": east(east(PAIR, "a", 3), "a", upper=2.9999),
    "two ranges": RANGED.constrain("range", AB, 5, 5).constrain("range", AB, 7, 7),
    "a range and two boxes": east(east(RANGED.constrain("range", AB, upper=5.0), "a", upper=-5), "b", 15),
    "what is held": replace(RANGED, x0=[[0, 0, 0], [9, 0, 0]], fixed=(0,)).constrain(
        "position", "a", [1, 0, 0], [1, 0, 0]
    ),
}


@pytest.mark.parametrize("backend", ["casadi", "osqp"])
def test_what_equalities_place_is_known_exactly(backend):
    """Also where one more says the same, but for casadi, which takes no more equalities than numbers that can move."""
    places = array([[1.0, 0, 0], [6, 0, 0]])
    placed = PAIR.constrain("position", ["a", "b"], places, places)
    more = placed.constrain("displacement", AB, [5, 0, 0], [5, 0, 0])
    for problem in (placed, more):
        if backend == "casadi" and problem is more:
            with refused(r"9 equalities.*6 numbers that can move"):
                solve(problem, backend)
            continue
        solution = solve(problem, backend)
        assert solution.x == pytest.approx(places, abs=1e-9)
        assert not solution.covariance.any()


@pytest.mark.parametrize("case", EMPTY)
def test_an_empty_set_is_infeasible_and_names_the_worst(case):
    problem = EMPTY[case]
    for backend in BOTH["range" in case :]:
        solution = solve(problem, backend, throw=False)
        assert solution.status is Status.INFEASIBLE
        worst = solution.extras["violated"]
        assert any(f"{c.kind} of a" in worst or f"{c.kind} of b" in worst for c in problem.constraints)
        assert case != "what is held" or "is 1 below its lower bound 1" in worst
        assert solution.violation > 4e-5
        with pytest.raises(SolveError, match=r"satisfies the constraints.*extras\['violated'\]") as caught:
            solve(problem, backend)
        assert caught.value.solution.extras["violated"]


def test_bounds_of_an_angle_turn_with_the_problem():
    costs = []
    for turn in (0.0, np.pi, -np.pi, 3 * np.pi):
        problem = Problem(AB, dimension=2).add("position", AB, [[0, 0], [5 * cos(turn), 0]], std=1.0)
        costs.append(solve(problem.constrain("azimuth", AB, turn + 0.1, turn + 0.2)).cost)
    assert costs == pytest.approx([costs[0]] * 4)


@pytest.mark.parametrize("backend", sorted(set(backends()) - {"casadi"}))
def test_a_backend_without_constraints_names_those_that_hold_them(backend):
    """Only osqp holds linear ones beside casadi."""
    if backend != "osqp":
        with refused(rf"on position: cannot be solved by {backend}, only by .*casadi.*osqp"):
            solve(PAIR.constrain("position", "a", upper=1.0), backend)
    with refused(rf"constraint on range: cannot be solved by {backend}, only by \['casadi'\]"):
        solve(PAIR.constrain("range", AB, upper=1.0), backend)


def test_the_far_side_of_a_range_is_a_maximum():
    """b must be 8 m from a, and is seen at 9 m to the right: the point 8 m to the left is stationary too."""
    problem = Problem(AB, x0=[[0, 0, 0], [-8, 0, 0]]).add("position", "a", [0, 0, 0], std=0.1)
    problem = problem.add("position", "b", [9, 0, 0], std=3.0).constrain("range", AB, 8.0, 8.0)
    stuck = solve(problem, "casadi", throw=False)
    assert stuck.x[1, 0] == pytest.approx(-8.0, abs=0.1)
    assert stuck.gradient_norm < 1e-6
    assert stuck.status is Status.SADDLE
    aside = solved(replace(problem, x0=[[0, 0, 0], [-8, 0.1, 0]]))
    gap = 1.0 / (0.01 + 9.0)  # the metre is shared by the variances
    assert aside.x[:, 0] == pytest.approx([0.01 * gap, 9.0 - 9.0 * gap], abs=1e-6)


def test_osqp_holds_answers_against_all_kkt_conditions():
    """min 1/2 x^2 + q x in [-1, 1]: by hand."""
    from scipy.sparse import eye

    from coopoc.optimize.backends.osqp import Programme

    def holds(q, x, y):
        one = eye(1, format="csc")
        sides = array([[-1.0], [1.0]])
        return Programme(one, one)._holds(np.ones(1), array([q]), *sides, array([x]), array([y]))

    assert holds(-2.0, 1.0, 1.0)  # pushed by the upper bound
    assert holds(2.0, -1.0, -1.0)
    assert holds(0.5, -0.5, 0.0)
    assert not holds(-2.0, 2.0, 0.0)  # outside
    assert not holds(-0.5, 0.0, 0.5)  # pushed by a bound that is not met
    assert not holds(0.5, 1.0, -1.5)  # pushed the wrong way
    assert not holds(-0.5, 0.0, 0.0)  # not stationary


@pytest.mark.parametrize(
    ("claim", "status"),
    [
        ([[5, 0, 0], [9, 0, 0]], Status.FAILED),  # on the bound, but the cost falls inside
        ([[0, 0, 0], [8, 0, 0]], Status.FAILED),  # the constraint holds with slack, the gradient does not vanish
        ([[6, 0, 0], [9, 0, 0]], Status.INFEASIBLE),
    ],
)
def test_a_claim_is_verified_independently_of_the_solver_and_followed_by_another(monkeypatch, claim, status):
    claims = Backend(
        "claims",
        lambda problem, x: SolverResult(array(claim, float), 1),
        capabilities=Capabilities(constraints="linear"),
    )
    problem = PAIR.constrain("position", "a", upper=[5, INF, INF])
    assert solve(problem, claims, throw=False).status is status
    monkeypatch.setattr(sys.modules["coopoc.optimize.solve"], "DEFAULTS", ("gauss-newton", claims, "casadi"))
    assert ("claims failed" in solve(problem, throw=False).notes[0]) is (status is Status.FAILED)


@pytest.mark.parametrize("loss", [None, Loss("cauchy", 2.0)])
def test_vehicles_between_kerbs_end_as_low_as_from_the_truth(loss):
    """Fixes of 15 m, ranges of 0.3 m, many minima; without an x0, and from one that is far off."""
    rng = default_rng(0)
    truth = stack([rng.uniform(-30, 30, 6), rng.uniform(-4, 4, 6)], axis=1)
    pairs = rng.permutation(stack(np.triu_indices(6, 1), 1))[:10]
    ranges = norm(truth[pairs[:, 0]] - truth[pairs[:, 1]], axis=1) + rng.normal(0, 0.3, 10)
    problem = Problem(tuple("abcdef"), dimension=2).add("range", pairs, ranges, std=0.3, loss=loss)
    problem = problem.add("position", range(6), truth + rng.normal(0, 15, (6, 2)), std=15.0)
    problem = problem.constrain("position", range(6), lower=[-INF, -4], upper=[INF, 4])
    least, far = solve(replace(problem, x0=truth)).cost, solve(replace(problem, x0=rng.normal(size=(6, 2))))
    assert max(solve(problem).cost, far.cost) < 1.0001 * least
    assert any("another minimum" in note for note in far.notes)


def test_a_robot_on_the_line_of_the_anchors_that_it_must_leave_is_drawn_off_it():
    problem = Problem((*AB, "c"), dimension=2, x0=[[0, 0], [8, 0], [4, 0]], fixed=(0, 1))
    problem = problem.add("position", "c", [4, 0], std=1.0)
    assert solved(problem.constrain("range", [(0, 2), (1, 2)], lower=5.0)).cost == pytest.approx(4.5)


def test_neither_5000_km_nor_millimetres_change_a_step():
    for seed in range(15):
        at, z = default_rng(seed).normal(size=(2, 2, 2)) * [[[10]], [[1]]]
        ends = []
        for shift, unit in ((0.0, 1.0), (5e6, 1.0), (0.0, 1e-3)):
            problem = Problem(AB, dimension=2).add("position", [*AB], unit * (at + z) + shift, std=unit)
            problem = problem.constrain("position", "a", unit * (at[0] - 0.1) + shift, unit * (at[0] + 0.1) + shift)
            ends.append(solve(problem.constrain("range", AB, upper=unit * (norm(at[0] - at[1]) - 0.5))))
            assert (ends[-1].x - shift) / unit == pytest.approx(ends[0].x, abs=1e-7)
            assert ends[-1].iterations <= ends[0].iterations + 2

"""GTSAM's own factors, optimisers and smoothers: they say our objective to the last digits, and find its minimum."""

from collections.abc import Callable
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from conftest import same_minimum
from random_graphs import star

from coopoc import V2X, Fleet, Sensors, observe
from coopoc.optimize import Loss, Problem, Status, pose, solve
from coopoc.optimize.backends.gtsam import forms, graph_of, tangent, values, which_turn
from coopoc.optimize.starts.initial import initial_guess

LOSSES = ("huber", "cauchy", "geman-mcclure", "truncated")


def nodes_of(dimension: int, seed: int = 1) -> Problem:
    """Three poses and two points somewhere."""
    rng = np.random.default_rng(seed)
    turn = rng.normal(size=(5, 3)) if dimension == 3 else rng.uniform(-3, 3, 5)
    x = pose(10 * rng.normal(size=(5, dimension)), turn)
    x[3:, dimension:] = np.eye(dimension).ravel()
    return Problem(tuple("abcde"), dimension=dimension, poses=range(3), x0=x)


def spd(size: int, scale: float = 1.0, seed: int = 2) -> np.ndarray:
    root = np.random.default_rng(seed).normal(size=(size, size))
    return scale * (root @ root.T + np.eye(size))


def apart(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Covariance of position and rotation that are independent."""
    d, r = len(first), len(second)
    return np.block([[first, np.zeros((d, r))], [np.zeros((r, d)), second]])


def measured(dimension: int, kind: str, nodes: list[tuple[str, ...]], noise: dict, loss: Loss | None = None) -> Problem:
    """One factor of a kind with z anywhere."""
    problem, rng = nodes_of(dimension), np.random.default_rng(3)
    count = len(nodes)
    if "pose" in kind:
        turn = rng.normal(size=(count, 3)) if dimension == 3 else rng.normal(size=count)
        z = pose(rng.normal(size=(count, dimension)), turn)
    else:
        size = {"range": 1, "speed": 1, "bearing": 1, "azimuth": 1, "inclination": 1}.get(kind, dimension)
        z = rng.uniform(0.2, 3.0, (count, size))
    constants = {"constants": [0.4]} if kind == "speed" else {}
    return problem.add(kind, nodes, z, **noise, **constants, loss=loss)


PAIRS = [("a", "b"), ("a", "d"), ("d", "b"), ("d", "e")]
SEEN = [("a", "b"), ("c", "e")]
BETWEEN = [("a", "b"), ("c", "b")]


def natives(d: int) -> dict[str, tuple]:
    """What GTSAM must have: kind, nodes, noise, and whether a loss may be on it."""
    turn = spd(1 if d == 2 else 3, 0.01)
    even = np.concatenate([np.full(d, 0.3), np.tile(np.linspace(0.1, 0.4, d), d)])
    found = {
        "position": ("position", [("a",), ("d",)], {"cov": np.stack([spd(d), 2 * spd(d)])}, True),
        "displacement of points": ("displacement", [("d", "e")], {"cov": spd(d)}, True),
        "range": ("range", PAIRS, {"std": 0.3}, True),
        "relative position": ("relative_position", BETWEEN, {"std": 0.3}, True),
        "relative pose": ("relative_pose", BETWEEN, {"cov": apart(0.09 * np.eye(d), turn)}, False),
        "relative pose log": ("relative_pose_log", BETWEEN, {"cov": spd(3 * d - 3, 0.01)}, True),
        "relative pose chordal": ("relative_pose_chordal", BETWEEN, {"std": even}, True),
        "pose": ("pose", [("a",), ("c",)], {"cov": apart(spd(d), turn)}, False),
    }
    if d == 2:
        found["bearing"] = ("bearing", SEEN, {"std": 0.1}, True)
        found["body spherical"] = ("body_spherical", SEEN, {"cov": spd(2, 0.1)}, True)
    return found


NATIVE = [
    (d, name, loss)
    for d in (2, 3)
    for name, (*_, robust) in natives(d).items()
    for loss in (None, *LOSSES[: 4 * robust])
]


@pytest.mark.parametrize(("dimension", "name", "loss"), NATIVE)
def test_gtsams_own_factors_have_our_cost_and_gradient(dimension, name, loss):
    """Against gtsam.NonlinearFactorGraph.error, to 1e-12, and the gradient of its linearisation."""
    kind, nodes, noise, _ = natives(dimension)[name]
    for scale in (0.5, 50.0):  # on either side of the loss's corner
        assert_same_objective(measured(dimension, kind, nodes, noise, Loss(loss, scale) if loss else None))


def assert_same_objective(problem: Problem) -> None:
    """Its graph in GTSAM has its cost and gradient."""
    posed, x = which_turn(problem), problem.x0
    at, graph = values(problem.space, posed, x), graph_of(problem, forms(problem))
    assert graph.error(at) == pytest.approx(problem.cost(x), rel=1e-12)
    residual, jacobian = problem.whiten(x)
    gradient, theirs = (jacobian.T @ residual).reshape(5, -1), graph.linearize(at).gradientAtZero()
    for i, turn in enumerate(tangent(problem.space, posed, x)):
        found = theirs.at(i) if theirs.exists(i) else np.zeros(turn.shape[1])
        assert found == pytest.approx(turn.T @ gradient[i], rel=1e-9, abs=1e-9 * np.abs(gradient).max())


@pytest.mark.parametrize(
    ("dimension", "kind", "nodes", "noise", "loss"),
    [
        (2, "relative_pose", BETWEEN, {"std": [0.3, 0.1, 0.1]}, None),
        (2, "relative_pose", BETWEEN, {"std": 0.1}, "huber"),
        (3, "pose", [("a",)], {"cov": spd(6, 0.01)}, None),
        (3, "relative_pose_chordal", BETWEEN, {"std": np.linspace(0.1, 0.4, 12)}, "cauchy"),
        (2, "relative_position", SEEN, {"std": 0.1}, None),
        (3, "bearing", SEEN, {"std": 0.1}, "geman-mcclure"),
        (3, "body_spherical", SEEN, {"std": 0.1}, "truncated"),
        (2, "azimuth", PAIRS, {"std": 0.1}, None),
    ],
)
def test_what_gtsam_lacks_is_a_custom_factor(dimension, kind, nodes, noise, loss):
    problem = measured(dimension, kind, nodes, noise, Loss(loss, 50.0) if loss else None)
    assert forms(problem) == [None]
    assert_same_objective(problem)


def spherical_star(formation: Fleet) -> Problem:
    """Ten neighbours at 22 m."""
    recording = observe(formation.between(0, 3), Sensors.paper_scenario2(), V2X.ideal(10), observers=[0])
    return Problem.from_snapshot(recording, 2, 0)


def plane(
    noise: float = 1.0,
    steps: int = 8,
    odometry: tuple[float, ...] = (0.1, 0.1, 0.02),
    fixed: bool = False,
    loss: Loss | None = None,
    wrong: int = 0,
) -> Problem:
    """Two vehicles in the plane: odometry, ranges, bearings of each other and of a landmark, fixes, a first pose."""
    rng = np.random.default_rng(5)
    turn = np.cumsum(rng.normal(0, 0.2, steps))
    first = np.cumsum(5.0 * np.c_[np.cos(turn), np.sin(turn)], axis=0)
    at, angle = (
        np.concatenate([first, first + np.array([8, 3]), [[10.0, -9.0]]]),
        np.concatenate([turn, turn + 0.1, [0.0]]),
    )
    n, x = 2 * steps, pose(at, angle)
    x0 = pose(at + rng.normal(0, 0.5, at.shape), angle + rng.normal(0, 0.05, n + 1))
    x0[-1, 2:] = np.eye(2).ravel()
    x0[0] = x[0] if fixed else x0[0]
    problem = Problem([str(k) for k in range(n + 1)], x0=x0, dimension=2, poses=range(n), fixed=(0,) if fixed else ())

    def seen(i: np.ndarray, j: np.ndarray) -> np.ndarray:
        return np.einsum("kji,kj->ki", x[i, 2:].reshape(-1, 2, 2), at[j] - at[i])

    i = np.concatenate([np.arange(steps - 1), steps + np.arange(steps - 1)])
    z = pose(
        seen(i, i + 1) + noise * rng.normal(0, 0.1, (len(i), 2)),
        angle[i + 1] - angle[i] + noise * rng.normal(0, 0.02, len(i)),
    )
    problem = problem.add("relative_pose", np.c_[i, i + 1], z, std=odometry)
    i, j = np.arange(steps), steps + np.arange(steps)
    gap = np.linalg.norm(at[i] - at[j], axis=1) + noise * rng.normal(0, 0.3, steps) + 6.0 * (np.arange(steps) < wrong)
    problem = problem.add("range", np.c_[i, j], gap[:, None], std=0.3, loss=loss)
    v = seen(j, i)
    z = np.c_[np.linalg.norm(v, axis=1), np.arctan2(v[:, 1], v[:, 0])]
    z = z + noise * rng.normal(0, [0.5, 0.05], z.shape)
    problem = problem.add("body_spherical", np.c_[j, i], z, std=[0.5, 0.05])
    v = seen(i, np.full(steps, n))
    bearing = np.arctan2(v[:, 1], v[:, 0]) + noise * rng.normal(0, 0.05, steps)
    problem = problem.add("bearing", [(k, n) for k in i.tolist()], bearing[:, None], std=0.05)
    ends, starts = [steps - 1, n - 1], [steps] if fixed else [0, steps]
    problem = problem.add("position", ends, at[ends] + noise * rng.normal(size=(2, 2)), std=1.0)
    return problem.add("pose", starts, x[starts], std=[0.5, 0.3, 0.05])


def space(chordal: bool = False, noise: float = 1.0) -> Problem:
    """Six poses in space in two loops, ranges to two beacons, a first pose; the beacons have a fix."""
    rng = np.random.default_rng(6)
    at, turn = np.cumsum(rng.normal(0, 4, (8, 3)), axis=0), rng.normal(size=(8, 3)) * 0.6
    x = pose(at, turn)
    rotation = x[:, 3:].reshape(-1, 3, 3)
    x0 = pose(at + rng.normal(0, 0.3, at.shape), turn + rng.normal(0, 0.05, turn.shape))
    x0[6:, 3:] = np.eye(3).ravel()
    problem = Problem([str(k) for k in range(8)], x0=x0, poses=range(6))
    i, j = np.array([(0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (5, 0), (3, 0)]).T
    error = pose(noise * rng.normal(0, 0.1, (len(i), 3)), noise * rng.normal(0, 0.03, (len(i), 3)))
    turned = np.swapaxes(rotation[i], 1, 2) @ rotation[j] @ error[:, 3:].reshape(-1, 3, 3)
    moved = np.einsum("kji,kj->ki", rotation[i], at[j] - at[i]) + error[:, :3]
    z = np.concatenate([moved, turned.reshape(-1, 9)], axis=1)
    std = np.array([0.1] * 3 + ([0.05] * 9 if chordal else [0.03] * 3))
    problem = problem.add("relative_pose" + "_chordal" * chordal, np.c_[i, j], z, std=std)
    pairs = [(k, 6 + k % 2) for k in range(6)]
    far = np.array([np.linalg.norm(at[k] - at[b]) for k, b in pairs]) + noise * rng.normal(0, 0.3, 6)
    problem = problem.add("range", pairs, far[:, None], std=0.3).add("position", [6, 7], at[6:], std=0.5)
    if chordal:
        return problem.add("pose_chordal", 0, x[:1], std=0.1)
    return problem.add("pose", 0, x[:1], std=[0.5, 0.4, 0.3, 0.05, 0.06, 0.07])


CASES: dict[str, Callable[[Fleet], Problem]] = {
    **{f"ranges {seed}": lambda fleet, seed=seed: star("range", seed) for seed in range(3)},
    "flat ranges": lambda fleet: star("range", 2, height=0.02),
    "ten spherical neighbours": spherical_star,
    "SE(2)": lambda fleet: plane(),
    "SE(2) with a fixed pose": lambda fleet: plane(fixed=True),
    "SE(2) with forward and sideways std": lambda fleet: plane(odometry=(0.1, 0.03, 0.02)),
    "SE(3)": lambda fleet: space(),
    "SE(3) chordal": lambda fleet: space(chordal=True),
    "SE(2) truncated": lambda fleet: plane(loss=Loss("truncated", 3.0), wrong=2),
    **{name: lambda fleet, name=name: star("range", 4, loss=Loss(name, 2.0), wrong=1) for name in LOSSES},
}


@pytest.mark.parametrize("case", CASES)
def test_optimizers_find_the_minimum_of_gauss_newton(formation, case):
    """Cost to 1e-9, estimates and covariances to 1e-6, before any refinement of ours."""
    problem = CASES[case](formation)
    ours, theirs = solve(problem), solve(problem, "gtsam")
    assert theirs.status is Status.SOLVED
    same_minimum(theirs, ours)


@pytest.mark.parametrize("case", ["ranges 0", "SE(2)"])
def test_a_limit_of_iterations_is_kept(formation, case):
    problem = CASES[case](formation)
    solution = solve(replace(problem, x0=initial_guess(problem)), "gtsam", max_iterations=2, throw=False)
    assert solution.status is Status.MAX_ITERATIONS
    assert solution.iterations == 2


@pytest.mark.parametrize("problem", [plane(noise=0.0), space(noise=0.0), space(chordal=True, noise=0.0)])
def test_marginals_equal_gtsams(problem):
    """gtsam.Marginals, which moves a pose along its body's axes, with the rotation first in space; without residuals,
    on which J^T J of GTSAM's chords depends."""
    solution, posed = solve(problem), which_turn(problem)
    marginals = gtsam.Marginals(graph_of(problem, forms(problem)), values(problem.space, posed, solution.x))
    for i, turn in enumerate(tangent(problem.space, posed, solution.x)):
        own = turn @ marginals.marginalCovariance(i) @ turn.T
        assert solution.covariance[i] == pytest.approx(own, abs=1e-6)

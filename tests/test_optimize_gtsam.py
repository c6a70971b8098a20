"""GTSAM's own factors, optimisers and smoothers: they say our objective to the last digits, and find its minimum."""

import gtsam
import numpy as np
import pytest
from conftest import DIMENSIONS
from numpy.random import default_rng
from test_optimize_poses import everything

from coopoc.optimize import Loss, Problem, pose, solve
from coopoc.optimize.backends.gtsam import forms, graph_of, tangent, values, which_turn

LOSSES = ("huber", "cauchy", "geman-mcclure", "truncated")


def nodes_of(dimension):
    """Three poses and two points somewhere."""
    rng = default_rng(1)
    x = pose(10 * rng.normal(size=(5, dimension)), rng.normal(size=(5, 3)) if dimension == 3 else rng.uniform(-3, 3, 5))
    x[3:, dimension:] = np.eye(dimension).ravel()
    return Problem(tuple("abcde"), dimension=dimension, poses=range(3), x0=x)


def spd(size, scale=1.0):
    root = default_rng(2).normal(size=(size, size))
    return scale * (root @ root.T + np.eye(size))


def apart(first, second):
    """Covariance of position and rotation that are independent."""
    d, r = len(first), len(second)
    return np.block([[first, np.zeros((d, r))], [np.zeros((r, d)), second]])


def measured(dimension, kind, nodes, noise, loss=None):
    """One factor of a kind with z anywhere."""
    problem, rng = nodes_of(dimension), default_rng(3)
    count = len(nodes)
    if "pose" in kind:
        turn = rng.normal(size=(count, 3)) if dimension == 3 else rng.normal(size=count)
        z = pose(rng.normal(size=(count, dimension)), turn)
    else:
        size = {"range": 1, "speed": 1, "bearing": 1, "azimuth": 1, "inclination": 1}.get(kind, dimension)
        z = rng.uniform(0.2, 3.0, (count, size))
    return problem.add(kind, nodes, z, **noise, **{"constants": [0.4]} if kind == "speed" else {}, loss=loss)


PAIRS = [("a", "b"), ("a", "d"), ("d", "b"), ("d", "e")]
SEEN = [("a", "b"), ("c", "e")]
BETWEEN = [("a", "b"), ("c", "b")]


def natives(d):
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


def assert_same_objective(problem):
    """Its graph in GTSAM has its cost and gradient."""
    posed, x = which_turn(problem), problem.x0
    at, graph = values(problem.space, posed, x), graph_of(problem, forms(problem))
    assert graph.error(at) == pytest.approx(problem.cost(x), rel=1e-12)
    residual, jacobian = problem.whiten(x)
    gradient, theirs = (jacobian.T @ residual).reshape(5, -1), graph.linearize(at).gradientAtZero()
    for i, turn in enumerate(tangent(problem.space, posed, x)):
        found = theirs.at(i) if theirs.exists(i) else np.zeros(turn.shape[1])
        assert found == pytest.approx(turn.T @ gradient[i], rel=1e-9, abs=1e-9 * abs(gradient).max())


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


@DIMENSIONS
def test_marginals_equal_gtsams(dimension):
    """gtsam.Marginals, which moves a pose along its body's axes, with the rotation first in space; without residuals,
    on which J^T J of GTSAM's chords depends."""
    problem, x = everything(dimension, noise=0.0)
    solution, posed = solve(problem), which_turn(problem)
    marginals = gtsam.Marginals(graph_of(problem, forms(problem)), values(problem.space, posed, x))
    for i, turn in enumerate(tangent(problem.space, posed, x)):
        assert solution.covariance[i] == pytest.approx(turn @ marginals.marginalCovariance(i) @ turn.T, abs=1e-6)

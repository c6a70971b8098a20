"""Joint covariances against NumPy's inverse and GTSAM's joint marginals."""

import gtsam
import numpy as np
import pytest
from conftest import DIMENSIONS, refused
from random_graphs import random_graph

from coopoc.optimize import Problem, solve
from coopoc.optimize.assess.assess import as_stated, joint_covariance
from coopoc.optimize.backends.gtsam import forms, graph_of, values, which_turn
from coopoc.optimize.graph_problems import from_graph


@pytest.mark.parametrize("steps", [10, 60])
@DIMENSIONS
def test_a_joint_covariance_is_a_part_of_the_inverse(dimension, steps):
    """Few nodes by a dense factor, many by a sparse one; a fixed node has none."""
    problem = from_graph(random_graph(1, dimension, steps=steps))
    found, dof = solve(problem), problem.space.dof
    J = as_stated(problem).whiten(found.x)[1].toarray()
    free = np.flatnonzero(problem.movable.ravel())
    inverse = np.zeros((J.shape[1], J.shape[1]))
    inverse[np.ix_(free, free)] = np.linalg.inv(J[:, free].T @ J[:, free])
    nodes = ["A0", "A5", "B3", "L1", "A5"]
    joint = joint_covariance(problem, found, nodes)
    blocks = inverse.reshape(len(problem.names), dof, len(problem.names), dof).swapaxes(1, 2)
    places = [problem.index(node) for node in nodes]
    assert joint == pytest.approx(blocks[np.ix_(places, places)], rel=1e-6, abs=1e-12)
    assert not joint[0].any()
    assert joint[1, 1] == pytest.approx(found.covariance[places[1]], rel=1e-6)


def ring():
    """Points with fixes and distances around a ring."""
    rng, names = np.random.default_rng(2), [f"p{k}" for k in range(30)]
    at = np.c_[20 * np.cos(np.arange(30) / 5), 20 * np.sin(np.arange(30) / 5)]
    problem = Problem(names, x0=at, dimension=2).add("position", names, at, std=2.0)
    pairs = [(0, k) for k in range(1, 30)]
    return problem.add("range", pairs, np.linalg.norm(at[1:] - at[0], axis=1) + 0.1 * rng.normal(size=29), std=0.1)


def test_joint_marginals_are_gtsams():
    problem = ring()
    found = solve(problem)
    tree = gtsam.Marginals(graph_of(problem, forms(problem)), values(problem.space, which_turn(problem), found.x))
    whole = tree.jointMarginalCovariance(keys := [0, 7, 21])
    joint = joint_covariance(problem, found, keys)
    assert joint == pytest.approx(np.array([[whole.at(a, b) for b in keys] for a in keys]), rel=1e-6, abs=1e-12)


def test_a_point_on_the_line_of_its_anchors_has_the_covariance_of_its_solution():
    between = Problem(("ego", "a", "b"), dimension=2, x0=[[4, 0.7], [0, 0], [10, 0]], fixed=[*"ab"])
    between = between.add("range", [("ego", "a"), ("ego", "b")], [3.9, 5.8], std=0.1)
    found = solve(between)
    assert joint_covariance(between, found, "ego")[0, 0] == pytest.approx(found.covariance[0], rel=1e-6)


def test_what_has_no_covariance_is_refused():
    problem = Problem([*"ab"]).add("displacement", ("a", "b"), [1, 0, 0], std=1.0)
    with refused("must be observable"):
        joint_covariance(problem, solve(problem, throw=False), (0, 1))
    fixed = problem.add("position", "a", [0, 0, 0], std=1.0)
    with refused("constraints"):
        joint_covariance(fixed.constrain("position", "a", lower=0.0), solve(fixed), (0, 1))
    with refused("'c'"):
        joint_covariance(fixed, solve(fixed), "c")

"""What is said of an end: infinite costs, singular J^T J, saddles, mirror images, bounds; against SciPy and closed
forms."""

import re
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from conftest import DESCENTS
from numpy import array, zeros
from numpy.linalg import inv, norm
from numpy.random import default_rng
from scipy.optimize import least_squares

from coopoc.optimize import Problem, Status, solve
from coopoc.optimize.convex import certify
from coopoc.optimize.graph_problems import _counted
from coopoc.optimize.model.problem import Search


def ranged(anchors, start, ranges, std):
    """A robot that ranges anchors in the plane."""
    count = len(anchors)
    problem = Problem((*map(str, range(count)), "r"), x0=np.vstack([anchors, start]), fixed=range(count), dimension=2)
    return problem.add("range", [(k, "r") for k in range(count)], ranges, std=std)


def test_fixed_nodes_are_at_no_local_minimum():
    problem = ranged(zeros((1, 2)), np.ones(2), array([9.0]), 1.0)
    assert "local" not in solve(replace(problem, fixed=(0, 1))).notes[0]


@DESCENTS
@pytest.mark.parametrize(("z", "std"), [(1e308, 1.0), (1.0, 1e-160)])
def test_an_infinite_cost_is_no_minimum(z, std, backend):
    problem = ranged(zeros((1, 2)), np.ones(2), array([z]), std).add("position", "r", [1, 1], 1.0)
    found = solve(problem, backend, throw=False)
    assert found.status is Status.FAILED
    assert "overflows" in found.notes[-1]


@pytest.mark.parametrize("seed", range(12))
def test_a_robot_on_the_line_of_its_anchors_is_at_a_minimum(seed):
    """SciPy's curvature by differences of its own cost is the inverse of the covariance."""
    rng = default_rng(seed)
    angle = rng.uniform(0, np.pi)
    along = array([np.cos(angle), np.sin(angle)])
    anchors, truth = np.outer([0, 10, 25.0], along), along * rng.uniform(2, 20)
    ranges = norm(anchors - truth, axis=1) + array([0.4, -0.4, -0.1])
    problem = ranged(anchors, truth + rng.normal(0, 1, 2), ranges, 0.3)
    found = solve(problem)
    theirs = least_squares(lambda p: (norm(anchors - p, axis=1) - ranges) / 0.3, problem.x0[3], xtol=1e-15)
    assert found.cost == pytest.approx(theirs.cost, rel=1e-6)
    cost = lambda p: 0.5 * np.square((norm(anchors - p, axis=1) - ranges) / 0.3).sum()  # noqa: E731
    h, x = 1e-3 * np.eye(2), found.x[3]
    hessian = [[cost(x + a + b) - cost(x + a - b) - cost(x - a + b) + cost(x - a - b) for a in h] for b in h]
    singular = "J^T J is singular here: the covariance is that of the exact Hessian" in found.notes
    assert singular == (abs((x - truth) @ array([-along[1], along[0]])) < 1e-4)
    if singular:
        assert found.covariance[3] == pytest.approx(inv(array(hessian) / 4e-6), rel=1e-3)


@DESCENTS
@pytest.mark.parametrize("offset", [0.0, 5e6])
@pytest.mark.parametrize("degrees", [0, 20, 45])
def test_a_strict_minimum_is_one_wherever_the_axes_are(degrees, offset, backend):
    """On the line of its anchors, of ranges that fit there alone: of one precision, and of 1 mm beside 0.5 m."""
    turn = array([[c := np.cos(np.deg2rad(degrees)), s := np.sin(np.deg2rad(degrees))], [-s, c]])
    for anchors, start, ranges, std in (
        ([0, 10, 25], [4, 0.7], [3.9, 5.8, 20.75], 0.1),
        ([0, 4.5], [9, 1e-3], [9.0, 3.7], array([[1e-3], [0.5]])),
    ):
        at = np.outer(anchors, [1.0, 0.0]) @ turn + offset
        problem = ranged(at, array(start) @ turn + offset, array(ranges), std)
        assert solve(problem, backend, throw=False).status is Status.SOLVED


ANCHORS = array([[0, 0], [10, 0.0]])


def test_a_saddle_between_two_anchors_is_one():
    """Closed form: ranges of 15 m to anchors 10 m apart are met 14.1 m off their line, of 4 and 6 m on it."""
    problem = ranged(ANCHORS, array([5, 0.0]), np.full(2, 15.0), 1.0)
    found = solve(replace(problem, search=Search(x0=problem.x0)), throw=False)
    assert found.status is Status.SADDLE
    assert "this minimum" not in str(found.notes)
    assert solve(problem).cost < 1e-9
    assert solve(ranged(ANCHORS, array([4, 0.1]), array([4.0, 6.0]), 0.1)).status is Status.SOLVED
    unknown = ranged(zeros((1, 2)), array([3, 4.0]), array([5.0]), 1.0)
    assert solve(unknown, throw=False).status is Status.RANK_DEFICIENT


@pytest.mark.parametrize(("toward", "why"), [([2.4, 0.7], "r went .* m away"), ([-1.0, 1.6, 1.6], "b and r nearly")])
def test_an_end_that_is_no_minimum_says_why(toward, why):
    """Azimuths that part meet nowhere; of three two are met above an anchor, and the third below it."""
    problem = Problem([*"abcr"], x0=[*ANCHORS, [10, -10], [11, 2]], dimension=2, fixed=range(3))
    found = solve(problem.add("azimuth", [(k, 3) for k in range(len(toward))], toward, std=0.1), throw=False)
    assert re.search(why, str(found))


def test_ranges_that_do_not_meet_are_noted():
    """Closed form: ranges of 3 m to anchors 10 m apart are each 2 m off in the middle, and nothing is spare."""
    found = solve(ranged(ANCHORS, array([5, 1.0]), np.full(2, 3.0), 1.0))
    assert found.cost == pytest.approx(4.0)
    assert "explains 0" in found.notes[-1]


@pytest.mark.parametrize(("std", "fix"), [(1e-5, 1.0), (1e-6, 1.0), (1e-4, 1e3)])
def test_odometry_of_micrometres_beside_a_fix_of_a_metre_is_known(std, fix):
    problem = Problem([*"abc"]).add("position", ["a", "c"], [[0, 0, 0], [2, 1, 0]], std=fix)
    found = solve(problem.add("displacement", [(0, 1), (1, 2)], [[1, 0, 0], [1, 0, 0]], std=std))
    assert found.covariance[1].diagonal() == pytest.approx(0.5 * fix**2, rel=1e-6)


def test_a_certified_mirror_image_is_not_unique():
    pair = ranged(ANCHORS, array([5, 1.0]), array([7, 8.0]), 1.0)
    verdict = certify(pair, solve(pair))
    assert (verdict.certified, verdict.unique) == (True, False)
    assert "mirror image" in str(verdict)
    fixed = pair.add("position", "r", [5, 5], std=1.0)
    verdict = certify(fixed, solve(fixed))
    assert (verdict.certified, verdict.unique) == (True, True)
    free = Problem([*"abc"], dimension=2, x0=[[0, 0], [3, 0], [3, 4]]).add("range", (0, 2), 5.2, std=0.1)
    free = free.add("displacement", [(0, 1), (1, 2)], [[3.0, 0.1], [0.1, 4.0]], std=0.2)
    verdict = certify(free, solve(free, throw=False))
    assert (verdict.certified, verdict.unique) == (True, False)
    assert "a motion of all" in str(verdict)


@pytest.mark.parametrize("seed", range(8))
def test_a_lower_bound_is_below_the_cost(seed):
    """Closed form: the least cost of a chain of fixes by elimination in exact fractions."""
    rng = default_rng(seed)
    z, u = 1e4 * rng.normal(size=6), rng.normal(size=5)
    s, t = 10.0 ** rng.uniform(-3, 0, 2)
    fix, chain = zeros((6, 3)), zeros((5, 3))
    fix[:, 0], chain[:, 0] = z, u
    problem = Problem(tuple("abcdef")).add("position", list("abcdef"), fix, std=s)
    problem = problem.add("displacement", list(zip("abcde", "bcdef", strict=True)), chain, std=t)
    a, b = 1 / Fraction(s) ** 2, 1 / Fraction(t) ** 2
    weight, mean, least = a, Fraction(z[0]), Fraction(0)
    for moved, fixed in zip(u, z[1:], strict=True):
        carried, at = weight * b / (weight + b), mean + Fraction(moved)
        least += carried * a / (carried + a) * (at - Fraction(fixed)) ** 2 / 2
        weight, mean = carried + a, (carried * at + a * Fraction(fixed)) / (carried + a)
    verdict = certify(problem, solve(problem))
    assert verdict.certified
    assert verdict.lower_bound <= float(least)


def held(lower):
    return solve(Problem([*"a"]).add("position", "a", [0, 0, 0], std=1.0).constrain("position", "a", lower=lower))


def test_bounds_that_push_are_no_local_minimum():
    """Closed form: each bound at b costs b^2 / 2."""
    assert not any("cost" in note for note in held(1.5).notes)
    (note,) = (note for note in held(9.0).notes if "cost" in note)
    assert "3 bounds that push" in note
    assert "local minimum" not in note
    assert held(-1.0).expected == 0


def test_a_convex_problem_has_no_local_minimum():
    apart = Problem([*"ab"], dimension=2).add("position", ["a", "b"], [[0, 0], [10, 0]], std=0.5)
    apart = apart.constrain("displacement", ("a", "b"), lower=[4.0, 0], upper=[4.0, 0])
    assert "explains 1 +- 1: constraints of displacement that contradict" in solve(apart).notes[-1]
    free = Problem([*"abc"], dimension=2).add("displacement", [(0, 1), (1, 2), (0, 2)], [[1, 0], [1, 0], [2.1, 0]], 0.1)
    assert solve(free, throw=False).cost == pytest.approx(0.1**2 / 6 / 0.1**2)


def test_what_is_said_of_many_lines_is_said_once():
    assert _counted([f"line {k}: repaired" for k in range(5021)]) == ["5021 times, first in line 0: repaired"]

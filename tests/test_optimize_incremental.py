"""iSAM2 behind `co.incremental`, against GTSAM called by hand."""

from itertools import pairwise

import gtsam
import numpy as np
import pytest
from conftest import refused
from numpy import array

import coopoc as co
from coopoc.optimize import Incremental, Loss, joint_covariance

STD = array([0.05, 0.05, 0.02])
TRUE = [gtsam.Pose2(np.cos(0.3 * k) * 5.0, np.sin(0.3 * k) * 5.0, 0.3 * k) for k in range(25)]
MARKS = {"l0": array([0.0, 1.0]), "l1": array([8.0, -3.0])}


def measured():
    """Odometry, and the landmark that each pose ranges."""
    rng = np.random.default_rng(3)
    moved = [a.between(b).compose(gtsam.Pose2(*(STD * rng.normal(size=3)))) for a, b in pairwise(TRUE)]
    return moved, [(k, f"l{k % 2}", TRUE[k].range(MARKS[f"l{k % 2}"]) + 0.1 * rng.normal()) for k in range(1, 25)]


def our_pose(pose):
    return co.pose(pose.translation(), pose.theta())


def followed(loss=None):
    """One step per pose."""
    moved, far = measured()
    start = co.Problem(("x0",), dimension=2, poses=(0,), x0=our_pose(TRUE[0])[None])
    often = gtsam.ISAM2Params()
    often.setRelinearizeThreshold(0.01)
    often.relinearizeSkip = 1
    live = co.incremental(start.add("pose", "x0", our_pose(TRUE[0]), std=0.01), often)
    at = TRUE[0]
    for step, (k, mark, distance) in zip(moved, far, strict=True):
        at = at.compose(step)
        new = {f"x{k}": our_pose(at)} | ({} if mark in live else {mark: MARKS[mark] + 0.3})
        names = live.names + list(new)
        seen = co.Factor("range", [[names.index(f"x{k}"), names.index(mark)]], [[distance]], std=[[0.1]], loss=loss)
        live.add([("relative_pose_log", (f"x{k - 1}", f"x{k}"), our_pose(step), STD), seen], new)
    for _ in range(5):  # steps without measurements
        live.add()
    return live


def batch():
    """GTSAM's graph by hand, whose poses have keys 0, 1, ... and landmarks 100, 101, and its optimum."""
    (moved, far), sigmas = measured(), gtsam.noiseModel.Diagonal.Sigmas
    graph, guess = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose2(0, TRUE[0], sigmas(np.full(3, 0.01))))
    for k, pose in enumerate(TRUE):
        guess.insert(k, pose)
    for j, mark in enumerate(MARKS.values()):
        guess.insert(100 + j, mark)
    for k, step in enumerate(moved):
        graph.add(gtsam.BetweenFactorPose2(k, k + 1, step, sigmas(STD)))
    for k, mark, distance in far:
        graph.add(gtsam.RangeFactor2D(k, 100 + int(mark[1]), distance, sigmas(array([0.1]))))
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-15)
    return graph, gtsam.LevenbergMarquardtOptimizer(graph, guess, params).optimize()


def test_the_live_estimate_is_near_the_batch_and_an_update_at_it():
    live, (_, best) = followed(), batch()
    found = live.update()
    assert found.status.name == "SOLVED"
    assert found.extras["isam2_off"] < 0.02
    for name in live.names:
        key = int(name[1:]) + 100 * (name[0] == "l")
        place = best.atPoint2(key) if name[0] == "l" else best.atPose2(key).translation()
        assert live[name][:2] == pytest.approx(place, abs=0.02)
        assert found[name][:2] == pytest.approx(place, abs=1e-4)
    assert live.x[live.names.index("x7")] == pytest.approx(live["x7"])


def test_marginals_are_gtsams_in_the_worlds_directions():
    live, (graph, best) = followed(), batch()
    marginals = gtsam.Marginals(graph, best)
    pose, mark = marginals.marginalCovariance(9), marginals.marginalCovariance(101)
    turn = np.eye(3)
    turn[:2, :2] = best.atPose2(9).rotation().matrix()
    scale = abs(pose).max()
    assert live.marginal("x9") == pytest.approx(turn @ pose @ turn.T, abs=0.03 * scale)
    assert live.marginal("l1")[:2, :2] == pytest.approx(mark, abs=0.03 * abs(mark).max())
    assert live.marginal("x9") == pytest.approx(
        joint_covariance(live.problem, live.update(), ("x9",))[0, 0], abs=0.03 * scale
    )


@pytest.mark.parametrize(("z", "std"), [([5e5, 5e6], 3.0), ([20.0, 0.0], 300.0)])
def test_a_guess_has_no_weight(z, std):
    """Closed form: the fix itself."""
    live = co.incremental(co.Problem([*"a"], dimension=2, x0=np.zeros((1, 2))).add("position", "a", z, std=std))
    assert live["a"] == pytest.approx(z, rel=1e-6, abs=1e-4)
    assert live.marginal("a").diagonal() == pytest.approx(std**2, rel=1e-6)


def test_a_step_that_isam2_cannot_take_is_undone(monkeypatch):
    live, new = followed(), {"x25": our_pose(TRUE[24])}
    live.add(values={"l9": [9.0, 0.0]})
    live.add([("range", ("x24", "l9"), 3.0, 0.1)])  # Cholesky takes a pivot for zero, and QR follows
    before, marginal = live["x24"], live.marginal("x24")
    monkeypatch.setattr(Incremental, "_free", lambda *_: [])
    with refused("Indeterminate"):
        live.add([("range", ("x24", "x25"), 1.0, 0.1)], new)
    assert live["x24"] == pytest.approx(before, abs=1e-6)
    assert live.marginal("x24") == pytest.approx(marginal, rel=1e-3)
    live.add([("relative_pose_log", ("x24", "x25"), our_pose(TRUE[1]), STD)], new)


def test_robust_losses_are_those_of_a_solve():
    found = followed(Loss("huber", 1.0)).update()
    assert found.status.name == "SOLVED"
    assert found.extras["isam2_off"] < 0.05


def test_what_is_refused_leaves_the_estimate_as_it_was():
    live = followed()
    before = live.x
    new = {"x25": our_pose(TRUE[-1])}
    for factors, values, field in (
        ([("range", ("x25", "nowhere"), 1.0, 0.1)], new, "node"),
        ([], {"x3": our_pose(TRUE[3])}, "values"),
        ([], {"l9": [1.0, 2.0, 3.0]}, "values"),
        ([("relative_pose", ("x24", "x25"), our_pose(TRUE[1]), [0.1, 0.2, 0.1])], new, "factors"),
        ([("range", ("x24", "x25"), 1.0, 0.1)], new, "leave x25 free"),
        ([], new, "leave x25 free"),
        (5, {}, "factors = 5"),
        ([("range", ("x24", "l0"))], {}, "tuples"),
        ([], {7: [1.0, 0.0]}, "names of nodes"),
    ):
        with refused(field):
            live.add(factors, values)
    assert (live.x == before).all()
    problem = co.Problem([*"a"], dimension=2).add("position", "a", [0, 0], std=1.0)
    with refused("1 constraints"):
        co.incremental(problem.constrain("position", "a", lower=0.0))
    with refused("params"):
        co.incremental(problem, params={"relinearizeSkip": 1})

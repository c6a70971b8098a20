"""Robust losses and graduated non-convexity against GTSAM's, SciPy's robust minima and CasADi's curvature."""

import itertools
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from numpy.random import default_rng
from oracles.whitened import LOSSES, hessian
from scipy.optimize import least_squares
from scipy.stats import chi2

from coopoc.optimize import MEASUREMENTS, Loss, Problem, pose, solve, solve_gnc
from coopoc.optimize.assess.assess import newton_decrease
from coopoc.optimize.backends.gtsam import forms, graph_of, values, which_turn

M = gtsam.noiseModel.mEstimator
GTSAMS = {"huber": M.Huber, "cauchy": M.Cauchy, "geman-mcclure": M.GemanMcClure, "truncated": M.TruncatedLeastSquares}


@pytest.mark.parametrize("name", GTSAMS)
@pytest.mark.parametrize("scale", [0.4, 1.3])
def test_losses_and_weights_are_gtsams(name, scale):
    r = np.array([0.0, 0.1, 0.39, 0.41, 1.29, 1.31, 3.0, 50.0])
    ours, theirs = Loss(name, scale), GTSAMS[name].Create(scale)
    assert ours.cost(r**2) == pytest.approx([2 * theirs.loss(v) for v in r], rel=1e-12)
    assert ours.weight(r**2) == pytest.approx([theirs.weight(v) for v in r], rel=1e-12)
    gradient_ = (ours.cost(r[1:] ** 2 + 1e-6) - ours.cost(r[1:] ** 2 - 1e-6)) / 2e-6
    assert ours.weight(r[1:] ** 2) == pytest.approx(gradient_, rel=1e-4, abs=1e-8)


def native(seed, wrong=0, loss=None):
    """Twelve points that GTSAM has factors for: a walk with odometry, three ranges to its start, two fixes of each
    point, of which the first `wrong` second ones are tens of metres off."""
    rng = default_rng(seed)
    truth = np.cumsum(rng.normal(0, 4, (12, 3)), axis=0)
    fixes = truth + rng.normal(size=(2, 12, 3))
    fixes[1, :wrong] += rng.uniform(15, 40, (wrong, 3)) * rng.choice([-1, 1], (wrong, 3))
    problem = Problem(tuple(f"p{k}" for k in range(12)), x0=truth).add("position", list(range(12)), fixes[0], std=1.0)
    pairs = [(k, k + 1) for k in range(11)]
    moved = np.diff(truth, axis=0) + rng.normal(0, 0.3, (11, 3))
    problem = problem.add("displacement", pairs, moved, std=0.3, loss=loss)
    far = [(0, 5), (0, 8), (0, 11)]
    ranges = [[np.linalg.norm(truth[j] - truth[i]) + rng.normal(0, 0.5)] for i, j in far]
    problem = problem.add("range", far, ranges, std=0.5, loss=loss)
    return problem.add("position", list(range(12)), fixes[1], std=1.0, loss=loss)


def observed(name, seed):
    """Two points among four that are held, by robust measurements of one number each, a third of them wrong."""
    rng = default_rng(seed)
    anchors = np.array([[0, 0, 0], [30, 0, 2], [0, 30, 4], [30, 30, 9.0]])
    truth = rng.uniform(8, 22, (2, 3)) * [1, 1, 0.5]
    problem = Problem([*"abcdpq"], x0=np.concatenate([anchors, truth + rng.normal(0, 0.5, (2, 3))]), fixed=[*"abcd"])
    pairs = [(a, 4 + p) for a in range(4) for p in range(2)] + [(4, 5)]
    vector = np.array([[*anchors, *truth][j] - [*anchors, *truth][i] for i, j in pairs])
    for kind, std in (("range", 0.3), ("azimuth", 0.03), ("inclination", 0.03)):
        z = MEASUREMENTS[kind].predict(vector) + std * rng.normal(size=(len(pairs), 1))
        z[rng.choice(len(pairs), 3, replace=False)] += 8 * std
        problem = problem.add(kind, pairs, z, std=std, loss=Loss(name, 1.2))
    return problem


@pytest.mark.parametrize("name", LOSSES)
@pytest.mark.parametrize("seed", range(3))
def test_scipy_finds_the_same_robust_minimum(name, seed):
    """SciPy's own huber and cauchy (elementwise, rho of (r / C)^2 times C^2), its solver and differences."""
    problem = observed(name, seed)
    plain = replace(problem, factors=tuple(replace(f, loss=None) for f in problem.factors))

    def residual(free):
        return plain.whiten(np.concatenate([problem.x0[:4], free.reshape(2, 3)]))[0]

    printed = {"geman-mcclure": lambda s: np.stack([s / (1 + s), (1 + s) ** -2.0, -2 * (1 + s) ** -3.0])}
    loss, ours = printed.get(name, name), solve(problem)
    near = ours.x[4:] + default_rng(seed).normal(0, 0.1, (2, 3))
    exact = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-12}
    tries = [
        least_squares(residual, start.ravel(), "3-point", loss=loss, f_scale=1.2, **exact)
        for start in (problem.x0[4:], near)
    ]
    best = min(tries, key=lambda found: found.cost)
    assert ours.cost == pytest.approx(best.cost, rel=1e-9)
    assert ours.x[4:].ravel() == pytest.approx(best.x, abs=1e-5)


def test_the_robust_curvature_is_casadis():
    """At random points, minima of the cost or not: newton_decrease says whether CasADi's Hessian is positive."""
    signs = []
    for seed, name in itertools.product(range(8), LOSSES):
        problem = native(seed, wrong=2, loss=Loss(name, 2.5))
        x = problem.x0 + default_rng(seed).normal(0, 0.25 + 0.05 * seed, problem.x0.shape)
        lowest = np.linalg.eigvalsh(hessian(problem, x)).min()
        assert abs(lowest) > 1e-4
        assert (newton_decrease(problem, x) is not None) == (lowest > 0)
        signs.append(lowest > 0)
    assert 3 < sum(signs) < len(signs) - 3


def gtsams_gnc(problem, loss):
    """Graph and GncLMOptimizer at the same probability, all but the second fixes known inliers."""
    graph, params = graph_of(problem, forms(problem)), gtsam.GncLMParams()
    params.setLossType(loss)
    params.setKnownInliers(list(range(graph.size() - 12)))
    params.setRelativeCostTol(0.0)
    return graph, gtsam.GncLMOptimizer(graph, values(problem.space, which_turn(problem), solve(problem).x), params)


@pytest.mark.parametrize("wrong", [0, 1, 5, 9])
def test_gtsam_doubts_the_same_measurements(wrong):
    for seed in range(3):
        problem = native(seed, wrong)
        graph, theirs = gtsams_gnc(problem, gtsam.GncLossType.TLS)
        result = theirs.optimize()
        ours = solve_gnc(problem, candidates=[3])
        assert np.array_equal(ours.extras["weights"], theirs.getWeights()[-12:])
        assert np.array_equal(ours.extras["weights"][:wrong], np.zeros(wrong))
        assert ours.x == pytest.approx(np.stack([result.atPoint3(k) for k in range(12)]), abs=1e-3)
        kept = [graph.at(k) for k in range(graph.size() - 12)]
        kept += [graph.at(graph.size() - 12 + k) for k in np.flatnonzero(ours.extras["weights"])]
        assert ours.cost == pytest.approx(sum(f.error(result) for f in kept), rel=1e-6)


def test_geman_mcclure_ends_where_gtsams_gnc_does():
    for seed in range(3):
        problem = native(seed, 5)
        loss = Loss("geman-mcclure", np.sqrt(chi2.ppf(0.99, 3)))
        stated = replace(problem, factors=(*problem.factors[:3], replace(problem.factors[3], loss=loss)))
        theirs = gtsams_gnc(problem, gtsam.GncLossType.GM)[1]
        assert solve(stated).cost == pytest.approx(graph_of(stated, forms(stated)).error(theirs.optimize()), rel=1e-3)


@pytest.mark.parametrize("seed", [18, 22, 29])
def test_poses_that_a_loss_may_part_end_as_low_as_from_the_truth(seed):
    """Five poses with fixes, relative poses and ranges, of which a quarter is wrong."""
    rng, n, loss = np.random.default_rng(seed), 5, Loss("cauchy", 1.0)
    at, turn = 10 * rng.normal(size=(n, 2)), rng.uniform(-3, 3, n)
    i, j = np.triu_indices(n, 1)

    def bad(m):
        return 10 * (rng.random((m, 1)) < 0.25) * rng.normal(size=(m, 2))

    c, s, (x, y) = np.cos(turn[:-1]), np.sin(turn[:-1]), np.diff(at, axis=0).T
    problem = Problem(range(n), dimension=2, poses=range(n))
    problem = problem.add("position", range(n), at + rng.normal(size=(n, 2)) + bad(n), std=1.0, loss=loss)
    gap = np.c_[c * x + s * y, c * y - s * x] + 0.2 * rng.normal(size=(n - 1, 2)) + bad(n - 1)
    pairs, z = [(k, k + 1) for k in range(n - 1)], pose(gap, np.diff(turn))
    problem = problem.add("relative_pose", pairs, z, std=[0.2, 0.2, 0.05], loss=loss)
    far = np.hypot(*(at[j] - at[i]).T) + bad(len(i))[:, 0] + 0.3 * rng.normal(size=len(i))
    problem = problem.add("range", np.c_[i, j], np.maximum(far, 0.1), std=0.3, loss=loss)
    least = solve(replace(problem, x0=pose(at, turn)), throw=False).cost
    assert solve(problem, throw=False).cost <= least * (1 + 1e-6)

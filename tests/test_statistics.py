"""Intervals against scipy.stats (bootstrap, t-test) and against their own promise: coverage."""

import numpy as np
import pytest
from conftest import refused
from numpy import ones
from numpy.random import default_rng
from scipy import stats
from scipy.spatial.transform import Rotation
from unseen_graphs import alignment_error

from coopoc import V2X, JointFilter, Kalman, Sensors, load_fleet, observe, rt_le
from coopoc.evaluate import statistics
from coopoc.evaluate.statistics import mean_interval, over_seeds, paired_difference


def test_one_ego_agrees_with_scipy_bootstrap(monkeypatch):
    monkeypatch.setattr(statistics, "RESAMPLES", 20000)
    values = default_rng(0).gamma(4.0, 0.3, 200)
    ours = mean_interval(values)
    theirs = stats.bootstrap((values,), np.mean, n_resamples=20000, method="percentile", rng=1).confidence_interval
    width = theirs.high - theirs.low
    assert abs(ours.low - theirs.low) < 0.03 * width
    assert abs(ours.high - theirs.high) < 0.03 * width
    assert ours.mean == pytest.approx(values.mean())
    assert ours.n == 200


def test_pairing_cancels_what_both_share():
    rng = default_rng(3)
    shared = rng.normal(5, 2, (50, 4))
    a, b = shared + 0.1 + rng.normal(0, 0.05, shared.shape), shared
    difference = paired_difference(a, b)
    assert 0.05 < difference.low < difference.mean < difference.high < 0.15
    apart = mean_interval(a)
    assert apart.high - apart.low > 10 * (difference.high - difference.low)


@pytest.mark.parametrize(
    ("egos", "runs", "between", "together", "low"),
    [(1, 40, 0.0, 0.0, 0.90), (8, 20, 1.0, 0.0, 0.88), (20, 10, 0.2, 1.0, 0.92), (6, 6, 1.0, 1.0, 0.92)],
)
def test_intervals_hold_the_mean_as_often_as_they_promise(egos, runs, between, together, low):
    """`together`: errors that egos share in a run."""
    rng = default_rng(4)
    hits = 0
    for _ in range(300):
        of_run = together * rng.normal(size=(runs, 1)) if together else 0.0
        found = mean_interval(between * rng.normal(size=egos) + of_run + rng.normal(size=(runs, egos)))
        hits += found.low <= 0 <= found.high
    assert low < hits / 300 < 0.98


def test_scores_go_in_as_they_come_out():
    """A difference that all runs share and egos do not: over egos, whose interval is wide."""
    fleet = load_fleet("town10-validation").between(0, 40)
    seen = observe(fleet, Sensors.paper_scenario2(), V2X(4), runs=20, observers=[0, 3, 5])
    a, b = (rt_le(method(seen, [0, 3, 5]), fleet) for method in (Kalman(), JointFilter()))
    ours = paired_difference(a, b)
    per_ego = (a - b).mean(0)
    half = stats.t.ppf(0.975, 2) * per_ego.std(ddof=1) / np.sqrt(3)
    assert ours.mean == pytest.approx(per_ego.mean())
    assert 0.5 * half < ours.high - ours.mean < 2.0 * half


def test_few_egos_that_differ_give_a_wider_interval_than_pooled_runs():
    values = np.array([1.0, 2.0, 3.0]) + 0.01 * default_rng(5).normal(size=(100, 3))
    nested, pooled = mean_interval(values), mean_interval(values.ravel())
    assert nested.high - nested.low > 4 * (pooled.high - pooled.low)


def test_seeds_agree_with_scipy_t_interval():
    values = default_rng(7).normal(1.1, 0.1, (5, 40, 3))
    found = over_seeds(values)
    means = values.mean(axis=(1, 2))
    expected = stats.ttest_1samp(means, 0.0).confidence_interval(0.95)
    assert (found.low, found.mean, found.high) == pytest.approx((expected.low, means.mean(), expected.high))


def test_one_value_has_no_interval():
    found = mean_interval(np.array([2.0]))
    assert found.mean == 2.0
    assert np.isnan(found.low)
    assert np.isnan(found.high)


def test_what_cannot_be_averaged_is_named():
    with refused(r"values\[1, 0\] = nan: must be finite"):
        mean_interval(np.array([1.0, np.nan]))
    with refused("must have shape"):
        mean_interval(np.empty((0, 3)))
    with refused("must have the shape of a"):
        paired_difference(ones((2, 3)), ones((3, 2)))
    with refused(r"a = \(2, 3, 4\): must have shape \(R, E\)"):
        paired_difference(ones((2, 3, 4)), ones((2, 3, 4)))
    with refused("at least two seeds"):
        over_seeds(ones((1, 3)))


@pytest.mark.parametrize("side", [1, -1])
def test_alignment_is_scipys(side):
    """A turn and a shift, also where a reflection would fit better."""
    rng = default_rng(8)
    estimate = rng.normal(size=(50, 3)) * [9, 5, 1]
    truth = Rotation.from_rotvec([0.3, -0.2, 2.0]).apply(estimate * [1, 1, side])
    truth += rng.normal([40, -7, 3], 0.1, truth.shape)
    _, left = Rotation.align_vectors(truth - truth.mean(0), estimate - estimate.mean(0))
    assert alignment_error(estimate, truth) == pytest.approx(left / np.sqrt(50))

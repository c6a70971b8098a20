"""Learned noise of pose filters: the noise that acts is the most likely one, and its log score is SciPy's density."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import refused
from scipy.stats import multivariate_normal
from test_pose_methods import WHITE, convoy, observed

import coopoc as co
from coopoc.evaluate.metrics import pose_covariance
from coopoc.learned.pose_noise import PoseTask, averaged, fit_pose_noise, log_score
from coopoc.world.body_frames import true_heading


def test_the_log_score_is_the_density_of_the_truth():
    """scipy.stats.multivariate_normal, less the constant of three dimensions."""
    fleet = convoy(2, 20)
    track = co.PoseFilter("fleet")(observed(fleet, runs=1), [0, 1])
    cov, scores = pose_covariance(track), log_score(track, fleet)
    for t, ego in ((0, 0), (9, 1), (19, 0)):
        error = np.append(track.x[0, t, ego, :2] - fleet.position[t, ego, :2], track.heading[0, t, ego])
        error[2] -= true_heading(fleet)[t, ego]
        wanted = multivariate_normal(np.zeros(3), cov[0, t, ego]).logpdf(error) + 1.5 * np.log(2 * np.pi)
        assert scores[0, t, ego] == pytest.approx(wanted, abs=1e-6)


def test_noise_that_acts_is_learned_from_a_wrong_start():
    """Closed form: the log score is proper, so that no noise beats the acting one but by chance."""
    fleet = convoy(3, 150)
    acting = replace(WHITE, velocity_reading="speed", velocity_floor=0.01)
    wrong = replace(acting, yaw_rate_std=0.06, range_std=0.1, velocity_std_ratio=0.3)
    method = co.PoseFilter("fleet", exact=False)
    task = PoseTask(observed(fleet, acting, runs=12), fleet, fleet.ids, method, 20)

    def score(assumed):
        return float(log_score(replace(method, assumed=assumed)(task.recording, fleet.ids), fleet)[:, 20:].mean())

    learned = fit_pose_noise([task], wrong, evaluations=120)
    assert score(wrong) < score(acting) - 0.3
    assert score(learned) > score(acting) - 0.05
    for name, within in (("yaw_rate_std", 0.5), ("velocity_std_ratio", 0.5)):
        assert abs(np.log(getattr(learned, name) / getattr(acting, name))) < within
    with refused("tasks"):
        fit_pose_noise([], wrong)


def test_odometry_that_means_nothing_is_learned_to_mean_nothing():
    """Speeds of another drive: the likelihood rises with their noise up to what Sensors allow, and no further."""
    fleet = convoy(2, 60)
    seen = observed(fleet, replace(WHITE, velocity_reading="speed", velocity_floor=0.01), runs=1)
    rng = np.random.default_rng(5)
    seen = replace(seen, velocity=seen.velocity * rng.uniform(-5.0, 5.0, (*seen.velocity.shape[:-1], 1)))
    start = replace(seen.sensors, velocity_std_ratio=0.8, azimuth_std=3.0)
    task = PoseTask(seen, fleet, fleet.ids, co.PoseFilter("fleet", exact=False), 5)
    assert fit_pose_noise([task], start, evaluations=60).velocity_std_ratio == 1.0


def test_a_number_that_one_has_not_learned_is_not_averaged():
    first = co.Sensors(yaw_rate_std=0.1)
    assert averaged([first, replace(first, yaw_rate_std=0.0)])[0].yaw_rate_std == 0.1

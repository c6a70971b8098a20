"""Fixes that err for a while: their statistics, the filter that estimates the error, and the bound."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import refused
from filterpy.kalman import KalmanFilter
from numpy import array, diag
from scipy.linalg import solve_discrete_are

from coopoc import V2X, Fleet, Sensors, bound_rt_le, load_fleet, nees, observe, posterior_bound, rt_le
from coopoc.methods.cooperative_filter import AS_STATED, CooperativeFilter
from coopoc.methods.noise_model import NoiseModel
from coopoc.world.body_frames import gauss_markov

WHITE = Sensors(gnss_std=(1.5, 1.5, 1.5))
OWN = replace(WHITE, gnss_drift_std=2.0, gnss_drift_time=5.0)
COMMON = replace(WHITE, gnss_common_std=2.0, gnss_drift_time=5.0)
BOTH = replace(OWN, gnss_common_std=1.0)


def convoy(vehicles=4, steps=150, dt=0.1):
    """Vehicles 12 m apart at 10 m/s, the second one leaving for a while in the middle."""
    t = dt * np.arange(steps)
    velocity = np.broadcast_to([10.0, 2.0, 0.0], (steps, vehicles, 3)).copy()
    velocity[:, 1:2, 1] += (np.where((t > 4) & (t < 8), 12.0, 0.0) - np.where((t > 8) & (t < 12), 12.0, 0.0))[:, None]
    position = np.cumsum(dt * velocity, 0) + 12.0 * np.arange(vehicles)[:, None] * [1.0, 0.5, 0.0]
    return Fleet(tuple(f"v{k}" for k in range(vehicles)), t, position, velocity)


def test_gauss_markov_has_the_stated_correlation():
    """Closed form: variance 1 and correlation exp(-k / 20) at k steps."""
    error = gauss_markov(np.random.default_rng(0).standard_normal((400, 3000)), 1 / 20)
    assert error.var(1) == pytest.approx(np.ones(400), abs=0.15)
    for lag in (1, 20, 60):
        assert (error[lag:] * error[:-lag]).mean() == pytest.approx(np.exp(-lag / 20), abs=0.02)


def test_drift_is_each_receivers_and_the_common_error_everyones():
    fleet = convoy()
    apart, alike = (
        observe(fleet, replace(s, gnss_std=(0.0,) * 3), assumed=WHITE, runs=40).gnss - fleet.position
        for s in (OWN, COMMON)
    )
    assert apart.std() == pytest.approx(2.0, rel=0.1)
    assert alike.std() == pytest.approx(2.0, rel=0.15)
    assert abs(np.corrcoef(apart[:, -1, 0, 0], apart[:, -1, 1, 0])[0, 1]) < 0.5
    np.testing.assert_allclose(alike[:, :, 0], alike[:, :, 1], atol=1e-12)


def test_alone_it_is_filterpys_augmented_filter():
    """filterpy with state (x, drift, common) per axis, from the first fix with a vague position."""
    fleet = convoy(1)
    seen = observe(fleet, BOTH, V2X(0), seed=3)
    track, keep = CooperativeFilter(priors=AS_STATED)(seen, [0]), np.exp(-0.1 / 5.0)
    q = NoiseModel.nominal(BOTH).process_variance(seen)[0, :, 0]
    for axis in range(3):
        kf = KalmanFilter(dim_x=3, dim_z=1)
        kf.x, kf.P = array([[seen.gnss[0, 0, 0, axis]], [0.0], [0.0]]), diag([1e6, 4.0, 1.0])
        kf.H, kf.R = np.ones((1, 3)), array([[1.5**2]])
        kf.F, kf.B = diag([1.0, keep, keep]), array([[0.1], [0.0], [0.0]])
        for t in range(len(fleet.t)):
            if t:
                kf.predict(u=seen.velocity[0, t, 0, axis], Q=diag([q[t, axis], 4 * (1 - keep**2), 1 - keep**2]))
            kf.update(seen.gnss[0, t, 0, axis])
            assert track.x[0, t, 0, axis] == pytest.approx(kf.x[0, 0], abs=1e-5)
            assert track.covariance[0, t, 0, axis, axis] == pytest.approx(kf.P[0, 0], rel=1e-4)


def test_bound_of_a_single_vehicle_is_the_riccati_equations():
    """SciPy's solve_discrete_are of (x, drift) per axis, after many steps at constant velocity."""
    fleet, keep = convoy(1, steps=3000), np.exp(-0.1 / 5.0)
    found = posterior_bound(fleet, OWN, 0)[-1, 0, 0]
    process = diag([(0.1 * OWN.velocity_std_ratio * 10.0) ** 2, 4 * (1 - keep**2)])
    prior = solve_discrete_are(diag([1.0, keep]).T, np.ones((2, 1)), process, array([[1.5**2]]))
    assert found == pytest.approx(
        (prior - np.outer(prior.sum(1) / (prior.sum() + 1.5**2), prior.sum(0)))[0, 0], rel=1e-3
    )


def test_rms_and_nees_agree_with_the_bound():
    fleet, v2x = convoy(), V2X(3, 25.0)
    for sensors in (OWN, COMMON, BOTH):
        track = CooperativeFilter(priors=AS_STATED)(observe(fleet, sensors, v2x, runs=60, observers=[0]), [0])
        rms = float(np.sqrt(np.mean(rt_le(track, fleet) ** 2)))
        assert rms == pytest.approx(bound_rt_le(posterior_bound(fleet, sensors, 0, v2x)), rel=0.12)
        assert np.nanmean(nees(track, fleet)) == pytest.approx(3.0, abs=0.45)


def test_what_cannot_be_is_refused():
    fleet = convoy()
    with refused("gnss_drift_time"):
        Sensors(gnss_drift_time=0.0)
    with refused("gnss_drift_std"):
        Sensors(gnss_drift_std=-1.0)
    with refused("smoothing"):
        posterior_bound(fleet, OWN, 0, smoothing=True)


@pytest.mark.parametrize(("most", "limit"), [(0, 25.0), (3, 5.0)])
def test_errors_that_last_and_are_not_told_are_in_the_covariance(most, limit):
    """Law: NEES is about 10, not 260 as without them, and 2.2 where neighbours show how far receivers err (9.3); where
    noise is white it is near its 2.4."""
    fleet, egos, levels, drawn = load_fleet("town10").between(0, 500), [24, 30], [], []
    for drift in (0.0, 3.0):
        acting = replace(WHITE, gnss_drift_std=drift, gnss_drift_time=40.0)
        seen = observe(fleet, acting, V2X(most), runs=6, seed=2, observers=egos, assumed=WHITE)
        drawn.append(seen)
        track = CooperativeFilter()(seen, egos)
        levels.append((float(np.median(nees(track, fleet)[:, 200:])), track.covariance[:, 200:, :, 0, 0].mean()))
    assert 1.5 < levels[0][0] < 2.6
    assert levels[0][1] < 0.1
    assert levels[1][0] < limit
    assert levels[1][1] > 10 * levels[0][1]
    late = replace(seen, gnss=np.where((np.arange(500) < 200)[:, None, None], drawn[0].gnss, seen.gnss))
    shown = CooperativeFilter()(late, egos).covariance
    assert shown[:, 450:, :, 0, 0].mean() > 5 * shown[:, 150:200, :, 0, 0].mean()

"""Laws that every method obeys, and independent filters that it equals."""

import re
from dataclasses import replace

import numpy as np
import pytest
from conftest import refused, without

from coopoc import GNSS, V2X, JointFilter, Kalman, NoiseModel, Sensors, observe
from coopoc.evaluate.metrics import errors, nees, share_of_average
from coopoc.methods.catalogue import METHODS, needs_whole_fleet
from coopoc.methods.cooperative_filter import Priors
from coopoc.methods.noise_model import resolve
from coopoc.world.recording import NOTHING_SIMULATED

S2 = Sensors.paper_scenario2()
SILENT = Sensors(gnss_std=(0, 0, 0), velocity_std_ratio=0, range_std=0, azimuth_std=0, inclination_std=0)
COVARIANCES = {f"{name}-{noise}": (name, noise) for name in METHODS for noise in ("identity", "nominal")}
EACH = pytest.mark.parametrize(("name", "noise"), COVARIANCES.values(), ids=COVARIANCES)
SNAPSHOTS = {"gnss"}
"""Methods without a memory: alone they give the fix."""


@EACH
def test_zero_noise_gives_zero_error(name, noise, crossing):
    method = METHODS[name](noise)
    fleet = crossing.between(0, 40)
    recording = observe(fleet, SILENT, V2X(max_neighbours=7, radius=200.0), assumed=S2)
    assert errors(method(recording, [0, 3]), fleet).max() < 1e-6


@EACH
def test_a_run_and_a_step_know_nothing_of_others(name, noise, crossing):
    """One run is the first of five, a short drive the beginning of a long one (estimates are causal), and seconds count
    from anywhere."""
    method = METHODS[name](noise)
    fleet, channel = crossing.between(0, 40), V2X(max_neighbours=4, loss=0.2, latency=0.1)
    seen = observe(fleet, S2, channel, runs=5)
    many = method(seen, [0]).x
    assert method(replace(seen, t=seen.t + 1.7e9), [0]).x == pytest.approx(many, abs=1e-3)
    assert method(observe(fleet, S2, channel), [0]).x == pytest.approx(many[:1], abs=1e-8)
    if name != "batch-smoother":
        assert method(observe(fleet.between(0, 8), S2, channel, runs=5), [0]).x == pytest.approx(many[:, :8], abs=1e-8)


@pytest.mark.parametrize("channel", [V2X(max_neighbours=0), V2X(4, loss=1.0)], ids=["alone", "no message arrives"])
@EACH
def test_without_messages_it_is_the_solo_method(name, noise, channel, crossing):
    """The Kalman filter with its covariance, or the fix; flat priors of positions weigh 1e-6 of a fix. The
    cooperative filter assumes that nothing is wrong."""
    method = METHODS[name](noise)
    if name == "cooperative-filter":
        method = replace(method, priors=Priors(forget=0.0, heading=0.0, scale=0.0, slip=0.0))
    recording = observe(crossing.between(0, 40), S2, channel, runs=3)
    track = method(recording, [0, 1])
    gates = name != "cooperative-filter" and getattr(method, "robust", False)  # whose gate of a fix is another one
    alone = (GNSS() if name in SNAPSHOTS else Kalman(noise, robust=gates))(recording, [0, 1])
    now = slice(-1, None) if name == "batch-smoother" else slice(None)
    assert track.x[:, now] == pytest.approx(alone.x[:, now], abs=1e-6 if name in SNAPSHOTS else 5e-4)
    if name not in SNAPSHOTS:
        assert track.covariance[:, now] == pytest.approx(alone.covariance[:, now], abs=1e-3)
    assert needs_whole_fleet(name) or (track.received_bytes == 0).all()


def test_stale_velocities_do_not_make_the_filter_sure_of_itself(formation):
    """A velocity held for ten steps makes the same error ten times: NEES stays near 3 at one message a second."""
    fleet = formation.between(0, 300)
    recording = observe(fleet, S2, V2X(max_neighbours=6, rate=1.0, loss=0.3), runs=30, observers=[0])
    assert nees(JointFilter()(recording, [0]), fleet).mean() < 4.0


def test_identity_gain_is_the_golden_ratio(formation):
    """Closed form: with unit covariances gain and posterior variance tend to (sqrt 5 - 1)/2."""
    track = Kalman("identity")(observe(formation, S2, observers=[0]), [0])
    assert track.covariance[0, -1, 0] == pytest.approx((np.sqrt(5) - 1) / 2 * np.eye(3))


@pytest.mark.parametrize("name", ["kalman", "joint", "lkf-sa-edge"])
def test_filters_that_claim_a_covariance_are_consistent(name, formation):
    """NEES gate: 95 % of the steps have their run-averaged NEES in the 99 % chi-square band; noise without bias."""
    fleet = formation.between(0, 300)
    recording = observe(fleet, S2, V2X(max_neighbours=6), runs=40, seed=1, observers=[0])
    assert share_of_average(nees(METHODS[name]("nominal")(recording, [0]), fleet).mean(0), 40).min() >= 0.95


def test_a_fitted_noise_model_finds_the_acting_noise(formation):
    training = observe(formation, Sensors(gnss_std=(1.0, 2.0, 3.0), velocity_reading="speed"), runs=2)
    fitted = NoiseModel.fitted(training, formation)
    assert fitted.gnss_std == pytest.approx((1.0, 2.0, 3.0), rel=0.02)
    assert fitted.process_std == pytest.approx((0.1, 0.1, 0.1), rel=0.02)
    late = replace(training, gnss=training.gnss + np.array([2.0, 0.0, 0.0]))  # an error that lasts is no less an error
    assert NoiseModel.fitted(late, formation).gnss_std[0] == pytest.approx(np.hypot(1.0, 2.0), rel=0.01)
    factor = np.random.default_rng(0).uniform(0.5, 9.0, training.present.shape)
    gnss = formation.position + factor[..., None] * (training.gnss - formation.position)
    log = replace(training, gnss=gnss, fix_factor=factor, notes=(NOTHING_SIMULATED,))
    log = replace(log, sensors=replace(log.sensors, velocity_floor=9.0))
    stds = NoiseModel._constant(log, formation)
    assert (*stds.gnss_std, *stds.process_std) == pytest.approx((*fitted.gnss_std, *fitted.process_std))
    with refused("fleet = without truth"):
        NoiseModel.fitted(replace(training, gnss=np.full_like(gnss, np.nan)), formation)


@pytest.mark.parametrize(
    ("lasts", "name", "said"),
    [(0.0, "fitted", r"noise as fitted, of fixes \[0\.[45].* not \[2\..* by -0"), (2.0, "nominal", "noise as stated")],
)
def test_noise_fitted_to_a_log_is_kept_where_it_helps_on_a_third_held_out(lasts, name, said, formation):
    """Law: white noise that is four times less than stated is found; an error that lasts, later, undoes the fit."""
    acting, stated = Sensors(gnss_std=(0.5,) * 3), Sensors(gnss_std=(2.0,) * 3, velocity_std_ratio=0.01)
    for drive in (formation, formation.select(formation.ids[::-1])):  # whichever vehicle is the first
        seen = observe(drive, acting, V2X(max_neighbours=0), seed=1, assumed=stated)
        wave = np.maximum(np.arange(len(seen.t)) / len(seen.t) - 0.5, 0.0)[:, None, None] * 10.0
        log = replace(seen, gnss=seen.gnss + lasts * wave, notes=(f"odometry: {NOTHING_SIMULATED}",))
        fitted = NoiseModel.fitted(log, drive)
        assert fitted.name == name
        assert re.match(said, *fitted.notes)


def test_the_floor_of_a_range_is_the_spread_of_its_arc(formation):
    """Closed form: d e^2 / 2 of an angle's error e has a standard deviation of d std^2 / sqrt(2)."""
    seen = observe(formation, Sensors(range_std=0.01, azimuth_std=0.1, inclination_std=0.05), V2X(2))
    seen = replace(seen, relative=np.where([True, False, False], 20.0, seen.relative))
    known = resolve("nominal", seen).sensors
    assert known.range_std == pytest.approx(np.hypot(20.0 * np.hypot(0.1**2, 0.05**2) / np.sqrt(2), 0.01), rel=1e-9)


def test_a_bad_noise_model_is_named(crossing):
    recording = observe(crossing, S2)
    with refused("noise_model = 'guess'"):
        Kalman("guess")(recording)
    with refused(r"noise_model = 'nominl': .* Did you mean nominal\?"):
        Kalman("nominl")(recording)
    with refused("process_std"):
        NoiseModel("mine", S2, process_std=(0.1, 0.1, 0.0))
    with refused("x0"):
        Kalman("nominal", x0=np.zeros((2, 3)))(recording, [0])


def test_absent_neighbour_is_left_out_and_absent_ego_not_estimated(crossing):
    recording = observe(without(crossing, (slice(20, 40), 1)).between(18, 42), S2, V2X(max_neighbours=7), runs=2)
    for make in METHODS.values():
        assert np.isfinite(make("nominal")(recording, [0]).x).all()
    np.testing.assert_array_equal(Kalman()(recording, [1]).absent[:, 0], np.isnan(recording.velocity[0, :, 1, 0]))


def test_nees_of_a_singular_covariance_is_refused(crossing):
    track = JointFilter()(observe(crossing, S2, V2X(max_neighbours=3), runs=3), [0, 2])
    for factor in (0.0, np.nan):
        with refused(f"{factor}.* of ego 0 in run 0 at step 0: must be .* without a zero"):
            nees(replace(track, covariance=track.covariance * np.diag([1, 1, factor])), crossing)

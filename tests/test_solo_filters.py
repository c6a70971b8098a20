"""Solo filters against textbook oracles, with gaps and absences; noise of fixes that need not be known."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import holed, refused, winding, without
from numpy.testing import assert_allclose, assert_array_equal
from oracles import solo as oracle

from coopoc import GNSS, V2X, CooperativeFilter, Kalman, NoiseModel, Sensors, observe
from coopoc.evaluate.metrics import nees, rt_le
from coopoc.kernels.solo import FixNoise
from coopoc.methods.kalman import solo_filter
from coopoc.methods.noise_model import motion_noise

S2 = Sensors.paper_scenario2()


@pytest.mark.parametrize("std", [1.5, 3.5])
def test_noise_of_fixes_need_not_be_known(std):
    """The cooperative filter alone, which assumes 2.5 m, within 1 % of the Kalman filter that knows it."""
    fleet = winding(900, 10.0, 7.0)
    recording = observe(fleet, Sensors(gnss_std=(std,) * 3), V2X(max_neighbours=0), runs=60)
    track = CooperativeFilter(NoiseModel.nominal(Sensors(gnss_std=(2.5,) * 3)))(recording)
    assert rt_le(track, fleet).mean() < 1.01 * rt_le(Kalman()(recording), fleet).mean()
    assert 2.5 * track.extras["fix_level"][:, -1].mean() == pytest.approx(std, rel=0.03)
    assert 2.5 < nees(track, fleet).mean() < 3.3


def test_bad_settings_are_named(crossing):
    for x0 in (np.zeros((2, 3)), np.zeros((9, 1, 3)), np.full((1, 3), np.nan)):
        with refused("^x0 = "):
            Kalman(x0=x0)(gaps(crossing))
    with refused("^velocity_floor = "):
        Kalman(NoiseModel.nominal(Sensors(velocity_floor=0.0)))(gaps(crossing))


def gaps(fleet, *away):
    """Some fixes missing everywhere, and vehicles that are away for a while."""
    return holed(observe(without(fleet, *away), S2, V2X(max_neighbours=0), runs=3), 0.4)


def series(seen, q, r, *at):
    """Fixes, velocities and variances of one axis of a vehicle, and dt."""
    run, n, c = at
    return *(part[run, :, n, c] for part in (seen.gnss, seen.velocity, q)), r[c], seen.dt


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("noise", ["nominal", "identity"])
def test_kalman(crossing, noise, known):
    seen = gaps(crossing, (slice(20, 30), 1))
    model = NoiseModel.identity() if noise == "identity" else NoiseModel.nominal(S2)
    q, r = np.broadcast_to(model.process_variance(seen, first=int(known)), seen.gnss.shape), model.gnss_variance
    start = crossing.position[0] if known else None
    x, p, _ = solo_filter(seen, range(len(seen.ids)), model, FixNoise(r), start)
    for run, n, c in np.ndindex(3, 4, 3):
        mean, variance = oracle.kalman(*series(seen, q, r, run, n, c), None if start is None else start[n, c])
        assert_allclose(x[run, :, n, c], mean, rtol=1e-12, atol=1e-12)
        assert_allclose(p[run, :, n, c], variance, rtol=1e-10)


def test_known_starts_of_several_across_a_gap(crossing):
    seen, x0 = gaps(crossing, (slice(20, 30), 1)), crossing.position[0]
    both, alone = Kalman(x0=x0[[1, 3]])(seen, [1, 3]), Kalman(x0=x0[[3]])(seen, [3])
    assert_array_equal(both.x[:, :, 1], alone.x[:, :, 0])


def test_noise_that_a_recording_states_is_every_filters(crossing):
    seen, model = gaps(crossing), NoiseModel.nominal(S2)
    more = np.random.default_rng(0).uniform(0.5, 9.0, seen.present.shape)
    seen, fixes = replace(seen, fix_factor=more, motion_variance=more), FixNoise(model.gnss_variance)
    named, plain = (solo_filter(seen, [0, 2], noise, fixes) for noise in (model, motion_noise(model, seen.dt)))
    assert_array_equal(named[:2], plain[:2])


def test_gnss_holds_the_last_fix(crossing):
    seen = gaps(crossing)
    track = GNSS()(seen, [1, 3])
    assert 0 < track.seconds < 60
    for t in range(len(seen.t)):
        newest = max(k for k in range(t + 1) if np.isfinite(seen.gnss[0, k, 1]).all())
        assert_array_equal(track.x[0, t, 0], seen.gnss[0, newest, 1])
    missing = np.isnan(seen.gnss[:, :, [1, 3], 0]).mean()
    assert track.notes == (f"holds the last fix where there is none: {100 * missing:.0f} % of the steps",)

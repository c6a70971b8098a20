"""Errors of odometry that may be there or not, and slips; the reference is filterpy, with its likelihoods."""

from dataclasses import replace

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from numpy import array
from numpy.testing import assert_allclose

import coopoc as co
from coopoc import V2X, CooperativeFilter, Fleet, observe
from coopoc.methods.cooperative_filter import ON_ROADS, Priors
from coopoc.world.body_frames import turned
from coopoc.world.recording import NOTHING_SIMULATED

S2 = co.Sensors.paper_scenario2()
ONLY_SCALE = Priors(forget=0.0, heading=0.0, slip=0.0, lasts=1e12)


@pytest.fixture(scope="module")
def town():
    return co.load_fleet("town10").between(0, 300)


def rms(recording, fleet, **priors: float):
    track = CooperativeFilter(priors=Priors()._replace(**priors))(recording, [3, 8])
    return float(np.sqrt(np.square(track.x - fleet.position[:, [3, 8]]).sum(-1).mean())), track


@pytest.mark.parametrize("priors", [ONLY_SCALE, ONLY_SCALE._replace(absent=-np.inf, exact=4.0)])
@pytest.mark.parametrize("scale", [0.0, 0.02, 0.05])
def test_the_average_is_that_of_two_filters_by_their_likelihoods(scale, priors):
    """filterpy: of the positions along a straight road one filter knows no scale error, one has it as a state; their
    estimates by Bayes' rule."""
    t = 0.5 * np.arange(120)
    position = np.stack([8.0 * t, 0 * t, 0 * t], -1)[:, None]
    fleet = Fleet(("a",), t, position, np.broadcast_to([8.0, 0, 0], position.shape))
    seen = observe(fleet, replace(S2, gnss_std=(1.0,) * 3), V2X(0), observers=[0], assumed=S2)
    seen = replace(seen, velocity=seen.velocity * (1 + scale))
    track = CooperativeFilter(priors=priors)(seen, [0])
    process = co.NoiseModel.nominal(S2).process_variance(seen)[0, :, 0, 0]
    filters, likely = [], array([ONLY_SCALE.absent, 0.0])
    for n in (1, 2):
        peer = KalmanFilter(dim_x=n, dim_z=1)
        peer.x, peer.P = array([[seen.gnss[0, 0, 0, 0]], [0.0]])[:n], np.diag([12.25, 0.01])[:n, :n]
        peer.H, peer.R = np.eye(1, n), array([[12.25]])
        filters.append(peer)
    for k in range(1, len(t)):
        moved = 0.5 * seen.velocity[0, k, 0, 0]
        for i, peer in enumerate(filters):
            peer.F = array([[1.0, moved], [0.0, 1.0]])[: i + 1, : i + 1]
            peer.predict(Q=np.diag([process[k], 0.0])[: i + 1, : i + 1])
            peer.x[0] += moved
            peer.update(array([[seen.gnss[0, k, 0, 0]]]))
            likely[i] += peer.log_likelihood
        there = 1.0 / (1.0 + np.exp(likely[0] - likely[1]))
        assert_allclose(track.x[0, k, 0, 0], (1 - there) * filters[0].x[0, 0] + there * filters[1].x[0, 0], atol=2e-3)
    assert track.extras["scale_error"][0, -1, 0] == pytest.approx(there * filters[1].x[1, 0], abs=1e-4)


def erring(seen):
    """All headings 4 degrees off, and all scales 3 %."""
    return replace(seen, velocity=turned(1.03 * seen.velocity, np.full(seen.velocity.shape[:3], 0.07)))


def test_odometry_that_errs_is_found_and_said(town):
    """Half the error; where nothing errs, it costs next to nothing."""
    seen = observe(town, S2, V2X(4), runs=3, observers=[3, 8])
    wrong = erring(seen)
    (found, track), (without, _) = rms(wrong, town), rms(wrong, town, heading=0.0, scale=0.0)
    assert found < 0.6 * without
    assert_allclose(track.extras["heading_error"][:, -1], -0.07, atol=0.025)
    assert any(note.startswith("heading error, ") for note in track.notes)
    (found, track), (without, _) = rms(seen, town), rms(seen, town, heading=0.0, scale=0.0)
    assert found < 1.01 * without
    assert not any("error" in note for note in track.notes)


def test_a_slip_is_found_and_ends(town):
    """Wheels of the egos are locked for three seconds, beside three neighbours or one."""
    seen = observe(town, S2, V2X(6), runs=3, observers=[3, 8])
    velocity = seen.velocity.copy()
    velocity[:, 120:150, [3, 8]] = 0.0
    slips = replace(seen, velocity=velocity)
    (found, track), (without, _) = rms(slips, town), rms(slips, town, slip=0.0)
    assert found < 0.98 < 0.4 * without
    said = track.extras["slips"].mean(axis=(0, 2))
    assert said[128:150].mean() > 0.5
    assert said[:115].max() < 0.1
    assert said[165:].mean() < 0.1
    assert any(note.startswith("slips, ") for note in track.notes)
    _, clean = rms(seen, town)
    assert clean.extras["slips"].mean() < 0.01


@pytest.mark.parametrize(("factor", "said"), [(1.0, False), (3.0, True)])
def test_notes_name_what_is_otherwise_than_stated_and_nothing_else(town, factor, said):
    """Real fixes are assumed to err more than is stated; a note says by how much they do."""
    sensors = replace(S2, range_offset_std=0.3)
    acts = replace(sensors, gnss_std=tuple(factor * array(S2.gnss_std)))
    seen = observe(town, acts, V2X(4), runs=2, observers=[3], assumed=sensors)
    notes = CooperativeFilter()(replace(seen, notes=(NOTHING_SIMULATED,)), [3]).notes
    levels = [float(note.split()[-5]) for note in notes if note.startswith(f"fix level, {town.ids[3]}: ")]
    assert levels == (pytest.approx([factor], rel=0.15) if said else [])
    assert not any(note.startswith("range offset, ") for note in notes)


def test_a_fleet_speaks_for_odometries_that_do_not_err():
    """Five precise odometries, fixes of 1 Hz, 90 s: what is known of all counts, and where all err, nothing is lost."""
    town = co.load_fleet("town10").between(0, 900)
    precise = replace(S2, velocity_std_ratio=0.01)
    seen = replace(observe(town, precise, V2X(4), runs=3, observers=[3, 8]), notes=(NOTHING_SIMULATED,))
    seen = replace(seen, gnss=np.where(np.arange(900)[:, None, None] % 10, np.nan, seen.gnss))
    wrong = erring(seen)
    each, none = ON_ROADS._replace(exact=-np.inf), ON_ROADS._replace(heading=0.0, scale=0.0)
    right, found, without = (rms(seen, town, **priors._asdict())[0] for priors in (none, ON_ROADS, each))
    assert right < found < without - 0.15 * (without - right)
    found, without = (rms(wrong, town, **priors._asdict())[0] for priors in (ON_ROADS, each))
    assert found < 1.01 * without


def test_a_star_whose_fixes_drift_as_stated_is_kept():
    sensors = replace(S2, gnss_std=(1.1,) * 3, gnss_drift_std=3.3, gnss_drift_time=60.0)
    recording = observe(co.load_fleet("town10"), sensors, V2X(2), runs=4, observers=[40])
    assert not CooperativeFilter()(recording, [40]).extras["alone"].any()

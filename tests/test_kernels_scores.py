"""Errors and NEES of tracks: the compiled pass against NumPy's own solve, and against the reference."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from coopoc import V2X, JointFilter, Kalman, Sensors, Track, observe
from coopoc.evaluate import scores
from coopoc.evaluate.metrics import errors, nees, neighbour_rt_le

S2 = Sensors.paper_scenario2()


@pytest.fixture
def track(crossing):
    return JointFilter()(observe(crossing, S2, V2X(max_neighbours=4), runs=3), [0, 5])


def test_errors_and_nees_are_numpys(track, crossing):
    gap = track.x - crossing.position[:, [0, 5]]
    assert_allclose(errors(track, crossing), np.linalg.norm(gap, axis=-1), rtol=1e-14)
    solved = np.linalg.solve(track.covariance, gap[..., None])[..., 0]
    assert_allclose(nees(track, crossing), (gap * solved).sum(axis=-1), rtol=1e-9)


def test_what_egos_think_of_neighbours(track, crossing):
    """Root mean square over the links that the ego knows something of, NaN without any."""
    seen = observe(crossing, S2, V2X(max_neighbours=4, loss=0.5, max_age=0.2), runs=3)
    theirs = track.neighbours.copy()
    theirs[1, ::3], theirs[2] = np.nan, np.nan
    partly = Track(track.t, track.egos, track.x, None, track.received_bytes, track.sent_bytes, 0.0, theirs)
    found = neighbour_rt_le(partly, seen, crossing)
    links = seen.links.of(0)
    gap = theirs[1, : len(links)] - crossing.position[seen.links.step[links], seen.links.neighbour[links]]
    assert found[1, 0] == pytest.approx(np.sqrt(np.nanmean((gap**2).sum(axis=-1))), rel=1e-13)
    assert np.isnan(found[2]).all()


def test_neighbours_are_counted_per_step(crossing, monkeypatch):
    """All eight are within the radius at every step, and the three nearest are linked; runs are scored by fours."""
    seen = observe(crossing, S2, V2X(max_neighbours=3, radius=1e4), runs=6)
    monkeypatch.setattr(scores, "SLAB", 1)
    found = scores.scored(JointFilter(), seen, ["c0", "c5"], crossing, quantiles=3)
    assert_allclose(found["error_quantiles_m"][..., 2], found["max_error_m"])
    assert found["neighbours_mean"].tolist() == [[3.0, 3.0]] * 6
    each = nees(JointFilter()(seen, ["c0", "c5"]), crossing).mean(axis=1)
    assert_allclose(found["nees"], each, rtol=1e-12)


def test_a_start_that_is_known_has_no_nees(crossing):
    known = Kalman("nominal", x0=crossing.position[0, [0]])(observe(crossing, S2, runs=2), [0])
    found = nees(known, crossing)
    assert np.isnan(found[:, 0]).all()
    assert np.isfinite(found[:, 1:]).all()
    gap = (known.x - crossing.position[:, [0]])[:, 1:]
    solved = np.linalg.solve(known.covariance[:, 1:], gap[..., None])[..., 0]
    assert_allclose(found[:, 1:], (gap * solved).sum(axis=-1), rtol=1e-9)

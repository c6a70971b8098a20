"""Errors and NEES of tracks: the compiled pass against NumPy's own solve, and against the reference."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.linalg import norm, solve
from numpy.testing import assert_allclose

from coopoc import V2X, JointFilter, Kalman, Sensors, observe
from coopoc.evaluate import scores
from coopoc.evaluate.metrics import errors, nees, share_of_average

S2 = Sensors.paper_scenario2()


@pytest.fixture
def track(crossing):
    return JointFilter()(observe(crossing, S2, V2X(max_neighbours=4), runs=3), [0, 5])


def test_errors_and_nees_are_numpys(track, crossing):
    gap = track.x - crossing.position[:, [0, 5]]
    assert_allclose(errors(track, crossing), norm(gap, axis=-1), rtol=1e-14)
    assert_allclose(nees(track, crossing), np.vecdot(gap, solve(track.covariance, gap[..., None])[..., 0]), rtol=1e-9)


def test_runs_are_scored_by_fours(crossing, monkeypatch):
    seen = observe(crossing, S2, V2X(max_neighbours=3, radius=1e4), runs=6)
    seen = replace(seen, gnss=seen.gnss * [1, 1, 0])
    monkeypatch.setattr(scores, "SLAB", 1)
    found = scores.scored(JointFilter(), seen, ["c0", "c5"], crossing, quantiles=3)
    assert set(found) < scores.COLUMNS
    assert_allclose(found["error_quantiles_m"][..., 2], found["max_error_m"])
    whole = JointFilter()(seen, ["c0", "c5"])
    assert_allclose(found["nees"], nees(whole, crossing).mean(1), rtol=1e-12)
    assert_allclose(found["nees_inside"][0], share_of_average(nees(whole, crossing).mean(0), seen.runs, 2))


def test_a_start_that_is_known_has_no_nees(crossing):
    known = Kalman("nominal", x0=crossing.position[0, [0]])(observe(crossing, S2, runs=2), [0])
    found = nees(known, crossing)
    assert np.isnan(found[:, 0]).all()
    assert np.isfinite(found[:, 1:]).all()
    gap = (known.x - crossing.position[:, [0]])[:, 1:]
    assert_allclose(found[:, 1:], np.vecdot(gap, solve(known.covariance[:, 1:], gap[..., None])[..., 0]), rtol=1e-9)

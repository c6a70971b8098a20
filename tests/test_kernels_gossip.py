"""Belief propagation and ADMM of a pair against numpy.linalg."""

from __future__ import annotations

import numpy as np
import pytest

from coopoc import V2X, Fleet, Sensors, observe
from coopoc.methods.decentralised import ConsensusADMM, GaussianBeliefPropagation
from coopoc.world.spherical import to_vector

S2 = Sensors.paper_scenario2()


@pytest.mark.parametrize("method", [GaussianBeliefPropagation("identity"), ConsensusADMM("identity", rounds=200)])
def test_two_vehicles_reach_the_least_squares_solution(method, crossing: Fleet) -> None:
    """The first step of a pair is a linear problem of two fixes and two relative measurements: numpy.linalg.lstsq."""
    recording = observe(crossing.select(["c0", "c3"]).between(0, 2), S2, V2X(max_neighbours=1, radius=200.0))
    first = recording.links.step == 0
    ahead = to_vector(recording.relative[0, first]) * np.where(recording.links.observer[first] == 0, 1.0, -1.0)[:, None]
    rows = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 1.0], [-1.0, 1.0]])
    right = np.concatenate([recording.gnss[0, 0], ahead])
    best = np.linalg.lstsq(rows, right, rcond=None)[0]
    track = method(recording, [0, 1])
    assert track.x[0, 0] == pytest.approx(best, abs=1e-9)
    if track.notes[0].startswith("GBP"):
        assert track.covariance is not None
        wanted = np.linalg.inv(rows.T @ rows)[0, 0] * np.eye(3)
        assert track.covariance[0, 0, 0] == pytest.approx(wanted, abs=1e-12)

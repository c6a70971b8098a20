"""Compiled belief propagation and ADMM against the NumPy reference and numpy.linalg."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_kernels import CHANNELS, S2, in_numpy

from coopoc import V2X, Fleet, Knowledge, observe
from coopoc.methods.admm import ConsensusADMM
from coopoc.methods.gbp import GaussianBeliefPropagation
from coopoc.world.spherical import to_vector

pytest.importorskip("numba")
KNOWN = {"identity": "identity", "nominal": "nominal", "fitted": Knowledge("fitted", S2, (0.3, 0.2, 0.01))}
METHODS = {"gbp": GaussianBeliefPropagation, "admm": ConsensusADMM,
           "damped": lambda known: GaussianBeliefPropagation(known, rounds=5, damping=0.4),
           "weak": lambda known: ConsensusADMM(known, rounds=2, rho=0.1)}  # fmt: skip


@pytest.mark.parametrize("channel", CHANNELS, ids=str)
@pytest.mark.parametrize("knowledge", KNOWN)
@pytest.mark.parametrize("name", METHODS)
def test_the_rounds_are_the_reference(
    crossing: Fleet, channel: V2X, knowledge: str, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Vehicle 1 is away for a while, vehicle 2 comes late; messages are lost, late and turned away."""
    position, velocity = crossing.position.copy(), crossing.velocity.copy()
    for column, away in ((1, slice(4, 9)), (2, slice(0, 6))):
        position[away, column] = velocity[away, column] = np.nan
    fleet = replace(crossing, position=position, velocity=velocity).between(0, 20)
    recording, method = observe(fleet, S2, channel, runs=2), METHODS[name](KNOWN[knowledge])
    found, wanted = method(recording, [0, 3, 7]), in_numpy(monkeypatch, method, recording, [0, 3, 7])
    assert found.covariance is not None
    assert wanted.covariance is not None
    np.testing.assert_allclose(found.x, wanted.x, atol=1e-9, rtol=0)
    np.testing.assert_allclose(found.covariance, wanted.covariance, atol=1e-9, rtol=1e-9)
    assert found.notes == wanted.notes


@pytest.mark.parametrize("method", [GaussianBeliefPropagation("identity"), ConsensusADMM("identity", rounds=200)])
def test_two_vehicles_reach_the_least_squares_solution(method, crossing: Fleet) -> None:
    """The first step of a pair is a linear problem of two fixes and two sightings: numpy.linalg.lstsq."""
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

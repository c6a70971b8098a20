"""Kernels of the whole fleet against dense oracles: gaps, absences, losses, delays, missing angles, batches of runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from oracles.admm import admm
from oracles.batch_smoother import batch_smoother
from oracles.central_filter import central_filter
from oracles.gbp import gbp
from oracles.whole_fleet import Drive

from coopoc import V2X, BatchSmoother, CentralFilter, Fleet, NoiseModel, Recording, Sensors, observe
from coopoc.methods.decentralised import ConsensusADMM, GaussianBeliefPropagation
from coopoc.methods.noise_model import resolve
from coopoc.world.exchange import exchange

S2 = Sensors.paper_scenario2()
KNOWN = {"nominal": "nominal", "identity": "identity", "fitted": NoiseModel("fitted", S2, (0.3, 0.2, 0.01))}
METHODS = {
    "gbp": GaussianBeliefPropagation,
    "gbp-damped": lambda known: GaussianBeliefPropagation(known, rounds=2, damping=0.4),
    "gbp-belief": lambda known: GaussianBeliefPropagation(known, rounds=2, carry="belief"),
    "admm": lambda known: ConsensusADMM(known, rounds=2, rho=0.7),
    "central-filter": CentralFilter,
    "batch-smoother": lambda known: BatchSmoother(known, exact_steps=12, settle=1e-9),
}
CHANNELS = {
    "plain": V2X(max_neighbours=3),
    "lossy and late": V2X(max_neighbours=3, loss=0.3, latency=0.2),
    "all": V2X(max_neighbours=20, radius=200.0),
    "none": V2X(max_neighbours=0),
}


def holed(recording: Recording, fixes: float, angles: float, delays: int = 0) -> Recording:
    """Without shares of the fixes and of ranges and angles; messages up to so many steps later than sent."""
    rng = np.random.default_rng(4)
    gnss, relative, arrival = recording.gnss.copy(), recording.relative.copy(), recording.arrival.copy()
    gone = rng.uniform(size=gnss.shape[:3]) < fixes
    gone[:, 0, [0, 5]] = False
    gnss[gone] = np.nan
    relative[rng.uniform(size=relative.shape) < angles * np.array([0.3, 1.0, 1.0])] = np.nan
    arrival = np.where(arrival >= 0, arrival + rng.integers(0, delays + 1, arrival.shape), -1)
    return replace(recording, gnss=gnss, relative=relative, arrival=arrival)


def drive(crossing: Fleet, channel: str, runs: int = 1, gaps: bool = True, absences: bool = True) -> Recording:
    fleet = crossing.select(range(6)).between(0, 14)
    position, velocity = fleet.position.copy(), fleet.velocity.copy()
    for column, away in ((1, slice(4, 9)), (2, slice(0, 6)), (3, slice(9, 14))) if absences else ():
        position[away, column] = velocity[away, column] = np.nan
    recording = observe(replace(fleet, position=position, velocity=velocity), S2, CHANNELS[channel], runs=runs)
    return holed(recording, 0.5, 0.2, 3 if channel == "lossy and late" else 0) if gaps else recording


def compare(name: str, known: str, recording: Recording) -> None:
    method, noise = METHODS[name](KNOWN[known]), resolve(KNOWN[known], recording)
    track = method(recording, [0, 5])
    central = name in ("central-filter", "batch-smoother")
    met = exchange(recording, method.message if not central else replace(method.message, rounds=0))
    arrival = met.either if central else met.both
    for run in range(recording.runs):
        one = Drive(recording, noise, met, arrival[run], run)
        rounds = method.message.rounds if not central else 9
        if name.startswith("gbp"):
            x, P = gbp(one, method.rounds, method.damping, method.carry)
        elif name == "admm":
            x, P = admm(one, method.rounds, method.rho)
        elif name == "central-filter":
            x, P = central_filter(one)
        else:
            x, P = batch_smoother(one, np.where(one.active[..., None], central_filter(one)[0], np.nan))
        for e, n in enumerate((0, 5)):
            wanted, cov = x[:, n], P[:, n]
            if name != "batch-smoother" and (arrival > met.step).any():
                wanted, cov = one.late(x, P, n, rounds)
            np.testing.assert_allclose(track.x[run, :, e], wanted, atol=1e-7, rtol=0)
            if track.covariance is not None:
                np.testing.assert_allclose(track.covariance[run, :, e], cov, atol=1e-7, rtol=1e-6)


@pytest.mark.parametrize("channel", CHANNELS)
@pytest.mark.parametrize("name", METHODS)
def test_gaps_absences_and_channels(name: str, channel: str, crossing: Fleet) -> None:
    compare(name, "nominal", drive(crossing, channel, runs=3))


@pytest.mark.parametrize("known", ["identity", "fitted"])
@pytest.mark.parametrize("name", METHODS)
def test_noise_models(name: str, known: str, crossing: Fleet) -> None:
    recording = drive(crossing, "lossy and late", gaps=known == "fitted")
    compare(name, known, recording)


@pytest.mark.parametrize("runs", [1, 5])
@pytest.mark.parametrize("name", ["gbp", "admm", "central-filter", "batch-smoother"])
def test_batches_of_runs_without_gaps(name: str, runs: int, crossing: Fleet) -> None:
    compare(name, "nominal", drive(crossing, "plain", runs=runs, gaps=False, absences=False))


def test_fixes_of_1_hz_in_data_of_10_hz(crossing: Fleet) -> None:
    """Every whole-fleet method takes them, and neighbours help."""
    recording = observe(crossing, S2, V2X(max_neighbours=6), runs=4)
    gnss = recording.gnss.copy()
    gnss[:, np.arange(60) % 10 > 0] = np.nan
    slow = replace(recording, gnss=gnss)
    for name, make in METHODS.items():
        track = make("nominal")(slow, [0, 3])
        assert np.isfinite(track.x).all(), name
        assert np.linalg.norm(track.x - crossing.position[:, [0, 3]], axis=-1).mean() < 6.5, name

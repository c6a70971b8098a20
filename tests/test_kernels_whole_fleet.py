"""Kernels of the whole fleet against dense oracles: gaps, absences, losses, delays, missing angles; filterpy."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import crossing_fleet, textbook
from filterpy.kalman import KalmanFilter
from oracles.batch_smoother import batch_smoother
from oracles.central_filter import central_filter
from oracles.whole_fleet import Drive

from coopoc import V2X, BatchSmoother, CentralFilter, Fleet, NoiseModel, Recording, Sensors, observe
from coopoc.methods.noise_model import resolve
from coopoc.world.exchange import exchange
from coopoc.world.links import to_vector

S2 = Sensors.paper_scenario2()
STILL = NoiseModel("fitted", S2, (1e-6, 1e-6, 1e-6))
KNOWN = {"nominal": "nominal", "identity": "identity", "fitted": NoiseModel("fitted", S2, (0.3, 0.2, 0.01))}
METHODS = {
    "central-filter": CentralFilter,
    "batch-smoother": BatchSmoother,
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


def compare(name: str, known: str | NoiseModel, recording: Recording, near: float = 1e-7) -> None:
    """Positions and covariances of all vehicles that are there throughout, in every run."""
    model = KNOWN.get(known, known) if isinstance(known, str) else known
    method, noise = textbook(METHODS[name](model)), resolve(model, recording)
    there = np.isfinite(recording.velocity).all(axis=(0, 1, 3)) & np.isfinite(recording.gnss[:, 0]).all(axis=(0, 2))
    egos = np.flatnonzero(there).tolist()
    track, met = method(recording, egos), exchange(recording)
    assert track.covariance is not None
    for run in range(recording.runs):
        one = Drive(recording, noise, met, met.arrival[run], run)
        if name == "central-filter":
            x, P = central_filter(one)
        else:
            x, P = batch_smoother(one, np.where(one.active[..., None], central_filter(one)[0], np.nan))
        for e, n in enumerate(egos):
            cov = P[:, n]
            np.testing.assert_allclose(track.x[run, :, e], x[:, n], atol=near, rtol=0)
            size = np.abs(cov).max(axis=(-1, -2), keepdims=True)
            assert (np.abs(track.covariance[run, :, e] - cov) / size).max() < 10 * near


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
@pytest.mark.parametrize("name", METHODS)
def test_batches_of_runs_without_gaps(name: str, runs: int, crossing: Fleet) -> None:
    compare(name, "nominal", drive(crossing, "plain", runs=runs, gaps=False, absences=False))


def test_vehicles_that_hardly_move_and_come_back(crossing: Fleet) -> None:
    """Motion known far better than any fix; vehicle 1 is away for a while."""
    position, velocity = crossing.position.copy(), crossing.velocity.copy()
    position[25:30, 1] = velocity[25:30, 1] = np.nan
    fleet = replace(crossing, position=position, velocity=velocity)
    compare("central-filter", STILL, observe(fleet, S2, V2X(max_neighbours=4), runs=2), near=1e-6)


def far_apart(copies: int, vehicles: int, steps: int = 25) -> Fleet:
    """Copies of a crossing, 200 m apart."""
    one = crossing_fleet(vehicles, steps)
    shift = np.arange(copies)[:, None, None, None] * [200.0, 0.0, 0.0]
    position = np.concatenate(list(one.position + shift), axis=1)
    ids = tuple(f"{k}-{name}" for k in range(copies) for name in one.ids)
    return Fleet(ids, one.t, position, np.tile(one.velocity, (1, copies, 1)))


@pytest.mark.parametrize(("copies", "vehicles"), [(1, 1), (1, 2), (3, 9), (1, 20)])
def test_components_of_any_size_are_the_oracle(copies: int, vehicles: int) -> None:
    """Matrices from one tile to many."""
    compare("central-filter", "nominal", observe(far_apart(copies, vehicles), S2, V2X(max_neighbours=6)))


def test_poor_and_very_good_measurements_are_the_oracle(crossing: Fleet) -> None:
    for range_std, angle_std, near in ((1e-3, 1e-4, 1e-6), (30.0, 1.0, 1e-9)):
        sensors = replace(S2, range_std=range_std, azimuth_std=angle_std, inclination_std=angle_std)
        compare("central-filter", "nominal", observe(crossing.between(0, 20), sensors, V2X(max_neighbours=4)), near)


def test_vehicles_in_one_place_are_the_oracle() -> None:
    position = np.repeat([[[0.0, 0, 0], [0.6, 0, 0], [9, 2, 0]]], 30, axis=0)
    fleet = Fleet(("a", "b", "c"), 0.1 * np.arange(30), position, 0 * position)
    recording = observe(fleet, Sensors(min_range=0.1), V2X(max_neighbours=2), runs=3)
    compare("central-filter", "nominal", recording, near=1e-8)


def test_the_central_filter_is_filterpys(crossing: Fleet) -> None:
    """All vehicles in one state, every relative measurement a row: with unit noise the whole problem is linear."""
    fleet = crossing.select(range(6)).between(0, 30)
    recording = observe(fleet, S2, V2X(max_neighbours=3), runs=2)
    track = CentralFilter("identity")(recording, range(6))
    assert track.covariance is not None
    links, seen = recording.links, to_vector(recording.relative)
    for run in range(2):
        peer = KalmanFilter(dim_x=18, dim_z=18, dim_u=18)
        peer.B, peer.Q = 0.1 * np.eye(18), np.eye(18)
        peer.x, peer.P = recording.gnss[run, 0].ravel(), np.eye(18)
        for t in range(30):
            now = np.flatnonzero(links.step == t)
            incidence = np.eye(6)[links.neighbour[now]] - np.eye(6)[links.observer[now]]
            if t:
                peer.predict(u=recording.velocity[run, t].ravel())
                peer.update(recording.gnss[run, t].ravel(), R=np.eye(18), H=np.eye(18))
            if len(now):
                peer.update(seen[run, now].ravel(), R=np.eye(3 * len(now)), H=np.kron(incidence, np.eye(3)))
            assert track.x[run, t].ravel() == pytest.approx(peer.x, abs=1e-9)
            own = peer.P.reshape(6, 3, 6, 3)[np.arange(6), :, np.arange(6)]
            assert track.covariance[run, t] == pytest.approx(own, abs=1e-9)

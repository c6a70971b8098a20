"""The whole-fleet filter against its dense oracle, filterpy and numpy.linalg, for components of any size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conftest import crossing_fleet
from filterpy.kalman import KalmanFilter
from oracles.central_filter import central_filter
from oracles.whole_fleet import Drive

from coopoc import V2X, CentralFilter, Fleet, NoiseModel, Recording, Sensors, observe
from coopoc.methods.noise_model import resolve
from coopoc.world.exchange import exchange
from coopoc.world.spherical import to_vector
from coopoc.world.v2x import NO_MESSAGE

S2 = Sensors.paper_scenario2()
STILL = NoiseModel("fitted", S2, (1e-6, 1e-6, 1e-6))


def assert_dense(method: CentralFilter, recording: Recording, near: float = 1e-9) -> None:
    """Positions and covariances of the egos that are present throughout, in every run."""
    egos = np.flatnonzero(np.isfinite(recording.velocity).all(axis=(0, 1, 3))).tolist()
    track, met = method(recording, egos), exchange(recording, NO_MESSAGE)
    assert track.covariance is not None
    for run in range(recording.runs):
        drive = Drive(recording, resolve(method.noise_model, recording), met, met.either[run], run)
        x, cov = central_filter(drive)
        np.testing.assert_allclose(track.x[run], x[:, egos], atol=near, rtol=0)
        size = np.abs(cov[:, egos]).max(axis=(-1, -2), keepdims=True)
        assert (np.abs(track.covariance[run] - cov[:, egos]) / size).max() < near


def test_vehicles_that_hardly_move_and_come_back(crossing: Fleet) -> None:
    """Motion known far better than any fix; vehicle 1 is away for a while."""
    position, velocity = crossing.position.copy(), crossing.velocity.copy()
    position[25:30, 1] = velocity[25:30, 1] = np.nan
    fleet = replace(crossing, position=position, velocity=velocity)
    method = CentralFilter(STILL)
    assert_dense(method, observe(fleet, S2, V2X(max_neighbours=4), runs=2), near=1e-6)


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
    assert_dense(CentralFilter(), observe(far_apart(copies, vehicles), S2, V2X(max_neighbours=6)))


def test_poor_and_very_good_measurements_are_the_oracle(crossing: Fleet) -> None:
    for range_std, angle_std, near in ((1e-3, 1e-4, 1e-6), (30.0, 1.0, 1e-9)):
        sensors = replace(S2, range_std=range_std, azimuth_std=angle_std, inclination_std=angle_std)
        assert_dense(CentralFilter(), observe(crossing.between(0, 20), sensors, V2X(max_neighbours=4)), near)


def test_a_run_knows_nothing_of_those_it_shares_its_covariance_with(crossing: Fleet) -> None:
    """To the last bit, whether runs receive the same or not."""
    method = CentralFilter("identity")
    for loss in (0.0, 0.3):
        recordings = [observe(crossing, S2, V2X(max_neighbours=4, loss=loss), runs=runs) for runs in (1, 3)]
        alone, many = (method(recording, [0, 5]) for recording in recordings)
        np.testing.assert_array_equal(alone.x[0], many.x[0])
        assert alone.covariance is not None
        assert many.covariance is not None
        np.testing.assert_array_equal(alone.covariance[0], many.covariance[0])


def test_the_filter_is_filterpys(crossing: Fleet) -> None:
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


def test_vehicles_in_one_place_are_the_oracle() -> None:
    position = np.repeat([[[0.0, 0, 0], [0.6, 0, 0], [9, 2, 0]]], 30, axis=0)
    fleet = Fleet(("a", "b", "c"), 0.1 * np.arange(30), position, 0 * position)
    recording = observe(fleet, Sensors(min_range=0.1), V2X(max_neighbours=2), runs=3)
    assert_dense(CentralFilter(), recording, near=1e-8)

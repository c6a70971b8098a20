"""The whole-fleet filter against its dense oracle, filterpy and numpy.linalg, for components of any size."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from conftest import callable_part, crossing_fleet
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


def matrix(members: int, rng: np.random.Generator, share: float) -> tuple[Any, Any, Any, Any]:
    """A covariance, an information of few pairs, who shares it, and the plan of one component."""
    from coopoc.kernels.fleets.components import arrange

    n = 3 * members
    near = np.triu(rng.random((members, members)) < share, 1)
    info = np.diag(rng.uniform(0.5, 2.0, n))
    for i, j in np.argwhere(near):
        root = np.zeros((n, 3))
        root[3 * i : 3 * i + 3] = rng.normal(size=(3, 3))
        root[3 * j : 3 * j + 3] = -root[3 * i : 3 * i + 3]
        info += root @ root.T
    root, plan = rng.normal(size=(n, 2 * n)), np.zeros((6, members + 1), np.int64)
    callable_part(arrange)(np.zeros(members, np.int64), plan)
    return root @ root.T / n, info, near | near.T, plan


@pytest.mark.parametrize("members", [1, 2, 4, 5, 13, 29])
@pytest.mark.parametrize("share", [0.0, 0.2, 1.0])
def test_what_a_sparse_information_adds_is_what_numpy_inverts(members: int, share: float) -> None:
    """From the upper triangle of P and the lower one of F, whatever stands in the others' place of P."""
    from coopoc.kernels.fleets.components import STRIDE
    from coopoc.kernels.fleets.low_rank import scratch, update

    rng = np.random.default_rng(members)
    spread, info, near, plan = matrix(members, rng, share)
    n, stride = 3 * members, int(plan[STRIDE, 0])
    wanted = np.linalg.inv(np.linalg.inv(spread) + info)
    p, f = np.zeros((2, stride, stride))
    p[:n, :n], f[:n, :n] = np.triu(spread) + np.tril(np.full((n, n), 7.0), -1), np.tril(info)
    flat = p.ravel()
    eta, moved = rng.normal(size=(2, members, 3)), np.empty((2, stride))
    callable_part(update)(plan, 0, flat, f.ravel(), near, scratch(members, stride), eta.copy(), moved)
    found = np.triu(flat.reshape(stride, stride)[:n, :n])
    np.testing.assert_allclose(found, np.triu(wanted), atol=1e-12 * np.abs(wanted).max())
    np.testing.assert_allclose(moved[:, :n], eta.reshape(2, n) @ wanted, atol=1e-11)


def test_components_merge_where_vehicles_meet_and_stay_together() -> None:
    from coopoc.kernels.fleets.components import BEGIN, HOME, MEMBER, arrange, connect

    arrange, connect = callable_part(arrange), callable_part(connect)
    label, plan = np.full(5, -1), np.zeros((6, 6), np.int64)
    all_active, none_active = np.ones(5, bool), np.zeros(5, bool)
    first, second = np.array([0, 1]), np.array([3, 4])
    assert connect(none_active, all_active, first, second, np.array([True, False]), label)
    assert arrange(label, plan) == 4
    assert plan[HOME, :5].tolist() == [0, 1, 2, 0, 3]
    assert not connect(all_active, all_active, first, second, np.array([True, False]), label)
    assert not connect(all_active, all_active, first, second, np.array([False, False]), label)
    assert connect(all_active, all_active, np.array([3]), np.array([4]), np.array([True]), label)
    assert arrange(label, plan) == 3
    gone = np.array([True, True, True, False, True])
    assert connect(all_active, gone, first, second, np.array([False, False]), label)
    assert arrange(label, plan) == 3
    assert plan[HOME, :5].tolist() == [0, 1, 2, -1, 0]
    assert plan[MEMBER, : plan[BEGIN, 3]].tolist() == [0, 4, 1, 2]
    assert connect(gone, all_active, first, second, np.array([False, False]), label)
    assert arrange(label, plan) == 4


def test_vehicles_in_one_place_are_the_oracle() -> None:
    position = np.repeat([[[0.0, 0, 0], [0.6, 0, 0], [9, 2, 0]]], 30, axis=0)
    fleet = Fleet(("a", "b", "c"), 0.1 * np.arange(30), position, 0 * position)
    recording = observe(fleet, Sensors(min_range=0.1), V2X(max_neighbours=2), runs=3)
    assert_dense(CentralFilter(), recording, near=1e-8)

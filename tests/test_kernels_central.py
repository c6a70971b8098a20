"""The compiled whole-fleet filter against the NumPy reference, and against numpy.linalg and filterpy."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from conftest import crossing_fleet
from filterpy.kalman import KalmanFilter
from test_kernels import CHANNELS, S2
from test_kernels_fleet import assert_same, coming_and_going, in_numpy

from coopoc import V2X, CentralFilter, Fleet, Knowledge, Sensors, observe
from coopoc.world.spherical import to_vector

pytest.importorskip("numba")
KNOWN = {"identity": "identity", "nominal": "nominal", "fitted": Knowledge("fitted", S2, (0.3, 0.2, 0.01)),
         "still": Knowledge("fitted", S2, (1e-60, 1e-30, 1e-60))}  # fmt: skip


@pytest.mark.parametrize("channel", CHANNELS, ids=str)
@pytest.mark.parametrize("knowledge", KNOWN)
def test_the_filter_is_the_reference(
    crossing: Fleet, channel: V2X, knowledge: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Vehicles appear, vanish and come back; messages are lost, late and turned away."""
    fleet = coming_and_going(crossing)
    position, velocity = fleet.position.copy(), fleet.velocity.copy()
    position[25:30, 1] = velocity[25:30, 1] = np.nan
    recording = observe(replace(fleet, position=position, velocity=velocity), S2, channel, runs=2)
    method = CentralFilter(KNOWN[knowledge])
    assert_same(method(recording, [0, 7]), in_numpy(monkeypatch, lambda: method(recording, [0, 7])))


def far_apart(copies: int, vehicles: int, steps: int = 25) -> Fleet:
    """Copies of a crossing, 200 m apart."""
    one = crossing_fleet(vehicles, steps)
    shift = np.arange(copies)[:, None, None, None] * [200.0, 0.0, 0.0]
    position = np.concatenate(list(one.position + shift), axis=1)
    ids = tuple(f"{k}-{name}" for k in range(copies) for name in one.ids)
    return Fleet(ids, one.t, position, np.tile(one.velocity, (1, copies, 1)))


@pytest.mark.parametrize(("copies", "vehicles"), [(1, 1), (1, 2), (4, 9), (1, 40)])
def test_islands_of_any_size_are_the_reference(
    copies: int, vehicles: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Matrices from one tile to many."""
    fleet = far_apart(copies, vehicles)
    recording, method = observe(fleet, S2, V2X(max_neighbours=6)), CentralFilter()
    everyone = range(len(fleet.ids))
    assert_same(method(recording, everyone), in_numpy(monkeypatch, lambda: method(recording, everyone)))


def test_poor_and_very_good_sightings_are_the_reference(crossing: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    for range_std, angle_std in ((1e-3, 1e-4), (30.0, 1.0)):
        sensors = replace(S2, range_std=range_std, azimuth_std=angle_std, inclination_std=angle_std)
        recording, method = observe(crossing, sensors, V2X(max_neighbours=4)), CentralFilter()
        assert_same(method(recording, [0, 7]), in_numpy(monkeypatch, lambda m=method, r=recording: m(r, [0, 7])),
                    near=1e-7 if range_std < 1 else 1e-9)  # fmt: skip


def test_a_run_knows_nothing_of_those_it_shares_its_covariance_with(crossing: Fleet) -> None:
    """To the last bit, whether runs hear the same or not."""
    method = CentralFilter("identity")
    for loss in (0.0, 0.3):
        recordings = [observe(crossing, S2, V2X(max_neighbours=4, loss=loss), runs=runs) for runs in (1, 3)]
        alone, many = (method(recording, [0, 5]) for recording in recordings)
        np.testing.assert_array_equal(alone.x[0], many.x[0])
        assert alone.covariance is not None
        assert many.covariance is not None
        np.testing.assert_array_equal(alone.covariance[0], many.covariance[0])


def test_the_filter_is_filterpys(crossing: Fleet) -> None:
    """All vehicles in one state, every sighting a row: with unit noise the whole problem is linear."""
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
    """A covariance, an information of few pairs, who shares it, and the plan of one island."""
    from coopoc.kernels.islands import settle

    n = 3 * members
    near = np.triu(rng.random((members, members)) < share, 1)
    info = np.diag(rng.uniform(0.5, 2.0, n))
    for i, j in np.argwhere(near):
        root = np.zeros((n, 3))
        root[3 * i : 3 * i + 3] = rng.normal(size=(3, 3))
        root[3 * j : 3 * j + 3] = -root[3 * i : 3 * i + 3]
        info += root @ root.T
    root, plan = rng.normal(size=(n, 2 * n)), np.zeros((6, members + 1), np.int64)
    settle(np.zeros(members, np.int64), plan)
    return root @ root.T / n, info, near | near.T, plan


@pytest.mark.parametrize("members", [1, 2, 4, 5, 13, 29])
@pytest.mark.parametrize("share", [0.0, 0.2, 1.0])
def test_what_a_sparse_information_adds_is_what_numpy_inverts(members: int, share: float) -> None:
    """From the upper triangle of P and the lower one of F, whatever stands in the others' place of P."""
    from coopoc.kernels.islands import STRIDE
    from coopoc.kernels.rank import COPIED, learn

    rng = np.random.default_rng(members)
    spread, info, near, plan = matrix(members, rng, share)
    n, stride = 3 * members, int(plan[STRIDE, 0])
    wanted = np.linalg.inv(np.linalg.inv(spread) + info)
    p, f = np.zeros((2, stride, stride))
    p[:n, :n], f[:n, :n] = np.triu(spread) + np.tril(np.full((n, n), 7.0), -1), np.tril(info)
    flat = p.ravel()
    pull, moved = rng.normal(size=(2, members, 3)), np.empty((2, stride))
    scratch = np.zeros((COPIED + stride) * stride), np.zeros((4, members), np.int64)
    learn(plan, 0, flat, f.ravel(), near, scratch, pull.copy(), moved)
    found = np.triu(flat.reshape(stride, stride)[:n, :n])
    np.testing.assert_allclose(found, np.triu(wanted), atol=1e-12 * np.abs(wanted).max())
    np.testing.assert_allclose(moved[:, :n], pull.reshape(2, n) @ wanted, atol=1e-11)


def test_islands_merge_where_vehicles_meet_and_stay_together() -> None:
    from coopoc.kernels.islands import BEGIN, HOME, MEMBER, meet, settle

    label, plan, everybody, nobody = np.full(5, -1), np.zeros((6, 6), np.int64), np.ones(5, bool), np.zeros(5, bool)
    first, second = np.array([0, 1]), np.array([3, 4])
    assert meet(nobody, everybody, first, second, np.array([True, False]), label)
    assert settle(label, plan) == 4
    assert plan[HOME, :5].tolist() == [0, 1, 2, 0, 3]
    assert not meet(everybody, everybody, first, second, np.array([True, False]), label)
    assert not meet(everybody, everybody, first, second, np.array([False, False]), label)
    assert meet(everybody, everybody, np.array([3]), np.array([4]), np.array([True]), label)
    assert settle(label, plan) == 3
    gone = np.array([True, True, True, False, True])
    assert meet(everybody, gone, first, second, np.array([False, False]), label)
    assert settle(label, plan) == 3
    assert plan[HOME, :5].tolist() == [0, 1, 2, -1, 0]
    assert plan[MEMBER, : plan[BEGIN, 3]].tolist() == [0, 4, 1, 2]
    assert meet(gone, everybody, first, second, np.array([False, False]), label)
    assert settle(label, plan) == 4


def test_vehicles_in_one_place_are_the_reference(monkeypatch: pytest.MonkeyPatch) -> None:
    position = np.repeat([[[0.0, 0, 0], [0.6, 0, 0], [9, 2, 0]]], 30, axis=0)
    fleet = Fleet(("a", "b", "c"), 0.1 * np.arange(30), position, 0 * position)
    recording = observe(fleet, Sensors(min_range=0.1), V2X(max_neighbours=2), runs=3)
    method = CentralFilter()
    assert_same(method(recording, [0, 1]), in_numpy(monkeypatch, lambda: method(recording, [0, 1])), near=1e-8)

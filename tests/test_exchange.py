"""Links and exchange of a fleet: neighbours by brute force, draws, bytes in closed form, caps and losses."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from conftest import coming_and_going, refused, standing

from coopoc import V2X, BatchSmoother, CentralFilter, Fleet, Sensors, observe
from coopoc.methods.decentralised import GaussianBeliefPropagation
from coopoc.world import sensing
from coopoc.world.exchange import exchange
from coopoc.world.inbox import inbox
from coopoc.world.links import Links
from coopoc.world.v2x import FIX_AND_VELOCITY, Message

S2 = Sensors.paper_scenario2()


def by_brute_force(fleet: Fleet, observers: Any, most: int, radius: float, min_range: float) -> Links:
    """Every distance of every step, sorted."""
    rows = []
    for t, position in enumerate(fleet.position):
        for observer in observers:
            gap = [float(np.sqrt(np.square(p - position[observer]).sum())) for p in position]
            fits = [(d, k) for k, d in enumerate(gap) if k != observer and min_range <= d <= radius]
            rows += [(t, observer, k) for _, k in sorted(fits)[:most]]
    columns = np.array(rows, dtype=np.int64).reshape(-1, 3).T
    return Links(*columns)


def assert_same_links(fleet: Fleet, observers: Any, most: int, radius: float, min_range: float = 2.0) -> int:
    found = sensing.find_links(fleet, observers, most, radius, min_range)
    wanted = by_brute_force(fleet, observers, most, radius, min_range)
    for name in ("step", "observer", "neighbour"):
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))
    return len(found)


@pytest.mark.parametrize("most", [0, 1, 4, 100])
@pytest.mark.parametrize("radius", [0.0, 1e-3, 12.0, 30.0, np.inf])
@pytest.mark.parametrize("observers", [[3], [1, 2, 7], range(8), []])
def test_neighbours_are_those_of_brute_force(crossing: Fleet, most: int, radius: float, observers: Any) -> None:
    fleet = coming_and_going(crossing).between(15, 45)
    count = assert_same_links(fleet, observers, most, radius)
    assert (count > 0) == (most > 0 and radius >= 12 and len(observers) > 0)


def test_neighbours_on_cell_borders_and_at_equal_distances_come_by_column() -> None:
    """A lattice whose spacing is the radius, turned over time, moved far away; in a random order of columns."""
    rng = np.random.default_rng(1)
    lattice = 30.0 * np.stack(np.meshgrid(np.arange(5), np.arange(4), [0.0]), axis=-1).reshape(-1, 3)
    lattice = rng.permutation(lattice)
    position = np.stack([lattice, -lattice, lattice + np.array([1e6, -1e6, 5]), lattice[:, [1, 0, 2]]])
    fleet = Fleet(tuple(f"v{i}" for i in range(20)), 0.1 * np.arange(4), position, 0 * position)
    assert assert_same_links(fleet, range(20), 3, 30.0) > 200
    assert assert_same_links(fleet, range(20), 10, np.hypot(30, 30)) > 300
    assert assert_same_links(fleet, range(20), 4, np.nextafter(30.0, 0)) == 0


def test_bytes_have_closed_forms() -> None:
    """Four vehicles in contact with each other for ten steps, 100 bytes on top of each message."""
    fleet = standing([[0, 0, 0], [9, 0, 0], [0, 9, 0], [9, 9, 0]], steps=10)
    recording = observe(fleet, S2, V2X(max_neighbours=3, overhead=100), runs=2)
    for method, received, sent in (
        (GaussianBeliefPropagation(rounds=3), 3 * (3 * (36 + 100) + 20), 3 * (3 * (36 + 100) + 20)),
        (CentralFilter(), 44 + 100, 32 + 3 * 16 + 100),
        (BatchSmoother(), 44 + 100, 32 + 3 * 16 + 100),
    ):
        track = method(recording, [0, 2])
        assert (track.received_bytes == 10 * received).all()
        assert (track.sent_bytes == 10 * sent).all()
    box = inbox(recording, 0, Message("thrice", 8, rounds=3, opening=2))
    assert (box.received_bytes == 10 * 3 * (3 * 132 + 8)).all()
    assert box.sent_bytes == 10 * (3 * 132 + 8)
    assert (inbox(recording, 0, FIX_AND_VELOCITY).received_bytes == 10 * 3 * 132).all()
    with refused("message"):
        inbox(recording, 0, GaussianBeliefPropagation().message)


def test_who_is_seen_may_answer() -> None:
    """a and b see each other, c sees b: with K = 1 there are two contacts, and b receives from both."""
    fleet = standing([[0, 0, 0], [9, 0, 0], [20, 0, 0]])
    message = Message("word", 25, unicast=True)
    met = exchange(observe(fleet, S2, V2X(max_neighbours=1)), message)
    assert met.first.tolist() == [0, 1, 0, 1]
    assert met.second.tolist() == [1, 2, 1, 2]
    assert (met.link < 0).tolist() == [False, True, False, True]
    assert (met.link_back < 0).tolist() == [False, False, False, False]
    assert (met.at_first >= 0).all()
    assert (met.at_second >= 0).all()
    assert met.received_bytes.tolist() == met.sent_bytes.tolist() == [[200.0, 400.0, 200.0]]
    capped = exchange(
        observe(standing([[0, 0, 0], [9, 0, 0], [20, 0, 0]], 100), S2, V2X(max_neighbours=1, bytes_per_second=1000.0)),
        message,
    )
    near, far = ((capped.at_first[0, capped.second == v] >= 0).mean() for v in (1, 2))
    back = (capped.at_second[0, capped.second == 1] >= 0).mean()
    assert near == back == 1.0
    assert far == 0.09  # whom b sees comes first and takes the whole cap; ten messages are in the bucket at first


def test_a_cap_takes_first_the_nearest_and_of_others_the_first() -> None:
    """Four see c as their nearest, c sees a alone; its bucket holds three messages at the first step."""
    fleet = standing([[9, 0, 0], [-10, 0, 0], [0, 0, 0], [0, 10, 0], [0, -10, 0]])
    capped = observe(fleet, S2, V2X(max_neighbours=1, bytes_per_second=300.0))
    met = exchange(capped, Message("word", 25, unicast=True))
    now = met.step == 0
    at_c = np.where(met.first == 2, met.at_first, met.at_second)[0, now] == 0
    assert np.where(met.first == 2, met.second, met.first)[now][at_c].tolist() == [0, 1, 3]


def test_loss_is_that_of_the_channel(formation: Fleet) -> None:
    lossy = observe(formation.between(0, 200), S2, V2X(max_neighbours=10, radius=1e3, loss=0.3), runs=2)
    met = exchange(lossy, GaussianBeliefPropagation().message)
    assert (met.at_first >= 0).mean() == pytest.approx(0.7, abs=0.02)
    assert (met.both >= 0).mean() == pytest.approx(0.49, abs=0.02)
    own = [lossy.arrival[:, lossy.links.of(column)] for column in range(len(lossy.ids))]  # all see all: one a link
    heard = np.stack([((arrival >= 0) & (arrival < 200)).sum(axis=1) for arrival in own], axis=1)
    word = exchange(replace(lossy, v2x=V2X(max_neighbours=10, overhead=7)), Message("word", 25))
    assert (word.received_bytes == 107 * heard).all()

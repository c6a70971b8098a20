"""Links and exchange of a fleet: neighbours by brute force, draws, bytes in closed form, caps and losses."""

import numpy as np
import pytest
from conftest import coming_and_going, refused, standing

from coopoc import V2X, BatchSmoother, Fleet, Sensors, observe
from coopoc.methods.batch_smoother import UPLOAD, counted
from coopoc.world import sensing
from coopoc.world.inbox import inbox
from coopoc.world.links import Links
from coopoc.world.v2x import FIX_AND_VELOCITY, Message

S2 = Sensors.paper_scenario2()
SIDES = "step", "observer", "neighbour"


def by_brute_force(fleet, observers, most, radius, min_range):
    """Every distance of every step, sorted."""
    rows = []
    for t, position in enumerate(fleet.position):
        for observer in observers:
            gap = [float(np.sqrt(np.square(p - position[observer]).sum())) for p in position]
            fits = [(d, k) for k, d in enumerate(gap) if k != observer and min_range <= d <= radius]
            rows += [(t, observer, k) for _, k in sorted(fits)[:most]]
    return Links(*np.array(rows, int).reshape(-1, 3).T)


def assert_same_links(fleet, observers, most, radius):
    found = sensing.find_links(fleet, observers, V2X(max_neighbours=most, radius=radius), 2.0)
    wanted = by_brute_force(fleet, observers, most, radius, 2.0)
    for name in SIDES:
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))
    return len(found)


@pytest.mark.parametrize("most", [0, 1, 4, 100])
@pytest.mark.parametrize("radius", [0.0, 1e-3, 12.0, 30.0, np.inf])
@pytest.mark.parametrize("observers", [[3], [1, 2, 7], range(8), []])
def test_neighbours_are_those_of_brute_force(crossing, most, radius, observers):
    count = assert_same_links(coming_and_going(crossing).between(15, 45), observers, most, radius)
    assert (count > 0) == (most > 0 and radius >= 12 and len(observers) > 0)


def test_neighbours_on_cell_borders_and_at_equal_distances_come_by_column():
    """A lattice whose spacing is the radius, turned over time, moved far away; in a random order of columns."""
    rng = np.random.default_rng(1)
    lattice = 30.0 * np.stack(np.meshgrid(np.arange(5), np.arange(4), [0.0]), axis=-1).reshape(-1, 3)
    lattice = rng.permutation(lattice)
    position = np.stack([lattice, -lattice, lattice + np.array([1e6, -1e6, 5]), lattice[:, [1, 0, 2]]])
    fleet = Fleet(tuple(f"v{i}" for i in range(20)), 0.1 * np.arange(4), position, 0 * position)
    assert assert_same_links(fleet, range(20), 3, 30.0) > 200
    assert assert_same_links(fleet, range(20), 10, np.hypot(30, 30)) > 300
    assert assert_same_links(fleet, range(20), 4, np.nextafter(30.0, 0)) == 0


def test_bytes_have_closed_forms():
    """Four vehicles in contact with each other for ten steps, 100 bytes on top of each message."""
    fleet = standing([[0, 0, 0], [9, 0, 0], [0, 9, 0], [9, 9, 0]], steps=10)
    recording = observe(fleet, S2, V2X(max_neighbours=3, overhead=100), runs=2)
    track = BatchSmoother()(recording, [0, 2])
    assert (track.received_bytes == 10 * (44 + 100)).all()
    assert (track.sent_bytes == 10 * (32 + 3 * 16 + 100)).all()
    box = inbox(recording, 0, Message("thrice", 8, rounds=3))
    assert (box.received_bytes == 10 * 3 * 3 * 132).all()
    assert box.sent_bytes == 10 * 3 * 132
    assert (inbox(recording, 0, FIX_AND_VELOCITY).received_bytes == 10 * 3 * 132).all()
    with refused("message"):
        inbox(recording, 0, UPLOAD)


def test_a_measurement_counts_by_a_message_of_either_way(formation):
    """A share of 0.3 of the messages is lost; measured both ways, 0.09 of the pairs get no message."""
    fleet = formation.between(0, 200)
    lossy = observe(fleet, S2, V2X(max_neighbours=len(fleet.ids), radius=1e3, loss=0.3), runs=2)
    counts = counted(lossy, np.ones(lossy.gnss.shape[:3], bool))
    pairs = {pair: k for k, pair in enumerate(zip(*(getattr(lossy.links, s) for s in SIDES), strict=True))}
    assert np.array_equal(counts, (lossy.arrival >= 0) | (lossy.arrival[:, [pairs[t, j, i] for t, i, j in pairs]] >= 0))
    assert counts.mean() == pytest.approx(0.91, abs=0.02)
    one_way = observe(standing([[0, 0, 0], [9, 0, 0], [20, 0, 0]]), S2, V2X(max_neighbours=1))
    assert counted(one_way, np.ones(one_way.gnss.shape[:3], bool)).all()
    assert not counted(one_way, np.zeros(one_way.gnss.shape[:3], bool)).any()

"""Schedules under a cap on bytes: the token bucket, nearest first and round robin."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import refused, standing
from numpy import array_equal

from coopoc import LKFSA, V2X, JointFilter, Sensors, observe
from coopoc.world.inbox import inbox, within_cap
from coopoc.world.v2x import FIX_AND_VELOCITY

S2 = Sensors.paper_scenario2()


def received_steps(fleet, **given: float):
    """Steps at which the first of two vehicles receives the other's message, 32 B a message."""
    seen = observe(fleet, S2, V2X(1, **given))  # type: ignore[arg-type]
    return np.flatnonzero(inbox(seen, 0, FIX_AND_VELOCITY).arrival[0] >= 0).tolist()


def test_the_token_bucket_by_hand():
    """100 B/s: 100 at first, 10 more a step, 32 for a message; what is left after each is 68, 46, 24, 2, 0, 8, ..."""
    pair = standing([[0, 0, 0], [9, 0, 0]], 20)
    assert received_steps(pair, bytes_per_second=100.0) == [0, 1, 2, 3, 6, 10, 13, 16, 19]
    assert received_steps(pair, bytes_per_second=20.0) == [
        0,
        16,
    ]  # it holds one message if that is more than a second's
    assert received_steps(pair, bytes_per_second=0.0) == []
    assert received_steps(pair, bytes_per_second=320.0) == list(range(20))
    assert received_steps(pair, bytes_per_second=100.0, latency=0.2) == [
        0,
        1,
        2,
        3,
        6,
        10,
        13,
        16,
    ]  # two are on their way


def test_messages_pass_the_bucket_nearest_first(crossing):
    """Against the rules, a message at a time."""
    seen = observe(crossing, S2, V2X(4, loss=0.3, latency=0.1, bytes_per_second=500.0), runs=5)
    link = seen.links.of(0)
    size, start = 47, np.searchsorted(seen.links.step[link], np.arange(len(seen.t) + 1))
    given = (seen.arrival[:, link], size, start, seen.links.neighbour[link], seen)
    found = within_cap(*given)
    wanted, depth = np.full_like(found, -1), 500.0
    for run in range(5):
        tokens, last = depth, 0
        for k in np.flatnonzero(given[0][run] >= 0):
            now = int(given[0][run, k])
            tokens, last = min(tokens + 500.0 * seen.dt * (now - last), depth), now
            if size <= tokens + 1e-9:
                tokens -= size
                wanted[run, k] = given[0][run, k]
    np.testing.assert_array_equal(found, wanted)
    assert 0.2 < (found >= 0).mean() < 0.9 * (seen.arrival[:, link] >= 0).mean()


def by_hand(seen, ego, size):
    """(step, neighbour) that are received in each run, by the rules one message at a time."""
    runs, links = [], seen.links
    for run in range(seen.runs):
        tokens, last, received = max(seen.v2x.bytes_per_second, size), dict[int, int](), set[tuple[int, int]]()
        for t in range(len(seen.t)):
            tokens = min(tokens + (t > 0) * seen.v2x.bytes_per_second * seen.dt, max(seen.v2x.bytes_per_second, size))
            here = [k for k in links.of(ego) if links.step[k] == t and seen.arrival[run, k] >= 0]
            if seen.v2x.schedule == "round robin":
                here.sort(key=lambda k: last.get(int(links.neighbour[k]), -1))
            for k in here:
                if tokens + 1e-9 >= size:
                    tokens, last[int(links.neighbour[k])] = tokens - size, t
                    received.add((t, int(links.neighbour[k])))
        runs.append(received)
    return runs


@pytest.mark.parametrize("schedule", ["nearest", "round robin"])
@pytest.mark.parametrize("cap", [150.0, 700.0])
def test_nearest_first_and_turns(crossing, schedule, cap):
    """Against a loop over runs and messages, with losses, rates, and neighbours that come and go."""
    channel = V2X(4, rate=7.0, loss=0.3, burst=2.0, latency=0.1, bytes_per_second=cap, overhead=20, schedule=schedule)
    seen = observe(crossing, S2, channel, runs=3)
    for ego in (0, 5):
        box = inbox(seen, ego, FIX_AND_VELOCITY)
        step, neighbour = seen.links.step[box.link], seen.links.neighbour[box.link]
        for run, wanted in enumerate(by_hand(seen, ego, 52)):
            found = {(int(step[k]), int(neighbour[k])) for k in np.flatnonzero(box.arrival[run] >= 0)}
            assert found == {(t, j) for t, j in wanted if t + 1 < len(seen.t)}
            assert len(found) > 10


def test_schedules_are_paired_and_repeat(crossing):
    """Fewer runs are a part of more; another schedule takes other messages of the same, for the same bytes."""
    channel = V2X(5, radius=60.0, loss=0.2, bytes_per_second=300.0, schedule="round robin")
    many, few = (inbox(observe(crossing, S2, channel, runs=runs), 2, FIX_AND_VELOCITY) for runs in (4, 2))
    assert array_equal(many.arrival[:2], few.arrival)
    assert not array_equal(many.arrival[0], many.arrival[1])
    nearest = inbox(observe(crossing, S2, replace(channel, schedule="nearest"), runs=4), 2, FIX_AND_VELOCITY)
    assert not array_equal(nearest.arrival, many.arrival)
    assert abs(nearest.received_bytes - many.received_bytes).max() <= 32 * 5
    for method in (JointFilter(), LKFSA()):
        track = method(observe(crossing, S2, channel, runs=2), [2])
        assert array_equal(track.received_bytes[:, 0], few.received_bytes)


def test_an_unknown_schedule_is_named():
    with refused(r"schedule = 'farthest': must be one of nearest, round robin.*Did you mean"):
        V2X(schedule="farthest")  # type: ignore[arg-type]

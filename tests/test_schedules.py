"""Schedules under a cap on bytes: the token bucket, turns, and the neighbour that lowers the bound most."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from scipy.linalg import solve_discrete_are

from coopoc import V2X, CentralFilter, Fleet, InputError, JointFilter, MovingHorizon, Recording, Sensors, observe
from coopoc.arrays import Floats
from coopoc.methods.decentralised import GaussianBeliefPropagation
from coopoc.world.exchange import exchange
from coopoc.world.inbox import inbox
from coopoc.world.informative import UNKNOWN, MostInformative
from coopoc.world.schedules import Nearest, order, within_cap
from coopoc.world.spherical import vector_cov
from coopoc.world.v2x import ESTIMATE, FIX_AND_VELOCITY, Message, Schedule

S2 = Sensors.paper_scenario2()
WORD = Message("word", 25, unicast=True)
INFORMATIVE: Schedule = "most informative"


def still(places: list[list[float]], steps: int = 20) -> Fleet:
    place = np.broadcast_to(np.array(places, dtype=float), (steps, len(places), 3))
    return Fleet(tuple(f"s{i}" for i in range(len(places))), np.arange(steps) * 0.1, place, 0 * place)


def received_steps(fleet: Fleet, **given: float) -> list[int]:
    """Steps at which the first of two vehicles receives the other's message, 32 B a message."""
    seen = observe(fleet, S2, V2X(1, **given))  # type: ignore[arg-type]
    return np.flatnonzero(inbox(seen, 0, FIX_AND_VELOCITY).arrival[0] >= 0).tolist()


def test_the_token_bucket_by_hand() -> None:
    """100 B/s: 100 at first, 10 more a step, 32 for a message; what is left after each is 68, 46, 24, 2, 0, 8, ..."""
    pair = still([[0, 0, 0], [9, 0, 0]])
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


def test_messages_of_many_sizes_pass_the_bucket_nearest_first(crossing: Fleet) -> None:
    """A later one may fit where an earlier one did not; against the rules, a message at a time."""
    channel, rng = V2X(4, loss=0.3, latency=0.1, bytes_per_second=500.0), np.random.default_rng(0)
    seen = observe(crossing, S2, channel, runs=5)
    link = seen.links.of(0)
    size, start = rng.integers(10, 90, len(link)), np.searchsorted(seen.links.step[link], np.arange(len(seen.t) + 1))
    given = (seen.arrival[:, link], size, start, seen, Nearest())
    found = within_cap(*given)
    wanted, depth = np.full_like(found, -1), 500.0
    for run in range(5):
        tokens, last = depth, 0
        for k in np.flatnonzero(given[0][run] >= 0):
            now = int(given[0][run, k])
            tokens, last = min(tokens + 500.0 * seen.dt * (now - last), depth), now
            if size[k] <= tokens + 1e-9:
                tokens -= size[k]
                wanted[run, k] = given[0][run, k]
    np.testing.assert_array_equal(found, wanted)
    assert 0.2 < (found >= 0).mean() < 0.9 * (seen.arrival[:, link] >= 0).mean()


def by_hand(seen: Recording, ego: int, size: int) -> list[set[tuple[int, int]]]:
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
def test_nearest_first_and_turns(crossing: Fleet, schedule: Schedule, cap: float) -> None:
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


def test_turns_are_turns() -> None:
    """Three neighbours, one message a step: 0, 1, 2, 0, 1, 2, ... once the full bucket is spent."""
    fleet = still([[0, 0, 0], [9, 0, 0], [0, 12, 0], [-15, 0, 0]], 60)
    seen = observe(fleet, S2, V2X(3, bytes_per_second=320.0, schedule="round robin"))
    box = inbox(seen, 0, FIX_AND_VELOCITY)
    received = seen.links.neighbour[box.link][box.arrival[0] >= 0].tolist()
    assert received == list(itertools.islice(itertools.cycle([1, 2, 3]), len(received)))
    assert len(received) == 10 + 59


def covariance(own: Floats, vectors: Floats, fix: Floats, received: tuple[int, ...]) -> Floats:
    """(3, 3) of the ego after the fixes received: the dense information matrix of ego and vectors, inverted."""
    n = len(vectors)
    blocks = [own, *vectors]
    information = np.zeros((3 * n + 3, 3 * n + 3))
    for k, block in enumerate(blocks):
        information[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = np.linalg.inv(block)
    for j in received:
        row = np.zeros((3, 3 * n + 3))
        row[:, :3] = row[:, 3 * j + 3 : 3 * j + 6] = np.eye(3)
        information += row.T @ np.diag(1 / fix) @ row
    return np.linalg.inv(information)[:3, :3]


@pytest.mark.parametrize("seed", range(4))
def test_the_greedy_choice_is_the_best_of_all(seed: int) -> None:
    """Every subset of four neighbours by brute force: each pick lowers the trace most of all that are left, by its
    utility, and two picks are within a hundredth of the best pair."""
    rng = np.random.default_rng(seed)
    places = [[0.0, 0, 0], *(rng.uniform(-20, 20, (4, 3)) * [1, 1, 0.1]).tolist()]
    sensors, channel = replace(S2, gnss_std=(2.0, 3.0, 5.0)), V2X(4, radius=100.0, schedule=INFORMATIVE)
    seen = observe(still(places, 2), sensors, channel, runs=2, seed=seed)
    link = seen.links.of(0)
    schedule = order(seen, 0, link, FIX_AND_VELOCITY)
    assert isinstance(schedule, MostInformative)
    schedule.measure(0, slice(0, 4))
    sender, fix = seen.links.neighbour[link[:4]], np.square(seen.sensors.fix_std)
    begin = schedule.own.copy()
    received: list[tuple[int, ...]] = [(), ()]
    for _ in range(3):
        worth, picks = schedule.utility(0, slice(0, 4)), []
        for run in range(2):
            vectors = schedule.vector[run, sender]
            before = np.trace(covariance(begin[run], vectors, fix, received[run]))
            gains = {
                j: before - np.trace(covariance(begin[run], vectors, fix, (*received[run], j)))
                for j in range(4)
                if j not in received[run]
            }
            np.testing.assert_allclose([worth[run, j] for j in gains], list(gains.values()), rtol=1e-6)
            picks.append(max(gains, key=lambda j: gains[j]))
            received[run] = (*received[run], picks[-1])
        schedule.receive(0, np.arange(2), np.array(picks))
    for run in range(2):
        pairs = {
            two: np.trace(covariance(begin[run], schedule.vector[run, sender], fix, two))
            for two in itertools.combinations(range(4), 2)
        }
        assert pairs[tuple(sorted(received[run][:2]))] < 1.01 * min(pairs.values())  # type: ignore[index]


def test_what_the_receiver_knows_is_what_a_filter_knows(crossing: Fleet) -> None:
    """Against filterpy: the ego's own fixes, and the vector to a neighbour whose messages arrive at steps 1, 2 and 6,
    forgotten 0.35 s later, and not measured at step 8."""
    seen = observe(crossing.between(0, 12), S2, V2X(7, radius=1e3, max_age=0.35, schedule=INFORMATIVE))
    link = seen.links.of(0)
    link = link[(seen.links.step[link] != 8) | (seen.links.neighbour[link] != 3)]
    schedule = order(seen, 0, link, FIX_AND_VELOCITY)
    assert isinstance(schedule, MostInformative)
    own, vector = KalmanFilter(3, 3), KalmanFilter(3, 3)
    own.H, vector.H, own.P, vector.P = np.eye(3), np.eye(3), UNKNOWN * np.eye(3), UNKNOWN * np.eye(3)
    own.R, age, last = np.diag(np.square(S2.fix_std)), 0, np.zeros(3)
    for t in range(12):
        span = slice(*np.searchsorted(seen.links.step[link], [t, t + 1]).tolist())
        schedule.measure(t, span)
        moved = np.square(0.1 * S2.assumed_velocity_std(seen.velocity[0, t, 0]))
        own.predict(Q=np.diag(moved))
        own.update(np.zeros(3))
        np.testing.assert_allclose(schedule.own[0], own.P, rtol=1e-6)
        age += 1
        if t == 8:
            continue
        (k,) = np.flatnonzero(seen.links.neighbour[link[span]] == 3) + span.start
        tracked = last.any() and age <= 3 and t != 9
        vector.predict(Q=np.diag(moved + (2 * age - 1) * 0.01 * last) if tracked else UNKNOWN * np.eye(3))
        vector.update(np.zeros(3), R=vector_cov(seen.relative[0, link[k]], S2.relative_std, S2.min_range))
        np.testing.assert_allclose(schedule.vector[0, 3], vector.P, rtol=1e-4)
        if t in (1, 2, 6):
            schedule.receive(t, np.array([0]), np.array([k]))
            own.update(np.zeros(3), R=own.R + vector.P)
            last, age = np.square(S2.assumed_velocity_std(seen.velocity[0, t, 3])), 0


def test_a_message_without_a_fix_brings_a_velocity_only(crossing: Fleet) -> None:
    seen = observe(crossing, S2, V2X(3, schedule=INFORMATIVE), runs=2)
    gnss = seen.gnss.copy()
    gnss[1, 0, 1:] = np.nan
    seen, link = replace(seen, gnss=gnss), seen.links.of(0)
    schedule = order(seen, 0, link, FIX_AND_VELOCITY)
    assert isinstance(schedule, MostInformative)
    schedule.measure(0, slice(0, int(np.searchsorted(seen.links.step[link], 1))))
    before = schedule.own.copy()
    schedule.receive(0, np.array([0, 1]), np.array([0, 0]))
    assert np.trace(schedule.own[0]) < np.trace(before[0])
    assert np.array_equal(schedule.own[1], before[1])
    assert (schedule.last[:, seen.links.neighbour[link[0]]] == 0).all()


def test_an_estimate_holds_the_fixes_since_the_last(crossing: Fleet) -> None:
    """What a sender's filter settles at is SciPy's Riccati solution; soon after, an estimate is worth a fix or two."""
    seen = observe(crossing, S2, V2X(7, radius=1e3, schedule=INFORMATIVE))
    link = seen.links.of(0)[:14]
    schedule = order(seen, 0, link, ESTIMATE)
    assert isinstance(schedule, MostInformative)
    fix, (j,) = np.diag(np.square(S2.fix_std)), seen.links.neighbour[link[:1]]

    def worth(brought: Floats) -> float:
        own, vector = schedule.own[0], schedule.vector[0, j]
        return float(np.trace(own) - np.trace(np.linalg.inv(np.linalg.inv(own) + np.linalg.inv(vector + brought))))

    schedule.measure(0, slice(0, 7))
    prior = solve_discrete_are(np.eye(3), np.eye(3), np.diag(0.01 * schedule.speed[0, j]), fix)
    settled = np.linalg.inv(np.linalg.inv(prior) + np.linalg.inv(fix))
    assert schedule.utility(0, slice(0, 7))[0, 0] == pytest.approx(worth(settled), rel=1e-6)
    schedule.receive(0, np.array([0]), np.array([0]))
    schedule.measure(1, slice(7, 14))
    k = seen.links.neighbour[link[7:]].tolist().index(j)
    assert schedule.utility(1, slice(7, 14))[0, k] == pytest.approx(worth(fix), rel=1e-6)
    schedule.measure(2, slice(7, 14))
    assert schedule.utility(2, slice(7, 14))[0, k] == pytest.approx(worth(fix / 2), rel=1e-6)


def test_fixes_come_from_the_nearest_and_estimates_in_turns() -> None:
    """Two neighbours, one message a step: another fix of the same is as good, another estimate is not."""
    fleet = still([[0, 0, 0], [9, 0, 0], [0, 12, 0]], 40)
    seen = observe(fleet, S2, V2X(2, bytes_per_second=320.0, schedule=INFORMATIVE))
    received = {}
    for message in (FIX_AND_VELOCITY, ESTIMATE):
        box = inbox(seen, 0, message)
        late = (box.arrival[0] >= 0) & (seen.links.step[box.link] >= 20)
        received[message.name] = np.bincount(seen.links.neighbour[box.link][late], minlength=3)[1:]
    assert received["fix and velocity"].tolist() == [20, 0]
    assert abs(int(received["estimate"][0]) - int(received["estimate"][1])) <= 4


@pytest.mark.parametrize("schedule", ["round robin", "most informative"])
def test_schedules_are_paired_and_repeat(crossing: Fleet, schedule: Schedule) -> None:
    """Fewer runs are a part of more; another schedule takes other messages of the same, for the same bytes."""
    channel = V2X(5, radius=60.0, loss=0.2, bytes_per_second=300.0, schedule=schedule)
    many, few = (inbox(observe(crossing, S2, channel, runs=runs), 2, FIX_AND_VELOCITY) for runs in (4, 2))
    assert np.array_equal(many.arrival[:2], few.arrival)
    assert not np.array_equal(many.arrival[0], many.arrival[1])
    nearest = inbox(observe(crossing, S2, replace(channel, schedule="nearest"), runs=4), 2, FIX_AND_VELOCITY)
    assert not np.array_equal(nearest.arrival, many.arrival)
    assert np.abs(nearest.received_bytes - many.received_bytes).max() <= 32 * 5
    for method in (JointFilter(), MovingHorizon(horizon=2)):
        track = method(observe(crossing, S2, channel, runs=2), [2])
        assert np.array_equal(track.received_bytes[:, 0], few.received_bytes)


def test_an_exchange_takes_turns_and_does_not_guess_utility() -> None:
    """b is in contact with a, whom it sees, and with c, who sees it: one message a step, in turns."""
    fleet = still([[0, 0, 0], [9, 0, 0], [20, 0, 0]], 100)
    channel = V2X(max_neighbours=1, bytes_per_second=1000.0, schedule="round robin")
    met = exchange(observe(fleet, S2, channel), WORD)
    near = met.at_second[0, met.second == 1] >= 0
    far = met.at_first[0, met.second == 2] >= 0
    assert near[:9].all()
    assert far[:9].all()  # the bucket is full at first
    assert (near[10:] ^ far[10:]).all()
    assert (near[10:-1] ^ near[11:]).all()
    guess = observe(fleet, S2, replace(channel, schedule="most informative"))
    with pytest.raises(InputError, match="schedule = 'most informative': must be 'nearest' or 'round robin' in an exc"):
        GaussianBeliefPropagation()(guess, [0])
    assert CentralFilter()(guess, [0]).received_bytes.sum() > 0  # its cap acts on nothing


def test_an_unknown_schedule_is_named() -> None:
    with pytest.raises(InputError, match=r"schedule = 'farthest': must be one of nearest, round robin.*Did you mean"):
        V2X(schedule="farthest")  # type: ignore[arg-type]

"""CooperativeMAP: the laws of a cooperative method, its closed forms, and what it does with a real channel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from coopoc import V2X, Fleet, InputError, Method, NoiseModel, Sensors, observe
from coopoc.evaluate.metrics import errors, nees, nees_inside, rt_le
from coopoc.methods.cooperative_map import CooperativeMAP
from coopoc.methods.star import ACCELERATION_STD
from coopoc.optimize import Problem, solve
from coopoc.world.inbox import inbox
from coopoc.world.recording import Recording
from coopoc.world.spherical import to_vector

S2 = Sensors.paper_scenario2()
SILENT = Sensors(gnss_std=(0, 0, 0), velocity_std_ratio=0, range_std=0, azimuth_std=0, inclination_std=0)
METHODS = [CooperativeMAP(window=w, noise_model=k) for w in (1, 4) for k in ("identity", "nominal")]


def label(method: CooperativeMAP) -> str:
    return f"{method.noise_model}-{method.window}"


@pytest.fixture(scope="module")
def recording(crossing: Fleet) -> Recording:
    return observe(crossing, S2, V2X(max_neighbours=4), runs=3)


@pytest.mark.parametrize("method", METHODS, ids=label)
def test_zero_noise_gives_zero_error(method: CooperativeMAP, crossing: Fleet) -> None:
    recording = observe(crossing, SILENT, V2X(max_neighbours=4), assumed=S2)
    assert errors(method(recording, [0, 3]), crossing).max() < 1e-6


@pytest.mark.parametrize("method", METHODS, ids=label)
def test_translating_the_world_translates_the_estimate(method: CooperativeMAP, crossing: Fleet) -> None:
    shift = np.array([1000.0, -500.0, 30.0])
    moved = replace(crossing, position=crossing.position + shift)
    here = method(observe(crossing, S2, V2X(max_neighbours=4), runs=2), [0])
    there = method(observe(moved, S2, V2X(max_neighbours=4), runs=2), [0])
    assert there.x - shift == pytest.approx(here.x, abs=1e-5)
    assert there.covariance == pytest.approx(here.covariance, abs=1e-5)


@pytest.mark.parametrize("method", METHODS, ids=label)
def test_order_of_vehicles_changes_nothing(method: CooperativeMAP, crossing: Fleet) -> None:
    names = list(crossing.ids)
    shuffled = crossing.select([names[0], *reversed(names[1:])])
    here = method(observe(crossing, S2, V2X(max_neighbours=4), runs=2), ["c0"]).x
    there = method(observe(shuffled, S2, V2X(max_neighbours=4), runs=2), ["c0"]).x
    assert there == pytest.approx(here, abs=1e-6)


@pytest.mark.parametrize("window", [1, 5])
def test_without_neighbours_it_is_the_egos_own_problem(crossing: Fleet, window: int) -> None:
    """A snapshot is the fix; a window is the linear least squares of its own fixes and odometry."""
    recording = observe(crossing, S2, V2X(max_neighbours=0), runs=2)
    track = CooperativeMAP(window=window)(recording, [2])
    if window == 1:
        assert track.x[:, :, 0] == pytest.approx(recording.gnss[:, :, 2], abs=1e-6)
        assert track.covariance[0, 5, 0] == pytest.approx(3.5**2 * np.eye(3), rel=1e-9)
        return
    step, dt = 30, recording.dt
    steps = np.arange(step - window + 1, step + 1)
    std = dt * S2.assumed_velocity_std(recording.velocity[1, steps, 2])
    for axis in range(3):
        rows = np.concatenate([np.eye(window) / 3.5, np.diff(np.eye(window), axis=0) / std[1:, axis, None]])
        moved = dt * recording.velocity[1, steps[1:], 2, axis]
        right = [recording.gnss[1, steps, 2, axis] / 3.5, moved / std[1:, axis]]
        assert track.x[1, step, 0, axis] == pytest.approx(np.linalg.lstsq(rows, np.concatenate(right))[0][-1], abs=1e-6)


def test_identity_snapshot_has_a_closed_form(recording: Recording) -> None:
    """Unit weights: each neighbour's fix minus its vector has variance 2, x = (z + 1/2 sum (z_j - v_j)) / (1 + K/2)."""
    track = CooperativeMAP(noise_model="identity")(recording, [1])
    for step in (0, 17, 45):
        links = recording.links.of(1)
        links = links[recording.links.step[links] == step]
        seen = recording.gnss[:, step, recording.links.neighbour[links]] - to_vector(recording.relative[:, links])
        expected = (recording.gnss[:, step, 1] + 0.5 * seen.sum(axis=1)) / (1 + 0.5 * len(links))
        assert track.x[:, step, 0] == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("window", [1, 4])
def test_the_track_is_the_problems_solution(recording: Recording, window: int) -> None:
    """With an ideal channel every step equals Problem.from_window solved alone; a neighbour's estimate is its point."""
    track = CooperativeMAP(window=window)(recording, [0])
    for run, step in ((0, 5), (1, 20), (2, 59)):
        problem = Problem.from_window(recording, step, 0, window, run)
        solution = solve(problem)
        assert track.x[run, step, 0] == pytest.approx(solution.x[problem.separator[-1]], abs=2e-5)
        assert track.covariance[run, step, 0] == pytest.approx(solution.covariance[problem.separator[-1]], abs=1e-5)
        here = recording.links.step[recording.links.of(0)] == step
        assert track.neighbours[run, here] == pytest.approx(solution.x[problem.separator[-1] + 1 :], abs=2e-5)


@pytest.mark.parametrize("backend", ["gtsam", "osqp"])
@pytest.mark.parametrize("window", [1, 3])
def test_backends_give_the_same_track(crossing: Fleet, backend: str, window: int) -> None:
    recording = observe(crossing.between(0, 12), S2, V2X(max_neighbours=4, loss=0.2), runs=2)
    reference = CooperativeMAP(window=window)(recording, [0])
    track = CooperativeMAP(backend=backend, window=window)(recording, [0])
    assert track.x == pytest.approx(reference.x, abs=5e-5)
    assert track.covariance == pytest.approx(reference.covariance, abs=5e-4)
    assert track.notes == (f"{backend} loops over the runs",)
    assert reference.notes == ()


@pytest.mark.parametrize("window", [1, 5])
def test_the_covariance_means_something(formation: Fleet, window: int) -> None:
    """Run-averaged NEES inside the 99 % chi-square band at 95 % of the steps."""
    fleet = formation.between(0, 150)
    recording = observe(fleet, S2, V2X.ideal(6), runs=40, observers=[0], seed=1)
    track = CooperativeMAP(window=window)(recording, [0])
    assert nees_inside(track, fleet).min() >= 0.95


def test_a_fix_is_used_once_in_a_window(formation: Fleet) -> None:
    """At 1 Hz a message is held for ten steps; used at each of them it would be ten fixes, and NEES would show it."""
    fleet = formation.between(0, 150)
    recording = observe(fleet, S2, V2X(max_neighbours=6, rate=1.0), runs=20, observers=[0])
    track = CooperativeMAP(window=8)(recording, [0])
    assert nees(track, fleet)[:, 20:].mean() == pytest.approx(3.0, abs=0.3)


def test_more_neighbours_and_longer_windows_help(formation: Fleet) -> None:
    fleet = formation.between(0, 80)
    by_k = [
        rt_le(CooperativeMAP()(observe(fleet, S2, V2X.ideal(k), runs=10, observers=[0]), [0]), fleet).mean()
        for k in (0, 2, 10)
    ]
    assert by_k[0] > 1.2 * by_k[1] > 1.2 * 1.2 * by_k[2]
    recording = observe(fleet, S2, V2X.ideal(4), runs=10, observers=[0])
    by_window = [rt_le(CooperativeMAP(window=w)(recording, [0]), fleet).mean() for w in (1, 3, 10)]
    assert by_window[0] > 1.2 * by_window[1] > 1.2 * 1.2 * by_window[2]


@pytest.mark.parametrize("method", METHODS, ids=label)
def test_it_uses_nothing_that_comes_later(method: CooperativeMAP, crossing: Fleet) -> None:
    recording = observe(crossing, S2, V2X(max_neighbours=4, latency=0.15, loss=0.3), runs=2)
    changed = recording.gnss.copy(), recording.velocity.copy(), recording.relative.copy()
    changed[0][:, 31:] += 50.0
    changed[1][:, 31:] += 50.0
    changed[2][:, recording.links.step >= 31, 0] += 5.0
    later = replace(recording, gnss=changed[0], velocity=changed[1], relative=changed[2])
    here, there = method(recording, [0]).x, method(later, [0]).x
    assert np.array_equal(here[:, :31], there[:, :31])
    assert not np.allclose(here[:, 31:], there[:, 31:])


@pytest.mark.parametrize("window", [1, 4])
def test_a_neighbour_without_messages_is_left_out(crossing: Fleet, window: int) -> None:
    """All messages lost: the estimate is that without neighbours, and the neighbours have no estimate."""
    silent = observe(crossing, S2, V2X(max_neighbours=4, loss=1.0), runs=2)
    alone = observe(crossing, S2, V2X(max_neighbours=0), runs=2)
    track = CooperativeMAP(window=window)(silent, [0])
    assert track.x == pytest.approx(CooperativeMAP(window=window)(alone, [0]).x, abs=1e-5)
    assert np.isnan(track.neighbours).all()
    assert (track.received_bytes == 0).all()


def test_a_late_fix_is_brought_forward(formation: Fleet) -> None:
    """Two steps late: the neighbours' fixes enter at z + 2 dt u with variance sigma^2 + 4 times one step's."""
    fleet = formation.between(0, 20)
    recording = observe(fleet, S2, V2X(max_neighbours=3, latency=0.2), observers=[0])
    track = CooperativeMAP(noise_model="nominal")(recording, [0])
    step, dt = 10, recording.dt
    problem = Problem.from_snapshot(recording, step, 0)
    fixes, relative = problem.factors
    late = [recording.ids.index(n) for n in problem.names[1:]]
    u = recording.velocity[0, step - 2, late]
    z, std = fixes.z.copy(), np.array(np.broadcast_to(fixes.std, fixes.z.shape))
    z[1:] = recording.gnss[0, step - 2, late] + 2 * dt * u
    drift = dt**2 * 2 * ACCELERATION_STD
    std[1:] = np.sqrt(3.5**2 + 4 * ((dt * S2.assumed_velocity_std(u)) ** 2 + drift**2))
    stated = replace(problem, factors=(replace(fixes, z=z, std=std), relative))
    assert track.x[0, step, 0] == pytest.approx(solve(stated).x[0], abs=1e-4)


def test_bytes_are_those_of_the_inbox(crossing: Fleet) -> None:
    recording = observe(crossing, S2, V2X(max_neighbours=4, loss=0.2, rate=5.0, overhead=100), runs=3)
    method = CooperativeMAP()
    track = method(recording, [0, 3])
    for e, ego in enumerate((0, 3)):
        box = inbox(recording, ego, method.message)
        assert np.array_equal(track.received_bytes[:, e], box.received_bytes)
        assert (track.sent_bytes[:, e] == box.sent_bytes).all()


def test_vehicles_that_meet_are_solved_converted(crossing: Fleet) -> None:
    """An inclination beyond pi puts the neighbour straight below, where the azimuth has no derivative."""
    recording = observe(crossing, S2, V2X(max_neighbours=1), runs=2)
    relative = recording.relative.copy()
    relative[..., 0], relative[..., 2] = 3.0, np.pi + 0.1
    track = CooperativeMAP()(replace(recording, relative=relative), [0])
    assert "where vehicles met" in track.notes[0]
    assert np.isfinite(track.x).all()
    assert (np.linalg.eigvalsh(track.covariance[:, :, 0]) > 1e-3).all()
    assert np.isfinite(track.covariance).all()


def test_fitted_knowledge_is_taken(crossing: Fleet) -> None:
    recording = observe(crossing, S2, V2X(max_neighbours=4), runs=2)
    fitted = NoiseModel.fitted(recording, crossing)
    assert isinstance(CooperativeMAP(noise_model=fitted), Method)
    assert rt_le(CooperativeMAP(window=3, noise_model=fitted)(recording, [0]), crossing).mean() < 3.0


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda r: CooperativeMAP(window=0), "window"),
        (lambda r: CooperativeMAP(backend="ipopt"), "backend"),
        (lambda r: CooperativeMAP(noise_model="guess")(r, [0]), "noise_model"),
        (lambda r: CooperativeMAP()(r, ["missing"]), "egos"),
    ],
)
def test_wrong_input_says_what_to_do(recording: Recording, make, field: str) -> None:
    with pytest.raises(InputError, match=field):
        make(recording)

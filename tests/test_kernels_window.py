"""Compiled windows of stars, robust or not, against the dense oracle, SciPy and GTSAM."""

from __future__ import annotations

import math
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from oracles import gnc as robust_oracle
from oracles import window as oracle
from scipy.optimize import least_squares
from scipy.stats import chi2

from coopoc import V2X, CooperativeMAP, Fleet, NoiseModel, Recording, Sensors, Track, observe
from coopoc.methods import sliding_window
from coopoc.methods.noise_model import resolve
from coopoc.world.inbox import inbox
from coopoc.world.links import spherical, to_vector, wrap
from coopoc.world.spoofing import spoofed
from coopoc.world.v2x import FIX_AND_VELOCITY

S2 = Sensors.paper_scenario2()
FITTED = NoiseModel("fitted", S2, (0.3, 0.2, 0.01))
CHANNELS = [
    V2X(max_neighbours=4),
    V2X(max_neighbours=7, loss=0.3, latency=0.2),
    V2X(max_neighbours=3, loss=1.0),
    V2X(max_neighbours=5, bytes_per_second=1000.0),
    V2X(max_neighbours=0),
]


@pytest.fixture(autouse=True)
def to_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """Gauss-Newton stops at a last step of a nanometre in place of 0.1 mm."""
    monkeypatch.setattr(sliding_window, "TOLERANCE", 1e-9)


def assert_is_the_oracle(recording: Recording, fleet: Fleet, method: CooperativeMAP, ego: int, track: Track) -> None:
    """Every point and covariance; the covariance is that of the last linearisation."""
    known, box = resolve(method.noise_model, recording), inbox(recording, ego, FIX_AND_VELOCITY)
    assert track.covariance is not None
    assert track.neighbours is not None
    column, before = track.egos.index(ego), sum(len(recording.links.of(e)) for e in track.egos[: track.egos.index(ego)])
    for run in range(recording.runs):
        for step in range(len(recording.t)):
            span = range(max(0, step - method.window + 1), step + 1)
            x = oracle.points(recording, box, ego, span, fleet.position)
            if method.robust is None:
                x, cov = oracle.window(recording, box, known, run, ego, span, x)
            else:
                rows = oracle.linear_rows(recording, box, known, run, ego, span)
                x, cov, _ = robust_oracle.gnc(
                    rows,
                    lambda at, run=run, span=span: [
                        r for t in span for r in oracle.relative_rows(recording, box, known, run, ego, at, t)
                    ],
                    x,
                    ego,
                    method.threshold,
                )
            place = 3 * list(x).index((ego, step))
            assert track.x[run, step, column] == pytest.approx(x[ego, step], abs=1e-6)
            wanted = cov[place : place + 3, place : place + 3]
            assert track.covariance[run, step, column] == pytest.approx(wanted, abs=1e-5 * wanted.max())
            for k in range(box.start[step], box.start[step + 1]):
                found = track.neighbours[run, before + k]
                vehicle = int(recording.links.neighbour[box.link[k]])
                held = box.newest[run, k] >= 0
                assert found == pytest.approx(x[vehicle, step] if held else np.full(3, np.nan), abs=1e-6, nan_ok=True)


@pytest.mark.parametrize("channel", CHANNELS, ids=str)
@pytest.mark.parametrize("noise_model", ["nominal", "identity", FITTED], ids=["nominal", "identity", "fitted"])
@pytest.mark.parametrize(("length", "runs"), [(1, 5), (2, 1), (5, 3)])
def test_the_window_is_the_oracle(crossing: Fleet, channel: V2X, noise_model: str, length: int, runs: int) -> None:
    """Neighbours join and leave, messages are lost, late and rejected."""
    fleet = crossing.between(0, 10)
    recording, method = observe(fleet, S2, channel, runs=runs), CooperativeMAP(noise_model=noise_model, window=length)
    assert_is_the_oracle(recording, fleet, method, 3, method(recording, [0, 3]))


@pytest.mark.parametrize("runs", [1, 5])
def test_noise_that_grows_with_the_speed(crossing: Fleet, runs: int) -> None:
    """The kernel makes the process noise from the measured velocity itself."""
    noisy, fleet = replace(S2, velocity_reading="speed", velocity_floor=0.5), crossing.between(0, 10)
    recording = observe(fleet, noisy, V2X(4, loss=0.2, latency=0.1, max_age=0.5), runs=runs)
    method = CooperativeMAP(window=3)
    assert_is_the_oracle(recording, fleet, method, 0, method(recording, [0]))


@pytest.mark.parametrize("length", [1, 4])
def test_vehicles_that_appear_and_vanish(crossing: Fleet, length: int) -> None:
    position, velocity = crossing.position.copy(), crossing.velocity.copy()
    position[:3, 2:5], velocity[:3, 2:5] = np.nan, np.nan
    position[6:8, 4:7], velocity[6:8, 4:7] = np.nan, np.nan
    fleet = replace(crossing, position=position, velocity=velocity).between(0, 12)
    recording, method = observe(fleet, S2, V2X(max_neighbours=5), runs=2), CooperativeMAP(window=length)
    assert_is_the_oracle(recording, fleet, method, 0, method(recording, [0]))


@pytest.mark.parametrize("length", [1, 4])
@pytest.mark.parametrize("channel", CHANNELS[:2], ids=str)
def test_a_missing_fix_is_no_factor(crossing: Fleet, channel: V2X, length: int) -> None:
    """Fixes at a third of the steps, at other times in every vehicle and run: the last one is carried by odometry."""
    fleet = crossing.between(0, 12)
    recording = observe(fleet, S2, channel, runs=3)
    gnss, there = recording.gnss.copy(), np.random.default_rng(1).random(recording.gnss.shape[:3]) < 1 / 3
    there[:, 0] = True
    gnss[~there] = np.nan
    recording, method = replace(recording, gnss=gnss), CooperativeMAP(window=length)
    assert_is_the_oracle(recording, fleet, method, 0, method(recording, [0]))


@pytest.mark.parametrize("noise_model", ["nominal", "identity"])
def test_a_missing_azimuth_leaves_a_range(crossing: Fleet, noise_model: str) -> None:
    fleet = crossing.between(0, 8)
    recording = observe(fleet, S2, V2X(max_neighbours=4), runs=5)
    relative = recording.relative.copy()
    relative[np.random.default_rng(2).random(relative.shape[:2]) < 0.2, 1] = np.nan
    recording = replace(recording, relative=relative)
    method = CooperativeMAP(window=3, noise_model=noise_model)
    assert_is_the_oracle(recording, fleet, method, 0, method(recording, [0]))


@pytest.mark.parametrize(("noise_model", "length"), [("nominal", 4), ("nominal", 1), ("identity", 3)])
@pytest.mark.parametrize("channel", [V2X(max_neighbours=4), V2X(max_neighbours=6, loss=0.3, latency=0.2)], ids=str)
def test_the_robust_window_is_the_oracle(crossing: Fleet, channel: V2X, noise_model: str, length: int) -> None:
    fleet = crossing.between(0, 8)
    recording = spoofed(observe(fleet, S2, channel, runs=2, observers=[0, 3]), 0.6, honest=[0, 3])
    method = CooperativeMAP(window=length, noise_model=noise_model, robust="truncated")
    track = method(recording, [0, 3])
    assert np.abs(track.x - replace(method, robust=None)(recording, [0, 3]).x).max() > 0.1
    assert_is_the_oracle(recording, fleet, method, 0, track)


def test_vehicles_in_one_place_are_solved_converted() -> None:
    position = np.zeros((8, 2, 3))
    position[:, 1, 0] = 0.3
    fleet = Fleet(("a", "b"), 0.1 * np.arange(8), position, np.zeros((8, 2, 3)))
    recording = observe(fleet, replace(S2, min_range=0.0, range_std=0.3), V2X(max_neighbours=1), runs=20)
    for robust in (None, "truncated"):
        found = CooperativeMAP(window=2, robust=robust)(recording, [0])
        assert any("solved converted" in note for note in found.notes)
        looped = CooperativeMAP(backend="gtsam", window=2)(recording.of_runs(slice(0, 3)), [0])
        if robust is None:
            assert np.median(np.abs(found.x[:3] - looped.x)) < 1e-3


@pytest.mark.parametrize("robust", [None, "truncated"])
def test_what_does_not_settle_is_solved_damped(
    monkeypatch: pytest.MonkeyPatch, crossing: Fleet, robust: str | None
) -> None:
    """A window by itself, with the uses of messages that came before it."""
    from coopoc.kernels.windows import batch_window

    channel = V2X(max_neighbours=4, latency=0.1, loss=0.5, max_age=0.3)
    recording = observe(crossing.between(0, 12), S2, channel, runs=2)
    method = CooperativeMAP(window=3, robust=robust)
    wanted, true = method(recording, [0]), batch_window.windows

    def lossy(*args):
        found = true(*args)
        found.x[1, 7:9], found.neighbours[1], found.ended[1] = np.nan, np.nan, batch_window.LOST
        return found

    monkeypatch.setattr(batch_window, "windows", lossy)
    found = method(recording, [0])
    assert found.notes == ("12 problems that did not settle were solved one by one, damped",)
    np.testing.assert_allclose(found.x, wanted.x, atol=1e-6)
    np.testing.assert_allclose(found.neighbours, wanted.neighbours, atol=1e-6)
    np.testing.assert_allclose(found.covariance, wanted.covariance, atol=1e-4)


HONEST = replace(FITTED, gnss_std=S2.gnss_std)


def formed(formation: Fleet, offset: tuple[float, float, float] = (20.0, -15.0, 3.0)) -> Recording:
    """A star of four whose messages are all in time; one neighbour is spoofed."""
    fleet = formation.select(range(4)).between(0, 6)
    seen = observe(fleet, S2, V2X(max_neighbours=3), runs=2, observers=[0])
    gnss = seen.gnss.copy()
    gnss[:, :, 2] += offset
    return replace(seen, gnss=gnss)


@pytest.mark.parametrize("known", [FITTED, HONEST], ids=["all", "robust"])
def test_the_window_is_the_least_squares_solution_of_scipy(formation: Fleet, known: NoiseModel) -> None:
    """The last of three steps, and J^T J inverted; robust without the spoofed neighbour."""
    robust = known is HONEST
    recording = formed(formation) if robust else formed(formation, (0.0, 0.0, 0.0))
    options = {"robust": "truncated", "threshold": 1 - 1e-9} if robust else {}
    track = CooperativeMAP(window=3, noise_model=known, **options)(recording, [0])
    assert track.covariance is not None
    seen = recording.relative[1].reshape(6, 3, 3)[3:]
    columns = np.array([0, *recording.links.neighbour[:3]])
    fix, moved = recording.gnss[1, 3:, columns], recording.dt * recording.velocity[1, 4:, columns]
    trust = ((columns != 2) | (not robust))[:, None, None]

    def residual(flat: np.ndarray) -> np.ndarray:
        x = flat.reshape(4, 3, 3)
        motion = (np.diff(x, axis=1) - moved.reshape(4, 2, 3)) / known.process_std
        gap = np.moveaxis(x[1:] - x[:1], 0, 1)
        off = np.stack(spherical(*np.moveaxis(gap, -1, 0)), axis=-1) - seen
        off[..., 1:] = wrap(off[..., 1:])
        wide = np.maximum(S2.min_range / seen[..., :1], 1.0) ** [0, 1, 1]
        std = np.minimum(wide * S2.relative_std, [math.inf, math.pi, math.pi])
        return np.concatenate([(trust * (x - fix) / known.gnss_std).ravel(), motion.ravel(), (off / std).ravel()])

    best = least_squares(residual, np.asarray(fix).ravel(), xtol=1e-15, ftol=1e-15, gtol=1e-15, x_scale="jac")
    assert track.x[1, 5, 0] == pytest.approx(best.x.reshape(4, 3, 3)[0, 2], abs=1e-5)
    inverse = np.linalg.inv(best.jac.T @ best.jac)[6:9, 6:9]
    assert track.covariance[1, 5, 0] == pytest.approx(inverse, abs=1e-4 * inverse.max())


def test_robust_snapshots_are_those_of_gtsam(formation: Fleet) -> None:
    """GncLMOptimizer on unit vectors and fixes, the neighbours' being its outlier candidates: the same points."""
    recording = formed(formation)
    track = CooperativeMAP(noise_model="identity", robust="truncated")(recording, [0])
    unit, columns = gtsam.noiseModel.Unit.Create(3), [0, *recording.links.neighbour[:3]]
    rejected = 0
    for run in range(2):
        for t in range(6):
            graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
            vectors = to_vector(recording.relative[run, 3 * t : 3 * t + 3])
            graph.add(gtsam.PriorFactorPoint3(0, recording.gnss[run, t, 0], unit))
            for k in range(3):
                graph.add(gtsam.BetweenFactorPoint3(0, k + 1, vectors[k], unit))
            for k in range(1, 4):
                graph.add(gtsam.PriorFactorPoint3(k, recording.gnss[run, t, columns[k]], unit))
            for k in range(4):
                start.insert(k, recording.gnss[run, t, columns[k]])
            params = gtsam.GncLMParams()
            params.setKnownInliers(list(range(4)))
            params.setRelativeCostTol(0.0)
            optimiser = gtsam.GncLMOptimizer(graph, start, params)
            theirs = optimiser.optimize()
            points = np.array([theirs.atPoint3(k) for k in range(4)])
            assert track.x[run, t, 0] == pytest.approx(points[0], abs=1e-6)
            assert track.neighbours[run, 3 * t : 3 * t + 3] == pytest.approx(points[1:], abs=1e-6)
            square = np.square(recording.gnss[run, t, columns[1:]] - points[1:]).sum(axis=1)
            assert np.array_equal(optimiser.getWeights()[4:], square <= chi2.ppf(0.99, 3))
            rejected += int((optimiser.getWeights() == 0).sum())
    assert rejected >= 12

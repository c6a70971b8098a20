"""Streaming: the laws that every filter obeys when it is fed step by step, and independent answers."""

import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from conftest import holed, measured, refused, textbook
from numpy import array, diag, nan, sqrt, square, zeros
from numpy.linalg import eigvalsh, inv, lstsq
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from oracles.solo import filterpys
from shell import ROOT, ran

from coopoc import V2X, CooperativeFilter, Fleet, Kalman, NoiseModel, Sensors, StarStream, observe
from coopoc.learned import GainNet, LearnedGain, OptimisedKF
from coopoc.methods.cooperative_filter import AS_STATED
from coopoc.methods.motion_history import MotionHistory
from coopoc.methods.star_stream import RelativeMeasurement

S2 = Sensors.paper_scenario2()
FITTED = NoiseModel("fitted", S2, process_std=(0.08, 0.07, 0.01), gnss_std=(3.0, 3.5, 4.0))
OKF = OptimisedKF((0.05, 0.04, 0.01), (0.1, 0.12, 0.05), (1.5, 1.6, 1.7))
NET = GainNet(2, 1)
SOLO: dict[str, tuple[Any, Callable[..., Any]]] = {
    "identity": (Kalman("identity"), Kalman("identity").start),
    "nominal": (Kalman("nominal"), Kalman(NoiseModel.nominal(S2)).start),
    "fitted": (Kalman(FITTED), Kalman(FITTED).start),
    "okf": (OKF, OKF.start),
    "net": (LearnedGain(NET), LearnedGain(NET).start),
}
STARTS: dict[str, Callable[..., Any]] = {
    **{name: start for name, (_, start) in SOLO.items()},
    "star": partial(StarStream, CooperativeFilter(FITTED, AS_STATED)),
}
U, Z = array([9.0, -2.0, 0.1]), array([30.0, 20.0, 1.0])


def play(stream, recording, ego, run, first=0):
    """(T, 3) and (T, 3, 3) of a solo stream that is fed a run from step `first` on."""
    fixes, speeds = recording.gnss[run, first:, ego], recording.velocity[run, first:, ego]
    found = [stream.step(z, u, recording.dt) for z, u in zip(fixes, speeds, strict=True)]
    return np.stack([x for x, _ in found]), np.stack([cov for _, cov in found])


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("name", SOLO)
def test_step_by_step_is_the_track(name, known, crossing):
    """From the first fix, and from a known start, whose own step is no step of the stream and has no fix, nor have a
    third; in one plane, at first or throughout."""
    method, start = SOLO[name]
    recording, x0 = holed(observe(crossing, S2, V2X(max_neighbours=0), runs=2)), crossing.position[0, 3]
    gnss, velocity = recording.gnss.copy(), recording.velocity.copy()
    flat = 9 if known else len(gnss[0])
    gnss[:, :flat, :, 2] *= 0.0
    velocity[:, :flat, :, 2] *= 0.0
    gnss[:, : int(known)] = np.nan
    recording = replace(recording, t=2.0 * recording.t, gnss=gnss, velocity=velocity)
    track = (replace(method, x0=x0[None]) if known else method)(recording, [3])
    x, cov = play(start(x0) if known else start(), recording, 3, run=1, first=int(known))
    assert_allclose(x, track.x[1, known:, 0], atol=1e-5 if name == "net" else 1e-12)
    if track.covariance is None:
        assert not cov.any()
    else:
        assert_allclose(cov, track.covariance[1, known:, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("start", "near"),
    [(textbook(Kalman(FITTED)).start, 1e-9), (partial(StarStream, CooperativeFilter(FITTED, AS_STATED)), 1e-4)],
)
def test_alone_it_is_filterpy_with_missing_and_late_fixes_and_any_dt(start, near):
    """filterpy gets a late fix moved by, and with the variance of, the motion since, from the sum of all steps. The
    star's flat prior of 1e6 m^2 weighs 1e-5 of a fix."""
    draw, stream = default_rng(0), start(interval=0.1)
    stream.step(Z, U, 0.1)
    theirs, t, path = filterpys(Z, diag(FITTED.gnss_variance), 0.1), [0.0, 0.1], [0 * U, 0.1 * U]
    for k in range(200):
        dt, u, z = draw.uniform(0.02, 0.5), draw.normal(0, 9, 3), Z + draw.normal(0, 3, 3)
        t, path = [*t, t[-1] + dt], [*path, path[-1] + dt * u]
        theirs.predict(u=u, B=dt * np.eye(3), Q=dt / 0.1 * diag(square(FITTED.process_std)))
        there, age = draw.uniform() > 0.3, draw.uniform(0, 0.6) * (k > 30)
        if there:
            moved = path[-1] - [np.interp(t[-1] - age, t, column) for column in array(path).T]
            theirs.update(z + moved, R=diag(FITTED.gnss_variance + age / 0.1 * square(FITTED.process_std)))
        x, cov = stream.step(z if there else None, u, dt, fix_age=age)
        assert_allclose(x, theirs.x, atol=near)
        assert_allclose(cov, theirs.P, atol=near)


@pytest.mark.parametrize("name", STARTS)
def test_a_long_step_is_two_short_ones(name):
    """Where motion is white noise of steps of 0.1 s."""
    given = {} if name == "net" else {"interval": 0.1}
    once, twice = STARTS[name](**given), STARTS[name](**given)
    for stream in (once, twice):
        stream.step(Z, U, 0.1)
        stream.step(Z + 1.0, U, 0.1)
    twice.step(None, U, 0.1)[0][:] = 0.0  # an estimate is the caller's
    (x, cov), (same_x, same_cov) = once.step(None, U, 0.2), twice.step(None, U, 0.1)
    assert_allclose(x, same_x, atol=1e-6 if name == "net" else 1e-12)
    if cov is not None:
        assert_allclose(cov, same_cov, atol=1e-12)
        assert_allclose(once.step(Z, U, 0.1)[0], twice.step(Z, U, 0.1)[0], atol=1e-12)


@pytest.mark.parametrize("name", ["nominal", "star", "net"])
def test_nothing_is_known_before_the_first_fix(name):
    stream = STARTS[name]()
    for _ in range(3):
        x, cov = stream.step(None, U, 0.1, fix_age=9.0)
        assert np.isnan(x).all()
        assert cov is None
    x, cov = stream.step(Z, U, 0.1, fix_age=0.3)
    assert_allclose(x, Z + 0.3 * U, atol=1e-5)
    if name == "nominal":
        variance = square(S2.gnss_std) + 3 * S2.motion_std(U[None, None, None], 0.1)[0, 0, 0] ** 2
        assert_allclose(diag(cov), variance)


def window(draw, steps, late, q, r):
    """Errors in m of a drive's end on one axis: the stream, the optimum, the stream without late fixes, and the
    optimum's own std. Odd steps bring the fix of `late` steps ago, even ones a prompt fix.

    The optimum is numpy's least squares over all positions of the window, each fix at its true time.
    """
    truth = np.cumsum(draw.normal(0, q, steps + 1))
    at = [t - late if t % 2 and t >= late else t for t in range(steps + 1)]
    fixes = truth[at] + draw.normal(0, r, steps + 1)
    known = NoiseModel("constant", process_std=(q, q, q), gnss_std=(r, r, r))
    full, prompt = Kalman(known).start(), Kalman(known).start()
    for t in range(steps + 1):
        stale = at[t] < t
        x, _ = full.step([fixes[t], 0.0, 0.0], [0.0, 0.0, 0.0], 0.1, fix_age=0.1 * (t - at[t]))
        without, _ = prompt.step(None if stale else [fixes[t], 0.0, 0.0], [0.0, 0.0, 0.0], 0.1)
    rows = np.vstack([np.eye(steps + 1)[at] / r, np.diff(np.eye(steps + 1), axis=0) / q])
    best = lstsq(rows, np.concatenate([fixes / r, zeros(steps)]), rcond=None)[0][-1]
    return x[0] - truth[-1], best - truth[-1], without[0] - truth[-1], sqrt(inv(rows.T @ rows)[-1, -1])


def test_a_late_fix_is_nearly_used_up():
    """0.3 s late at the noise of scenario 2 at 10 m/s: within 2 % of the least squares over the whole window, which
    is itself as good as it says; without the late fixes a filter is clearly worse."""
    draw = default_rng(5)
    errors = array([window(draw, 60, 3, q=0.1, r=3.5) for _ in range(150)])
    ours, best, without, _ = sqrt(np.mean(errors**2, 0))
    assert best == pytest.approx(errors[0, 3], rel=0.2)
    assert ours < 1.02 * best
    assert without > 1.1 * best


@pytest.mark.parametrize(
    ("field", "given"),
    [
        ("gnss", {"gnss": [1.0, nan, 2.0]}),
        ("velocity", {"velocity": [1.0, 2.0]}),
        ("velocity", {"velocity": [1e5, 0.0, 0.0]}),
        ("dt", {"dt": 0.0}),
        ("fix_age", {"fix_age": nan}),
        ("fix_age", {"fix_age": 0.7}),
    ],
)
@pytest.mark.parametrize("name", ["nominal", "star", "net"])
def test_bad_input_is_named_and_forgotten(name, field, given):
    one, other = STARTS[name](), STARTS[name]()
    for stream in (one, other):
        stream.step(Z, U, 0.1)
    with refused(f"^{field} = "):
        one.step(**{"gnss": Z, "velocity": U, "dt": 0.1} | given)
    assert str(getattr(one, "broadcast", "")) == str(getattr(other, "broadcast", ""))
    assert_array_equal(one.step(Z, U, 0.1)[0], other.step(Z, U, 0.1)[0])
    assert_array_equal(one.history.rows, other.history.rows)


def test_the_motion_that_is_kept_is_its_integral():
    """Closed form: the summed motion, interpolated at any age, while the ring of steps wraps around and grows."""
    rng, history = default_rng(0), MotionHistory(10.0)
    dt = np.concatenate([rng.uniform(0.2, 0.9, 100), rng.uniform(0.01, 0.05, 500), rng.uniform(0.2, 0.9, 50)])
    moved, variance = rng.normal(size=(len(dt), 3)), rng.uniform(size=(len(dt), 3))
    end, sums = np.append(0.0, np.cumsum(dt)), zeros((len(dt) + 1, 6))
    sums[1:] = np.cumsum(np.hstack([moved, variance]), 0)
    for k, step in enumerate(dt, start=1):
        history.push(step, moved[k - 1], variance[k - 1])
        seen = history.rows[0, 2]
        assert seen == pytest.approx(end[k] - end[k - len(history)])
        assert seen == pytest.approx(end[k]) or seen - dt[k - len(history)] < 10.0 <= seen
        for age in (0.0, 0.31 * seen, seen):
            since = sums[k] - [np.interp(end[k] - age, end, column) for column in sums.T]
            fix, late = history.forward([5.0, 0.0, -1.0], age)
            assert_allclose([*(fix - [5.0, 0.0, -1.0]), *late], since, atol=1e-9)


def test_bad_starts_are_named():
    for field, make in {
        "x0": lambda: Kalman("identity").start([0.0, 0.0]),
        "interval": lambda: Kalman("identity").start(interval=0.0),
        "history": lambda: Kalman("identity").start(history=-1.0),
        "max_age": lambda: StarStream(CooperativeFilter(FITTED), max_age=nan),
        "noise_model": lambda: StarStream(CooperativeFilter("nominal")),
        "filter": lambda: StarStream(Kalman(FITTED)),  # type: ignore[arg-type]
        "message": lambda: RelativeMeasurement("b", [9.0, 0.0, 1.57], Z, U),
    }.items():
        with refused(f"^{field} = "):
            make()
    assert StarStream(CooperativeFilter(FITTED)).broadcast is None
    oracle = Kalman(NoiseModel.oracle(S2, Fleet(("a",), [0, 0.1], zeros((2, 1, 3)), zeros((2, 1, 3)))))
    with refused(r"noise_model = 'oracle'.*NoiseModel.nominal"):
        oracle.start()


@pytest.mark.parametrize("first", [None, Z + 1.0])
def test_a_star_from_a_known_place_is_the_kalman_filter(first):
    star = StarStream(CooperativeFilter(FITTED, AS_STATED), Z)
    alone = textbook(Kalman(FITTED)).start(Z)
    for z in (first, None, Z + U):
        (x, cov), (same_x, same_cov) = (stream.step(z, U, 0.1) for stream in (star, alone))
        assert_allclose(x, same_x, atol=1e-6)
        assert_allclose(cov, same_cov, atol=1e-6)


def test_a_stream_forgets_whom_it_met_long_ago():
    stream, other = (StarStream(CooperativeFilter(FITTED)) for _ in range(2))
    for k in range(400):
        other.step(Z, U, 0.1)
        heard = RelativeMeasurement(f"v{k}", [9.0, 0.0, 1.57], *other.broadcast)  # type: ignore[misc]
        stream.step(Z, U, 0.1, neighbours=[heard])
    assert len(stream._last) < 60


NOMINAL = CooperativeFilter(NoiseModel.nominal(Sensors()))


def test_a_message_given_again_says_nothing_new():
    """Though its age is rounded."""
    sure = list[float]()
    for late in (0.0, 1e-6):
        stream, other = (StarStream(NOMINAL) for _ in range(2))
        other.step(Z, U, 0.1)
        for k in range(9):
            heard = RelativeMeasurement("b", [9.0, 0.0, 1.57], *other.broadcast, age=(0.1 - late) * k)  # type: ignore[misc]
            cov = stream.step(Z if k == 0 else None, U, 0.1, neighbours=[heard])[1]
        sure.append(cov.trace())
    assert sure[0] == pytest.approx(sure[1], rel=1e-4)


def test_a_star_follows_again_after_a_pause_of_one_step():
    """A minute without a fix counted as one in which fixes agreed: a place that they contradict was kept for good."""
    stream, noise = StarStream(NOMINAL), default_rng(0).normal(0, 1.5, (70, 3))
    for k, error in enumerate(noise):
        if k == 30:
            stream.step(None, [0, 0, 0], 60.0)
        place = 10.0 * k * array([1, 0, 0]) + [0, 5000 * (k >= 30), 0]
        x, _ = stream.step(place + error, [10, 0, 0], 1.0)
    assert abs(x - place).max() < 10.0


def test_velocities_of_short_and_long_steps_are_alike_plausible():
    """A long step after a short one seemed implausible, its variance divided by the other's time: 2.7 m, not 1.6."""
    stream, draw, errors = StarStream(NOMINAL, interval=0.1), default_rng(0), []
    for k in range(600):
        dt = 0.199 if k % 2 else 0.001
        noise, place = (
            0.1 * abs(U) * sqrt(0.1 / dt) * draw.normal(size=3),
            U * (0.1 * (k - k % 2) + 0.001 + 0.199 * (k % 2)),
        )
        x, _ = stream.step(place + draw.normal(0, 1.5, 3) if k % 10 == 0 else None, U + noise, dt)
        errors.append(x - place)
    assert sqrt(square(errors[100:]).sum(axis=1).mean()) < 2.0


@pytest.mark.slow
@pytest.mark.parametrize("log", ["bundled", "KITTI 00"])
def test_the_replay_runs(log):
    arguments = []
    if log != "bundled":
        arguments = [measured(f"KITTI_00_{part}.txt") for part in ("ORB", "gt_times", "gt")]
    command = [sys.executable, "-W", "error", ROOT / "examples" / "replay_log.py", *arguments, "--steps", "150"]
    out = ran(command, check=True).stdout
    assert ("No log given" in out) == (log == "bundled")
    rows = [line.split("  ") for line in out.splitlines() if line.startswith(("Kal", "OKF", "Fed"))]
    numbers = array([[float(word) for word in row[1:] if word.strip()] for row in rows])
    assert numbers.shape == (4, 6)
    assert (numbers[:, :5] < 2.5 * sqrt(3)).all(), "better than the fixes, however bad the log is"
    assert (numbers[:, 5] > 50).all(), "steps per second"


def test_a_range_of_zero_is_refused_and_forgotten(crossing):
    """No direction is seen in one place: a filter of a star gave NaN from there on."""
    stream, other = (StarStream(CooperativeFilter(FITTED)) for _ in range(2))
    stream.step([0, 0, 0], [1, 0, 0], 0.1)
    other.step([1, 0, 0], [1, 0, 0], 0.1)
    with refused("the range first and > 0"):
        RelativeMeasurement("b", [0.0, 0.1, 1.5], *other.broadcast)  # type: ignore[misc]
    near = RelativeMeasurement("b", [1e-6, 0.1, 1.5], *other.broadcast)  # type: ignore[misc]
    x, cov = stream.step([0, 0, 0], [1, 0, 0], 0.1, neighbours=[near])
    assert np.isfinite(x).all()
    assert (eigvalsh(cov) > 0).all()
    recording = observe(crossing, Sensors(), V2X(max_neighbours=2))
    relative = recording.relative.copy()
    relative[0, 3, 0] = 0.0
    with refused(r"\[0, 3\] = 0\.0: must be a range > 0 m"):
        replace(recording, relative=relative)

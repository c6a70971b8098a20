"""Compiled kernels against the NumPy reference, and against filterpy, SciPy and numpy.linalg."""

from __future__ import annotations

import math
import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from scipy.optimize import least_squares

from coopoc import V2X, CooperativeMAP, Fleet, InputError, JointFilter, Knowledge, Recording, Sensors, observe
from coopoc.kernels import compile as kernels
from coopoc.methods.lkf_sa import LaplacianKalman
from coopoc.methods.star import assumed_arrays, measured_arrays
from coopoc.methods.track import Method, Track
from coopoc.world.inbox import inbox
from coopoc.world.spherical import spherical, to_vector, wrap
from coopoc.world.v2x import FIX_AND_VELOCITY

pytest.importorskip("numba")
S2 = Sensors.paper_scenario2()
CHANNELS = [V2X(max_neighbours=4), V2X(max_neighbours=7, loss=0.3, latency=0.2), V2X(max_neighbours=3, loss=1.0),
            V2X(max_neighbours=5, bytes_per_second=1000.0), V2X(max_neighbours=0)]  # fmt: skip


def in_numpy(monkeypatch: pytest.MonkeyPatch, method: Any, recording: Recording, egos: Any) -> Track:
    with monkeypatch.context() as patch:
        patch.setenv(kernels.SWITCH, "numpy")
        track: Track = method(recording, egos)
    return track


def assert_same(found: Track, wanted: Track, near: float = 1e-9) -> None:
    np.testing.assert_allclose(found.x, wanted.x, atol=near, rtol=0)
    assert found.covariance is not None
    assert wanted.covariance is not None
    size = np.abs(wanted.covariance).max(axis=(-1, -2), keepdims=True)
    assert (np.abs(found.covariance - wanted.covariance) / size).max() < 1e-9
    np.testing.assert_allclose(found.neighbours, wanted.neighbours, atol=near, rtol=0)
    assert (found.received_bytes == wanted.received_bytes).all()
    assert found.notes == wanted.notes


@pytest.mark.parametrize("channel", CHANNELS, ids=str)
@pytest.mark.parametrize("exact", [True, False])
@pytest.mark.parametrize("knowledge", ["nominal", "identity"])
def test_the_filter_is_the_reference(
    crossing: Fleet, channel: V2X, exact: bool, knowledge: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neighbours join and leave, messages are lost, late and turned away."""
    recording = observe(crossing, S2, channel, runs=2)
    method = JointFilter(knowledge, exact=exact)
    assert_same(method(recording, [0, 3]), in_numpy(monkeypatch, method, recording, [0, 3]))


@pytest.mark.parametrize("knowledge", ["oracle", "fitted", "still"])
def test_the_filter_is_the_reference_with_little_and_with_constant_process_noise(
    crossing: Fleet, knowledge: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    parked = replace(crossing, position=np.repeat(crossing.position[:1], len(crossing.t), axis=0),
                     velocity=0 * crossing.velocity)  # fmt: skip
    fleet = parked if knowledge == "oracle" else crossing
    known = {"oracle": Knowledge.oracle(S2, fleet), "fitted": Knowledge("fitted", S2, (0.3, 0.2, 0.01)),
             "still": Knowledge("fitted", S2, (1e-60, 1e-30, 1e-60))}[knowledge]  # fmt: skip
    recording = observe(fleet, S2, V2X(max_neighbours=4, loss=0.2), runs=2)
    method = JointFilter(known)
    assert_same(method(recording, [1]), in_numpy(monkeypatch, method, recording, [1]))


SPEED = [JointFilter(), LaplacianKalman("nominal"), CooperativeMAP(window=3)]


@pytest.mark.parametrize("method", SPEED, ids=lambda m: m.name)
def test_noise_that_grows_with_the_speed_is_the_reference(
    crossing: Fleet, method: Method, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The kernels make the process noise from the measured velocity themselves, in a run alone and in five abreast."""
    for runs in (1, 5):
        noisy = replace(S2, velocity_reading="speed", velocity_floor=0.5)
        recording = observe(crossing.between(0, 20), noisy, V2X(4, loss=0.2, latency=0.1, max_age=0.5), runs=runs)
        found, wanted = method(recording, [0]), in_numpy(monkeypatch, method, recording, [0])
        np.testing.assert_allclose(found.x, wanted.x, atol=1e-7, rtol=0)
        np.testing.assert_allclose(found.covariance, wanted.covariance, atol=1e-6)


def test_vehicles_that_appear_and_vanish(monkeypatch: pytest.MonkeyPatch, crossing: Fleet) -> None:
    position, velocity = crossing.position.copy(), crossing.velocity.copy()
    position[:20, 2:5], velocity[:20, 2:5] = np.nan, np.nan
    position[40:, 4:7], velocity[40:, 4:7] = np.nan, np.nan
    recording = observe(replace(crossing, position=position, velocity=velocity), S2, V2X(max_neighbours=5), runs=2)
    filter_, snapshot = JointFilter(), CooperativeMAP()
    assert_same(filter_(recording, [0]), in_numpy(monkeypatch, filter_, recording, [0]))
    found, wanted = snapshot(recording, [0]), in_numpy(monkeypatch, snapshot, recording, [0])
    np.testing.assert_allclose(found.x, wanted.x, atol=1e-6)


def test_the_linear_filter_equals_filterpy(formation: Fleet) -> None:
    """Independent check over the stacked star of a formation that never changes, from its first estimate on."""
    fleet = formation.select(range(4)).between(0, 40)
    recording = observe(fleet, S2, V2X(max_neighbours=3), runs=1, observers=[0])
    known = Knowledge("fitted", S2, process_std=(0.08, 0.07, 0.01), gnss_std=(3.0, 3.5, 4.0))
    track = JointFilter(known, exact=False)(recording, [0])
    n, order = 12, [0, *recording.links.neighbour[:3]]
    peer = KalmanFilter(dim_x=n, dim_z=n + 9, dim_u=n)
    sight = np.kron(np.hstack([-np.ones((3, 1)), np.eye(3)]), np.eye(3))
    peer.B, peer.H = 0.1 * np.eye(n), np.vstack([np.eye(n), sight])
    peer.Q = np.kron(np.eye(4), np.diag(np.square(known.process_std)))
    where = to_vector(recording.relative[0])
    noise = np.zeros((n + 9, n + 9))
    noise[:n, :n] = np.kron(np.eye(4), np.diag(known.gnss_variance))
    for t in range(40):
        z = np.concatenate([recording.gnss[0, t, order].ravel(), where[3 * t : 3 * t + 3].ravel()])
        if t:
            peer.predict(u=recording.velocity[0, t, order].ravel())
            ahead = peer.x[3:].reshape(3, 3) - peer.x[:3]
        else:
            ahead = where[:3]
        for k in range(3):
            at = slice(n + 3 * k, n + 3 * k + 3)
            noise[at, at] = known.relative_cov(np.array(spherical(*ahead[k])))
        if t:
            peer.update(z, R=noise)
        else:  # filterpy's own update would lose seven digits to the flat prior
            weight = peer.H.T @ np.linalg.inv(noise)
            peer.P = np.linalg.inv(np.eye(n) / 1e6 + weight @ peer.H)
            start = np.concatenate([z[:3], (z[:3] + ahead).ravel()])
            peer.x = start + peer.P @ weight @ (z - peer.H @ start)
        assert track.x[0, t, 0] == pytest.approx(peer.x[:3], abs=1e-9)
        assert track.covariance is not None
        assert track.covariance[0, t, 0] == pytest.approx(peer.P[:3, :3], rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("channel", CHANNELS, ids=str)
@pytest.mark.parametrize("knowledge", ["nominal", "identity"])
def test_the_snapshot_is_the_reference(
    crossing: Fleet, channel: V2X, knowledge: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To the tolerance at which both stop, a last step of 0.1 mm: what is left is below a hundredth of it."""
    recording = observe(crossing, S2, channel, runs=2)
    method = CooperativeMAP(knowledge=knowledge)
    found, wanted = method(recording, [0, 3]), in_numpy(monkeypatch, method, recording, [0, 3])
    np.testing.assert_allclose(found.x, wanted.x, atol=1e-6)
    np.testing.assert_allclose(found.neighbours, wanted.neighbours, atol=1e-6)
    assert found.covariance is not None
    assert wanted.covariance is not None
    np.testing.assert_allclose(found.covariance, wanted.covariance, atol=1e-4 * wanted.covariance.max())


def test_the_snapshot_is_the_least_squares_solution_of_scipy(crossing: Fleet) -> None:
    from coopoc.kernels.snapshot import SOLVED, snapshots

    recording = observe(crossing, S2, V2X(max_neighbours=4), runs=2, observers=[0])
    box, known = inbox(recording, 0, FIX_AND_VELOCITY), Knowledge.nominal(S2)
    x, cov, _, ended = snapshots(measured_arrays(recording, 0, box), assumed_arrays(recording, known), 1e-11, 0.1)
    assert (ended == SOLVED).all()
    for run, t in ((0, 0), (1, 17), (0, 59)):
        links = box.link[box.start[t] : box.start[t + 1]]
        order = [0, *recording.links.neighbour[links]]
        fix, seen = recording.gnss[run, t, order], recording.relative[run, links]

        def residual(flat: Any, fix: Any = fix, seen: Any = seen) -> Any:
            points = flat.reshape(-1, 3)
            d, az, inc = spherical(*(points[1:] - points[0]).T)
            off = np.stack([d - seen[:, 0], wrap(az - seen[:, 1]), wrap(inc - seen[:, 2])], axis=1)
            return np.concatenate([((points - fix) / S2.gnss_std).ravel(), (off / S2.relative_std).ravel()])

        start = np.concatenate([fix[:1], fix[0] + to_vector(seen)])
        best = least_squares(residual, start.ravel(), jac="3-point", method="lm", xtol=1e-14, ftol=1e-14, gtol=1e-14)
        assert x[run, t] == pytest.approx(best.x[:3], abs=1e-6)
        spread = np.linalg.inv(best.jac.T @ best.jac)[:3, :3]
        assert cov[run, t] == pytest.approx(spread, abs=1e-6)


def test_vehicles_in_one_place_are_solved_converted(monkeypatch: pytest.MonkeyPatch) -> None:
    """A noisy range near zero: the notes count the same problems, and the answers agree."""
    position = np.repeat([[[0.0, 0, 0], [0.6, 0, 0], [9, 2, 0]]], 40, axis=0)
    fleet = Fleet(("a", "b", "c"), 0.1 * np.arange(40), position, 0 * position)
    acting = replace(S2, min_range=0.1)
    recording = observe(fleet, acting, V2X(max_neighbours=2), runs=4, observers=[0])
    method = CooperativeMAP()
    found, wanted = method(recording, [0]), in_numpy(monkeypatch, method, recording, [0])
    assert found.notes == wanted.notes != ()
    np.testing.assert_allclose(found.x, wanted.x, atol=1e-5)


def test_what_does_not_settle_goes_to_the_damped_reference(monkeypatch: pytest.MonkeyPatch, crossing: Fleet) -> None:
    from coopoc.kernels import snapshot

    recording, method = observe(crossing, S2, V2X(max_neighbours=4), runs=2), CooperativeMAP()
    wanted, true = in_numpy(monkeypatch, method, recording, [0]), snapshot.snapshots

    def lossy(*args: Any) -> Any:
        x, cov, others, ended = true(*args)
        x[1, 7:9], ended[1, 7:9] = np.nan, snapshot.LOST
        return x, cov, others, ended

    monkeypatch.setattr(snapshot, "snapshots", lossy)
    found = method(recording, [0])
    np.testing.assert_allclose(found.x[1, 7:9], wanted.x[1, 7:9], rtol=0, atol=1e-10)
    np.testing.assert_allclose(found.x, wanted.x, atol=1e-6)


def flat(full: Any, beside: Any, stride: int) -> Any:
    """Upper triangle with noise below it, a right-hand side and zeros."""
    out = np.zeros((len(full), stride))
    out[:, : len(full)] = np.triu(full) + np.tril(np.ones_like(full), -1)
    out[:, len(full)] = beside
    return out.ravel()


@pytest.mark.parametrize("n", [3, 6, 12, 33, 36])
def test_block_solution_and_last_marginal_are_those_of_numpy(n: int) -> None:
    from coopoc.kernels.blocks import eliminate, substitute, width

    rng = np.random.default_rng(n)
    root, b, stride = rng.normal(size=(n, 2 * n)), rng.normal(size=n), width(n)
    full, factor, pivots, x = root @ root.T, np.empty(n * stride), np.empty(3 * n), np.empty(n)
    assert stride > n
    eliminate(flat(full, b, stride), n, stride, factor, pivots)
    substitute(factor, n, stride, x)
    np.testing.assert_allclose(x, np.linalg.solve(full, b), rtol=1e-9)
    np.testing.assert_allclose(-pivots[-9:].reshape(3, 3), np.linalg.inv(full)[-3:, -3:], rtol=1e-9)


@pytest.mark.parametrize("n", [3, 6, 33])
def test_what_may_move_and_what_leaves_is_as_in_covariance_form(n: int) -> None:
    """Against numpy.linalg.inv of covariance + Q; a block of no stiffness is marginalised."""
    from coopoc.kernels.blocks import loosen, width

    rng = np.random.default_rng(n)
    root, stride = rng.normal(size=(n, 2 * n)), width(n)
    full, q = root @ root.T, 10.0 ** rng.uniform(-3, 3, n)
    a, memory = flat(full, 0.0, stride), np.empty(6 * stride + 9)
    loosen(a, n, stride, 1 / q, memory)
    expected = np.linalg.inv(np.linalg.inv(full) + np.diag(q))
    found = np.triu(a.reshape(n, stride)[:, :n])
    np.testing.assert_allclose(found, np.triu(expected), rtol=1e-7, atol=1e-9 * np.abs(expected).max())
    if n > 3:
        a, stiffness = flat(full, 0.0, stride), np.append(np.zeros(3), 1 / q[3:])
        loosen(a, n, stride, stiffness, memory)
        expected = np.triu(np.linalg.inv(np.linalg.inv(full)[3:, 3:] + np.diag(q[3:])))
        found = np.triu(a.reshape(n, stride)[3:, 3:n])
        np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-9 * np.abs(expected).max())


def test_the_angle_is_atan2() -> None:
    from coopoc.kernels.sighting import angle

    for turn in np.concatenate([np.linspace(-3.14, 3.14, 301), [0.0, 1e-9, -1e-300, 0.2449, -0.245]]):
        assert angle(3 * math.sin(turn), 3 * math.cos(turn)) == pytest.approx(turn, rel=1e-15, abs=0)


def test_without_numba_the_reference_serves_and_says_so_once(crossing: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    recording, method = observe(crossing, S2, V2X(max_neighbours=3), runs=1), JointFilter()
    wanted = method(recording, [0])
    monkeypatch.setitem(sys.modules, "numba", None)
    kernels.numba_is_there.cache_clear()
    try:
        with pytest.warns(UserWarning, match=r"pip install 'coopoc\[fast\]'"):
            found = method(recording, [0])
        assert_same(found, wanted)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            CooperativeMAP()(recording, [0])
    finally:
        kernels.numba_is_there.cache_clear()


def test_a_wrong_switch_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(kernels.SWITCH, "cuda")
    with pytest.raises(InputError, match="COOPOC_KERNELS = 'cuda': must be 'numba' or 'numpy'"):
        kernels.use_kernels()


def test_machine_code_is_stale_after_a_change_of_any_file_beside_it(tmp_path: Path) -> None:
    file = tmp_path / "a.py"
    file.write_text("one")
    before = kernels._stamp.__wrapped__((tmp_path,))
    file.write_text("other")
    assert kernels._stamp.__wrapped__((tmp_path,)) != before


def test_importing_the_package_imports_no_numba() -> None:
    code = "import sys, coopoc; coopoc.JointFilter, coopoc.CooperativeMAP; print('numba' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"

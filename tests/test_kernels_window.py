"""Compiled windows of stars against the NumPy reference, SciPy and numpy.linalg."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from test_kernels import CHANNELS, S2, assert_same, in_numpy

from coopoc import V2X, CooperativeMAP, Fleet, Knowledge, observe
from coopoc.world.spherical import spherical, wrap

pytest.importorskip("numba")
FITTED = Knowledge("fitted", S2, (0.3, 0.2, 0.01))


@pytest.mark.parametrize("channel", CHANNELS, ids=str)
@pytest.mark.parametrize("knowledge", ["nominal", "identity", FITTED], ids=["nominal", "identity", "fitted"])
@pytest.mark.parametrize("length", [2, 5])
def test_the_window_is_the_reference(
    crossing: Fleet, channel: V2X, knowledge: str, length: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both stop at a last step of 0.1 mm: the covariance of the one before it is off by a hundredth of a percent."""
    recording = observe(crossing.between(0, 16), S2, channel, runs=2)
    method = CooperativeMAP(knowledge=knowledge, window=length)
    found, wanted = method(recording, [0, 3]), in_numpy(monkeypatch, method, recording, [0, 3])
    assert found.covariance is not None
    assert wanted.covariance is not None
    np.testing.assert_allclose(found.covariance, wanted.covariance, atol=1e-4 * wanted.covariance.max())
    assert_same(replace(found, covariance=wanted.covariance), wanted)


def test_vehicles_that_appear_and_vanish(monkeypatch: pytest.MonkeyPatch, crossing: Fleet) -> None:
    position, velocity = crossing.position.copy(), crossing.velocity.copy()
    position[:8, 2:5], velocity[:8, 2:5] = np.nan, np.nan
    position[12:15, 4:7], velocity[12:15, 4:7] = np.nan, np.nan
    fleet = replace(crossing, position=position, velocity=velocity).between(0, 24)
    recording, method = observe(fleet, S2, V2X(max_neighbours=5), runs=2), CooperativeMAP(window=4)
    found, wanted = method(recording, [0]), in_numpy(monkeypatch, method, recording, [0])
    np.testing.assert_allclose(found.x, wanted.x, atol=1e-9)
    np.testing.assert_allclose(found.neighbours, wanted.neighbours, atol=1e-9)


def test_vehicles_in_one_place_are_solved_converted(monkeypatch: pytest.MonkeyPatch) -> None:
    position = np.zeros((8, 2, 3))
    position[:, 1, 0] = 0.3
    fleet = Fleet(("a", "b"), 0.1 * np.arange(8), position, np.zeros((8, 2, 3)))
    close = replace(S2, min_range=0.0, range_std=0.3)
    recording, method = observe(fleet, close, V2X(max_neighbours=1), runs=20), CooperativeMAP(window=2)
    found, wanted = method(recording, [0]), in_numpy(monkeypatch, method, recording, [0])
    assert "solved converted" in found.notes[0]
    assert found.notes == wanted.notes
    np.testing.assert_allclose(found.x, wanted.x, atol=1e-6)


@pytest.mark.parametrize("v2x", [V2X(max_neighbours=4), V2X(max_neighbours=4, latency=0.1, loss=0.5, max_age=0.3)])
def test_what_does_not_settle_goes_to_the_damped_reference(
    monkeypatch: pytest.MonkeyPatch, crossing: Fleet, v2x: V2X
) -> None:
    """A window by itself, with the uses of messages that came before it."""
    from coopoc.kernels import snapshot, window

    recording, method = observe(crossing.between(0, 12), S2, v2x, runs=2), CooperativeMAP(window=3)
    wanted, true = in_numpy(monkeypatch, method, recording, [0]), window.windows

    def lossy(*args):
        x, cov, others, ended = true(*args)
        x[1, 7:9], others[1], ended[1] = np.nan, np.nan, snapshot.LOST
        return x, cov, others, ended

    monkeypatch.setattr(window, "windows", lossy)
    found = method(recording, [0])
    np.testing.assert_allclose(found.covariance[1], wanted.covariance[1], atol=1e-10)
    assert_same(replace(found, covariance=wanted.covariance), wanted)


def test_the_window_is_the_least_squares_solution_of_scipy(formation: Fleet) -> None:
    """The last of three steps of a star of four whose messages are all in time, and J^T J inverted."""
    fleet = formation.select(range(4)).between(0, 6)
    recording = observe(fleet, S2, V2X(max_neighbours=3), runs=2, observers=[0])
    track = CooperativeMAP(window=3, knowledge=FITTED)(recording, [0])
    assert track.covariance is not None
    seen = recording.relative[1].reshape(6, 3, 3)[3:]
    columns = [0, *recording.links.neighbour[:3]]
    fix, moved = recording.gnss[1, 3:, columns], recording.dt * recording.velocity[1, 4:, columns]

    def residual(flat: np.ndarray) -> np.ndarray:
        x = flat.reshape(4, 3, 3)
        motion = (np.diff(x, axis=1) - moved.reshape(4, 2, 3)) / FITTED.process_std
        gap = np.moveaxis(x[1:] - x[:1], 0, 1)
        off = np.stack(spherical(*np.moveaxis(gap, -1, 0)), axis=-1) - seen
        off[..., 1:] = wrap(off[..., 1:])
        wide = np.maximum(S2.min_range / seen[..., :1], 1.0) ** [0, 1, 1]
        std = np.minimum(wide * S2.relative_std, [math.inf, math.pi, math.pi])
        return np.concatenate([((x - fix) / FITTED.gnss_std).ravel(), motion.ravel(), (off / std).ravel()])

    best = least_squares(residual, np.asarray(fix).ravel(), xtol=1e-15, ftol=1e-15, gtol=1e-15, x_scale="jac")
    assert track.x[1, 5, 0] == pytest.approx(best.x.reshape(4, 3, 3)[0, 2], abs=1e-5)
    inverse = np.linalg.inv(best.jac.T @ best.jac)[6:9, 6:9]
    assert track.covariance[1, 5, 0] == pytest.approx(inverse, abs=1e-4 * inverse.max())

"""Compiled moving horizons and fixed-lag smoothers against the NumPy reference and numpy.linalg.

`test_methods_horizon` holds them against SciPy, filterpy and gtsam.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_kernels import CHANNELS, S2, assert_same, in_numpy

from coopoc import V2X, Fleet, JointFilter, Knowledge, observe
from coopoc.methods import moving_horizon
from coopoc.methods.fixed_lag import FixedLagSmoother
from coopoc.methods.moving_horizon import MovingHorizon

pytest.importorskip("numba")
FITTED = Knowledge("fitted", S2, (0.3, 0.2, 0.01))
METHODS = [MovingHorizon(1), MovingHorizon(6), MovingHorizon(6, exact=False), MovingHorizon(4, knowledge="identity"),
           MovingHorizon(4, knowledge=FITTED), FixedLagSmoother(0), FixedLagSmoother(3),
           FixedLagSmoother(3, exact=False), FixedLagSmoother(2, knowledge="identity")]  # fmt: skip


def label(method: MovingHorizon | FixedLagSmoother) -> str:
    known = method.knowledge if isinstance(method.knowledge, str) else method.knowledge.name
    length = method.horizon if isinstance(method, MovingHorizon) else method.lag
    return f"{method.name}-{length}-{known}{'' if method.exact else '-linear'}"


@pytest.mark.parametrize("channel", CHANNELS, ids=str)
@pytest.mark.parametrize("method", METHODS, ids=label)
def test_the_horizon_is_the_reference(
    crossing: Fleet, channel: V2X, method: MovingHorizon | FixedLagSmoother, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neighbours join and leave, messages are lost, late and turned away."""
    recording = observe(crossing.between(0, 20), S2, channel, runs=2)
    assert_same(method(recording, [0, 3]), in_numpy(monkeypatch, method, recording, [0, 3]))


@pytest.mark.parametrize("latency", [0.1, 0.5, 1.2])
def test_messages_of_any_age_stand_where_the_reference_has_them(
    formation: Fleet, latency: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Within the horizon, beyond it, and older than a message may be."""
    channel = V2X(max_neighbours=3, latency=latency, loss=0.3, max_age=1.0)
    recording, method = observe(formation.between(0, 30), S2, channel, runs=2, observers=[0]), MovingHorizon(7)
    found, wanted = method(recording, [0]), in_numpy(monkeypatch, method, recording, [0])
    assert ("dropped" in "".join(found.notes)) is (latency > 0.7)
    assert_same(found, wanted)


def test_vehicles_that_appear_and_vanish(monkeypatch: pytest.MonkeyPatch, crossing: Fleet) -> None:
    position, velocity = crossing.position.copy(), crossing.velocity.copy()
    position[:8, 2:5], velocity[:8, 2:5] = np.nan, np.nan
    position[12:15, 4:7], velocity[12:15, 4:7] = np.nan, np.nan
    fleet = replace(crossing, position=position, velocity=velocity).between(0, 24)
    recording = observe(fleet, S2, V2X(max_neighbours=5, latency=0.3), runs=2)
    for method in (MovingHorizon(5), FixedLagSmoother(4)):
        assert_same(method(recording, [0]), in_numpy(monkeypatch, method, recording, [0]))


@pytest.mark.parametrize("make", [MovingHorizon, FixedLagSmoother])
def test_hardly_any_process_noise_loses_no_digits(crossing: Fleet, make: type, monkeypatch: pytest.MonkeyPatch) -> None:
    """What stands still is known to 1e-8 m a step; the linear filter, which filterpy confirms, says the same."""
    recording = observe(crossing.between(0, 20), S2, V2X(max_neighbours=4, loss=0.2), runs=2)
    known = Knowledge.oracle(S2, crossing.between(0, 20))
    wanted = JointFilter(known, exact=False)(recording, [1])
    for exact in (False, True):
        method = make(3, knowledge=known, exact=exact)
        found, plain = method(recording, [1]), in_numpy(monkeypatch, method, recording, [1])
        assert_same(found, plain)
        if not exact:
            assert_same(replace(found, notes=()), wanted)


def test_windows_that_still_move_are_counted(monkeypatch: pytest.MonkeyPatch, crossing: Fleet) -> None:
    monkeypatch.setattr(moving_horizon, "SWEEPS", 0)
    recording, method = observe(crossing.between(0, 20), S2, V2X(max_neighbours=4), runs=2), MovingHorizon(4)
    found = method(recording, [0, 3])
    assert "still moving" in found.notes[0]
    assert_same(found, in_numpy(monkeypatch, method, recording, [0, 3]))


def test_a_step_goes_on_and_comes_back_as_one_system() -> None:
    """numpy.linalg: a star of four goes on to the next step, one leaves; both solved together, the first eliminated."""
    from coopoc.kernels.blocks import width
    from coopoc.kernels.horizon_steps import look_back, loosen_and_keep

    rng, n = np.random.default_rng(3), 12
    root, b, ahead = rng.normal(size=(n, 2 * n)), rng.normal(size=n), rng.normal(size=n)
    information, stiffness = root @ root.T, rng.uniform(0.1, 40.0, n)
    stiffness[3:6] = ahead[3:6] = 0.0
    a = np.zeros((n, width(n)))
    a[:, :n], a[:, n] = np.triu(information), b
    kept, flat = np.zeros(n * (width(n) + 3)), a.ravel()
    loosen_and_keep(flat, n, width(n), stiffness, kept, np.zeros(3 * width(n)))
    motion = np.diag(stiffness)
    inverse = np.linalg.inv(information + motion)
    stays = stiffness > 0
    upper = np.triu(flat.reshape(n, -1)[:, :n])[stays][:, stays]
    left = (motion - motion @ inverse @ motion)[stays][:, stays]
    np.testing.assert_allclose(upper, np.triu(left), atol=1e-10)
    np.testing.assert_allclose(flat.reshape(n, -1)[stays, n], (motion @ inverse @ b)[stays], atol=1e-10)
    z = ahead.copy()
    look_back(kept, n, width(n), stiffness, z)
    np.testing.assert_allclose(z, inverse @ (b + motion @ ahead), atol=1e-10)

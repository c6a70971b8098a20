"""Compiled moving horizons against the dense oracle and numpy.linalg.

`test_methods_horizon` holds them against SciPy, filterpy and gtsam.
"""

from dataclasses import replace

import numpy as np
import pytest
from conftest import textbook
from oracles.moving_horizon import Drive, moving_horizon

from coopoc import V2X, Fleet, JointFilter, NoiseModel, Recording, Sensors, observe
from coopoc.methods import moving_horizon as module
from coopoc.methods.moving_horizon import MovingHorizon
from coopoc.methods.noise_model import resolve
from coopoc.world.inbox import inbox
from coopoc.world.v2x import FIX_AND_VELOCITY

S2 = Sensors.paper_scenario2()
CHANNELS = [
    V2X(max_neighbours=4),
    V2X(max_neighbours=7, loss=0.3, latency=0.2),
    V2X(max_neighbours=3, loss=1.0),
    V2X(max_neighbours=5, bytes_per_second=1000.0),
    V2X(max_neighbours=0),
]
FITTED = NoiseModel("fitted", S2, (0.3, 0.2, 0.01))
METHODS = [
    MovingHorizon(horizon=1),
    MovingHorizon(horizon=6),
    MovingHorizon(horizon=6, exact=False),
    MovingHorizon(horizon=4, noise_model="identity"),
    MovingHorizon(horizon=4, noise_model=FITTED),
]


def label(method: MovingHorizon) -> str:
    known = method.noise_model if isinstance(method.noise_model, str) else method.noise_model.name
    return f"{method.name}-{method.horizon}-{known}{'' if method.exact else '-linear'}"


def assert_is_the_oracle(
    recording: Recording, method: MovingHorizon, ego: int, runs: range, near: float = 1e-7
) -> None:
    known, box = resolve(method.noise_model, recording), inbox(recording, ego, FIX_AND_VELOCITY)
    track, exact = textbook(method)(recording, [ego]), method.exact and known.exact_relative
    assert track.covariance is not None
    assert track.neighbours is not None
    for run in runs:
        drive = Drive(recording, box, known, run, ego)
        x, cov = moving_horizon(drive, method.horizon + 1, exact, module.REPEATS if exact else 0)
        for t, star in enumerate(drive.star):
            assert track.x[run, t, 0] == pytest.approx(x[ego, t], abs=near)
            assert track.covariance[run, t, 0] == pytest.approx(cov[t], abs=1e-7 * cov[t].max())
            for vehicle, link in star.items():
                if link >= 0:
                    assert track.neighbours[run, link] == pytest.approx(x[vehicle, t], abs=10 * near)


@pytest.mark.parametrize("channel", CHANNELS, ids=str)
@pytest.mark.parametrize("method", METHODS, ids=label)
def test_the_horizon_is_the_oracle(crossing: Fleet, channel: V2X, method: MovingHorizon) -> None:
    """Neighbours join and leave, messages are lost, late and rejected."""
    assert_is_the_oracle(observe(crossing.between(0, 12), S2, channel, runs=2), method, 3, range(2))


@pytest.mark.parametrize("latency", [0.1, 0.5, 1.2])
def test_messages_of_any_age_stand_where_the_oracle_has_them(formation: Fleet, latency: float) -> None:
    """Within the horizon, beyond it, and older than a message may be."""
    channel = V2X(max_neighbours=3, latency=latency, loss=0.3, max_age=1.0)
    recording, method = observe(formation.between(0, 24), S2, channel, runs=5, observers=[0]), MovingHorizon(horizon=7)
    assert ("dropped" in "".join(method(recording, [0]).notes)) is (latency > 0.7)
    assert_is_the_oracle(recording, method, 0, range(0, 5, 4), 1e-6)


def test_vehicles_that_appear_and_vanish_and_fixes_that_are_missing(crossing: Fleet) -> None:
    position, velocity = crossing.position.copy(), crossing.velocity.copy()
    position[:4, 2:5], velocity[:4, 2:5] = np.nan, np.nan
    position[8:10, 4:7], velocity[8:10, 4:7] = np.nan, np.nan
    fleet = replace(crossing, position=position, velocity=velocity).between(0, 16)
    recording = observe(fleet, S2, V2X(max_neighbours=5, latency=0.3), runs=3)
    gnss, there = recording.gnss.copy(), np.random.default_rng(1).random(recording.gnss.shape[:3]) < 1 / 3
    there[:, 0] = True
    gnss[~there] = np.nan
    assert_is_the_oracle(replace(recording, gnss=gnss), MovingHorizon(horizon=5), 0, range(3))


def test_a_neighbour_that_is_first_seen_due_north() -> None:
    """It joins where the x of its point and of the ego's are one number."""
    t = 0.1 * np.arange(8)
    position = np.zeros((8, 2, 3)) + np.array([[100.0, 0.0, 0.0], [100.0, 12.0, 0.0]])
    position[:, :, 1] += 5 * t[:, None]
    fleet = Fleet(("ego", "north"), t, position, np.tile([0.0, 5.0, 0.0], (8, 2, 1)))
    seen = observe(fleet, S2, V2X(max_neighbours=1), runs=2)
    assert len(seen.links.of(0))
    gnss, relative = seen.gnss.copy(), seen.relative.copy()
    gnss[:, 0] = position[0]
    relative[:, seen.links.step == 0] = [12.0, np.pi / 2, np.pi / 2]
    relative[:, (seen.links.step == 0) & (seen.links.observer == 1), 1] *= -1
    assert_is_the_oracle(replace(seen, gnss=gnss, relative=relative), MovingHorizon(horizon=3), 0, range(2))


def test_hardly_any_process_noise_loses_no_digits(crossing: Fleet) -> None:
    """What stands still is known to 1e-8 m a step; the linear filter, which filterpy confirms, says the same."""
    recording = observe(crossing.between(0, 20), S2, V2X(max_neighbours=4, loss=0.2), runs=2)
    known = NoiseModel.oracle(S2, crossing.between(0, 20))
    wanted, found = (
        textbook(method)(recording, [1])
        for method in (JointFilter(known, exact=False), MovingHorizon(known, horizon=3, exact=False))
    )
    np.testing.assert_allclose(found.x, wanted.x, atol=1e-8)
    np.testing.assert_allclose(found.covariance, wanted.covariance, atol=1e-8)


def test_windows_that_still_move_are_counted(monkeypatch: pytest.MonkeyPatch, crossing: Fleet) -> None:
    monkeypatch.setattr(module, "REPEATS", 0)
    recording, method = observe(crossing.between(0, 20), S2, V2X(max_neighbours=4), runs=2), MovingHorizon(horizon=4)
    assert "still moving" in method(recording, [0, 3]).notes[0]
    assert_is_the_oracle(recording, method, 0, range(1))

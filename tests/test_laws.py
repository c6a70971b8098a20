"""Laws that hold for any drive: drives, noise, changes of the world and numbers in files are Hypothesis's."""

from dataclasses import replace
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

import coopoc as co
from coopoc.data.fleet_files import read_table, write_table
from coopoc.data.log.motion import Signal, step_means
from coopoc.formats.trajectories import read_tum, write_tum
from coopoc.methods.catalogue import METHODS
from coopoc.world.storage import digest, read_recording, save_recording

hypothesis = pytest.importorskip("hypothesis")
from hypothesis import given, settings  # noqa: E402
from hypothesis import strategies as some  # noqa: E402

FEW = settings(max_examples=12, deadline=None, derandomize=True, database=None)
CAUSAL = some.sampled_from(["kalman", "joint", "split-ci", "mhe"])
NUMBERS = some.floats(-1e6, 1e6)
FOLDER = Path(mkdtemp())


@some.composite
def fleets(draw: Any) -> co.Fleet:
    """Two to four vehicles that turn and climb as they like, 5 to 40 m apart."""
    rng, count = np.random.default_rng(draw(some.integers(0, 2**32))), draw(some.integers(2, 4))
    turn, dt = draw(some.floats(-1.0, 1.0)), draw(some.sampled_from([0.05, 0.1, 0.5]))
    t = dt * np.arange(12)
    course = turn * t[:, None] + rng.uniform(-3, 3, count)
    velocity = 8 * np.stack([np.cos(course), np.sin(course), 0.1 * np.cos(0.3 * course)], axis=-1)
    start = 15 * np.stack([np.arange(count), rng.uniform(-1, 1, count), rng.uniform(-0.2, 0.2, count)], axis=-1)
    names = tuple("abcd"[:count])
    return co.Fleet(names, t, start + np.cumsum(dt * velocity, axis=0), velocity)


@some.composite
def recordings(draw: Any) -> co.Recording:
    """What they measure in two runs, some messages lost or late; noise of velocities alike on all axes."""
    fleet = draw(fleets())
    noise = co.Sensors(gnss_std=(draw(some.floats(0.3, 5.0)),) * 3, velocity_reading="speed", min_range=0.0)
    channel = co.V2X(3, 200.0, loss=draw(some.floats(0.0, 0.5)), latency=draw(some.sampled_from([0.0, 2 * fleet.dt])))
    return co.observe(fleet, noise, channel, runs=2, seed=draw(some.integers(0, 2**32)))


def x(name: str, recording: co.Recording, egos: Any = ("a",)) -> Any:
    return METHODS[name]("nominal")(recording, list(egos)).x


@FEW
@given(recordings(), CAUSAL, some.floats(0, 2e9), some.integers(3, 11))
def test_the_hour_of_the_day_the_future_and_other_runs_change_nothing(
    seen: co.Recording, name: str, since: float, steps: int
) -> None:
    """A drive's beginning, and a run alone, to the last digit; times to what a double keeps of them."""
    whole = x(name, seen)
    np.testing.assert_array_equal(x(name, seen.between(0, steps)), whole[:, :steps])
    np.testing.assert_array_equal(x(name, seen.of_runs(slice(0, 1))), whole[:1])
    assert_allclose(x(name, replace(seen, t=seen.t + since)), whole, atol=1e-3)


@FEW
@given(fleets(), some.sampled_from(["gnss_std", "range_std", "azimuth_std", "velocity_std_ratio"]), some.floats(1, 3))
def test_more_noise_is_never_more_information(fleet: co.Fleet, what: str, factor: float) -> None:
    less = co.Sensors(range_std=0.5, azimuth_std=0.05, inclination_std=0.05, velocity_std_ratio=0.1)
    more = replace(less, **{what: np.multiply(getattr(less, what), factor).tolist()})
    bounds = (co.posterior_bound(fleet, noise, "a", co.V2X(3, 200.0)) for noise in (less, more))
    small, large = (np.linalg.eigvalsh(bound) for bound in bounds)
    assert (large >= small * (1 - 1e-9)).all()


@FEW
@given(some.lists(some.tuples(some.floats(0.01, 1.0), NUMBERS), min_size=3, max_size=12), some.floats(0.05, 0.5))
def test_the_mean_over_a_step_is_that_over_its_halves(samples: list[tuple[float, float]], dt: float) -> None:
    gaps, values = np.array(samples).T
    signal = Signal(np.cumsum(gaps), values[:, None])
    grid = dt * np.arange(9)
    halves = step_means(signal, 0.5 * dt * np.arange(-1, 17))[:, 0]
    assert_allclose(step_means(signal, grid)[:, 0], (halves[::2] + halves[1::2]) / 2, atol=1e-6, rtol=1e-9)


@FEW
@given(recordings(), fleets())
def test_files_hold_what_was_written(seen: co.Recording, fleet: co.Fleet) -> None:
    save_recording(seen, FOLDER / "a.npz")
    assert digest(read_recording(FOLDER / "a.npz")[0]) == digest(seen)
    for file in ("a.csv", "a.parquet"):
        write_table(fleet, FOLDER / file)
        again = read_table(FOLDER / file, any_scale=True)
        assert again.ids == fleet.ids
        assert np.array_equal(again.position, fleet.position)
        assert np.array_equal(again.velocity, fleet.velocity)
    write_tum(FOLDER / "a.tum", fleet.t, fleet.position[:, 0])
    assert_allclose(read_tum(FOLDER / "a.tum").position, fleet.position[:, 0], atol=1e-8)

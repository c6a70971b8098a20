"""Wrong calls of the public functions: each is refused with an error of ours that names the field, or has an answer."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from dataclasses import fields
from typing import Any

import numpy as np
import pytest

import coopoc as co

WRONG: tuple[Any, ...] = (
    None,
    "x",
    "",
    -1,
    0,
    1.5,
    True,
    10**30,
    float("inf"),
    float("nan"),
    [],
    {},
    [1, 2],
    ["a", "b"],
    [None],
    object(),
    b"x",
    np.ones((2, 2)),
    np.full(3, np.nan),
)
"""Values of the wrong kind, size or range; some are right for some fields."""
FEW = (None, "x", -1, 0, 1.5, True, float("nan"), float("inf"), [], np.ones((2, 2)))
METHODS: tuple[Any, ...] = (
    co.GNSS,
    co.Kalman,
    co.AdaptiveKalman,
    co.VariationalKalman,
    co.JointFilter,
    co.LKFSA,
    co.MSMV,
    co.CooperativeMAP,
    co.MovingHorizon,
    co.FixedLagSmoother,
    co.BatchSmoother,
    co.CentralFilter,
    co.CovarianceIntersection,
    co.Diffusion,
    co.GaussianBeliefPropagation,
    co.ConsensusADMM,
)
FLEET = co.load_fleet("town10").between(0, 6).select([0, 1, 2, 3])
SENSORS, CHANNEL = co.Sensors.paper_scenario2(), co.V2X(max_neighbours=3)
RECORDING = co.observe(FLEET, SENSORS, CHANNEL, runs=1, seed=0)
TRACK = co.Kalman("nominal")(RECORDING, [0, 1])


def ours(call: Callable[[], object], what: str) -> None:
    """The call has an answer, or ends in an error of ours."""
    try:
        call()
    except (co.InputError, co.MissingLibraryError):
        pass
    except Exception as error:
        pytest.fail(f"{what}: {type(error).__name__}: {error}")


def swept(make: Callable[..., object], given: dict[str, Any], wrong: tuple[Any, ...] = WRONG) -> None:
    """Each argument once with each wrong value, the others as given."""
    for name in given:
        for value in wrong:
            call = lambda name=name, value=value: make(**{**given, name: value})  # noqa: E731
            ours(call, f"{name}={value!r:.40}")


def init(instance: Any) -> dict[str, Any]:
    """The arguments that a dataclass was made with."""
    return {field.name: getattr(instance, field.name) for field in fields(instance) if field.init}


@pytest.mark.parametrize(
    "noun", [SENSORS, CHANNEL, FLEET, RECORDING, TRACK, RECORDING.links], ids=lambda n: type(n).__name__
)
def test_no_noun_takes_what_it_cannot_hold(noun: Any) -> None:
    swept(type(noun), init(noun))


@pytest.mark.parametrize("method", METHODS, ids=lambda m: m.__name__)
def test_methods_refuse_options_and_recordings_of_the_wrong_kind(method: Any) -> None:
    """What a method accepts when it is made, it can run with."""
    for name in init(method()):
        for value in FEW:
            ours(lambda name=name, value=value: method(**{name: value})(RECORDING, [0]), f"{name}={value!r:.40}")
    for value in WRONG:
        ours(lambda value=value: method()(RECORDING, value), f"egos={value!r:.40}")
    for value in (None, FLEET, "town10", []):
        with pytest.raises(co.InputError, match=r"must be a Recording|recording"):
            method()(value, [0])


def streams() -> Iterator[Any]:
    yield from (co.Kalman("identity"), co.JointFilter("identity"), co.AdaptiveKalman(), co.VariationalKalman())


@pytest.mark.parametrize("method", list(streams()), ids=lambda m: m.name)
def test_a_stream_refuses_what_is_no_measurement(method: Any) -> None:
    swept(method.start, dict.fromkeys(inspect.signature(method.start).parameters))
    given: dict[str, Any] = {"gnss": [0.0, 0.0, 0.0], "velocity": [1.0, 0.0, 0.0], "dt": 0.1, "fix_age": 0.0}
    if isinstance(method, co.JointFilter):
        given["neighbours"] = ()
    swept(lambda **step: method.start().step(**step), given)
    stream = method.start()
    before = stream.step([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], 0.1)[0]
    with pytest.raises(co.InputError, match="velocity"):
        stream.step([0.0, 0.0, 0.0], "fast", 0.1)
    assert np.array_equal(method.start().step([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], 0.1)[0], before)


def test_functions_refuse_arguments_of_the_wrong_kind() -> None:
    swept(co.observe, {"fleet": FLEET, "sensors": SENSORS, "v2x": CHANNEL, "runs": 1, "seed": 0, "observers": [0]})
    swept(FLEET.between, {"start": 0, "stop": 3})
    relative = {
        "id": "b",
        "relative": [9.0, 0.1, 1.57],
        "gnss": [0.0, 0.0, 0.0],
        "velocity": [0.0, 0.0, 0.0],
        "age": 0.0,
    }
    swept(co.RelativeMeasurement, relative)
    for metric in (co.rt_le, co.max_error, co.nees):
        swept(metric, {"track": TRACK, "fleet": FLEET})
    swept(co.posterior_bound, {"fleet": FLEET, "sensors": SENSORS, "ego": 0, "smoothing": False, "information": "star"})
    swept(co.fleet_bound, {"fleet": FLEET, "sensors": SENSORS, "v2x": CHANNEL})
    posed = {"fleet": FLEET, "sensors": co.Sensors(heading_std=0.1), "ego": 0, "v2x": CHANNEL, "information": "star"}
    swept(co.pose_bound, posed)
    swept(co.OwnMeasurement, {"velocity": [9.0, 0.0, 0.0], "yaw_rate": 0.1, "gnss": [0.0, 0.0, 0.0], "heading": 0.1})
    swept(co.BodyMeasurement, {"id": "b", "relative": [9.0, 0.1, 1.57], "age": 0.0})
    swept(co.bound_rt_le, {"cov": np.eye(3)[None]})
    swept(co.paired_difference, {"a": [1.0, 2.0], "b": [2.0, 4.0], "level": 0.95, "resamples": 100, "seed": 0})
    swept(co.channel_load, {"position": np.zeros((2, 3)), "size": [100.0, 100.0], "rate": [1.0, 1.0]})

"""Streams of pose filters give the numbers of their Track, over gaps and landmarks."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from test_pose_filter import NOISE, rough  # noqa: F401

import coopoc as co
from coopoc.methods.poses.pose_inputs import to_landmarks


def own_of(recording: co.Recording, run: int, t: int, column: int) -> co.OwnMeasurement:
    """What a vehicle measured of itself at a step."""
    assert recording.body is not None
    rate, heading = (values[run, t, column] for values in (recording.body.yaw_rate, recording.body.heading))
    return co.OwnMeasurement(recording.velocity[run, t, column], rate, recording.gnss[run, t, column], heading)


@pytest.mark.parametrize("how", [{}, {"lasting": True, "exact": False, "gate": 3.0}])
def test_a_stream_gives_the_numbers_of_its_track(rough: co.Recording, how: Any) -> None:  # noqa: F811
    method, links = co.PoseFilter("solo", assumed=NOISE, **how), rough.links
    track, mine = method(rough, [0]), to_landmarks(rough, rough.links.of(0))
    for run in range(2):
        stream = method.start(rough.dt)
        for t in range(len(rough.t)):
            now = mine[links.step[mine] == t]
            marks = [
                co.LandmarkMeasurement(rough.relative[run, k], rough.gnss[run, t, links.neighbour[k]]) for k in now
            ]
            x, cov = stream.step(own_of(rough, run, t, 0), marks)
            np.testing.assert_array_equal(x[:3], track.x[run, t, 0])
            np.testing.assert_array_equal(x[3], track.heading[run, t, 0])  # type: ignore[index]
            np.testing.assert_array_equal(cov[:3, :3], track.covariance[run, t, 0])  # type: ignore[index]
            np.testing.assert_array_equal(cov[3, :4], track.heading_covariance[run, t, 0])  # type: ignore[index]


def test_a_known_start_needs_no_compass() -> None:
    sensors = co.Sensors(heading_std=0.05)
    method = co.PoseFilter("solo", assumed=sensors)
    still = co.OwnMeasurement([1.0, 0.0, 0.0], 0.0)
    stream = method.start(0.1, [1.0, 2.0, 0.0, 0.5])
    assert stream.step(still).x == pytest.approx([1.0, 2.0, 0.0, 0.5])
    assert stream.step(still).x[:2] == pytest.approx([1 + 0.1 * np.cos(0.5), 2 + 0.1 * np.sin(0.5)])


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: co.PoseFilter("fleet", assumed=NOISE).start(0.1), "has no stream"),
        (lambda: co.PoseFilter("solo").start(0.1), "assumed"),
        (lambda: co.PoseFilter("solo", assumed=NOISE).start(0.0), "dt"),
        (lambda: co.PoseFilter("solo", assumed=NOISE).start(0.1, np.zeros(3)), "begin"),
        (lambda: co.PoseFilter("solo", assumed=NOISE).start(0.1).step(co.OwnMeasurement([1, 0, 0], 0.0)), "begin"),
        (lambda: co.LandmarkMeasurement([9.0, 0], [0.0, 0, 0]), "relative"),
        (lambda: co.LandmarkMeasurement([9.0, 0, 1.5], [0.0, np.nan, 0]), "place"),
        (lambda: co.OwnMeasurement([1.0, 0], 0.0), "velocity"),
        (lambda: co.OwnMeasurement([1.0, 0, 0], np.nan), "yaw_rate"),
    ],
)
def test_mistakes_are_named(make: Any, words: str) -> None:
    with pytest.raises(co.InputError, match=words):
        make()

"""Streams of pose filters give the numbers of their Track, over gaps, losses, delays, landmarks and newcomers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from test_pose_filter import NOISE, rough  # noqa: F401
from test_pose_methods import WHITE, convoy

import coopoc as co
from coopoc.methods.pose_stream import PoseStream


def own_of(recording: co.Recording, run: int, t: int, column: int) -> co.OwnMeasurement:
    """What a vehicle measured of itself at a step."""
    assert recording.body is not None
    rate, heading = (values[run, t, column] for values in (recording.body.yaw_rate, recording.body.heading))
    return co.OwnMeasurement(recording.velocity[run, t, column], rate, recording.gnss[run, t, column], heading)


def fed(recording: co.Recording, stream: PoseStream, run: int, star: bool) -> tuple[Any, Any]:
    """States and covariances of vehicle 0, whose stream gets every message at the step at which it arrives."""
    links, marks = recording.links, recording.landmarks
    mine, found = links.of(0), []
    mine = mine if star else mine[np.isin(links.neighbour[mine], marks)]
    for t in range(len(recording.t)):
        at = {int(links.neighbour[k]): k for k in mine[links.step[mine] == t]}
        came = {int(links.neighbour[k]): int(links.step[k]) for k in mine if recording.arrival[run, k] == t}
        seen = []
        for n in [*at, *(n for n in came if n not in at)]:
            sent = own_of(recording, run, came[n], n) if n in came else None
            place = recording.gnss[run, t, n] if n in marks else None
            relative = recording.relative[run, at[n]] if n in at else None
            age = 0.1 * (t - came[n]) if n in came else 0.0
            seen.append(co.BodyMeasurement(recording.ids[n], relative, sent, age, place))
        found.append(stream.step(own_of(recording, run, t, 0), seen))
    return np.array([one.x for one in found]), np.array([one.covariance for one in found])


@pytest.mark.parametrize(
    ("unit", "how"),
    [
        ("solo", {}),
        ("solo", {"lasting": True}),
        ("solo", {"exact": False, "invariant": True}),
        ("star", {}),
        ("star", {"lasting": True, "exact": False, "gate": 3.0}),
    ],
)
def test_a_stream_gives_the_numbers_of_its_track(rough: co.Recording, unit: Any, how: Any) -> None:  # noqa: F811
    method = co.PoseFilter(unit, assumed=NOISE, **how)
    track = method(rough, [0])
    for run in range(2):
        x, cov = fed(rough, method.start(rough.dt, max_age=rough.v2x.max_age), run, unit == "star")
        np.testing.assert_array_equal(x[:, :3], track.x[run, :, 0])
        np.testing.assert_array_equal(x[:, 3], track.heading[run, :, 0])  # type: ignore[index]
        np.testing.assert_array_equal(cov[:, :3, :3], track.covariance[run, :, 0])  # type: ignore[index]
        np.testing.assert_array_equal(cov[:, 3, :4], track.heading_covariance[run, :, 0])  # type: ignore[index]


def test_a_star_may_grow() -> None:
    """Nine neighbours join a star that began with two: still the Track's numbers."""
    fleet = convoy(10, 30)
    sensors = WHITE
    seen = co.observe(fleet, sensors, co.V2X(9, 100.0), frame="body", observers=[0])
    assert len(seen.links) == 9 * 30
    kept = (seen.links.step > 10) | (np.arange(len(seen.links)) % 9 < 2)
    links = co.Links(seen.links.step[kept], seen.links.observer[kept], seen.links.neighbour[kept])
    from dataclasses import replace

    fewer = replace(seen, links=links, relative=seen.relative[:, kept], arrival=seen.arrival[:, kept])
    method = co.PoseFilter("star", assumed=sensors)
    track, (x, _) = method(fewer, [0]), fed(fewer, method.start(0.1), 0, True)
    np.testing.assert_array_equal(x[:, :3], track.x[0, :, 0])


def test_a_known_start_needs_no_compass() -> None:
    sensors = co.Sensors(heading_std=0.05)
    method = co.PoseFilter("solo", assumed=sensors)
    still = co.OwnMeasurement([1.0, 0.0, 0.0], 0.0)
    stream = method.start(0.1, [1.0, 2.0, 0.0, 0.5])
    assert stream.step(still).x == pytest.approx([1.0, 2.0, 0.0, 0.5])
    assert stream.step(still).x[:2] == pytest.approx([1 + 0.1 * np.cos(0.5), 2 + 0.1 * np.sin(0.5)])


def refused(seen: Any) -> Any:
    own = co.OwnMeasurement([1.0, 0, 0], 0.0, [0.0, 0, 0], 0.1)
    return co.PoseFilter("solo", assumed=NOISE).start(0.1).step(own, seen)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: co.PoseFilter("fleet", assumed=NOISE).start(0.1), "has no stream"),
        (lambda: co.PoseFilter("star").start(0.1), "assumed"),
        (lambda: co.PoseFilter("star", assumed=NOISE).start(0.0), "dt"),
        (lambda: co.PoseFilter("star", assumed=NOISE).start(0.1, np.zeros(3)), "begin"),
        (lambda: co.PoseFilter("solo", assumed=NOISE).start(0.1).step(co.OwnMeasurement([1, 0, 0], 0.0)), "begin"),
        (lambda: refused([co.BodyMeasurement("b", [9.0, 0, 1.5])]), "landmarks"),
        (lambda: refused([co.BodyMeasurement("m", [9.0, 0, 1.5], place=[9.0, 0, 0])] * 2), "once each"),
        (lambda: co.BodyMeasurement("m", [9.0, 0]), "relative"),
        (lambda: co.BodyMeasurement("m", None, place=[9.0, 0, 0]), "landmark"),
        (lambda: co.OwnMeasurement([1.0, 0], 0.0), "velocity"),
        (lambda: co.OwnMeasurement([1.0, 0, 0], np.nan), "yaw_rate"),
    ],
)
def test_mistakes_are_named(make: Any, words: str) -> None:
    with pytest.raises(co.InputError, match=words):
        make()

"""The cooperative gain as streams that send each other their messages, against the Track of the whole recording."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from test_learned_cooperative import NOISE, net

from coopoc import V2X, Fleet, InputError, Recording, RelativeMeasurement, observe
from coopoc.arrays import Floats
from coopoc.learned import CooperativeGain
from coopoc.learned.nets.cooperative import SUMS, SumsMeasurement
from coopoc.learned.nets.noise_net import NoiseFilter, estimate_noise
from coopoc.learned.nets.noise_step import new_memory, noise_step, packed
from coopoc.learned.nets.sums_stream import SENT, SumsStream
from coopoc.methods.noise_model import NoiseModel
from coopoc.world.inbox import inbox
from coopoc.world.links import Links

CHANNELS = {
    "ideal": V2X(max_neighbours=4, radius=25.0),
    "lossy": V2X(max_neighbours=4, radius=25.0, loss=0.5, burst=3.0),
    "rare": V2X(max_neighbours=4, radius=25.0, rate=2.0),
    "silent": V2X(max_neighbours=4, radius=25.0, loss=1.0),
}


def holed(recording: Recording, share: float = 0.2) -> Recording:
    """The recording with a share of its relative measurements and of its fixes, but the first, left out."""
    draw = np.random.default_rng(8)
    kept = draw.uniform(size=len(recording.links)) > share
    gone = draw.uniform(size=recording.gnss.shape[:3]) < share
    gone[:, 0] = False
    links = Links(*(part[kept] for part in (recording.links.step, recording.links.observer, recording.links.neighbour)))
    gnss = np.where(gone[..., None], np.nan, recording.gnss)
    parts = {"relative": recording.relative[:, kept], "arrival": recording.arrival[:, kept]}
    return replace(recording, links=links, gnss=gnss, **parts)


def drive(recording: Recording, streams: list[SumsStream], run: int, ego: int) -> tuple[Floats, Floats, list[Floats]]:
    """Estimates (T, 3), covariances (T, 3, 3) and neighbours of an ego; every vehicle runs a stream, those that the ego
    measures send it their message if it arrives."""
    found, box = [], inbox(recording, ego, SUMS)
    for t in range(len(recording.t)):
        own = [recording.gnss[run, t], recording.velocity[run, t]]
        for k, stream in enumerate(streams):
            if k != ego:
                stream.step(own[0][k], own[1][k], recording.dt)
        seen = []
        for i in range(box.start[t], box.start[t + 1]):
            j = recording.links.neighbour[box.link[i]]
            message = streams[j].message if box.fresh[run, i] else None
            seen.append(SumsMeasurement(recording.ids[j], recording.relative[run, box.link[i]], message))
        x, cov = streams[ego].step(own[0][ego], own[1][ego], recording.dt, seen)
        there = streams[ego].neighbours
        assert list(there) == [one.id for one in seen]
        found.append((x, cov, list(there.values())))
    return (
        np.stack([x for x, _, _ in found]),
        np.stack([np.asarray(cov) for _, cov, _ in found]),
        [x for _, _, near in found for x in near],
    )


@pytest.mark.parametrize("channel", CHANNELS)
@pytest.mark.parametrize("ego", [0, 4])
def test_streams_that_send_each_other_their_sums_are_the_track(channel: str, ego: int, crossing: Fleet) -> None:
    """Neighbours come and go, a fifth of fixes and measurements fails, messages are lost."""
    recording = holed(observe(crossing, NOISE, CHANNELS[channel], runs=2, seed=3))
    assert len(set(recording.neighbours(ego).tolist())) > 2
    method = CooperativeGain(net())
    track = method(recording, [ego])
    x, cov, near = drive(recording, [method.start(recording.sensors) for _ in recording.ids], 1, ego)
    np.testing.assert_allclose(x, track.x[1, :, 0], atol=1e-9)
    np.testing.assert_allclose(cov, track.covariance[1, :, 0], atol=1e-9)  # type: ignore[index]
    np.testing.assert_allclose(near, track.neighbours[1], atol=1e-9)  # type: ignore[index]


def test_with_given_noise_it_is_the_track_too(crossing: Fleet) -> None:
    recording = holed(observe(crossing, NOISE, CHANNELS["lossy"], runs=2, seed=5))
    for known in (NoiseModel.nominal(NOISE), NoiseModel.nominal(replace(NOISE, velocity_reading="speed"))):
        method = CooperativeGain(known)
        x, _, _ = drive(recording, [method.start() for _ in recording.ids], 0, 2)
        np.testing.assert_allclose(x, method(recording, [2]).x[0, :, 0], atol=1e-9)


def test_noise_step_by_step_is_that_of_the_drive(crossing: Fleet) -> None:
    """The net in torch over a drive whose fixes are mostly missing."""
    recording = holed(observe(crossing, NOISE, V2X(max_neighbours=0), seed=1), 0.7)
    model, memory, out = net(1), new_memory(), np.empty(6)
    fix, process = estimate_noise(model, recording, [3])
    weights = packed({name: value.detach().double().numpy() for name, value in model.named_parameters()})
    for t in range(len(recording.t)):
        given = [*recording.gnss[0, t, 3], *recording.velocity[0, t, 3], recording.dt]
        noise_step(weights, memory, np.array(given), out)
        np.testing.assert_allclose(out, [*fix[0, t, 3], *process[0, t, 3]], rtol=1e-9)


def test_alone_and_with_constant_noise_it_is_filterpys() -> None:
    """With steps of changing length, before which no fix was known."""
    known = NoiseModel.fitted(*steady())
    stream, draw = CooperativeGain(known).start(), np.random.default_rng(4)
    x, cov = stream.step(None, [5.0, 1.0, 0.0], 0.1)
    assert cov is None
    assert np.isnan(x).all()
    theirs = KalmanFilter(dim_x=3, dim_z=3, dim_u=3)
    theirs.P, theirs.R, theirs.H = 1e6 * np.eye(3), np.diag(known.gnss_variance), np.eye(3)
    for t in range(30):
        z, u, dt = draw.normal(0, 3, 3), draw.normal(0, 8, 3), draw.uniform(0.05, 0.2)
        if t:
            theirs.B = dt * np.eye(3)
            theirs.predict(u=u, Q=np.diag(np.square(known.process_std)))
        else:
            theirs.x = z.copy()
        theirs.update(z)
        x, cov = stream.step(z, u, dt)
        np.testing.assert_allclose(x, theirs.x, atol=1e-7)
        np.testing.assert_allclose(cov, theirs.P, rtol=1e-7, atol=1e-9)


def steady() -> tuple[Recording, Fleet]:
    t = np.arange(50) / 10
    fleet = Fleet(("a",), t, np.full((50, 1, 3), t[:, None, None]), np.ones((50, 1, 3)))
    return observe(fleet, NOISE, V2X(max_neighbours=0)), fleet


def test_alone_it_is_the_noise_filter(crossing: Fleet) -> None:
    recording = holed(observe(crossing, NOISE, V2X(max_neighbours=0)))
    track, stream = NoiseFilter(net())(recording, [3]), CooperativeGain(net()).start()
    for t in range(len(recording.t)):
        x, _ = stream.step(recording.gnss[0, t, 3], recording.velocity[0, t, 3], recording.dt)
        np.testing.assert_allclose(x, track.x[0, t, 0], atol=1e-9)


def test_more_vehicles_than_there_was_room_for() -> None:
    """Forty neighbours, of which a star holds nine and then forty: as if there had been room from the first step."""
    draw = np.random.default_rng(2)
    small, large = (CooperativeGain(net()).start() for _ in range(2))
    large._reserve(64, 64)
    senders = {f"n{k}": CooperativeGain(net()).start() for k in range(40)}
    for t in range(6):
        place = {name: np.array([8.0 + k, 3.0 * k - 60.0, 0.5]) for k, name in enumerate(senders)}
        seen = []
        for name, stream in list(senders.items())[7 * t % 30 :][: 9 if t < 4 else 40]:
            stream.step(place[name] + draw.normal(0, 1, 3), [0.1, 0.0, 0.0], 0.1)
            x, y, z = place[name]
            flat = np.hypot(x, y)
            angles = np.arctan2(y, x), np.arctan2(flat, z)
            seen.append(SumsMeasurement(name, [np.hypot(flat, z), *angles], stream.message))
        z = draw.normal(0, 1, 3)
        found = [stream.step(z, [0.1, 0.0, 0.0], 0.1, seen) for stream in (small, large)]
        np.testing.assert_array_equal(found[0][0], found[1][0])
        np.testing.assert_array_equal(found[0][1], found[1][1])


def test_what_a_stream_cannot_take_is_refused_and_changes_nothing(crossing: Fleet) -> None:
    stream, other = (CooperativeGain(net()).start() for _ in range(2))
    _ = stream.step([0.0, 0.0, 0.0], [9.0, 0.0, 0.0], 0.1), other.step([9.0, 0.0, 0.0], [9.0, 0.0, 0.0], 0.1)
    before, seen = stream.message, SumsMeasurement("b", [9.0, 0.0, 1.57], other.message)
    wrong = (
        ("velocity", ([0.0] * 3, [np.nan, 0.0, 0.0], 0.1)),
        ("gnss", ([0.0, np.nan, 0.0], [9.0, 0.0, 0.0], 0.1)),
        ("dt", ([0.0] * 3, [9.0, 0.0, 0.0], 0.0)),
        ("neighbours", ([0.0] * 3, [9.0, 0.0, 0.0], 0.1, [seen, seen])),
    )
    for field, given in wrong:
        with pytest.raises(InputError, match=field):
            stream.step(*given)  # type: ignore[arg-type]
    np.testing.assert_array_equal(stream.message, before)
    assert len(before) == SENT
    with pytest.raises(InputError, match="must be 15 finite numbers"):
        SumsMeasurement("b", [9.0, 0.0, 1.57], before[:12])
    with pytest.raises(InputError, match="relative"):
        SumsMeasurement("b", [-9.0, 0.0, 1.57])
    with pytest.raises(InputError, match="sums = False: must be True for a stream"):
        CooperativeGain(net(), sums=False).start()
    with pytest.raises(InputError, match=r"sensors = .*those of the NoiseModel"):
        CooperativeGain(NoiseModel.nominal(NOISE)).start(NOISE)


@pytest.mark.parametrize("wrong", [None, [1], ["b"], [RelativeMeasurement("b", [9.0, 0.1, 1.57])]])
def test_what_is_no_measurement_with_sums_is_refused(wrong: Any) -> None:
    stream = CooperativeGain(net()).start(NOISE)
    with pytest.raises(InputError, match="must hold SumsMeasurements"):
        stream.step([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], 0.1, neighbours=wrong)

"""The world: fleets that cannot be used, noise keys, links, messages."""

import re
import zlib
from dataclasses import replace

import numpy as np
import pytest
from conftest import among, refused, standing
from numpy import arange, array, array_equal, nan, pi
from numpy.random import Generator, Philox, SeedSequence, default_rng
from scipy import stats
from test_methods import SILENT

from coopoc import (
    V2X,
    Body,
    Fleet,
    InputError,
    JointFilter,
    Kalman,
    OwnMeasurement,
    PoseFilter,
    Sensors,
    load_fleet,
    observe,
)
from coopoc.world.channels import lost
from coopoc.world.inbox import inbox
from coopoc.world.links import to_vector, vector_cov
from coopoc.world.sensors import stream
from coopoc.world.v2x import FIX_AND_VELOCITY

S2 = Sensors.paper_scenario2()


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"t": [0.0, 0.1, 0.1]}, "t[2]"),
        ({"t": [0.0, 0.1, 0.201]}, "t"),
        ({"ids": ("a", "a")}, "ids"),
        ({"position": np.zeros((3, 1, 3))}, "position"),
        ({"position": np.full((3, 2, 3), nan)}, "position/velocity"),
        ({"position": np.full((3, 2, 3), np.inf)}, "position/velocity"),
    ],
)
def test_unusable_fleet_names_the_field(change, field):
    with pytest.raises(InputError) as error:
        replace(Fleet(("a", "b"), [0.0, 0.1, 0.2], *np.zeros((2, 3, 2, 3))), **change)
    assert error.value.field == field
    assert error.value.hint


def test_unknown_vehicle_lists_the_known(crossing):
    with refused("c0, c1"):
        crossing.select(["nobody"])
    with refused(r"0\.\.7"):
        crossing.index(8)


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda: V2X(max_neighbours=-1), "max_neighbours = -1"),
        (lambda: V2X(burst=0.5), "burst"),
        (lambda: Sensors(gnss_std=3.5), "gnss_std = 3.5: must be 3 numbers"),  # type: ignore[arg-type]
        (lambda: Sensors(gnss_bias=(1.0, 0.5)), "low <= high"),
        (lambda: Sensors(azimuth_std=4.0), "0..pi rad"),
        (lambda: Sensors(gnss_bias_mode="daily"), "gnss_bias_mode"),
        (lambda: Sensors(velocity_std_ratio=float("nan")), "velocity_std_ratio"),
        (lambda: Sensors(velocity_std_ratio=15), "velocity_std_ratio = 15: must be in .0, 1., 0.15 for 15 %"),
        (lambda: PoseFilter("solo", assumed=S2).start(0.1, array([0, 0, 0, 90.0])), "begin.0. = 90"),
    ],
)
def test_bad_configuration_is_named(build, words):
    with refused(words):
        build()


def test_float32_is_refused_and_unwrapped_headings_are_not():
    """Two vehicles that circle for nearly five turns; degrees are refused with all other mistakes (test_misuse)."""
    t = arange(300) / 10
    turn = np.c_[t, -t]
    circles = np.stack([9 * np.sin(turn), -9 * np.cos(turn), 0 * turn], axis=2)
    fleet = Fleet(("a", "b"), t, circles, np.gradient(circles, 0.1, axis=0), heading=turn + array([0, pi]))
    with refused(r"position.*float32, which are 0.5 m apart.*Subtract a local origin"):
        replace(fleet, position=(circles + array([5e5, 5.8e6, 0])).astype(np.float32))
    late = observe(fleet, S2, V2X(2), frame="body").between(200, 300)
    body = late.body
    unwrapped = replace(late, body=Body(body.yaw_rate, np.unwrap(body.heading, axis=1) + 12 * pi))
    assert not late.unlikely + unwrapped.unlikely
    stream = PoseFilter("solo", assumed=S2).start(0.1)
    for heading, fix in zip(t.tolist(), circles[:, 0], strict=True):
        stream.step(OwnMeasurement([9.0, 0.0, 0.0], 1.0, fix, heading))


def test_what_is_unlikely_stands_in_the_notes_of_recording_and_track():
    town = load_fleet("town10").between(0, 600)
    world, body = (observe(town, S2, V2X(2), frame=frame, observers=[8]) for frame in ("world", "body"))
    for right in (world, body, observe(town, replace(S2, heading_std=0.1, yaw_rate_bias_std=0.02), frame="body")):
        assert not right.unlikely
    own = body.body
    motions = r"contradict each other in \d+ % of the drive: velocities are in m/s"
    wrong = [
        (motions, replace(world, velocity=3.6 * world.velocity)),
        (motions, replace(world, velocity=world.velocity * [1, -1, 1])),
        (motions, replace(body, body=Body(own.yaw_rate, pi / 2 - own.heading))),
        (motions, replace(body, body=Body(np.clip(np.rad2deg(own.yaw_rate), -35, 35), own.heading))),
        (motions, replace(body, velocity=3.6 * body.velocity, body=Body(own.yaw_rate, nan * own.heading))),
        ("azimuth_std is 2 rad, which is 115°", replace(world, sensors=replace(S2, azimuth_std=2.0))),
    ]
    for note, recording in wrong:
        (doubt,) = recording.unlikely
        assert re.search(note, doubt)
        method = JointFilter() if recording.body is None else PoseFilter("solo", begin=np.zeros((60, 4)))
        assert {*recording.notes} & {*method(recording, [8]).notes} == {doubt}
    knots = np.where(arange(60)[:, None] == 3, 1.94, 1.0)
    (note,) = observe(replace(town, velocity=knots * town.velocity), S2, V2X(2), observers=[8]).notes
    assert f"velocities of ['{town.ids[3]}'] contradict positions" in note
    mended = replace(recording, sensors=S2)
    assert not (*mended.notes, *Kalman()(mended, [8]).notes)


def test_zero_noise_may_act_but_not_be_assumed(crossing):
    with refused(r"gnss_std.*assumed=Sensors"):
        observe(crossing, SILENT)
    assert array_equal(observe(crossing, SILENT, assumed=S2).gnss[0], crossing.position)


def test_draws_belong_to_their_key(crossing):
    """30 runs are a prefix of 100, K = 2 a part of K = 6, a smaller fleet keeps its draws."""
    few = observe(crossing, S2, V2X(max_neighbours=2), runs=3, seed=5)
    many = observe(crossing, S2, V2X(max_neighbours=6), runs=5, seed=5)
    assert array_equal(few.gnss, many.gnss[:3])
    same = among(many.links, few.links)
    assert array_equal(few.relative, many.relative[:3, same])
    poor = V2X(max_neighbours=6, loss=0.3, burst=3.0, rate=4.0, latency=0.1)
    lossy, fewer = (observe(crossing, S2, replace(poor, max_neighbours=k), runs=r, seed=5) for k, r in ((6, 5), (2, 3)))
    assert array_equal(fewer.arrival, lossy.arrival[:3, same])
    assert array_equal(observe(crossing.select(["c3", "c1"]), S2, runs=3, seed=5).gnss[:, :, 0], few.gnss[:, :, 3])
    assert not array_equal(observe(crossing, S2, runs=3, seed=6).gnss, few.gnss)


def test_noise_has_the_stated_moments():
    """Independent check: SciPy's Kolmogorov-Smirnov test against the normal and uniform distributions."""
    apart = np.broadcast_to(array([[0.0, 0, 0], [20, 0, 0]]), (400, 2, 3))
    fleet = Fleet(("a", "b"), arange(400) * 0.1, apart, np.full((400, 2, 3), 8.0))
    sensors = replace(Sensors.paper_scenario1(), gnss_bias=(0.0, 0.0))
    recording = observe(fleet, sensors, V2X(max_neighbours=1), runs=20)
    for draws, std in (
        (recording.gnss - fleet.position, 1.8),
        (recording.velocity - fleet.velocity, 1.2),
        (recording.relative[..., 0] - 20.0, 1.0),
        (recording.relative[:, recording.links.observer == 0, 1], np.deg2rad(4)),
    ):
        assert stats.kstest(draws.ravel() / std, "norm").pvalue > 0.01
    biased = observe(fleet, Sensors.paper_scenario1(), runs=200).gnss - observe(fleet, sensors, runs=200).gnss
    assert np.ptp(biased, axis=1).max() < 1e-9
    assert stats.kstest(biased[:, 0].ravel(), "uniform", args=(0.5, 0.5)).pvalue > 0.01
    sampled = observe(fleet, replace(Sensors.paper_scenario1(), gnss_bias_mode="sample"), runs=2)
    assert np.ptp(sampled.gnss - observe(fleet, sensors, runs=2).gnss, axis=1).min() > 0.4


def test_velocity_readings():
    velocity = array([3.0, 4.0, 0.0])
    assert Sensors(velocity_reading="axis").velocity_std(velocity) == pytest.approx([0.3, 0.4, 0.0])
    assert Sensors(velocity_reading="speed").velocity_std(velocity) == pytest.approx([0.5, 0.5, 0.5])
    assert Sensors().motion_std(velocity[None, None, None], 0.1)[0, 0, 0, 2] == pytest.approx(0.005)


def test_vector_cov_against_sampling():
    """Independent check: the sample covariance of converted draws (small angles, so that first order holds)."""
    relative, std = array([25.0, 0.7, 1.3]), array([0.3, 0.01, 0.02])
    draws = to_vector(relative + default_rng(1).standard_normal((200_000, 3)) * std)
    assert vector_cov(relative, std) == pytest.approx(np.cov(draws.T), abs=2e-3)


def test_gilbert_elliott_share_and_burst():
    """Closed form: stationary loss and mean run length of the two-state chain."""
    bad = lost(default_rng(0).uniform(size=(40, 20_000)), loss=0.1, burst=5.0)
    starts = (bad[:, 1:] & ~bad[:, :-1]).sum()
    assert bad.mean() == pytest.approx(0.1, rel=0.03)
    assert bad.sum() / starts == pytest.approx(5.0, rel=0.03)


def test_loss_delay_and_rate_act_on_messages(formation):
    fleet = formation.between(0, 200)

    def box_of(**channel):
        return inbox(observe(fleet, S2, V2X(4, **channel), runs=6, observers=[0]), 0, FIX_AND_VELOCITY)  # type: ignore[arg-type]

    box, lossy, late, slow = box_of(), box_of(loss=0.3), box_of(latency=0.25), box_of(rate=2.0)
    assert box.fresh.all()
    assert (box.received_bytes == 200 * 4 * 32).all()
    assert box.sent_bytes == 200 * 32
    assert lossy.received_bytes.mean() == pytest.approx(0.7 * 200 * 4 * 32, rel=0.05)
    assert np.ptp(lossy.received_bytes) > 0
    at = np.repeat(arange(200), np.diff(late.start))
    assert (late.newest[0, at >= 3] == at[at >= 3] - 3).all()
    assert (late.newest[0, at < 3] == -1).all()
    assert slow.received_bytes[0] == pytest.approx(200 * 4 * 32 / 5, rel=0.05)
    assert slow.fresh.mean() == pytest.approx(0.2, abs=0.02)


def test_recording_holds_no_truth(crossing):
    """No array of the recording holds a true position or velocity, and no field leads to the fleet."""
    recording = observe(crossing, S2, V2X(max_neighbours=3), runs=2)
    truths = (crossing.position, crossing.velocity)
    for name in recording.__dataclass_fields__:
        value = getattr(recording, name)
        assert not isinstance(value, Fleet)
        if isinstance(value, np.ndarray) and value.shape[-3:] == crossing.position.shape:
            assert not any(np.isclose(value, truth, atol=1e-6).all(-1).any() for truth in truths), name


def test_unknown_and_unrecorded_egos(crossing):
    recording = observe(crossing, S2, V2X(loss=0.5), observers=[1, 2])
    with refused("observers"):
        recording.columns([0])
    with refused("egos"):
        recording.columns(["ghost"])
    assert recording.columns(["c2", 1]) == [2, 1]
    assert array_equal(recording.between(0, 999).arrival, recording.arrival)


@pytest.mark.parametrize(("seed", "run"), [(0, 0), (7, 99), (2**32 - 1, 3), (2**32, 2)])
def test_a_stream_is_that_of_its_key(seed, run):
    """Against NumPy's own way from a tuple of numbers."""
    key = (seed, run, *(zlib.crc32(word.encode()) for word in ("gnss", "a", "b")))
    assert stream(seed, "gnss", run, "a", "b").normal() == Generator(Philox(SeedSequence(key))).normal()


def test_a_message_is_held_until_it_is_too_old():
    """By the definition, link by link: the newest message of the sender that has arrived, unless older than max_age."""
    fleet = standing([[0, 0, 0], [9, 0, 0], [0, 9, 0]], 40)
    recording = observe(fleet, Sensors(), V2X(2, loss=0.6, latency=0.2, max_age=0.5), runs=3, seed=1, observers=[0])
    held, links = inbox(recording, 0, FIX_AND_VELOCITY), recording.links
    forgotten = 0
    for run in range(3):
        for k, link in enumerate(held.link.tolist()):
            step, sender = int(links.step[link]), int(links.neighbour[link])
            same = (links.neighbour == sender) & (recording.arrival[run] >= 0) & (recording.arrival[run] <= step)
            newest = links.step[same & (links.step <= step)].max(initial=-1)
            too_old = newest >= 0 and step - newest > 5
            forgotten += too_old
            assert held.newest[run, k] == (-1 if too_old else newest)
    assert forgotten > 3


def test_a_range_that_would_be_negative_is_reflected():
    """|d + n| at 3 m with a noise of 10 m: never negative, and its mean is that of a folded normal (SciPy)."""
    seen = observe(
        standing([[0, 0, 0], [3, 0, 0]], 2000), Sensors(range_std=10.0), V2X(1), runs=5, seed=2, observers=[0]
    )
    assert (seen.relative[..., 0] >= 0).all()
    assert seen.relative[..., 0].mean() == pytest.approx(stats.foldnorm(0.3, scale=10.0).mean(), rel=0.03)

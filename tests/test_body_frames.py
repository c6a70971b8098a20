"""Recordings in body frames: turned by the compass they are those of the world, draw by draw."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import refused, with_masts
from numpy import array_equal

import coopoc as co
from coopoc.world.body_frames import body_motion, in_world, true_heading
from coopoc.world.storage import read_recording, save_recording

NOISE = co.Sensors(heading_std=0.02, heading_bias_std=0.03, velocity_reading="speed")


@pytest.fixture
def body(crossing):
    return co.observe(crossing, NOISE, co.V2X(max_neighbours=3), runs=3, frame="body")


def test_turned_by_the_compass_the_draws_are_those_of_the_world(crossing, body):
    """Closed form: a bearing plus the compass is the azimuth, with the same errors; fixes and ranges are equal."""
    world = co.observe(crossing, NOISE, co.V2X(max_neighbours=3), runs=3)
    again = in_world(body)
    assert array_equal(again.gnss, world.gnss)
    assert array_equal(again.relative[..., [0, 2]], world.relative[..., [0, 2]])
    assert abs(np.angle(np.exp(1j * (again.relative[..., 1] - world.relative[..., 1])))).max() < 1e-12


def test_exact_sensors_give_the_true_motion_back(crossing):
    exact = co.Sensors(velocity_std_ratio=0.0, yaw_rate_std=0.0)
    seen = co.observe(crossing, exact, frame="body")
    assert np.allclose(in_world(seen).velocity[0, 1:], crossing.velocity[1:], atol=1e-12)
    heading = true_heading(crossing)
    wrapped = co.observe(
        replace(crossing, heading=np.angle(-np.exp(1j * (heading - heading[30])))), exact, frame="body"
    )
    for body in (seen.body, wrapped.body):  # a heading that leaps by a turn was a yaw rate of 63 rad/s
        assert np.allclose(np.diff(heading, axis=0), crossing.dt * body.yaw_rate[0, 1:], atol=1e-12)


def test_lasting_errors_of_odometry_have_their_spread_and_change_no_other_draws(crossing):
    plain, biased = (
        co.observe(crossing, co.Sensors(**more), runs=400, frame="body")
        for more in ({}, {"yaw_rate_bias_std": 0.05, "speed_scale_std": 0.1})
    )
    assert array_equal(plain.gnss, biased.gnss)
    assert array_equal(plain.body.heading, biased.body.heading)
    bias = biased.body.yaw_rate - plain.body.yaw_rate
    assert np.ptp(bias, axis=1).max() < 1e-2  # one for a whole run
    assert bias[:, 0].std() == pytest.approx(0.05, rel=0.1)
    motion, _ = body_motion(crossing)
    scale = (biased.velocity - plain.velocity)[:, 5, :, 0] / motion[5, :, 0]
    assert scale.std() == pytest.approx(0.1, rel=0.1)


def test_landmarks_are_measured_beside_the_neighbours_and_stand_exactly(crossing):
    v2x = co.V2X(max_neighbours=2, radius=40.0)
    alone, seen = (
        co.observe(one, co.Sensors(), v2x, landmarks=marks)
        for one, marks in ((crossing, ()), (with_masts(crossing, [[5.0] * 3]), ["m0"]))
    )
    assert (seen.gnss[:, :, 8] == 5.0).all()
    of_mast = seen.links.neighbour == 8
    assert of_mast.any()
    assert not (seen.links.observer == 8).any()
    assert (seen.arrival[:, of_mast] == -1).all()
    assert array_equal(seen.relative[:, ~of_mast], alone.relative)  # neighbours and their draws are as without it
    with refused("landmarks"):
        co.observe(crossing, co.Sensors(), landmarks=["c0"])


def test_position_methods_refuse_body_frames(body):
    for method in (co.Kalman(), co.JointFilter(), co.BatchSmoother()):
        with refused(r"body frames: must be in the world frame here.*in_world"):
            method(body)
    nothing = co.observe(co.load_fleet("town10").between(0, 3), co.Sensors(compass=False), frame="body")
    with refused("Take a pose filter"):
        in_world(nothing)
    with refused("must be in body frames"):
        in_world(in_world(body))


def test_a_recording_in_body_frames_is_cut_and_stored_as_any(body, tmp_path):
    body = replace(body, tags=np.eye(8, 3))
    save_recording(body, tmp_path / "body.npz")
    again, _ = read_recording(tmp_path / "body.npz")
    assert array_equal(again.body.yaw_rate, body.body.yaw_rate)
    assert array_equal(again.tags, body.tags)
    assert array_equal(body.between(10, 20).of_runs(slice(1, 3)).body.heading, body.body.heading[1:3, 10:20])


def test_who_has_no_heading_notes_tags(body):
    world = in_world(replace(body, tags=np.eye(8, 3)))
    assert "tags up to 1 m" in str(co.Kalman()(world).notes)
    assert "tags" not in str(co.PoseFilter()(replace(body, tags=world.tags)).notes)


def test_a_cap_acts_in_body_frames(crossing):
    track = co.PoseFilter(fusion="naive")(
        co.observe(crossing, NOISE, co.V2X(max_neighbours=3, bytes_per_second=500.0), frame="body")
    )
    assert track.received_bytes.max() <= 500.0 * 7.0

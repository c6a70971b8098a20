"""NMEA and ROS bags: logs of receivers and robots, checked against pynmeagps, pymap3d and what the test wrote."""

import importlib
import re
import sys
from collections.abc import Callable
from contextlib import suppress
from datetime import datetime, timedelta
from itertools import product
from typing import Any

import numpy as np
import pymap3d
import pytest
from conftest import measured, refused
from fuzz.good_files import sentence
from logs import drive
from numpy import array
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose

import coopoc as co
from coopoc.data.log.check import check
from coopoc.data.log.read import read_log


def degrees(value, wide):
    whole = int(abs(value))
    return f"{whole:0{wide}d}{60 * (abs(value) - whole):011.8f}"


def nmea(fleet, column, start, rmc=True):
    """A vehicle of a fleet, driven in Munich."""
    lat, lon, h = pymap3d.enu2geodetic(*fleet.position[:, column].T, 48.14, 11.58, 560.0)
    lines = []
    for k, t in enumerate(fleet.t - fleet.t[0]):
        at = start + timedelta(seconds=float(round(t, 3)))
        clock = at.strftime("%H%M%S.%f")[:-4]
        place = f"{degrees(lat[k], 2)},N,{degrees(lon[k], 3)},E"
        lines.append(sentence(f"GNGGA,{clock},{place},4,20,0.6,{h[k] - 46.0:.4f},M,{'46.0' * (k % 2)},M,,"))
        lines.append(sentence(f"GNGST,{clock},,,,,0.020,0.010,0.050"))
        if rmc:
            vx, vy, _ = fleet.velocity[k, column]
            knots, course = np.hypot(vx, vy) * 3600 / 1852, np.degrees(np.arctan2(vx, vy)) % 360
            lines.append(sentence(f"GNRMC,{clock},A,{place},{knots:.4f},{course:.3f},{at.strftime('%d%m%y')},,,R"))
    return "".join(lines)


def test_nmea_is_fixes_speed_and_course(tmp_path):
    """Written through midnight by hand and pymap3d, whose positions come back; stamps are seconds since 1970, dates may
    begin late, and every other separation of the geoid is missing."""
    pytest.importorskip("pynmeagps")
    fleet = drive(2, steps=100)
    start = datetime(2024, 2, 28, 23, 59, 55)
    for column, name in enumerate(("a.nmea", "b.log")):
        (tmp_path / name).write_text(nmea(fleet, column, start))
    rec = read_log(tmp_path, origin=(48.14, 11.58, 560.0)).recording
    assert_allclose(rec.gnss[0], fleet.position, atol=1e-3)
    assert_allclose(rec.velocity[0, 2:], fleet.velocity[2:], atol=0.05)
    assert rec.t[0] == pytest.approx((start - datetime(1970, 1, 1)).total_seconds())
    assert rec.sensors.gnss_std == pytest.approx((0.01, 0.02, 0.05))
    (tmp_path / "a.nmea").write_text(re.sub(r".GNRMC,23.*\n", "", nmea(fleet, 0, start)))
    assert read_log(tmp_path).recording.t[0] == rec.t[0]
    (tmp_path / "a.nmea").write_text(nmea(fleet, 0, start, rmc=False))
    rec = read_log(tmp_path / "a.nmea", origin=(48.14, 11.58, 560.0)).recording
    assert len(rec.t) == 100
    assert norm(rec.velocity[0, 5:-5, 0], axis=-1) == pytest.approx(8.0, abs=0.2)


def test_a_truth_in_nmea_is_of_the_only_car_and_of_its_day(tmp_path):
    """A truth of GGA alone has no date; one of another time is refused."""
    pytest.importorskip("pynmeagps")
    fleet, start = drive(1, steps=100), datetime(2024, 2, 28, 12)
    (tmp_path / "a.nmea").write_text(nmea(fleet, 0, start))
    (tmp_path / "truth.gga").write_text(nmea(fleet, 0, start, rmc=False))
    assert_allclose(read_log(tmp_path, origin=(48.14, 11.58, 560.0)).truth.position, fleet.position, atol=1e-3)
    (tmp_path / "truth.gga").write_text(nmea(fleet, 0, start + timedelta(hours=2), rmc=False))
    with refused(r"truth\.gga: column t = 5040. to 504.* s: must overlap the log, .*Does its clock"):
        read_log(tmp_path)


def test_a_real_car_that_stops_keeps_all_its_fixes():
    """1,653 fixes of a u-blox F9K, a third of them at standstill, where it gives no course; and a surveyed truth."""
    pytest.importorskip("pynmeagps")
    log = read_log(measured("ublox_f9k.nmea"), truth=measured("span_truth.gga"))
    assert log.summary.read == {"fixes": 1653}
    assert list(log.summary.refused) == ["damaged NMEA sentences"]
    error = norm((log.recording.gnss[0] - log.truth.position)[..., :2], axis=-1)
    assert np.nanmedian(error) == pytest.approx(0.49, abs=0.05)  # stated by those who published it


def test_damaged_sentences_are_counted(tmp_path):
    pytest.importorskip("pynmeagps")
    lines = nmea(drive(1, steps=60), 0, datetime(2024, 1, 1)).splitlines(keepends=True)
    lines[6] = lines[6].replace("N", "S", 1).replace("GSGGA", "GNGGA")[:-4] + "00\r\n"
    lines[9] = lines[9][:30] + "\r\n"
    lines[12] = sentence("GNGGA,000000.40,,,,,0,00,,,M,,M,,")
    lines.insert(20, "hello\r\n")
    lines.insert(30, sentence("GNGSA,A,3,01,,,,,,,,,,,,1.0,0.6,0.8,1"))
    (tmp_path / "a.nmea").write_text("".join(lines))
    summary = read_log(tmp_path).summary
    assert summary.refused["damaged NMEA sentences"][0] == 2
    assert summary.refused["fixes of quality 0"][0] == 1
    assert summary.refused["lines of NMEA files that are no sentence"] == (1, "a.nmea: line 21")
    assert summary.unused["NMEA sentences GSA"] == 1
    assert summary.read["fixes"] == 57
    (tmp_path / "a.nmea").write_text("hello\n")
    with refused(r"a\.nmea = 0 fixes"):
        read_log(tmp_path)


def test_without_pynmeagps_the_pip_line_is_shown(tmp_path, monkeypatch):
    (tmp_path / "a.nmea").write_text("x")
    (tmp_path / "a.bag").write_text("x")
    for file, extra, library in (("a.nmea", "nmea", "pynmeagps"), ("a.bag", "ros", "rosbags.highlevel")):
        monkeypatch.setitem(sys.modules, library, None)
        with pytest.raises(co.MissingLibraryError, match=rf"pip install .*\[{extra}\]'"):
            read_log(tmp_path / file)


def test_the_cats_cars_agree_with_pynmeagps_and_pymap3d():
    """Real data: 100 positions of the first car, parsed and converted by the libraries alone."""
    pynmeagps = pytest.importorskip("pynmeagps")
    log = read_log(measured("AV_veh1.nmea"), dt=0.1)
    lines = measured("AV_veh1.nmea").read_bytes().splitlines()[:100]
    parsed = [pynmeagps.NMEAReader.parse(line + b"\r\n") for line in lines]
    assert log.origin is not None
    at = array([(m.lat, m.lon, float(m.alt) + float(m.sep)) for m in parsed])
    assert_allclose(at[0], log.origin)
    assert_allclose(
        log.recording.gnss[0, :100, 0], np.column_stack(pymap3d.geodetic2enu(*at.T, *log.origin)), atol=1e-5
    )


@pytest.mark.parametrize("ros", [1, 2])
def test_a_bag_is_read(tmp_path, ros):
    """Written here: fixes, odometry and imu of two vehicles, a truth by PoseStamped, and a topic of another kind."""
    pytest.importorskip("rosbags")
    fleet = drive(2, steps=80, start=1.7e9)
    path = tmp_path / ("drive.bag" if ros == 1 else "drive")
    write_bag(path, fleet, ros)
    log = read_log(path, origin=(48.14, 11.58, 560.0), dt=0.1)
    rec = log.recording
    assert rec.ids == ("car0", "car1")
    assert_allclose(rec.gnss[0], fleet.position, atol=1e-6)
    assert_allclose(rec.velocity[0, 2:], fleet.velocity[2:], atol=0.05)
    assert rec.sensors.gnss_std == pytest.approx((0.5, 0.6, 2.0))
    assert_allclose(log.truth.position[:, 0], fleet.position[:, 0], atol=1e-6)
    assert np.isnan(log.truth.position[:, 1]).all()
    assert any("/car0/note" in what for what in log.summary.unused)
    assert co.rt_le(co.Kalman()(rec, [0]), log.truth)[0, 0] < 0.05
    assert np.isfinite(co.read_log(path, dt=0.1).recording.gnss[0, :, :, 0]).sum() == 80 * 2
    file = path if ros == 1 else next(path.glob("*.db3"))
    whole = file.read_bytes()
    for at in default_rng(0).integers(len(whole), size=8):
        file.write_bytes(whole[:at] + b"\xff" * 8 + whole[at + 8 :])
        with suppress(co.InputError):
            read_log(path)


def test_topics_of_a_bag_are_left_out_or_are_the_truth(tmp_path):
    """A pose of another program beside fixes in degrees; a simulator's truth by Odometry, whose heading counts."""
    pytest.importorskip("rosbags")
    fleet, path = drive(2, steps=80, start=1.7e9), tmp_path / "drive"
    write_bag(path, fleet, 2, truth="pose")
    with refused("topics of a bag"):
        read_log(path, dt=0.1)
    without = read_log(path, dt=0.1, ignore=["/car0/pose"])
    assert without.truth is None
    assert any("/car0/pose" in what for what in without.summary.unused)
    assert read_log(path, dt=0.1, ignore=["x", "y", "z", "heading"]).recording.gnss.shape[2] == 2
    actual = read_log(path, dt=0.1, truth="/car0/pose", origin=(48.14, 11.58, 560.0), frame="body").truth
    assert_allclose(actual.position[:, 0], fleet.position[:, 0], atol=1e-6)
    assert_allclose(actual.heading[:, 0], np.arctan2(fleet.velocity[:, 0, 1], fleet.velocity[:, 0, 0]), atol=1e-6)
    body = read_log(path, dt=0.1, ignore=["/car0/pose", "/car1/imu"], frame="body").recording.body
    assert abs(body.yaw_rate[0]).max(0) == pytest.approx([0.06, 0.0], abs=1e-3)
    stands = read_log(path, dt=0.1, ignore=["/car0/pose"], truth="/car1/odom", origin=(48.14, 11.58, 560.0)).truth
    assert not stands.position[:, 1].any()  # that of its poses, which the test left at zero
    for wrong, match in (({"truth": "/car0/poses"}, "Did you mean /car0/pose"), ({"kinds": {"a": "x"}}, "to tables")):
        with refused(match):
            read_log(path, dt=0.1, **wrong)


def test_motion_capture_and_radios_of_a_public_bag():
    """TIERS: /vrpn_client_node/turtlebot1/pose, /uwb/tof/n_1/n_2/distance. By rosbags and NumPy: the same poses, and
    ranges of radios that have no delays calibrated, 0.39 m too long in the median."""
    highlevel = pytest.importorskip("rosbags.highlevel")
    folder = measured("tiers_ros2")
    recording = read_log(folder).recording
    assert sorted(recording.ids) == [f"turtlebot{k}" for k in range(1, 8)]
    raw: dict[str, list[tuple[float, ...]]] = {}
    store = importlib.import_module("rosbags.typesys")
    with highlevel.AnyReader([folder], default_typestore=store.get_typestore(store.Stores.ROS2_HUMBLE)) as reader:
        for c, _, data in reader.messages():
            m = reader.deserialize(data, c.msgtype)
            at = m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec
            where = m.pose.position if "pose" in c.topic else None
            raw.setdefault(c.topic, []).append((at, m.range) if where is None else (at, where.x, where.y, where.z))
    way = {name: array(raw[f"/vrpn_client_node/{name}/pose"]) for name in recording.ids}
    one = way["turtlebot1"]
    k = recording.ids.index("turtlebot1")
    near = array([abs(one[:, 1:] - fix).sum(1).min() for fix in recording.gnss[0, 100:200, k]])
    assert np.nanmax(near) < 1e-5  # a fix is brought to its step
    errors = []
    for topic, rows in raw.items():
        if "distance" in topic and "n_8" not in topic:
            t, ranges = array(rows).T
            a, b = (way[f"turtlebot{part[2:]}"] for part in topic.split("/")[3:5])
            gap = [np.interp(t, a[:, 0], a[:, d]) - np.interp(t, b[:, 0], b[:, d]) for d in (1, 2, 3)]
            errors.append(ranges - norm(gap, axis=0))
    links = recording.links
    ends = recording.gnss[0, links.step, links.observer] - recording.gnss[0, links.step, links.neighbour]
    assert np.nanmedian(recording.relative[0, :, 0] - norm(ends, axis=1)) == pytest.approx(
        np.median(np.concatenate(errors)), abs=0.01
    )
    assert np.isfinite(recording.relative[0, :, 0]).sum() > 0.95 * sum(map(len, errors))


def test_times_of_a_bag_are_those_of_its_headers_or_of_its_reception(tmp_path):
    pytest.importorskip("rosbags")
    write_bag(tmp_path / "drive", drive(1, steps=60, start=1.7e9), 2, late=0.25, invalid=40)
    by_header, received = (read_log(tmp_path / "drive", dt=0.1, stamps=stamps) for stamps in ("header", "received"))
    assert received.recording.t[0] - by_header.recording.t[0] == pytest.approx(0.25, abs=1e-5)
    assert "times are by stamps=header; headers are between 0.25 and 0.25 s before" in str(by_header.summary)
    assert by_header.summary.refused["fixes that the receiver calls invalid"][0] == 1


ALL = {"fix": "sensor_msgs/NavSatFix", "odom": "nav_msgs/Odometry", "imu": "sensor_msgs/Imu"}
FIRST = ALL | {"truth": "geometry_msgs/PoseStamped", "note": "std_msgs/String"}
"""Topic -> type of all vehicles, and of the first."""


def write_bag(path, fleet, ros, truth="truth", late=0.0, invalid=-1):
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)

    def of(kind, *values):
        return store.types[kind.replace("/", "/msg/")](*values)

    def at(x, y=0.0, z=0.0, kind="Vector3"):
        return of(f"geometry_msgs/{kind}", float(x), float(y), float(z))

    serialize = store.serialize_ros1 if ros == 1 else store.serialize_cdr
    writer: Any = rosbag1.Writer(path) if ros == 1 else rosbag2.Writer(path, version=9)
    with writer:
        topics = {}
        for column, one in enumerate(fleet.ids):
            for what, kind in (ALL if column else FIRST).items():
                name, type_ = f"/{one}/{truth if what == 'truth' else what}", kind.replace("/", "/msg/")
                topics[column, what] = writer.add_connection(name, type_, typestore=store)
        for (step, t), ((column, what), topic) in product(enumerate(fleet.t), topics.items()):
            x, u = fleet.position[step, column], fleet.velocity[step, column]
            stamp = of("builtin_interfaces/Time", int(t), round((t - int(t)) * 1e9))
            crab, speed, unknown = 0.3 * column, np.hypot(*u[:2]), np.zeros(36)
            yaw = float(np.arctan2(u[1], u[0])) - crab
            turned = of("geometry_msgs/Quaternion", 0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2))
            upright = of("geometry_msgs/Pose", at(0, kind="Point"), of("geometry_msgs/Quaternion", 0.0, 0.0, 0.0, 1.0))
            values: dict[str, list[Any]] = {
                "fix": [
                    of("sensor_msgs/NavSatStatus", -int(step == invalid), 1),
                    *pymap3d.enu2geodetic(*x, 48.14, 11.58, 560.0),
                    np.diag([0.25, 0.36, 4.0]).ravel(),
                    2 - 2 * column,
                ],
                "odom": [
                    "base",
                    of("geometry_msgs/PoseWithCovariance", upright, unknown),
                    of(
                        "geometry_msgs/TwistWithCovariance",
                        of("geometry_msgs/Twist", at(speed * np.cos(crab), speed * np.sin(crab)), at(0)),
                        0.01 * np.eye(1, 36)[0],
                    ),
                ],
                "imu": [
                    turned,
                    0.01 * np.eye(3).ravel(),
                    at(0, 0, 0.06 * np.cos(0.15 * (t - fleet.t[0]))),
                    unknown[:9],
                    at(0, 0, 9.8),
                    unknown[:9],
                ],
                "truth": [of("geometry_msgs/Pose", at(*x, kind="Point"), turned)],
            }
            head = of("std_msgs/Header", *[0] * (ros == 1), stamp, "map")
            message = of(FIRST[what], head, *values[what]) if what in values else of(FIRST[what], "hello")
            writer.write(topic, round((t + late) * 1e9), serialize(message, FIRST[what].replace("/", "/msg/")))


def test_what_is_no_bag_is_named(tmp_path):
    pytest.importorskip("rosbags")
    (tmp_path / "a.bag").write_bytes(b"no bag")
    with refused(r"a\.bag = .*must be a ROS bag"):
        read_log(tmp_path / "a.bag")


@pytest.mark.parametrize("ros", [1, 2])
def test_a_damaged_bag_is_named(tmp_path, ros):
    """Each of 60 bags with a few wrong bytes is read, or refused with an error of ours."""
    pytest.importorskip("rosbags")
    path = tmp_path / ("drive.bag" if ros == 1 else "drive")
    write_bag(path, drive(2).between(0, 12), ros)
    rng = default_rng(0)
    for file in [path] if ros == 1 else sorted(path.iterdir()):
        good = file.read_bytes()
        for _ in range(60):
            bad = bytearray(good)
            for place in rng.integers(len(bad), size=rng.integers(1, 9)):
                bad[place] = rng.integers(256)
            file.write_bytes(bad)
            with suppress(co.InputError):
                read_log(path, dt=0.1)
        file.write_bytes(good)
    if ros == 2:
        text = (path / "metadata.yaml").read_text()
        (path / "metadata.yaml").write_text(re.sub(r"nanoseconds: \d+", "nanoseconds: .inf", text))
        with suppress(co.InputError):
            read_log(path, dt=0.1)


FOOT = 0.3048
NMEA: dict[str, tuple[Callable[[list[str]], list[str]], str]] = {
    "latitude and longitude swapped": (lambda w: [*w[:2], w[4], "N", w[2], "E", *w[6:]], "0 fixes"),
    "decimal commas": (lambda w: [word.replace(".", ",") for word in w], "0 fixes"),
    "degrees for degrees and minutes": (lambda w: [*w[:2], "34.375284", w[3], "108.899189", *w[5:]], "0 fixes"),
}
INVISIBLE: dict[str, Callable[[list[str]], list[str]]] = {
    "S for N": lambda w: [*w[:3], "S", *w[4:]],
    "heights in feet": lambda w: [*w[:9], f"{float(w[9]) / FOOT:.3f}", *w[10:]],
}
"""Fixes alone have nothing to be compared with: docs/your_data.md lists these."""


@pytest.mark.parametrize("mistake", [*NMEA, *INVISIBLE, "none"])
def test_a_mistake_in_nmea_of_a_receiver(tmp_path, mistake):
    """CATS, two receivers, two minutes; checksums are those of the changed sentences."""
    change = NMEA[mistake][0] if mistake in NMEA else INVISIBLE.get(mistake, lambda words: words)
    for name in ("AV_veh1", "AV_veh2"):
        lines = measured(f"{name}.nmea").read_text().splitlines()[:1200]
        changed = "".join(sentence(",".join(change(line[1:].partition("*")[0].split(",")))) for line in lines)
        (tmp_path / f"{name}.nmea").write_text(changed)
    if mistake in NMEA:
        with refused(NMEA[mistake][1]):
            read_log(tmp_path)
    else:
        leap = mistake == "heights in feet"
        words = r"0\.\d+ times as large as stated" + r"|AV_veh1: 1\.\d% .* outliers" * leap
        assert all(re.search(words, warning) for warning in check(read_log(tmp_path)).warnings)

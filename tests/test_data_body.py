"""Logs in body frames: speed, yaw rate, compass and bearings stay as they were measured, for pose filters."""

import re
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from conftest import refused
from numpy import arange, hypot, isnan, pi
from numpy.linalg import norm
from numpy.testing import assert_allclose
from shell import ran
from strange_logs import strange

import coopoc as co
from coopoc.data.log.check import check as check_poses
from coopoc.data.log.residuals import begin_of, together
from coopoc.data.registry import read_log as load_log
from coopoc.evaluate.metrics import innovation_columns
from coopoc.studies import real

T = np.round(arange(0, 40, 0.1), 1)
CARS = {"red": (0.0, 12.0, 0.10), "blue": (1.0, 16.0, 0.08), "green": (2.5, 20.0, 0.09)}
MAST = (25.0, 3.0)
STD = {"speed": 0.05, "yaw_rate": 0.01, "x": 0.5, "y": 0.5, "range": 0.1, "bearing": 0.03, "heading": 0.05}


def wrapped(angle):
    return np.mod(np.asarray(angle) + pi, 2 * pi) - pi


def drives():
    """Places (T, 2) m, headings (T,) rad, speed and yaw rate of cars on circles: all closed forms."""
    out = {}
    for name, (start, radius, rate) in CARS.items():
        angle = start + rate * T
        out[name] = radius * np.c_[np.cos(angle), np.sin(angle)], wrapped(angle + pi / 2), radius * rate, rate
    return out


def table(noise=0.0, mirrored=False, compass=True):
    """A log and its truth; the mast measures ranges."""
    rng, rows, truth, cars = np.random.default_rng(5), [], [], drives()

    def add(t, name, kind, value, partner=""):
        rows.append((t, name, kind, partner, value + noise * rng.normal(0, STD[kind]), STD[kind]))

    for name, (place, heading, speed, rate) in cars.items():
        for i, t in enumerate(T):
            truth.append((t, name, *place[i], heading[i]))
            add(t, name, "speed", speed)
            add(t, name, "yaw_rate", rate)
            if i % 10 == 0:
                add(t, name, "x", place[i, 0])
                add(t, name, "y", place[i, 1])
            if compass and i % 5 == 0:
                add(t, name, "heading", heading[i])
            if i % 4 == 0:
                for other in cars:
                    if other != name:
                        apart = cars[other][0][i] - place[i]
                        turned = wrapped(np.arctan2(apart[1], apart[0]) - heading[i])
                        add(t, name, "bearing", -turned if mirrored else turned, other)
                        add(t, name, "range", hypot(*apart), other)
                add(t, "mast", "range", hypot(*(place[i] - MAST)), name)
    rows += [(0.0, "mast", "x", "", MAST[0], 0.01), (0.0, "mast", "y", "", MAST[1], 0.01)]
    log = pd.DataFrame(rows, columns=["t", "vehicle", "kind", "partner", "value", "std"])
    return log, pd.DataFrame(truth, columns=["t", "vehicle", "x", "y", "heading"])


def written(folder, **options: Any):
    log, truth = table(**options)
    folder.mkdir(exist_ok=True)
    log.to_csv(folder / "log.csv", index=False)
    truth.to_csv(folder / "truth.csv")
    return folder


def test_what_was_measured_is_what_the_recording_holds(tmp_path):
    log = load_log(f"{written(tmp_path / 'log')}?frame=body")
    rec, cars = log.recording, drives()
    assert set(rec.ids) == {*CARS, "mast"}
    mast = rec.ids.index("mast")
    assert rec.landmarks == (mast,)
    for name, (place, heading, speed, rate) in cars.items():
        k = rec.ids.index(name)
        assert_allclose(rec.velocity[0, :, k], np.tile([speed, 0, 0], (len(T), 1)), atol=1e-12)
        assert_allclose(rec.body.yaw_rate[0, :, k], rate, atol=1e-12)
        assert_allclose(rec.gnss[0, ::10, k, :2], place[::10], atol=1e-12)
        assert isnan(rec.gnss[0, 1:10, k]).all()
        assert_allclose(wrapped(rec.body.heading[0, ::5, k] - heading[::5]), 0, atol=1e-12)
        assert isnan(rec.body.heading[0, 1:5, k]).all()
    for step, observer, neighbour, relative in zip(
        rec.links.step, rec.links.observer, rec.links.neighbour, rec.relative[0], strict=True
    ):
        place, heading = cars[rec.ids[observer]][:2]
        other = np.array(MAST) if neighbour == mast else cars[rec.ids[neighbour]][0][step]
        apart = other - place[step]
        assert relative[0] == pytest.approx(hypot(*apart))
        if neighbour == mast:  # it measured the range, which a filter needs from the vehicle
            assert isnan(relative[1])
        else:
            assert wrapped(relative[1] - np.arctan2(apart[1], apart[0]) + heading[step]) == pytest.approx(0, abs=1e-9)
    assert (rec.links.observer != mast).all()
    assert_allclose(wrapped(log.truth.heading[:, rec.ids.index("blue")] - cars["blue"][1]), 0, atol=1e-9)


def test_a_vehicle_without_a_fix_starts_from_what_it_sees_of_others(tmp_path):
    """One car has fixes; the others measure it and each other, and none has a compass."""
    folder = written(tmp_path / "log", noise=1.0, compass=False)
    frame = pd.read_csv(folder / "log.csv")
    kept = frame["vehicle"].isin(["red", "mast"]) | ~frame["kind"].isin(["x", "y"])
    frame[kept].to_csv(folder / "log.csv")
    log = co.read_log(folder, frame="body")
    begin, cars = co.pose_start(log.recording)[0], drives()
    for name, (place, heading, _, _) in cars.items():
        found = begin[log.recording.ids.index(name)]
        assert hypot(*(found[:2] - place[0])) < 2.5
        assert abs(wrapped(found[3] - heading[0])) < np.deg2rad(20)
    track = co.PoseFilter("fleet", begin=begin[None])(log.recording, list(CARS))
    assert np.nanmean(co.pose_nees(track, log.truth)[:, 100:]) < 6
    kept &= ~frame["kind"].isin(["bearing", "range"]) | (frame["partner"] != "red")
    frame[kept].to_csv(folder / "log.csv")
    lost = co.read_log(folder, frame="body")
    with refused("has no fix and sees too little"):
        co.pose_start(lost.recording)
    assert "truth's first poses" in check_poses(lost).span


def test_a_log_without_a_fix_is_read_and_what_landmarks_cannot_measure_is_counted(tmp_path):
    frame, _ = table()
    frame = frame[~frame["kind"].isin(["x", "y"]) | (frame["vehicle"] == "mast")]
    more = [(0.4, "mast", "bearing", "red", 0.3, 0.1), (0.4, "red", "vx", "", 1.0, 0.1)]
    pd.concat([frame, pd.DataFrame(more, columns=frame.columns)]).to_csv(tmp_path / "log.csv")
    log = co.read_log(tmp_path / "log.csv", frame="body")
    columns = [log.recording.ids.index(name) for name in CARS]
    assert isnan(log.recording.gnss[:, :, columns]).all()
    assert log.summary.refused["messages of landmarks, and their measurements other than ranges to vehicles"][0] == 1
    assert log.summary.refused["world velocities in body frames"][0] == 1
    begin = np.full((4, 4), np.nan)
    begin[columns] = [[*place[0], 0.0, heading[0]] for place, heading, _, _ in drives().values()]
    track = replace(co.PoseFilter("fleet"), begin=begin)(log.recording, list(CARS))
    assert abs(track.x[0, ..., :2] - np.stack([place for place, _, _, _ in drives().values()], axis=1)).max() < 0.1


@pytest.mark.parametrize(
    ("drop", "options", "message"),
    [
        ("yaw_rate", {"frame": "body"}, "no yaw_rate: must have speeds and yaw rates"),
        ("speed", {"frame": "body"}, "no speed: must have speeds and yaw rates"),
        ("", {"frame": "boddy"}, "Did you mean body"),
    ],
)
def test_mistakes_are_named(tmp_path, drop, options, message):
    frame, _ = table()
    frame[(frame["kind"] != drop) | (frame["vehicle"] != "red")].to_csv(tmp_path / "log.csv")
    with refused(message):
        co.read_log(tmp_path / "log.csv", **options)


@pytest.mark.parametrize("mirrored", [False, True])
def test_the_check_follows_the_fleet_and_finds_mirrored_bearings(tmp_path, mirrored):
    folder = written(tmp_path / "log", noise=1.0, mirrored=mirrored, compass=False)
    command = [sys.executable, "-W", "error", "-m", "coopoc.cli", "data", "check", f"{folder}?frame=body"]
    done = ran(command, cwd=tmp_path, check=True)
    assert "a filter of each vehicle alone, throughout" in done.stdout
    assert "bearing" in done.stdout
    assert ("They look like bearings clockwise from the heading" in done.stdout) == mirrored
    assert ("nothing looks wrong" in done.stdout) != mirrored
    assert (tmp_path / "log-check.png").stat().st_size > 20_000


@pytest.mark.parametrize(("frame", "hint"), [("world", "They look like bearings"), ("body", "Then name them bearing")])
def test_bearings_that_are_called_azimuths_are_named(tmp_path, frame, hint):
    log, _ = table(noise=1.0, compass=frame == "world")
    log.replace({"kind": {"bearing": "azimuth"}}).to_csv(tmp_path / "log.csv")
    assert hint in "\n".join(check_poses(co.read_log(tmp_path / "log.csv", frame=frame)).warnings)


@pytest.mark.parametrize(
    ("kind", "change", "said"),
    [
        ("yaw_rate", (-1, 0), "fixes of red contradict: scale=red.yaw_rate:-1 mends it, unless x and y"),
        ("yaw_rate", (57.3, 0), "fixes of red contradict: scale=red.yaw_rate:0.01745"),
        ("bearing", (1, 1.5), r"turned by -1\.5\d? rad: add -1\.5"),
    ],
)
def test_axes_that_are_turned_or_flipped_are_named(tmp_path, kind, change, said):
    log, _ = table(noise=1.0, compass=False)
    own = log["kind"] == kind
    value = change[0] * log["value"][own] + change[1]
    log.loc[own, "value"] = wrapped(value) if kind == "bearing" else value
    log.to_csv(tmp_path / "log.csv")
    words = "\n".join(check_poses(co.read_log(tmp_path / "log.csv", frame="body")).warnings)
    assert re.search(said, words)
    assert "too fast" not in words


def test_the_check_scores_those_whose_truth_is_known(tmp_path):
    folder = written(tmp_path / "log", noise=1.0)
    truth = table()[1]
    truth[truth["vehicle"] == "blue"].assign(x=lambda frame: frame["x"] + 50).to_csv(folder / "truth.csv")
    found = check_poses(co.read_log(folder, frame="body"))
    assert [row["error_m"] is not None for row in found.vehicles] == [
        row["vehicle"] == "blue" for row in found.vehicles
    ]
    assert all(warning.startswith("blue: ") for warning in found.warnings)
    assert "blue: its filter errs by" in found.warnings[0]
    assert ["blue: fixes lie -5" in warning for warning in found.warnings] == [False, True]


def test_what_no_filter_can_follow_is_still_summarised(tmp_path):
    frame, _ = table(compass=False)
    frame = frame[~frame["kind"].isin(["x", "y"]) & (frame["vehicle"] != "mast")]
    frame.to_csv(tmp_path / "log.csv")
    done = ran([sys.executable, "-m", "coopoc.cli", "data", "check", "log.csv?frame=body"], cwd=tmp_path, check=True)
    assert "400 samples of odometry" in done.stdout
    assert "no filter follows it" in done.stdout


def test_innovations_of_poses_are_consistent_where_all_is_white():
    """Closed form: normalised innovations of a right filter average 1 (Bar-Shalom et al. 2001, section 5.4)."""
    fleet = co.load_fleet("town10").between(0, 300)
    noise = co.Sensors(gnss_std=(1.0, 1.0, 1.0), heading_std=0.1, yaw_rate_std=0.05)
    rec = co.observe(fleet, noise, co.V2X(max_neighbours=2), runs=20, seed=1, observers=["town10-24"], frame="body")
    track = co.PoseFilter("solo")(rec, ["town10-24"])
    both = track, replace(track, heading_covariance=None)
    whole, sure = (np.nanmean(innovation_columns(one, rec)["nis"]) for one in both)
    assert sure > whole == pytest.approx(1.0, abs=0.03)


def test_the_study_of_real_poses_takes_a_log_of_ones_own(tmp_path, monkeypatch):
    """What the filter alone, called here, does with the same log is in the study's rows."""
    data = f"{written(tmp_path / 'log', noise=1.0)}?frame=body"
    settings = {"data": data, "evaluations": 5, "calibrate_s": 10.0}
    results = co.run_study("real", tmp_path, settings=settings, progress=False)
    assert results.failed == 0
    frame = results.frame
    assert set(frame["max_neighbours"]) == {0, 1, 2}
    assert set(frame["landmarks"]) == {0, 1}
    assert set(frame.loc[frame["method"] == "trained-centralised", "max_neighbours"]) == {0, 2}
    log = load_log(data)
    assert real.drives.calibrated(settings | {"calibrate_s": None}) == pytest.approx(0.4 * log.recording.t[-1])
    alone = co.PoseFilter("solo", lasting=True, gate=5.0)(log.recording, list(CARS))
    first = slice(100, 100 + int(real.drives.block(settings) / log.recording.dt))
    apart = norm(alone.x[0, first, 1] - np.pad(drives()["blue"][0][first], ((0, 0), (0, 1))), axis=1)
    found = results.select(method="pose-fleet", max_neighbours=0, landmarks=1, ego="blue", run=0)["rt_le_m"]
    assert found.tolist() == pytest.approx([np.sqrt(np.mean(apart**2))], rel=1e-9)
    error = results.select(method="pose-fleet").groupby("max_neighbours")["rt_le_m"].mean()
    assert error[2] < 0.8 * error[0]
    caption = (tmp_path / "real" / "tables" / "rt_le.md").read_text()
    assert "600 bearings" in caption
    assert "then they are thinned" in caption
    assert re.match("K = 1 without a landmark.* with 1 landmark ", real.STUDY.answers(results)[0])
    two = replace(results, frame=results.select(method="pose-fleet", landmarks=1, max_neighbours=[0, 1]))
    assert "over 2 cells" in real.STUDY.answers(two)[-1]
    assert not real.STUDY.answers(replace(results, frame=results.select(method="pose-naive")))
    unposed = real.drives.source(data)._replace(posed=False)
    monkeypatch.setattr(real.drives, "source", lambda _: unposed)
    assert "No row is trained" in real._caption(results, "")


def test_studies_say_where_a_log_belongs(tmp_path):
    folder = written(tmp_path / "log")
    with refused("Take coopoc run real"):
        co.run_study("side_by_side", tmp_path, settings={"data": f"{folder}?frame=body"}, progress=False)
    with refused("Take coopoc run side_by_side"):
        co.run_study("real", tmp_path, settings={"data": str(folder)}, progress=False)


def librsf(folder, wheels):
    """A robot on a circle of 5 m ranges four anchors without error, as libRSF writes it; its true way and headings."""
    t = arange(0, 40, 0.1)
    angle = 0.15 * t
    place = 5 * np.c_[np.cos(angle), np.sin(angle)]
    measured, true = [], []
    for k, (now, (x, y)) in enumerate(zip(t, place, strict=True)):
        number = k % 4
        corner = np.array([-8.0 + 16 * (number % 2), -8.0 + 16 * (number // 2), 1.5 * (not wheels)])
        reach = norm(corner - [x, y, 0.0])
        places = " ".join(map(str, corner[: 2 if wheels else 3]))
        measured.append(f"range{2 if wheels else 3} {now:.1f} {reach:.12g} 0.01 {places} {100 + number} 0")
        if wheels:  # 0.75 m/s and 0.15 rad/s, 0.2 m from wheel to wheel
            measured.append(f"odom2diff {now:.1f} 0.735 0.765 0 0.1 0.0001 0.0001 0.0001")
        else:
            measured.append(f"odom3 {now:.1f} 0.75 0 0 0 0 0.15 {'0.0001 ' * 6}")
        true.append(f"point2 {now:.1f} {x} {y} 0 0 0 0" if wheels else f"point3 {now:.1f} {x} {y} 0 {'0 ' * 9}")
    folder.mkdir()
    (folder / "Hall_Input.txt").write_text("\n".join([*measured, "imu 0.0 1 2 3"]))
    (folder / "Hall_GT.txt").write_text("\n".join(true))
    (folder / "readme.txt").write_text("Not a measurement.")
    return place, wrapped(angle + pi / 2)


@pytest.mark.parametrize("wheels", [True, False])
def test_libRSFs_text_is_followed_from_ranges_alone(tmp_path, wheels):
    """The pose of a robot without a fix, bearing or compass comes from ranges to four anchors."""
    place, heading = librsf(tmp_path / "hall", wheels)
    log = load_log(f"{tmp_path / 'hall'}?frame=body")
    ego = log.recording.ids.index("Hall")
    assert {log.recording.ids[k] for k in log.recording.landmarks} == {"100", "101", "102", "103"}
    assert log.summary.unused == {"Hall_Input.txt: lines imu": 1}
    assert (1, "readme.txt") in log.summary.refused.values()
    assert_allclose(log.truth.position[:, ego, :2], place, atol=1e-9)
    noise = log.recording.sensors
    assert (noise.range_std, noise.yaw_rate_std) == pytest.approx((0.1, np.sqrt(2e-4) / 0.2 if wheels else 0.01))
    track = co.PoseFilter("solo", begin=co.pose_start(log.recording))(log.recording, ["Hall"])
    assert norm(track.x[0, 50:, 0, :2] - place[50:], axis=1).max() < 0.15
    assert abs(wrapped(track.heading[0, 50:, 0] - heading[50:])).max() < 0.05
    with refused("where ranges to anchors place it"):
        co.read_log(tmp_path / "hall")


def test_ranges_are_moved_to_their_step(tmp_path):
    """Closed form: cars that pass each other at 30 m/s range 0.04 s after a step."""
    t = arange(90) / 10
    x, cars = 15 * t - 60, [pd.DataFrame({"t": t + 0.04, "vehicle": "a", "partner": "b", "range": 118.8 - 30 * t})]
    for name, way in (("a", 1), ("b", -1)):
        own = {"vehicle": name, "speed": 15, "yaw_rate": 0, "x": way * x, "y": 0, "heading": np.arccos(way)}
        cars.append(pd.DataFrame({"t": t, **own}))
    pd.concat(cars).query("t < 3").to_csv(tmp_path / "log.csv")
    rec = co.read_log(tmp_path / "log.csv", frame="body").recording
    assert_allclose(rec.relative[0, :, 0], -2 * x[rec.links.step], atol=1e-6)


def test_ranges_and_bearings_are_moved_to_their_step_without_a_place(tmp_path):
    """Closed form: on a circle of 30 m at 12 m/s, what a car measures of a mast 0.05 s after a step."""
    t, turn = arange(90) / 10, 0.4j
    mast, mean = 50 + 9j, np.sinc(0.02 / pi)  # speeds are that of a chord
    at = [(mast + 30j * np.exp(turn * when)) * np.exp(-turn * when) for when in (t, t + 0.05)]
    seen = pd.DataFrame({"t": t + 0.05, "partner": "mast", "range": abs(at[1]), "bearing": np.angle(at[1])})
    own = pd.DataFrame({"t": t, "speed": 12 * mean, "yaw_rate": 0.4})
    places = pd.DataFrame({"t": [0.0], "vehicle": "mast", "x": 50.0, "y": 9.0})
    pd.concat([own.assign(vehicle="a"), seen.assign(vehicle="a"), places]).query("t < 3").to_csv(tmp_path / "log.csv")
    rec = co.read_log(tmp_path / "log.csv", frame="body", dt=0.1).recording
    there = at[0][rec.links.step]
    assert_allclose(rec.relative[0, :, :2], np.column_stack([abs(there), np.angle(there)]), atol=0.01)


def test_two_anchors_leave_the_side_open(tmp_path):
    librsf(tmp_path / "hall", True)
    file = tmp_path / "hall" / "Hall_Input.txt"
    file.write_text("\n".join(line for line in file.read_text().split("\n") if not line.endswith(("102 0", "103 0"))))
    with refused("or three ranges"):
        co.pose_start(co.read_log(file, frame="body").recording)


@pytest.mark.parametrize("share", [0.03, -0.05])
def test_wheels_of_another_size_cost_little_from_a_known_pose(tmp_path, share):
    """The references are the same filter with right wheels, and one that takes wheels as right."""
    found = {}
    for wheels in (0.0, share):
        folder = strange(tmp_path / f"{wheels}", "robot", wheels={"robot0": wheels, "robot1": wheels})
        log = together(co.read_log(folder, frame="body"))[0]
        begin, spread, where = begin_of(log)
        assert "truth" in where
        made = co.PoseFilter("fleet", begin=begin, spread=spread)
        told = replace(log.recording.sensors, speed_scale_std=0.0, yaw_rate_bias_std=0.0, range_offset_std=0.0)
        both = ["robot0", "robot1"]
        tracks = made(log.recording, both), replace(made, assumed=told)(log.recording, both)
        found[wheels] = [co.rt_le(track, log.truth).mean() for track in tracks]
        scale, std = (tracks[0].extras[name][0, -1] for name in ("speed_scale", "speed_scale_std"))
        assert (abs(scale - wheels) < 4 * std).all()
    assert found[share][0] < 1.3 * found[0.0][0] < 0.5 * found[share][1]

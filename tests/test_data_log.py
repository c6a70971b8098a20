"""Logs of one's own: what is read is what was measured, whatever the units, rates, clocks and gaps."""

from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pymap3d
import pytest
from conftest import refused
from logs import NOISE, at, drive, fixes, long, motion, observed, ranges, write
from numpy import arange, arctan2, array, cos, exp, isfinite, radians, sin
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from strange_logs import strange

import coopoc as co
from coopoc.data.log.motion import Signal, step_means
from coopoc.data.log.read import read_log
from coopoc.data.registry import read_log as load_log
from coopoc.evaluate.metrics import nees


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_a_recording_comes_back_from_its_rows(tmp_path, suffix):
    """Fixes, velocities, relative measurements and messages; late and lost ones, too. Velocities are means over steps
    of samples joined by lines, so those of the rows are made such that their means are the recording's."""
    true = observed(drive(start=1.7e9), rate=5.0, latency=0.25, loss=0.2)
    log = read_log(write(long(true), tmp_path / f"log.{suffix}"))
    found = log.recording
    assert found.ids == true.ids
    assert_allclose(found.t, true.t, rtol=0, atol=1e-6)
    assert_allclose(found.gnss, true.gnss, atol=1e-5)
    means = true.velocity.copy()
    means[:, 1:] = (means[:, 1:] + means[:, :-1]) / 2  # trapezoids between samples at the steps
    assert_allclose(found.velocity, means, atol=1e-4)  # stamps have 7 digits behind the point
    keys = ["step", "observer", "neighbour"]
    one, other = (
        pd.DataFrame({key: getattr(recording.links, key) for key in keys}).sort_values(keys)
        for recording in (true, found)
    )
    assert_array_equal(one, other)
    order, back = one.index, other.index
    assert_allclose(found.relative[0, back], true.relative[0, order], atol=1e-9)
    wanted = np.where(true.broadcasts[true.links.step, true.links.neighbour], true.arrival[0], -1)
    assert_array_equal(found.arrival[0, back], wanted[order])
    assert found.sensors == replace(
        NOISE, min_range=0.0, range_offset_std=1.0, velocity_floor=found.sensors.velocity_floor
    )
    assert found.sensors.velocity_floor == pytest.approx(0.1)
    assert log.messages
    assert not log.summary.refused
    assert log.summary.read["fixes"] == 200 * 4


@pytest.mark.parametrize("latitude", [48.14, -33.9, 0.0, 89.9])
def test_degrees_are_metres_by_the_radii_of_curvature(tmp_path, latitude):
    """Closed form: east N cos(lat) dlon and north M dlat of WGS84 (Hofmann-Wellenhof et al. 2008, section 8)."""
    d, a, e2 = 1e-4 * arange(20), 6378137.0, 0.00669437999014
    frame = {"t": arange(20.0), "latitude": latitude + d, "longitude": 11.58 + d, "height": 20.0}
    x, y = read_log(write(pd.DataFrame(frame), tmp_path / "car.csv")).recording.gnss[0, :, 0, :2].T
    s = sin(radians(latitude)) ** 2
    normal, meridian = a / np.sqrt(1 - e2 * s), a * (1 - e2) / (1 - e2 * s) ** 1.5
    assert_allclose(y, (meridian + 20) * radians(d), rtol=1e-4)
    assert_allclose(x, (normal + 20) * cos(radians(latitude + d)) * radians(d), rtol=1e-4)


def test_a_drive_in_degrees_is_one_in_metres(tmp_path):
    fleet = drive(1)
    origin = (48.14, 11.58, 520.0)
    lat, lon, h = pymap3d.enu2geodetic(*fleet.position[:, 0].T, *origin)
    frame = pd.DataFrame({"time": fleet.t, "lat": lat, "lon": lon, "alt": h, "speed_kmh": 8 * 3.6, "both": 3.0})
    frame["yaw"] = (90 - np.degrees(arctan2(fleet.velocity[:, 0, 1], fleet.velocity[:, 0, 0]))) % 360
    write(frame, tmp_path / "car7.csv")
    names = {"t": "time", "latitude": "lat", "longitude": "lon", "height": "alt", "compass_deg": "yaw"}
    log = read_log(tmp_path / "car7.csv", columns=names, origin=origin)
    assert log.recording.ids == ("car7",)
    assert_allclose(log.recording.gnss[0, :, 0], fleet.position[:, 0], atol=1e-6)
    assert_allclose(log.recording.velocity[0, 5:, 0], fleet.velocity[5:, 0], atol=0.05)
    far = str(read_log(tmp_path / "car7.csv", columns=names, origin=(48.14, 12.58, 0)).summary)
    assert "fixes far from the origin, over 70 km, of car7" in far
    names |= {"latitude_std": "both", "longitude_std": "both"}
    free = read_log(tmp_path / "car7.csv", columns=names)
    assert {*free.recording.sensors.gnss_std[:2]} == {3}
    assert free.origin == pytest.approx((lat[0], lon[0], h[0]))
    assert_allclose(free.recording.gnss[0, 0, 0], 0, atol=1e-9)
    assert read_log(tmp_path / "car7.csv", columns=names, ignore=["height"]).origin == (lat[0], lon[0], 0.0)
    write(frame.assign(alt=frame["alt"][frame.index % 3 > 0]), tmp_path / "car7.csv")
    few = read_log(tmp_path / "car7.csv", columns=names, origin=origin)
    assert_allclose(few.recording.gnss[0, :, 0], fleet.position[:, 0], atol=1e-3)
    assert not few.summary.refused
    frame.loc[:9, ["lat", "lon", "alt"]] = 0.0
    write(frame, tmp_path / "car7.csv")
    late = read_log(tmp_path / "car7.csv", columns=names)
    assert late.origin == pytest.approx((lat[10], lon[10], h[10]))
    refused = late.summary.refused
    assert refused["fixes at zero, which are none"][0] + refused["height of 0, which stands for none"][0] == 30


def test_columns_that_end_with_a_partner_are_measurements_of_it(tmp_path):
    t = arange(0, 10, 0.5)
    for name, other, x in zip("ab", "ba", (0.0, 12.0), strict=True):
        seen = {f"range_{other}": 12.0, f"range_{other}_std": 0.2, "range_kept": "yes"}
        write(pd.DataFrame({"t": t, "x": 5 * t + x, "y": 0.0, "vx": 5.0, "vy": 0.0} | seen), tmp_path / f"{name}.csv")
    (tmp_path / "GT").mkdir()
    co.write_tum(tmp_path / "GT" / "b.tum", t, np.outer(t, [5, 0, 0]))
    log = read_log(tmp_path)
    assert log.truth.position[-1, 1, 0] == 47.5
    assert (log.recording.sensors.range_std, np.nanmax(log.recording.relative)) == pytest.approx((0.2, 12.0))
    assert sum(log.summary.unused.values()) == 40


def test_a_std_that_names_no_kind_is_that_of_fixes_alone_and_is_reported_elsewhere(tmp_path):
    t = arange(0, 10, 0.5)
    fixes = pd.DataFrame({"t": t, "vehicle": "car", "x": 5 * t, "y": 0.0, "std": 2.5})
    motion = pd.DataFrame({"t": t, "vehicle": "car", "vx": 5.0, "vy": 0.0})
    folder = tmp_path / "log"
    folder.mkdir()
    write(fixes, folder / "fixes.csv")
    write(motion, folder / "motion.csv")
    (folder / "truth.csv.gz").touch()
    log = read_log(folder)
    assert log.summary.refused["files of kinds that are not read"] == (1, "truth.csv.gz")
    assert log.recording.sensors.gnss_std[:2] == pytest.approx((2.5, 2.5))
    assert any("std of fixes.csv is the standard deviation of each of x, y" in one for one in log.summary.assumed)
    (folder / "old").mkdir()
    write(fixes, folder / "old" / "gps.csv")
    assert "left out: old. " in f"{read_log(folder).summary}"
    write(fixes.assign(t=t + 0.1), folder / "gps.csv")
    write(motion.assign(t=t + 0.1), folder / "wheel.csv")
    assert "one kind of car (motion.csv, wheel.csv), car (fixes.csv, gps.csv) come" in f"{read_log(folder).summary}"
    mixed = read_log(write(fixes.assign(vx=5.0, vy=0.0, value=1.0), tmp_path / "mixed.csv"))
    assert mixed.recording.sensors.gnss_std[:2] == pytest.approx(co.Sensors().gnss_std[:2])
    unused = " ".join(map(str, mixed.summary.unused))
    assert "column std, which belongs to no kind (name it x_std)" in unused
    assert "column value" in unused


def test_a_bearing_is_turned_by_the_heading_at_its_own_time(tmp_path):
    """The observer turns at 0.5 rad/s and measures a road-side unit between the steps; closed form, there and at the
    step."""
    t = arange(0, 10, 0.1)
    at = t[10:90:5] + 0.04
    heading = 0.3 + 0.5 * np.append(t, at)
    (x, own), (heading, h) = (np.split(values, [len(t)]) for values in (-6j * exp(1j * heading), heading))
    wide = pd.DataFrame({"t": t, "vehicle": "car", "x": x.real, "y": x.imag, "speed": 3.0, "yaw_rate": 0.5})
    wide.loc[::50, "heading"] = np.angle(exp(1j * heading[::50]))
    azimuth = np.angle(20 + 5j - own)
    radio = pd.DataFrame(
        {"t": at, "vehicle": "car", "partner": "rsu", "bearing_deg": np.degrees(np.angle(exp(1j * (azimuth - h))))}
    )
    (tmp_path / "log").mkdir()
    write(wide, tmp_path / "log" / "car.csv")
    write(radio, tmp_path / "log" / "camera.csv")
    write(pd.DataFrame({"t": [0.0], "vehicle": "rsu", "x": 20.0, "y": 5.0}), tmp_path / "log" / "rsu.csv")
    log = read_log(tmp_path / "log", dt=0.1)
    rec, col = log.recording, log.recording.ids.index("car")
    assert_allclose(rec.relative[0, :, 1], azimuth, atol=0.01)
    assert_allclose(rec.relative[0, :, 1], np.angle(20 + 5j - x[10:90:5]), atol=2e-4)
    assert np.isnan(rec.relative[0, :, [0, 2]]).all()
    true = 3 * exp(1j * heading)
    assert_allclose(rec.velocity[0, 1:, col] @ [1, 1j, 0], (true[1:] + true[:-1]) / 2, atol=2e-3)
    assert (rec.gnss[0, :, rec.ids.index("rsu")] == [20.0, 5.0, 0.0]).all()
    assert "stands at" in log.summary.vehicles["rsu"]


def test_slow_fixes_are_brought_to_their_step_by_the_odometry(tmp_path):
    """1 Hz fixes 0.03 s beside the steps of 10 Hz odometry: without the motion they were 0.24 m off."""
    fleet = drive(1)
    u, times = fleet.velocity[:, 0], arange(3, 190, 10) * 0.1 + 0.03
    x, y, _ = at(fleet, "car0", times).T
    (tmp_path / "log").mkdir()
    write(pd.DataFrame({"t": fleet.t, "vehicle": "a", "vx": u[:, 0], "vy": u[:, 1]}), tmp_path / "log" / "odometry.csv")
    write(pd.DataFrame({"t": times, "vehicle": "a", "x": x, "y": y}), tmp_path / "log" / "gnss.csv")
    log = read_log(tmp_path / "log")
    fixed = isfinite(log.recording.gnss[0, :, 0, 0])
    assert np.flatnonzero(fixed).tolist() == list(range(3, 190, 10))
    assert_allclose(log.recording.gnss[0, fixed, 0], fleet.position[fixed, 0], atol=0.01)
    assert log.recording.stretches("a") == ((3, 200),)
    assert log.summary.refused["steps of a before its first fix"][0] == 3


def test_a_good_receiver_is_weighed_as_it_states(tmp_path):
    """By the root mean square of both it erred by 0.5 m beside a receiver of 4 m, and helped it half as much."""
    fleet = drive(2, 600)
    parts = [fixes(fleet, *each) for each in (("car0", 1, 0.05), ("car1", 1, 4.0))]
    parts += [ranges(fleet, *fleet.ids, 0.1, 0.3), *(motion(fleet, name, 0.1, 0.3) for name in fleet.ids)]
    rec = read_log(write(pd.concat(parts), tmp_path / "log.csv")).recording
    for method in (co.Kalman(), co.CooperativeFilter()):
        assert abs(method(rec).x[0, :, 0] - at(fleet, "car0", rec.t)).mean() < 0.1


def test_a_clock_that_is_ahead_is_set_back(tmp_path):
    true = observed(drive(2, start=100.0), k=1, latency=0.2)
    frame = long(true)
    late = frame["vehicle"] == "car1"
    received = (frame["kind"] == "message") & (frame["partner"] == "car1")
    frame.loc[late, "t"] += 0.37
    frame.loc[received, "arrival"] = [f"{float(a) + 0.37:.6f}" for a in frame.loc[received, "arrival"]]
    log = read_log(write(frame, tmp_path / "log.csv"), clock={"car1": 0.37}, dt=0.1)
    assert_allclose(log.recording.gnss, true.gnss, atol=1e-5)
    assert_array_equal(np.sort(log.recording.arrival), np.sort(true.arrival))
    with refused(r"clock = 'car9'.*car0, car1"):
        read_log(tmp_path / "log.csv", clock={"car9": 1.0})


def test_vehicles_come_and_go_and_nothing_is_dropped_in_silence(tmp_path):
    frame = long(observed(drive(3)), messages=False)
    gone = (frame["vehicle"] == "car2") & (frame["t"] > 5.02) & (frame["t"] < 12.02)
    log = read_log(write(frame[~(gone & frame["kind"].isin(["vx", "vy", "vz"]))], tmp_path / "log.csv"))
    rec, refused = log.recording, log.summary.refused
    absent = np.isnan(rec.velocity[0, :, 2, 0])
    assert np.flatnonzero(absent)[[0, -1]].tolist() == [52, 119]
    assert not isfinite(rec.gnss[0, absent, 2]).any()
    assert refused["fixes in gaps of the odometry"][0] == absent.sum()
    one = [why for why in refused if "one of the two is absent" in why]
    kept = isfinite(rec.relative).sum()
    assert refused[one[0]][0] + kept == frame["kind"].isin(["range", "azimuth", "inclination"]).sum()
    assert rec.stretches("car2") == ((0, 52), (120, 200))
    assert read_log(tmp_path / "log.csv", max_gap=8.0).recording.stretches("car2") == ((0, 200),)


def test_a_speed_that_is_turned_by_a_noisy_heading_is_as_uncertain(tmp_path):
    """Closed form: eight cars at 10 m/s on bends, headings of 0.05 rad every 0.4 s; NEES is 2 in a plane if consistent,
    and was 43 with the noise of the speeds alone."""
    rng, rows, truth = default_rng(8), [], []
    t = np.round(arange(0, 60, 0.1), 1)
    for car in range(8):
        turn = 0.2 * sin(0.3 * t + car)
        heading = car + np.cumsum(turn) * 0.1
        x = np.cumsum(1.0 * np.c_[cos(heading - turn / 20), sin(heading - turn / 20)], axis=0)
        for k, now in enumerate(t):
            truth.append((now, f"car{car}", *x[k]))
            rows.append((now, f"car{car}", "speed", 10 + rng.normal(0, 0.1), 0.1))
            rows.append((now, f"car{car}", "yaw_rate", turn[k], 0.001))
            rows += [(now, f"car{car}", axis, x[k, i] + rng.normal(0, 1.5), 1.5) for i, axis in enumerate("xy")]
            if k % 4 == 0:
                angle = heading[k] + rng.normal(0, 0.05)
                rows.append((now, f"car{car}", "heading", arctan2(sin(angle), cos(angle)), 0.05))
    write(pd.DataFrame(rows, columns=["t", "vehicle", "kind", "value", "std"]), tmp_path / "log.csv")
    write(pd.DataFrame(truth, columns=["t", "vehicle", "x", "y"]), tmp_path / "truth.csv")
    log = read_log(tmp_path / "log.csv", truth=tmp_path / "truth.csv")
    assert log.recording.sensors.velocity_floor == pytest.approx(np.sqrt((0.1**2 + 4 * (10 * 0.05) ** 2) / 2), rel=0.01)
    assert 1.2 < nees(co.Kalman()(log.recording, list(log.recording.ids)), log.truth)[:, 100:].mean() < 2.8


LATE = 0.04
"""s, behind every step of 0.1 s."""
MAST = array([40.0, 60.0])


def straight(t):
    """Two cars that pass each other at 25 m/s."""
    here = np.asarray(t, float)
    return {"east": array([15 * here - 100, 0 * here]), "west": array([60 - 10 * here, 4 + 0 * here])}


def circle(t):
    """Place m and heading rad of a car at 6 m/s that turns by 0.5 rad/s."""
    return array([12 * sin(0.5 * t), -12 * cos(0.5 * t)]), 0.5 * t


def read_rows(rows, folder, **options: Any):
    file = folder / "log.csv"
    pd.DataFrame(rows, columns=["t", "vehicle", "kind", "partner", "value"]).to_csv(file)
    return co.read_log(file, **options).recording


@pytest.mark.parametrize("late", [0.0, LATE, -LATE])
def test_ranges_and_azimuths_of_passing_cars_are_those_at_the_step(tmp_path, late):
    """Moved by the nearest step alone, ranges were wrong by 1 m."""
    rows: list[tuple[Any, ...]] = [(0.0, "mast", kind, "", MAST[k]) for k, kind in enumerate("xy")]
    for t in np.round(arange(0, 8, 0.1), 1):
        at = straight(t)
        for name, speed in (("east", 15.0), ("west", -10.0)):
            rows += [(t, name, kind, "", value) for kind, value in zip("xy", at[name], strict=True)]
            rows += [(t, name, "vx", "", speed), (t, name, "vy", "", 0.0)]
        then = straight(t + late)
        for other, place in (("west", then["west"]), ("mast", MAST)):
            gap = place - then["east"]
            rows += [(t + late, "east", "range", other, np.hypot(*gap))]
            rows += [(t + late, "east", "azimuth", other, arctan2(gap[1], gap[0]))]
    found = read_rows(rows, tmp_path, mutual=False)
    links, place = found.links, found.gnss[0]
    gap = (place[links.step, links.neighbour] - place[links.step, links.observer])[:, :2]
    far = np.hypot(*gap.T) > 12.0  # nearer, fixes would not know the direction
    assert far.sum() > 120
    assert_allclose(found.relative[0, far, 0], np.hypot(*gap[far].T), atol=1e-9)
    assert_allclose(found.relative[0, far, 1], arctan2(gap[far, 1], gap[far, 0]), atol=1e-9)
    assert isfinite(found.relative[0]).all() == (not late)  # of what is too near
    assert not (found.relative[0, :, 0] <= 0).any()


@pytest.mark.parametrize("late", [LATE, -LATE])
def test_bearings_in_body_frames_turn_with_the_car(tmp_path, late):
    """Closed form: the bearing of what is far away."""
    rows: list[tuple[Any, ...]] = []
    far = 1e6 * MAST
    rows += [(0.0, "far", kind, "", value) for kind, value in zip("xy", far, strict=True)]
    for t in np.round(arange(0, 6, 0.1), 1):
        place, _ = circle(t)
        rows += [(t, "car", "speed", "", 6.0), (t + 1e-3, "car", "yaw_rate", "", 0.5)]
        rows += [(t, "car", kind, "", value) for kind, value in zip("xy", place, strict=True)]
        then, heading = circle(t + late)
        bearing = arctan2(*(far - then)[::-1]) - heading
        rows.append((t + late, "car", "bearing", "far", arctan2(sin(bearing), cos(bearing))))
    log = read_rows(rows, tmp_path, frame="body", any_scale=True)
    assert (len(log.links) >= 59, log.dt) == (True, pytest.approx(0.1))  # not that of two sensors' stamps
    for step, relative in zip(log.links.step, log.relative[0], strict=True):
        place, heading = circle(log.t[step])
        off = relative[1] - arctan2(*(far - place)[::-1]) + heading
        assert arctan2(sin(off), cos(off)) == pytest.approx(0, abs=1e-4)


@pytest.mark.parametrize("seed", range(4))
def test_the_mean_over_a_step_is_that_over_its_halves(seed):
    rng = default_rng(seed)
    signal = Signal(np.cumsum(rng.uniform(0.01, 1.0, 9)), rng.uniform(-1e6, 1e6, (9, 1)))
    halves = step_means(signal, 0.15 * arange(-1, 17))[:, 0]
    whole = step_means(signal, 0.3 * arange(9))[:, 0]
    assert_allclose(whole, (halves[::2] + halves[1::2]) / 2, atol=1e-6, rtol=1e-9)


def test_deviations_are_stated_in_any_unit(tmp_path):
    """The closed form: 3.6 km/h are 1 m/s, a knot is 1852 m an hour, and those of a latitude are m."""
    for speed, std in {"speed_kmh": 3.6, "speed_knots": 3600 / 1852}.items():
        rows = f"t,vehicle,latitude,longitude,height,{speed},compass_deg\n"
        rows += "".join(f"{k},a,48,{11 + 1e-5 * k},1,{std},90\n" for k in range(9))
        (tmp_path / "a.csv").write_text(rows)
        found = load_log(f"{tmp_path}?std=latitude:2,longitude:1,height:3,{speed}:{std}").recording
        assert (found.sensors.gnss_std, found.sensors.velocity_floor) == ((1.0, 2.0, 3.0), pytest.approx(1.0))
        assert_allclose(found.velocity[0, :, 0, 0], 1.0)


def test_a_radars_range_is_not_known_to_its_partner(tmp_path):
    log = read_log(strange(tmp_path, "car", seconds=30.0))
    assert (log.recording.links.observer > log.recording.links.neighbour).all()
    assert "ranges beside a direction count for who measured them alone" in str(log.summary)


@pytest.mark.parametrize("std", [3.5, None])
def test_noisy_fixes_at_a_high_rate_have_no_speed_of_their_own(tmp_path, std):
    """588 m/s from one to the next; of days the speed is one."""
    t = arange(0, 20, 0.01)
    x, y = default_rng(0).normal(0, 3.5, (2, len(t)))
    drive = pd.DataFrame({"t": t, "x": 10 * t + x, "x_std": std, "y": y, "z": x, "vx": 10.0, "vy": 0.0})
    log = read_log(write(drive, tmp_path / "a.csv"))
    assert log.summary.read["fixes"] == len(t)
    assert log.recording.sensors.gnss_std[2] == pytest.approx(3.5, rel=0.1)  # which fixes show
    with refused(r"a typical speed of [89].*e\+05 m/s"):
        read_log(write(drive.assign(t=t / 86400), tmp_path / "a.csv"))

"""What `coopoc data check` says of logs with faults that are easy to overlook, and what a log is read as."""

import re
from dataclasses import replace
from itertools import permutations
from time import process_time
from typing import Any

import numpy as np
import pandas as pd
import pytest
from conftest import refused
from logs import bends, drive, fixes, motion, noisy, outliers, ranges, write
from numpy import arange, cumsum, exp, nan, pi, sin, where
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from strange_logs import strange

import coopoc as co
from coopoc.data.log.check import check
from coopoc.data.log.estimates import factors
from coopoc.data.log.read import read_log
from coopoc.data.registry import read_log as load_log


def said(log):
    return "\n".join(check(log).warnings)


def cars(folder, change=lambda frame: frame, rate=0.1):
    """Two cars on a plane: fixes twice a second, odometry, ranges five times a second by the first alone."""
    fleet = bends()
    parts = [ranges(fleet, "car0", "car1", 0.2, 0.3)]
    for seed, name in enumerate(fleet.ids):
        parts += [fixes(fleet, name, 0.5, 1.0, seed).drop(columns="z")]
        parts += [motion(fleet, name, rate, 0.1, seed).drop(columns="vz")]
    folder.mkdir(exist_ok=True)
    write(change(pd.concat(parts, ignore_index=True)), folder / "log.csv")
    write(pd.concat([fixes(fleet, name, 0.1, 1e-9).drop(columns="z") for name in fleet.ids]), folder / "truth.csv")
    return folder


FAULTS: dict[str, tuple[Any, str]] = {
    "none": (lambda f: f, "^$"),
    "one range of twenty": (lambda f: f.assign(range=outliers(f["range"])), r"[345]\.\d% of the ranges lie beyond 5"),
    "one fix of twenty": (
        lambda f: f.assign(x=f["x"] + 15 * f.index.isin(np.flatnonzero(f["x"].notna())[::20])),
        r"car0: [45]\.\d% of the fixes lie beyond 5",
    ),
    "deviations in degrees": (lambda f: f.assign(yaw_rate=0.0, yaw_rate_std=0.6), "yaw_rate are 0.6 rad: if.*:0.0105"),
    "ranges of one end": (
        lambda f: pd.concat(
            [f, f.dropna(subset="range").eval("vehicle = partner\npartner = 'car0'\nrange = range + 1")]
        ),
        "ranges of car1 to car0 by .[01]",
    ),
    "reflections that last": (
        lambda f: f.assign(range=f["range"] + 4 * f["t"].between(40, 60)),
        "off for long, by no offset: car0 to car1 by [34]",
    ),
    "milliseconds": (
        lambda f: f.assign(t=1000 * f["t"] + 40 * f["range"].notna()),
        r"car0: .*Is t in ms \(scale=t:1e-3\)",
    ),
    "stamps without their fraction": (
        lambda f: f.assign(t=np.floor(f["t"])),
        r"\d\d% of what was logged is not used, mostly \d+ repeated rows .*stamp\.sec without nanosec",
    ),
    "a body twist as vx, vy": (
        lambda f: f.assign(vx=np.hypot(f["vx"], f["vy"]), vy=0.1 * sin(arange(len(f))) + 0 * f["vx"]),
        "car0: vx, vy look like a body-frame velocity",
    ),
    "degrees": (lambda f: f.rename(columns={"x": "y", "y": "x"}).eval("x = 1.6 * x"), "car0: axes look swapped"),
    "a mirrored velocity": (lambda f: f.assign(vy=-f["vy"]), "car0: axes look swapped or mirrored: .* at -?0 deg"),
    "a partner without a place": (
        lambda f: pd.concat([f, f[f["range"].notna()].assign(partner="anchor")]),
        r"\d+% of what was logged is not used, mostly \d+ relative measurements of members without a position .anchor",
    ),
    "another time zone": (
        lambda f: f.assign(t=f["t"] + 1800 * f.vehicle.eq("car1")),
        "car1: it is there when no other vehicle is: do clocks or time zones differ",
    ),
    "another zone of UTM": (
        lambda f: f.assign(x=f["x"] + 1e4 * (f.t > 90)),
        r"car0: its fixes jump by 1e\+04 m at 90.6 s, and stay there",
    ),
    "another frame": (
        lambda f: f.assign(x=f["x"] + 4e6 * f["vehicle"].eq("car1")),
        "car1: its fixes lie 4000 km from all",
    ),
    "velocities of the past": (
        lambda f: f.assign(t=f["t"] + 0.06 * f["vx"].notna()),
        r"car0: its odometry is 0\.0[56]\d* \+- \S+ s later than the truth, its fixes are not",
    ),
    "leap seconds": (lambda f: f.assign(t=f["t"] + 18 * f["x"].notna()), r"car1: its fixes are 18 s behind the"),
    "a fix held": (lambda f: f.assign(x=f["x"].where(~f["t"].between(9, 30), 5), y=0 * f["x"]), "fixes that repeat"),
    "fixes far from the truth of who stands": (
        lambda f: f.assign(**dict.fromkeys(["x", "y", "vx", "vy"], 0 * f["x"])),
        r"car0: fixes lie \S+ m east and \S+ m north of the truth in the median. Has it another frame",
    ),
}


def test_hundreds_of_clocks_are_estimated_in_seconds():
    row, began = arange(12000), process_time()
    x = np.zeros((12000, 200))
    x[row, row % 200] = sin(row)
    assert_allclose(factors(x.sum(1) + 0.1 * np.cos(row), x, 0.1).value, 1.0, atol=0.1)
    assert process_time() - began < 3.0


def test_an_offset_of_ranges_is_taken_off(tmp_path):
    """Two metres on every range, and a range that is too large by two metres in millimetres."""
    folder = cars(tmp_path / "log", lambda f: f.assign(range=1000 * (f["range"] + 2)))
    log = read_log(folder, scale={"range": 1e-3}, std={"range": 0.3}, offset={"range": 2.0})
    assert said(log) == ""
    assert_allclose(log.recording.relative, read_log(cars(tmp_path / "plain")).recording.relative, atol=1e-9)
    pair = read_log(folder, scale={"range": 1e-3}, std={"range": 0.3}, offset={"car1-car0": 2.0, "range": 9.0})
    assert_array_equal(pair.recording.relative, log.recording.relative)
    with refused("offset = 'uwb': must be one of"):
        read_log(folder, offset={"uwb": 1.0})


@pytest.mark.parametrize("truth", [True, False])
def test_an_antenna_elsewhere_is_found_and_taken_off(tmp_path, truth):
    """1.5 m ahead and 0.6 m to the right of a car whose speed changes, with fixes of 0.5 m that come 0.1 s late."""
    t, arm = 0.02 * arange(9000), (1.5, -0.6)
    ahead, speed = exp(2.5j * sin(0.1 * t)), 8 + 4 * sin(0.21 * t)
    position, velocity = (
        np.c_[part.real, part.imag, 0 * t][:, None] for part in (cumsum(0.02 * speed * ahead), speed * ahead)
    )
    reference = co.Fleet(("car",), t, position, velocity)
    seen = position[:, 0, :2] @ [1, 1j] + complex(*arm) * ahead - 0.1 * speed * ahead
    moved = replace(reference, position=np.c_[seen.real, seen.imag, 0 * t][:, None])
    parts = [fixes(moved, "car", 0.5, 0.5), motion(reference, "car", 0.1, 0.1)]
    write(pd.concat(parts).drop(columns=["z", "vz"]), tmp_path / "log.csv")
    if truth:
        write(fixes(reference, "car", 0.1, 1e-9).drop(columns="z"), tmp_path / "truth.csv")
    (line,) = [text for text in check(read_log(tmp_path)).warnings if "antenna=" in text]
    ahead_of, one, left, other, *_ = map(float, re.findall(r"-?\d+\.\d+", line))
    assert_allclose([ahead_of, left], arm, atol=4 * max(one, other))
    assert max(one, other) < (0.1 if truth else 0.3)
    assert "antenna=" not in said(load_log(f"{tmp_path}?{line.split()[-4]}"))


def test_wrong_ranges_are_named_and_mislead_no_filter(tmp_path):
    """From the file to the study's rows: with wrong ranges cooperation still helps, without gates it does not."""
    folder = cars(tmp_path / "log", lambda f: f.assign(range=outliers(f["range"], 0.1)))
    log = read_log(folder)
    assert "of the ranges lie beyond 5" in said(log)
    settings = {"data": str(folder), "method": "kalman,joint", "max_neighbours": "1"}
    results = co.run_study("side_by_side", tmp_path / "out", settings=settings, progress=False)
    assert not results.failed
    error = results.frame.groupby("method")["rt_le_m"].mean()
    assert error["joint"] < 0.99 * error["kalman"]
    assert co.rt_le(co.JointFilter(robust=False)(log.recording, ["car0", "car1"]), log.truth).mean() > error["kalman"]


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_has_a_line(tmp_path, fault):
    change, message = FAULTS[fault]
    text = said(read_log(cars(tmp_path / "log", change), **{"dt": 0.2} if "stamps" in fault else {}))
    assert pd.Series([text]).str.contains(message, regex=True)[0], text
    if "look" not in message:
        assert "look" not in text


def test_what_lasting_errors_of_fixes_may_be_is_no_offset(tmp_path):
    cars(tmp_path, lambda f: f.assign(range=f["range"] + 1.5, x_std=3.0, y_std=3.0))
    assert "offset" not in said(read_log(tmp_path / "log.csv"))


def test_a_range_is_known_to_both_ends_and_used_between_steps(tmp_path):
    """Odometry at 50 Hz, ranges at 5 Hz that one car logged: both are helped, at steps as fixes and ranges come."""
    log = read_log(cars(tmp_path / "log", rate=0.02))
    assert log.recording.dt == pytest.approx(0.2)
    assert "steps of 0.2 s, as fixes and pairs are measured; odometry every 0.02 s is averaged" in str(log.summary)
    assert "900 ranges count for the other end, too" in str(log.summary)
    own = read_log(tmp_path / "log", mutual=False)
    assert "count for the other end" not in str(own.summary)
    alone, joint, one_way = (
        co.rt_le(method(part.recording, ["car0", "car1"]), log.truth)[0]
        for method, part in ((co.Kalman(), log), (co.JointFilter(), log), (co.JointFilter(), own))
    )
    assert (joint < 0.97 * alone).all()
    assert one_way[0] < 0.97 * alone[0]
    assert one_way[1] == pytest.approx(alone[1], abs=1e-4)
    assert read_log(tmp_path / "log", dt=0.02).recording.dt == 0.02


def test_the_height_of_a_truth_above_another_surface_is_named(tmp_path):
    """Four drones with a folder each of fixes and of their radio; the truth is above the geoid, one is 0.8 m off."""
    fleet, log = bends(4, climb=20.0), tmp_path / "drones"
    log.mkdir()
    for seed, name in enumerate(fleet.ids):
        parts = [fixes(fleet, name, 0.5, 0.5, seed).assign(z_std=0.5), motion(fleet, name, 0.1, 0.05, seed)]
        radio = [ranges(fleet, name, other, 0.2, 0.1, seed) for other in fleet.ids if other != name]
        (log / name).mkdir()
        write(pd.concat(parts).drop(columns="vehicle"), log / name / "gps.csv")
        write(pd.concat(radio).drop(columns="vehicle"), log / name / "radio.csv")
        (log / name / "._gps.csv").write_bytes(b"\x00\xff")
    for up, message in (
        (0.0, ""),
        (15.0, "car0: fixes lie -15 m above the truth in the median"),
        (0.8, "car0: fixes lie -0."),
    ):
        tables = [fixes(fleet, name, 0.1, 1e-9) for name in fleet.ids]
        tables[0]["z"] += up
        write(pd.concat(tables), log / "truth.csv")
        text = said(read_log(log))
        assert message in text
        assert ("above the truth" in text) == bool(up)


def test_what_is_added_to_all_ranges_is_no_scale(tmp_path):
    pairs = dict.fromkeys(permutations([f"drone{k}" for k in range(4)], 2), 40.0)
    assert "times as long" not in said(read_log(strange(tmp_path / "log", "drone", seconds=60, pairs=pairs)))


@pytest.mark.parametrize(("who", "offset"), [("logged", 0.8), ("not logged", 0.8), ("logged", 20.0)])
def test_an_offset_of_the_ranges_of_one_is_named(tmp_path, who, offset):
    log = strange(tmp_path / "log", "drone", seconds=90, pairs={(f"drone{k}", "drone2"): offset for k in (0, 1, 3)})
    (log / "truth.csv").unlink()
    text = said(read_log(log, std=None if who == "logged" else {"range": 1.0}))
    assert len(re.findall("drone2 (?:and drone. )?by [+]", text)) == text.count(" by +") == 3
    assert "offset=drone" in text


@pytest.mark.parametrize("known", [True, False])
def test_offsets_of_pairs_are_found_on_the_first_part(tmp_path, known):
    """Those that were added, to 0.03 m with a truth and 0.1 m without one; they are gone from the rest."""
    path = strange(tmp_path / "log", "drone", pairs={("drone0", "drone1"): 0.5, ("drone0", "drone2"): -0.3})
    if not known:
        (path / "truth.csv").unlink()
    (option,) = re.findall(r"offset=(\S+) takes", said(load_log(f"{path}?until=130")))
    found = {pair: float(by) for pair, _, by in (each.partition(":") for each in option.split(","))}
    assert found == pytest.approx({"drone0-drone1": 0.5, "drone0-drone2": -0.3}, abs=0.03 if known else 0.1)
    assert "offset=" not in said(load_log(f"{path}?offset={option}&since=130"))


def test_a_car_that_stands_without_a_heading_keeps_its_fixes(tmp_path):
    """As receivers do, which give a course to what moves alone: a third of the drive stands."""
    t = np.round(arange(0, 90, 0.2), 1)
    moves = (t < 30) | (t >= 60)
    x = cumsum(where(moves, 1.6, 0.0))
    frame = pd.DataFrame({"t": t, "vehicle": "car", "x": x, "y": 0.0, "speed": where(moves, 8.0, 0.02)})
    frame["heading"] = where(moves, 0.0, nan)
    log = read_log(write(frame, tmp_path / "car.csv"))
    assert np.isfinite(log.recording.gnss[0, :, 0, 0]).all()
    assert not log.summary.refused
    assert_allclose(log.recording.velocity[0, ~moves & (t > 31), 0], 0.0, atol=0.03)
    frame.loc[~moves, "speed"] = nan  # a receiver that says nothing while it stands
    text = said(read_log(write(frame, tmp_path / "car.csv")))
    assert "mostly 14" in text
    assert "fixes in gaps of the odometry" in text
    assert "Where a vehicle stands, log a speed of 0" in text


def test_fixes_of_what_stands_err_too(tmp_path):
    x, y = default_rng(0).normal(0, 10, (2, 300))
    frame = pd.DataFrame({"t": arange(300), "x": x, "y": y, "vx": 0, "vy": 0})
    assert "NIS is" in said(read_log(write(frame, tmp_path / "a.csv")))
    assert "none of which changes" in str(check(read_log(write(frame.assign(x=0, y=0), tmp_path / "a.csv"))).unseen)


def test_noise_of_velocities_is_no_late_clock(tmp_path):
    """At steps of 1 s the noise of a velocity moves the filter at once."""
    fleet = drive(1, 300, 1.0)
    log = fixes(fleet, "car0", 1.0, 0.5).merge(motion(fleet, "car0", 1.0, 1.5, 5))
    assert said(read_log(write(log, tmp_path / "a.csv"))) == ""


def test_one_car_with_a_gap_and_columns_of_its_own(tmp_path):
    fleet = bends(1)
    frame = fixes(fleet, "car0", 1.0, 1.0).merge(motion(fleet, "car0", 0.1, 0.1), how="outer", on=["t", "vehicle"])
    frame = frame[~frame["t"].between(60, 80)].drop(columns=["vehicle", "z", "vz"])
    frame = frame.assign(qx=0.1)
    log = read_log(write(frame.assign(id=7, course_deg=90.0), tmp_path / "taxi.csv"))
    assert log.recording.ids == ("taxi",)
    (first, last), (again, end) = log.recording.stretches("taxi")
    assert (first, last, end) == (0, pytest.approx(600, abs=5), len(log.recording.t))
    assert again == pytest.approx(805, abs=5)  # with the first fix behind the gap
    text = said(log)
    assert "x?" not in text, "a quaternion's qx is no x"
    assert "column id, Did you mean vehicle?; taxi.csv: column course_deg, Did you mean compass_deg?" in text


@pytest.mark.parametrize("given", ["vx,vy", "heading,speed", "", "speed,yaw_rate"])
def test_an_arm_of_an_antenna_is_taken_off(tmp_path, given):
    """Closed form: on a circle of radius r to the left an antenna drives one of hypot(r - left, forward), and its own
    course is off by arctan2(forward, r - left)."""
    t, r, arm = np.round(arange(0, 90, 0.1), 1), 30.0, 1.5 + 0.5j
    ahead = 1j * exp(0.2j * t)
    seen, u = (arm - 1j * r) * ahead, 0.2 * r * ahead
    every = {
        "t": t,
        "x": seen.real,
        "y": seen.imag,
        "vx": u.real,
        "vy": u.imag,
        "heading": np.angle(u),
        "speed": abs(u),
    }
    frame = pd.DataFrame({**every, "yaw_rate": 0.2})[["t", "x", "y", *filter(None, given.split(","))]]
    file = f"{write(frame, tmp_path / 'car.csv')}?frame={'body' if 'yaw' in given else 'world'}"
    course = exp(1j * np.arctan2(1.5, r - 0.5) * (given in ("", "speed,yaw_rate")))
    for option in ("", "&antenna=1.5/0.5/9", "&antenna=car:1.5/0.5/9"):
        off = bool(option) * arm * course
        rec = load_log(file + option).recording
        late = slice(30 * (given == "speed,yaw_rate"), None)  # when the fixes have shown where it points
        near = 0.4 if given == "" else 0.05  # m, since a course of fixes lags behind
        assert_allclose(rec.gnss[0, late, 0] @ [1, 1j, 0], (seen - off * ahead)[late], atol=near)
        assert ("reference point, of car (1.5, 0.5, 0 m forward, left, up, by" in " ".join(rec.notes)) == bool(option)


def turned_drive(folder, speed, turn, seconds=120.0):
    """A car that goes round in circles or stops, fixes of 1 m once a second, headings turned by an angle."""
    folder.mkdir(exist_ok=True)
    rng, t = default_rng(1), arange(0, seconds, 0.04)
    v = speed(t)
    heading = cumsum(0.01 * v * 0.04)
    x, y = cumsum(v * np.cos(heading)) * 0.04, cumsum(v * sin(heading)) * 0.04
    fixed = arange(len(t)) % 25 == 0
    seen = [where(fixed, at + rng.normal(0, 1.0, len(t)), nan) for at in (x, y)]
    odometry = {"speed": v * rng.normal(1, 0.02, len(t)), "heading": np.angle(exp(1j * (heading + turn)))}
    write(pd.DataFrame({"t": t, "vehicle": "a", "x": seen[0], "y": seen[1], **odometry}), folder / "log.csv")
    write(pd.DataFrame({"t": t, "vehicle": "a", "x": x, "y": y})[::5], folder / "truth.csv")
    return folder


@pytest.mark.parametrize(
    ("speed", "turn", "words"),
    [
        (lambda t: 0 * t + 10, 0.05, r"(?!(.|\n)*behind)(.|\n)*its odometry is turned by 2\."),
        (lambda t: 10 * sin(t * pi / 20).clip(0), 0.05, r"(.|\n)*turned by (2\.[89]|3\.0)\d? \+- 0\.[01]\d deg"),
        (lambda t: 10 + 4 * sin(t / 2), pi, r"(.*\n)?a: fixes move -?1[78]\d deg anticlockwise .*$"),
    ],
)
def test_odometry_that_is_turned_is_nothing_else(tmp_path, speed, turn, words):
    """On a circle, without a truth, fixes passed for 0.5 s late: positions that it draws aside lie behind those of the
    filter. Of a car that stands half of the time 3 degrees were 0 +- 0, and speeds that count backwards 0.2 s early."""
    log = turned_drive(tmp_path / "log", speed, turn)
    if "behind" in words:
        (log / "truth.csv").unlink()
    text = said(read_log(log, std={"x": 1.0, "y": 1.0}))
    assert re.match(words, text), text


def test_fixes_that_are_late_beside_a_gyro_are_named(tmp_path):
    path = turned_drive(tmp_path, lambda t: 10 * sin(t / 4).clip(0), 0.0, 400.0) / "log.csv"
    log = pd.read_csv(path).drop(columns="heading").eval("yaw_rate = 0.01 * speed")
    write(log.assign(**log[["x", "y"]].shift(50)), path)
    assert "s behind its odometry" in said(read_log(path))


def test_what_may_be_chance_is_said_from_two_standard_errors_on(tmp_path):
    """Whatever the seed of the noise, an error of 1.7 degrees is named, or said to be perhaps one."""
    for seconds in (70, 80, 90):
        log = turned_drive(tmp_path / str(seconds), lambda t: 10 + 4 * sin(t / 6), 0.03, seconds)
        result = check(read_log(log / "log.csv", std={"x": 1.0, "y": 1.0}))
        every = "\n".join([*result.warnings, *result.unseen])
        assert re.search(r"turned by 1\.|whether an error of 0\.0\d+ \+- 0\.0\d+ \(rad, of the direction", every)


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("wheels", r"(scale=a\.speed:0\.9[78]\d*) mends it"),
        ("wheels in km/h", r"(scale=a\.speed_kmh:0\.9[78]\d*) mends it"),
        ("current", r"(offset=a\.vx:-0\.[23]\d*,a\.vy:\S+) takes it off"),
        ("tunnel", r"a: its fixes are off by up to \d\S+ times its standard deviation from [67]\d\d to 8\d\d s"),
    ],
)
def test_few_fixes_show_what_errs_and_the_option_mends_it(tmp_path, fault, words):
    """Fixes a minute apart, and no truth; between two of them the heading is off."""
    rng, t = default_rng(3), arange(0.0, 900.0)
    heading, v = 2.5 * sin(0.03 * t), 4 + sin(0.02 * t)
    u = v * exp(1j * heading) + 0.3 * (fault == "current")
    x = cumsum(u) - 0.5 * u
    off = 0.2 * (fault == "tunnel") * (t > 600) * (t < 660)
    kind, unit = ("speed_kmh", 3.6) if "km/h" in fault else ("speed", 1.0)
    wheels = unit * v * (1.02 if "wheels" in fault else 1.0), unit * 0.05
    measured = {kind: wheels, "heading": (heading + off, 0.01)}
    odometry, seen = noisy(rng, t, "a", measured), noisy(rng, t, "a", {"x": (x.real, 2.0), "y": (x.imag, 2.0)})
    table = pd.concat([odometry, seen[::60]])
    write(table.assign(lidar=1.0) if fault == "tunnel" else table, tmp_path / "log.csv")  # "a" is in all sentences
    found = re.search(words, said(read_log(tmp_path)))
    assert found
    for option in found.groups():
        assert said(load_log(f"{tmp_path}?{option}")) == ""

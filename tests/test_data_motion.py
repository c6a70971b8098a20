"""Logs that hold less than motion: no odometry, no heading, gaps, two rates. References are filterpy's filter of a
constant velocity with the density that is best by the truth, and filters that are told what a log does not hold."""

import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from conftest import refused
from filterpy.common import Q_continuous_white_noise
from filterpy.kalman import KalmanFilter
from numpy import arange, array, cos, cumsum, gradient, isfinite, nan, sin, where
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import coopoc as co
from coopoc.arrays import Floats
from coopoc.data.log.check import check
from coopoc.kernels.constant_velocity import BANK, constant_velocity
from coopoc.world.body_frames import in_world, turned
from coopoc.world.links import wrap

T = np.round(arange(0, 180, 0.1), 1)
TUNNEL = [k for k in range(0, len(T), 10) if not 600 < k < 900]
"""Steps that have a fix."""
FILTERS = co.Kalman(), co.JointFilter(), co.CooperativeFilter()
SPEED, COURSE = 8 + 6 * sin(T / 17), cumsum(0.1 * 0.25 * sin(T / 9) * sin(T / 40))
"""m/s and rad, of a car."""
RATE = gradient(COURSE, 0.1)


def path(name):
    """(T, 3) m: cars that stop, go and turn; a drone; a slow robot."""
    if name == "drone":
        return np.c_[3 * sin(T / 2.5), 3 * sin(T / 1.7 + 1), 1 + 0.5 * sin(T / 4)]
    if name == "robot":
        return np.c_[0.2 * T + sin(T / 20), cos(T / 11), 0 * T]
    if name == "town":
        return cumsum(np.exp(0.5j * np.pi * (T // 25))[:, None] * [1, -1j, 0], axis=0).real
    if name == "stops":
        return cumsum((abs(2.5 * T % 60 - 30) - 10).clip(0, 12)[:, None] * [0.1, 0, 0], axis=0)
    climb = 0.06 * (name == "hill") * sin(T / 10)
    return cumsum(0.1 * SPEED[:, None] * np.c_[cos(COURSE), sin(COURSE), climb], axis=0)


def axes(u, frame=""):
    """Columns of a velocity (T, 3) m/s."""
    return {f"v{axis}{frame}": u[:, c] for c, axis in enumerate("xyz")}


def log(folder, name, std, every, seed=0, steps=(), **more: Floats):
    """A log of noisy fixes at some of the steps, and of what else is measured at all of them; times and fixes."""
    x, rng = path(name), default_rng(seed)
    k = array(steps) if len(steps) else arange(0, len(T), every)
    z, std = np.full_like(x, nan), np.broadcast_to(std, x.shape)
    z[k] = x[k] + rng.normal(0, std[k])
    drive = pd.DataFrame(z, columns=[*"xyz"]).assign(t=T, vehicle="a", **more)
    drive[["x_std", "y_std", "z_std"]] = where(isfinite(z), std, nan)
    folder.mkdir(parents=True, exist_ok=True)
    drive[drive[["x", *more]].notna().any(axis=1)].to_csv(folder / "a.csv", index=False)
    pd.DataFrame(x, columns=[*"xyz"]).assign(t=T, vehicle="a").to_csv(folder / "truth.csv", index=False)
    return co.read_log(folder), T[k], z[k]


def error(read, method):
    assert read.truth is not None
    return co.rt_le(method(read.recording), read.truth)[0, 0]


def filtered(t, z, std, density):
    """filterpy's positions (M, 3) m and velocities m/s after each fix."""
    kf, x, u = KalmanFilter(dim_x=2, dim_z=1), np.empty_like(z), np.empty_like(z)
    for c in range(3):
        kf.x, kf.P = array([[z[0, c]], [0.0]]), np.diag([std**2, 100.0])
        kf.R, kf.H = array([[std**2]]), array([[1.0, 0.0]])
        for k in range(len(t)):
            if k > 0:
                kf.F = array([[1.0, t[k] - t[k - 1]], [0.0, 1.0]])
                kf.Q = Q_continuous_white_noise(2, t[k] - t[k - 1], density)
                kf.predict()
                kf.update(z[k, c])
            x[k, c], u[k, c] = kf.x[:, 0]
    return x, u


def test_one_filter_of_the_bank_is_filterpys():
    rng = default_rng(3)
    t, w, std = cumsum(rng.uniform(0.2, 0.6, 60)), 0.4, 1.5
    z = np.c_[3 * t, 0.2 * t**2, 0 * t] + rng.normal(0, 0.1, (60, 3))  # no innovation is clipped
    interval = float(np.median(np.diff(t)))
    velocity, *_ = constant_velocity(t, z, interval, 9.0, std**2, 10.0, np.full(7, w))
    assert_allclose(velocity, filtered(t, z, std, (w / interval) ** 4 * std**2)[1], atol=1e-9)
    t, x = 5.0 * arange(200), 5 * cumsum(rng.normal(0, 2, (200, 3)), 0).cumsum(0)
    proved = constant_velocity(t, x + rng.normal(0, std, x.shape), 5.0, 9.0, std**2, 10.0, BANK)[3]
    assert proved[9:].min() > 0.2 * std**2  # where gains near 1 fit any noise, that of fixes is as stated


CASES = [("town", 1.5, 50), ("car", 1.5, 10), ("car", 1.5, 1), ("drone", 0.1, 1), ("robot", 0.3, 2)]
CASES += [("stops", 0.03, 10), ("town", 0.1, 50)]


@pytest.mark.parametrize(("name", "std", "every"), CASES)
def test_fixes_alone_are_filtered_as_by_the_best_constant_velocity(tmp_path, name, std, every):
    read, t, z = log(tmp_path, name, std, every)
    assert "no odometry of a" in " ".join(read.recording.notes)
    x = path(name)[np.searchsorted(T, t)]
    densities = 10.0 ** arange(-3, 3.1, 0.5)
    best = min(np.sqrt(np.square(filtered(t, z, std, q)[0] - x).sum(1).mean()) for q in densities)
    for method in FILTERS:
        assert error(read, method) < 1.15 * best
    assert "the odometry, which they else follow" not in " ".join(check(read).warnings)


def test_a_velocity_that_few_fixes_show_is_no_surer_than_it_is(tmp_path):
    """Fixes of 5 cm, the first second: 25 cm off, and NEES 24 and 51 (Kalman filter, smoother)."""
    t, names, std = 0.1 * arange(100), list("abcde"), 0.05
    x = np.broadcast_to(15.0 * t[:, None, None] * array([1.0, 0.0]), (100, 5, 2))
    z = (x + default_rng(5).normal(0, std, x.shape)).reshape(-1, 2)
    table = pd.DataFrame(z, columns=["x", "y"]).assign(t=t.repeat(5), vehicle=names * 100, x_std=std, y_std=std)
    table.to_csv(tmp_path / "log.csv", index=False)
    recording = co.read_log(tmp_path / "log.csv").recording
    for method in (co.Kalman(), co.BatchSmoother()):
        track = method(recording, names)
        square = np.square(track.x[0, :10, :, :2] - x[:10]).sum(-1)
        assert square.mean() < 3.0 * std**2
        assert (square / track.covariance[0, :10, :, :2, :2].trace(axis1=2, axis2=3)).mean() < 1.5


@pytest.mark.parametrize("frame", ["world", "body"])
@pytest.mark.parametrize("apart", [False, True])
def test_a_drone_that_tilts_and_moves_sideways_is_turned_by_its_quaternions(tmp_path, frame, apart):
    """By SciPy's rotation; beside the filter that has the velocity in the world. Quaternions may be in a table of
    their own."""
    u, std = gradient(path("drone"), 0.1, axis=0), np.full((len(T), 3), 0.1)
    ideal = log(tmp_path / "world", "drone", 0.1, 10, **axes(u), **axes(std, "_std"))[0]
    turn = Rotation.from_euler("ZYX", np.c_[0.3 * T, 0.2 * sin(T), 0.3 * cos(T)])
    q = dict(zip(("qx", "qy", "qz", "qw"), turn.as_quat().T, strict=True))
    own = axes(turn.inv().apply(u), "_body") | axes(std, "_body_std") | ({} if apart else q)
    log(tmp_path / "body", "drone", 0.1, 10, **own, yaw_rate=0 * T + 0.3)
    if apart:
        pd.DataFrame(q).assign(t=T, vehicle="a").to_csv(tmp_path / "body/imu.csv")
    read = co.read_log(tmp_path / "body", frame=frame)
    assert "forward, y left, z up" in " ".join(read.recording.notes)
    world = in_world(read.recording) if frame == "body" else read.recording
    assert_allclose(world.velocity, ideal.recording.velocity, atol=0.03)
    assert error(read, co.PoseFilter("solo") if frame == "body" else co.Kalman()) < 1.3 * error(ideal, co.Kalman())


def test_a_body_velocity_that_errs_for_long_misleads_no_pose_filter(tmp_path):
    """By 3 % and 0.1 m/s on each axis; beside the filter that is told the errors, from when fixes have shown them."""
    u, off, rng = gradient(path("drone"), 0.1, axis=0), list[float](), default_rng(5)
    heading = wrap(0.3 * T + rng.normal(0, 0.02, len(T)))
    turn = {"heading": heading, "heading_std": 0 * T + 0.02, "yaw_rate": 0 * T + 0.3}
    for name, bias in (("slow", 0.1), ("ideal", 0.0)):
        own = turned(u, -0.3 * T) * (1 + 0.3 * bias) + [bias, -bias, bias] + rng.normal(0, 0.05, u.shape)
        log(tmp_path / name, "drone", 0.5, 10, **axes(own, "_body"), **turn, vx_body_std=0 * T + 0.05)
        rec = co.read_log(tmp_path / name, frame="body").recording
        told = rec.sensors if bias else replace(rec.sensors, speed_scale_std=0.0, velocity_bias_std=0.0)
        track = co.PoseFilter("solo", assumed=told)(rec)
        off.append(norm(track.x[0, 600:, 0] - path("drone")[600:], axis=1).mean())
        assert not bias or track.extras["vz_error"][0, -1] == pytest.approx(0.1, abs=0.02)
    assert off[0] < 1.3 * off[1]


def test_each_fix_counts_as_it_is_stated(tmp_path):
    """Of 2 cm but for half a minute."""
    poor = (T > 60) & (T < 90)
    u = SPEED * np.exp(1j * COURSE) + default_rng(2).normal(0, 0.1, (len(T), 2)) @ [1, 1j]
    std = where(poor, 3.0, 0.02)[:, None]
    read = log(tmp_path, "car", std, 2, vx=u.real, vy=u.imag, vz=0 * T, vx_std=0 * T + 0.1)[0]
    for method in (*FILTERS, co.BatchSmoother()):
        off = norm(method(read.recording).x[0, :, 0] - path("car"), axis=1)
        assert off[~poor].mean() < 0.06
        assert off[poor].mean() < 0.7


def test_vehicles_with_and_without_odometry_are_each_as_among_their_like(tmp_path):
    alone = log(tmp_path, "car", 1.5, 10, vx=SPEED * cos(COURSE), vy=SPEED * sin(COURSE), vz=0 * T)[0]
    pd.read_csv(tmp_path / "a.csv", usecols=["t", *"xyz"]).dropna().to_csv(tmp_path / "b.csv")
    both, like = co.read_log(tmp_path), co.read_log(tmp_path / "b.csv").recording
    for method in (*FILTERS, co.BatchSmoother()):
        assert abs(method(both.recording, ["b"]).x[:, ::10] - method(like).x).mean() < 0.3
        assert_allclose(method(both.recording, ["a"]).x, method(alone.recording, ["a"]).x, atol=1e-6)
    assert not any(text.startswith("b") for text in check(both).warnings)


@pytest.mark.parametrize(("std", "bias"), [(1.5, 0.0), (1.5, 0.01), (15.0, 0.003)])
def test_a_heading_that_no_one_measured_follows_from_gyro_and_fixes(tmp_path, std, bias):
    """Beside the same log with a compass of 1 degree; without a gyro beside fixes alone."""
    rng = default_rng(1)
    odometry = {"speed": 1.01 * SPEED + rng.normal(0, 0.1, len(T))}
    gyro = {"yaw_rate": RATE + bias + rng.normal(0, 0.01, len(T))}
    compass = {"heading": COURSE + rng.normal(0, np.radians(1.0), len(T))}
    alone = error(log(tmp_path / "fixes", "car", std, 10)[0], co.Kalman())
    known = error(log(tmp_path / "known", "car", std, 10, **odometry, **compass)[0], co.Kalman())
    turning = log(tmp_path / "gyro", "car", std, 10, **odometry, **gyro)[0]
    assert "is the course of the fixes, between them by yaw rates" in str(turning.summary)
    by_fixes = log(tmp_path / "course", "car", std, 10, **odometry)[0]
    for method in (co.Kalman(), co.CooperativeFilter()):
        assert error(turning, method) < max(0.85 * alone, 1.3 * known)
        assert error(by_fixes, method) < 1.3 * alone


@pytest.mark.parametrize("kind", ["speed", "heading"])
def test_a_signal_that_is_late_is_named(tmp_path, kind):
    """And no antenna."""
    signals = {"speed": 8 + 4 * sin(0.7 * T), "heading": 2.5 * sin(0.13 * T)}
    way = cumsum(0.1 * signals["speed"] * np.exp(1j * signals["heading"]))
    fixes = where(arange(len(T)) % 10, nan, way + default_rng(0).normal(0, 0.7, (len(T), 2)) @ [1, 1j])
    signals[kind] = np.interp(T - 0.5, T, signals[kind])
    pd.DataFrame({"t": T, "vehicle": "a", "x": fixes.real, "y": fixes.imag, **signals}).to_csv(tmp_path / "a.csv")
    sentences = " ".join(check(co.read_log(tmp_path)).warnings)
    assert f"a: its {kind}s are 0." in sentences
    assert "antenna" not in sentences


def test_a_heading_that_drifts_is_followed(tmp_path):
    """By 3 degrees a minute, beside fixes alone: 20 m off where its error hardly changes."""
    compass = COURSE + np.radians(3) * T / 60 + default_rng(0).normal(0, 0.01, len(T))
    odometry = {"speed": SPEED, "speed_std": 0.1 + 0 * T, "heading": compass, "heading_std": 0.01 + 0 * T}
    filter, fixes = co.CooperativeFilter(), log(tmp_path / "fixes", "car", 1.5, 10)[0]
    assert error(log(tmp_path / "drifts", "car", 1.5, 10, **odometry)[0], filter) < 1.2 * error(fixes, filter)


def test_ten_bearings_by_one_derived_heading_say_what_one_does(tmp_path):
    """Its errors last."""
    seen, std = {"speed": SPEED, "yaw_rate": RATE, "partner": "b", "bearing": 0.1 + 0 * T}, list[float]()
    for bearing in (seen["bearing"], where(arange(len(T)) % 10, nan, 0.1)):
        std.append(log(tmp_path, "car", 1.5, 10, **seen | {"bearing": bearing})[0].recording.sensors.heading_std)
    assert std[0] == pytest.approx(10**0.5 * std[1], rel=0.01)


def test_a_gyro_counts_as_its_noise_is_logged(tmp_path):
    """Beside a compass of 1 degree, on the way of a car; and what is known of no direction at the start is absent."""
    rng, speed = default_rng(1), where(T > 0, SPEED, 0.0)
    noise = {"speed_std": 0.1 + 0 * T, "yaw_rate_std": 0.001 + 0 * T}
    gyro = {"speed": speed, "yaw_rate": RATE + rng.normal(0, 0.001, len(T)), **noise}
    known = error(log(tmp_path / "known", "car", 1.0, 10, speed=speed, heading=COURSE)[0], co.Kalman())
    assert error(log(tmp_path / "gyro", "car", 1.0, 10, **gyro)[0], co.Kalman()) < 1.5 * known
    spun = gyro | {"speed": speed + 8.0 * ((T > 80) & (T < 110))}
    notes = co.Kalman()(log(tmp_path / "spun", "car", 1.0, 10, **spun)[0].recording).notes
    assert any(note.startswith("odometry, a: fails") for note in notes)
    coarse = co.read_log(tmp_path / "gyro", dt=0.5).recording
    assert np.nanmax(abs(norm(coarse.velocity[0, 1:, 0], axis=1) - np.interp(coarse.t[1:], T, speed))) < 1.5


@pytest.mark.parametrize("std", [0.05, 1.5])
def test_the_speed_of_a_slow_robot_is_along_its_course(tmp_path, std):
    pace = norm(gradient(path("robot"), 0.1, axis=0), axis=1)
    alone = error(log(tmp_path / "fixes", "robot", std, 10)[0], co.Kalman())
    assert error(log(tmp_path / "speed", "robot", std, 10, speed=pace)[0], co.Kalman()) < 1.1 * alone


@pytest.mark.parametrize("method", [co.Kalman(), co.CooperativeFilter()])
def test_a_course_that_is_held_without_fixes_is_lost_on_bends(tmp_path, method):
    """Behind a tunnel of half a minute, without a gyro."""
    read = log(tmp_path, "car", 1.5, 10, steps=TUNNEL, speed=SPEED)[0]
    track = method(read.recording)
    behind = np.flatnonzero(read.recording.t > 92)
    assert np.sqrt(np.mean(norm(track.x[0, behind, 0] - read.truth.position[behind, 0], axis=1) ** 2)) < 3.0
    assert np.nanmean(co.nees(track, read.truth)) < 4.0


def test_yaw_rates_of_the_other_sense_are_named_and_no_speed_is_blamed(tmp_path):
    sentences = " ".join(check(log(tmp_path / "log", "car", 1.5, 10, speed=SPEED, yaw_rate=-RATE)[0]).warnings)
    assert "scale=a.yaw_rate:-1 mends it" in sentences
    assert "odometry" not in sentences.replace("of fixes and odometry are", "")


@pytest.mark.parametrize("given", ["", "speed", "speed,yaw_rate"])
def test_nothing_looks_ahead(tmp_path, given):
    """A fix at 120 s that is 40 m off changes no estimate before it."""
    more = {name: {"speed": SPEED, "yaw_rate": RATE}[name] for name in given.split(",") if name}
    read = log(tmp_path / "as it was", "car", 1.0, 10, **more)[0]
    rows = pd.read_csv(tmp_path / "as it was" / "a.csv")
    rows.loc[rows["t"] == 120.0, "x"] += 40.0
    (tmp_path / "moved").mkdir()
    rows.to_csv(tmp_path / "moved" / "a.csv")
    moved = co.read_log(tmp_path / "moved").recording
    moved = replace(moved, sensors=read.recording.sensors, motion_variance=read.recording.motion_variance)
    before = read.recording.t < 119.99
    for method in (co.Kalman(), co.CooperativeFilter()):
        one, other = method(read.recording).x[:, before], method(moved).x[:, before]
        assert_allclose(one, other, atol=1e-9)


def test_a_gap_splits_a_drive_in_every_method(tmp_path):
    """Law: beyond a gap a method is what it is on the drive behind it alone. What is never there is refused."""
    read = log(tmp_path, "car", 1.5, 10, steps=TUNNEL)[0]
    rec, truth = read.recording, read.truth
    assert truth is not None
    (first, _), second = rec.stretches("a")
    assert first == 0
    for method in (co.GNSS(), *FILTERS, co.MSMV()):
        track = method(rec)
        assert 20 < track.absent.sum() < 32
        assert np.isnan(track.x[:, track.absent[:, 0]]).all()
        assert_allclose(track.x[:, slice(*second)], method(rec.between(*second)).x)
        assert isfinite(co.rt_le(track, truth)).all()
        assert isfinite(co.max_error(track, truth)).all()
        assert any("no estimate there" in note for note in track.notes)
    with refused("absent"):
        co.Kalman()(replace(rec, velocity=nan * rec.velocity))


def test_hills_are_followed_by_fixes_that_are_denser_than_odometry(tmp_path):
    """Without a vertical velocity a height erred by 6 m; at steps of the odometry nine of ten fixes were lost."""
    seldom = where(arange(len(T)) % 10, nan, 1.0)
    read = log(tmp_path / "log", "hill", 1.5, 1, speed=SPEED * seldom, heading=COURSE * seldom)[0]
    assert read.recording.dt == 0.1
    assert error(read, co.Kalman()) < 0.3 * error(read, co.GNSS())


@pytest.mark.parametrize("kind", ["vz", "vz_body"])
def test_a_velocity_upwards_counts_at_its_own_times(tmp_path, kind):
    """Beside a speed at twice the rate and other stamps; without one it is counted as left out."""
    up, step = np.gradient(path("hill")[:, 2], 0.1), np.arange(len(T))
    beside = {"speed": np.where(step % 2, nan, SPEED), kind: np.where(step % 4 == 1, up, nan)}
    rec = log(tmp_path, "hill", 1.5, 10, heading=COURSE, **beside)[0].recording
    assert_allclose(rec.velocity[0, :, 0, 2], np.interp(rec.t, T, up), atol=0.06)
    assert rec.sensors.climb_std == 0.0
    assert f"{len(T) // 4} velocities aside or up" in str(co.read_log(tmp_path, ignore=["speed"]).summary)


def test_stamps_at_two_rates_are_kept(tmp_path):
    steps = cumsum(np.tile([2, 3], 300))
    read, t, _ = log(tmp_path, "car", 1.5, 1, steps=steps[steps < len(T)].tolist())
    assert isfinite(read.recording.gnss[0, :, 0, 0]).sum() == len(t)


STRANGE = {
    "stands, without noise": (0.0, arange(60.0)),
    "two fixes": (8.0, arange(2.0)),
    "bursts": (20.0, np.sort(np.ravel(arange(60.0)[:, None] + [0.0, 0.05, 0.9]))),
    "a train": (80.0, 0.1 * arange(60)),
}
"""Name -> m/s and the times of fixes, s."""


@pytest.mark.parametrize("name", STRANGE)
def test_fixes_of_another_kind_are_followed_throughout(tmp_path, name):
    """Without noise: no estimate is farther from a fix than its standard deviation once there have been four."""
    speed, t = STRANGE[name]
    pd.DataFrame({"t": t, "vehicle": "a", "x": speed * t, "y": 0.0}).to_csv(tmp_path / "a.csv")
    rec = co.read_log(tmp_path / "a.csv").recording
    known = np.flatnonzero(isfinite(rec.gnss[0, :, 0, 0]))
    assert len(known) == len(t)
    for method in FILTERS:
        assert (norm((method(rec).x - rec.gnss)[0, known, 0], axis=-1)[4:] < 2.6).all()


NONE = {
    "heights": lambda rows, part: rows.assign(z=rows["z"].mask(part & rows["z"].notna(), -9999.0)),
    "places": lambda rows, part: rows.assign(**{k: rows[k].mask(part & rows[k].notna(), 0.0) for k in "xy"}),
    "steps": lambda rows, part: rows.fillna(dict.fromkeys("xyz", 0.0)),
    "deviations": lambda rows, part: rows.assign(x_std=rows["x_std"].mask(part & rows["x_std"].notna(), 9999.0)),
    "speeds": lambda rows, part: rows.assign(speed=rows["speed"].mask(part, 255.0)),
}


@pytest.mark.parametrize("what", NONE)
def test_numbers_that_stand_for_none_are_none(tmp_path, what):
    log(tmp_path, "car", 1.0, 10, speed=SPEED, heading=COURSE)
    rows = pd.read_csv(tmp_path / "a.csv")
    NONE[what](rows, rows["t"].between(100, 114)).to_csv(tmp_path / "a.csv")
    read = co.read_log(tmp_path)
    assert np.nanmax(abs(read.recording.gnss[0] - read.truth.position)) < 6.0
    assert np.nanmax(abs(read.recording.velocity)) < 20.0
    assert read.recording.sensors.fix_std[0] == pytest.approx(1.0)


@pytest.mark.parametrize("held", [True, False])
def test_fixes_that_are_held_are_a_gap_where_nothing_else_moves(tmp_path, held):
    """With speeds and yaw rates it is one of these, behind which the heading begins anew."""
    log(tmp_path, "car", 1.0, 10, **({} if held else {"speed": SPEED, "yaw_rate": RATE}))
    rows = pd.read_csv(tmp_path / "a.csv")
    part = rows["t"].between(120, 150)
    columns = ["x", "y", "z"] if held else ["yaw_rate"]
    rows.loc[part, columns] = rows.loc[~part & rows["t"].lt(120), columns].iloc[-1].to_numpy() if held else nan
    rows.to_csv(tmp_path / "a.csv")
    read = co.read_log(tmp_path)
    assert np.isnan(read.recording.velocity[0, :, 0, 0])[np.searchsorted(read.recording.t, [130.0, 140.0])].all()
    assert error(read, co.Kalman()) < 2.0


@pytest.mark.parametrize("every", [1, 20])
def test_a_truth_may_be_seldom_and_without_heights(tmp_path, every):
    read, *_ = log(tmp_path, "hill", 1.0, 10, **axes(gradient(path("hill"), 0.1, axis=0)))
    pd.read_csv(tmp_path / "truth.csv").drop(columns="z")[::every].to_csv(tmp_path / "truth.csv")
    assert error(co.read_log(tmp_path), co.Kalman()) < 1.5 * error(read, co.Kalman()) + 0.3


@pytest.mark.parametrize(
    ("fault", "named"),
    [
        ("smoothed", r"a: its fixes are [01]\.\d+ \+- 0\.0\d s behind its odometry"),
        ("wind", r"a: it moves by 1\.[4-6]\d \+- 0\.\d+ m/s towards -?\d deg"),
        ("down", "a: heights of fixes fall where vz is positive.* scale=a.vz:-1 mends"),
    ],
)
def test_what_a_log_holds_beside_its_odometry_is_named(tmp_path, fault, named):
    u = gradient(path("drone"), 0.1, axis=0) - [1.5 * (fault == "wind"), 0, 0]
    log(tmp_path, "drone", 0.05, 2, **axes(u * [1, 1, 1 - 2 * (fault == "down")]))
    (tmp_path / "truth.csv").unlink()
    rows = pd.read_csv(tmp_path / "a.csv")
    if fault == "smoothed":
        rows[[*"xyz"]] = rows[[*"xyz"]].interpolate().ewm(com=8).mean().where(rows[[*"xyz"]].notna())
    rows.to_csv(tmp_path / "a.csv")
    warnings = check(co.read_log(tmp_path)).warnings
    assert re.search(named, "\n".join(warnings))
    assert not re.search("too (fast|slow)|is turned by", "\n".join(warnings))


def test_a_robot_without_heights_is_read_beside_a_drone(tmp_path):
    log(tmp_path, "drone", 0.1, 2)
    pd.read_csv(tmp_path / "a.csv").drop(columns=["z", "z_std"]).assign(vehicle="b").to_csv(tmp_path / "b.csv")
    read = co.read_log(tmp_path)
    drone, robot = read.recording.gnss[0, ..., 2].T
    assert_allclose(robot, np.median(drone))

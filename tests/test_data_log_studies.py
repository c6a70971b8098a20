"""Logs of one's own from file to table and picture: the check, studies, and a Recording as a setting."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from conftest import refused
from logs import bends, drive, fixes, long, motion, observed, ranges, write
from numpy import nan, pi
from numpy.testing import assert_allclose
from oracles.solo import filterpys

import coopoc as co
from coopoc.cli import _status
from coopoc.data.log.check import check
from coopoc.data.log.read import read_log
from coopoc.data.registry import load_fleet
from coopoc.data.registry import read_log as load_log
from coopoc.evaluate.metrics import fix_innovations, innovation_columns, normalised_innovations
from coopoc.evaluate.scores import scored
from coopoc.studies import neighbours, scene
from coopoc.studies.roads import roads, thinned
from coopoc.study.publish import views
from coopoc.study.report import report
from coopoc.world.storage import digest, read_recording, save_recording

FEW = {"method": "gnss,kalman,joint,bound", "max_neighbours": "0,2"}


def truth(fleet):
    frame = pd.DataFrame(fleet.position.reshape(-1, 3), columns=[*"xyz"])
    return frame.assign(t=np.repeat(fleet.t, len(fleet.ids)), vehicle=fleet.ids * len(fleet.t))


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """A log without and one with a truth; car2 is away for seven seconds."""
    out = tmp_path_factory.mktemp("logs")
    fleet = drive(4, gap=15.0)
    frame = long(observed(fleet), messages=False)
    frame = frame[~((frame["vehicle"] == "car2") & frame["t"].between(5, 12))]
    for name in ("without", "with"):
        (out / name).mkdir()
        write(frame, out / name / "measurements.csv")
    write(truth(fleet), out / "with" / "truth.csv")
    return out


def test_truth_is_read_on_the_steps_of_the_recording(folders):
    log = read_log(folders / "with")
    assert_allclose(log.truth.position, drive(4, gap=15.0).position, atol=1e-9)
    assert load_fleet(folders / "with").digest == log.truth.digest
    assert co.read_log(folders / "with").recording.ids == log.recording.ids
    with refused(r"without = no truth: .*truth\.csv"):
        load_fleet(folders / "without")


def test_scores_are_of_the_steps_at_which_an_ego_is_there(folders):
    """Each stretch by itself, pooled by NumPy; bytes per second of driving."""
    log, method = read_log(folders / "with"), co.JointFilter()
    found, off, sent = scored(method, log.recording, ["car2"], log.truth), list[Any](), 0.0
    cuts = log.recording.stretches("car2")
    assert len(cuts) == 2
    for cut in cuts:
        track = method(log.recording.between(*cut), ["car2"])
        off.append(np.linalg.norm(track.x[0, :, 0] - log.truth.position[slice(*cut), 2], axis=-1))
        sent += track.sent_bytes.item()
    every = np.concatenate(off)
    assert found["rt_le_m"].item() == pytest.approx(np.sqrt(np.mean(every**2)))
    assert found["max_error_m"].item() == pytest.approx(every.max())
    assert found["sent_bytes_per_second"].item() == pytest.approx(sent / (len(every) * log.recording.dt))
    gnss = log.recording.gnss.copy()
    gnss[:, :, 2] = gnss[:, 0, 1] = nan
    with refused("car2.*is never present at two successive steps"):
        method(replace(log.recording, gnss=gnss), ["car1", "car2"])


def test_a_unit_at_the_road_is_no_ego_and_real_data_have_no_bound(tmp_path):
    frame = long(observed(drive(3)), messages=False)
    stands = (frame["vehicle"] == "car2") & frame["kind"].isin(["vx", "vy", "vz"])
    data = str(write(frame.assign(value=frame["value"].mask(stands, 0.0)), tmp_path / "log.csv"))
    assert scene.egos({"data": data, "egos": "auto"}) == ("car0", "car1")
    methods = {cell.settings["method"] for cell in neighbours.STUDY.override({"data": data}).cells()}
    assert "bound" not in methods >= {"kalman"}


def test_settings_of_simulated_noise_do_nothing_on_a_log_and_the_caption_says_so(folders, tmp_path):
    more = {"heading_bias_deg": 3.0, "own_share": 0.3, "spoofed_share": 0.5, "egos": "car2", "loss": 0.1}
    settings = {**FEW, "data": str(folders / "without"), **more}
    assert not co.run_study("side_by_side", tmp_path, settings=settings, progress=False).failed
    (table,) = (view["caption"] for view in views(tmp_path / "side_by_side")["tables"] if view["name"] == "bytes")
    assert "With loss 0.1, spoofed_share 0.5. Without effect on a log: own_share, heading_bias_deg." in table
    with refused("loss = 'x': must be a number"):
        scene.channel({**more, "data": "town10", "loss": "x"})


def test_innovations_take_the_place_of_scores(folders, tmp_path):
    results = co.run_study("side_by_side", tmp_path, settings={**FEW, "data": str(folders / "without")}, progress=False)
    assert not results.failed
    rows = results.frame
    assert "rt_le_m" not in rows or rows["rt_le_m"].isna().all()
    means = rows[rows["method"] != "bound"].groupby("method")["innovation_m"].mean()
    assert means["kalman"] < means["gnss"]
    assert 0.8 < rows.query("method == 'kalman'")["nis"].mean() < 1.2
    assert {"innovation", "nis"} <= {file.stem for file in (tmp_path / "side_by_side").rglob("*.md")}


@pytest.mark.parametrize(("options", "offset", "most"), [("", 2.0, 1.0), ("?dt=0.1", 0.0, 0.97), ("", 0.0, 0.93)])
def test_ranges_help_or_do_no_harm(tmp_path, options, offset, most):
    """Radios with uncalibrated delays, and steps at half of which nothing is measured; beside the filter alone."""
    fleet, parts = bends(4, 2.0), list[pd.DataFrame]()
    for k, name in enumerate(fleet.ids):
        parts += [fixes(fleet, name, 1.0, 1.5, 10 * k), motion(fleet, name, 0.1, 0.1, 10 * k + 1)]
        parts += [ranges(fleet, name, other, 0.2, 0.15, 10 * k + 2) for other in fleet.ids[k + 1 :]]
    table = pd.concat(parts)
    path = write(table.assign(range=table["range"] + offset), tmp_path / "cars.csv")
    log = load_log(f"{path}{options}")
    true = np.stack([[np.interp(log.recording.t, fleet.t, x) for x in p.T] for p in fleet.position.swapaxes(0, 1)])
    without = replace(log.recording, relative=np.full_like(log.recording.relative, nan))
    tracks = [co.CooperativeFilter()(seen, fleet.ids) for seen in (log.recording, without)]
    tracks.append(co.Kalman()(without, fleet.ids))
    rms = [np.sqrt(np.square(track.x[0] - true.transpose(2, 0, 1))[..., :2].mean()) for track in tracks]
    assert rms[0] < most * rms[1]
    assert rms[1] < 1.1 * rms[2]  # it was 1.4: a log that states its noise is believed


def test_a_recording_is_stored_bit_by_bit(tmp_path):
    fleet = drive(3)
    recording = co.observe(fleet, co.Sensors.paper_scenario2(), co.V2X(2, loss=0.3), runs=4, seed=1)
    save_recording(recording, tmp_path / "a.npz", fleet)
    read, true = read_recording(tmp_path / "a.npz")
    assert digest(read) == digest(recording)
    assert true.digest == fleet.digest
    save_recording(read, tmp_path / "b.npz", true)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    assert load_fleet(tmp_path / "a.npz").digest == fleet.digest
    with refused("ids and times differ"):
        save_recording(recording, tmp_path / "c.npz", fleet.between(0, 50))


def test_innovations_are_filterpys(folders):
    """Independent reference: filterpy's y and S, step by step."""
    rec = co.read_log(folders / "with").recording
    track = co.Kalman()(rec, ["car0"])
    found, squares = fix_innovations(track, rec), normalised_innovations(track, rec)
    q = rec.sensors.motion_std(rec.velocity, rec.dt)[0, :, 0] ** 2
    kf = filterpys(rec.gnss[0, 0, 0], np.diag(np.square(rec.sensors.gnss_std)), rec.dt)
    for t in range(1, 100):
        kf.predict(u=rec.velocity[0, t, 0], Q=np.diag(q[t]))
        kf.update(rec.gnss[0, t, 0])
        assert_allclose(found[0, t, 0], kf.y, atol=1e-9)
        assert squares[0, t, 0] == pytest.approx(kf.y @ kf.SI @ kf.y / 3, rel=1e-6)
    columns = innovation_columns(track, rec)
    assert columns["fixes"].tolist() == [[199.0]]
    assert columns["nis"] == pytest.approx(np.nanmean(squares, 1))


def test_the_check_finds_nothing_wrong_but_what_was_left_out(folders):
    found = check(read_log(folders / "with"))
    assert ["not used, mostly 621" in warning for warning in found.warnings] == [True]
    assert all(0.7 < row["nis"] < 1.3 for row in found.vehicles)
    (ranges,) = [row for row in found.measurements if row["measurement"] == "range"]
    assert ranges["expected_std"] / 2 < ranges["robust_std"] < 1.5 * ranges["expected_std"]


def test_a_truth_in_another_frame_is_found(folders, tmp_path):
    moved = truth(drive(4, gap=15.0)).assign(x=lambda frame: frame["x"] - 40, y=lambda frame: frame["y"] + 9)
    write(moved, tmp_path / "vicon.csv")
    warnings = check(read_log(folders / "without", truth=tmp_path / "vicon.csv")).warnings
    offsets = re.findall(r"lie (\S+) m east and (\S+) m north", " ".join(warnings))
    assert len(offsets) == 4
    for offset in offsets:
        assert [float(each) for each in offset] == pytest.approx([40, -9], abs=0.7)


def test_a_truth_with_another_clock_is_named(folders, tmp_path):
    late = truth(drive(4, gap=15.0)).assign(t=lambda frame: frame["t"] + 1.0)
    warnings = check(read_log(folders / "without", truth=write(late, tmp_path / "vicon.csv"))).warnings
    offsets = re.findall(r"odometry is (\S+) \+- (\S+) s earlier than the truth", " ".join(warnings))
    off = [abs(float(late) - 0.95) / float(error) for late, error in offsets]  # the drive has the speed of a step's end
    assert len(off) == 4
    assert max(off) < 3


def test_odometry_that_alone_is_late_is_no_clock(tmp_path):
    """car1's velocities are stamped 0.4 s late; all that car2 has measured is."""
    fleet = drive(4, gap=15.0)
    frame = long(observed(fleet), messages=False)
    late = frame["vehicle"].eq("car1") & frame["kind"].isin(["vx", "vy"]) | frame["vehicle"].eq("car2")
    write(frame.assign(t=frame["t"] + 0.4 * late), tmp_path / "measurements.csv")
    write(truth(fleet), tmp_path / "truth.csv")
    found = " ".join(check(read_log(tmp_path)).warnings)
    assert re.search(r"car1: its odometry is \S+ \+- \S+ s later than the truth, its fixes are not", found)
    assert "clock=car1" not in found
    assert "clock=car2:0." in found


WRONG = {
    "speeds in km/h": (["vx", "vy"], lambda v: 3.6 * v, r"fixes travel 0\.2\d times as far.*speed_kmh"),
    "speeds in miles an hour": (
        ["vx", "vy"],
        lambda v: v / 0.44704,
        r"fixes travel 0\.4\d times as far.*miles an hour",
    ),
    "positions in feet": (["x", "y"], lambda v: v / 0.3048, r"fixes travel 3\.\d+ times as far"),
    "positions in km": (["x", "y"], lambda v: v / 1000, r"are positions in km\?"),
    "azimuths clockwise from north": (
        ["azimuth"],
        lambda v: (pi / 2 - v) % (2 * pi),
        r"azimuths miss.*clockwise from north",
    ),
    "ranges in feet": (
        ["range"],
        lambda v: v / 0.3048,
        r"ranges miss .* 3\.\d+ times as long: scale=range:0\.30\d .*of feet 0\.3048",
    ),
}


@pytest.mark.parametrize(
    ("case", "stated"), [*((case, 1.5) for case in WRONG), *((case, 0.4) for case in [*WRONG][-2:])]
)
def test_the_check_says_what_looks_wrong(tmp_path, case, stated):
    """Relative measurements were not looked at where fixes of all vehicles err by more than is stated."""
    kinds, change, message = WRONG[case]
    frame = long(observed(drive(4, gap=15.0)), messages=False)
    frame["value"] = frame["value"].mask(frame["kind"].isin(kinds), change(frame["value"]))
    warnings = check(read_log(write(frame, tmp_path / "log.csv"), std=dict.fromkeys("xyz", stated))).warnings
    assert any(pd.Series([warning]).str.contains(message, regex=True)[0] for warning in warnings), warnings


def test_stamps_in_milliseconds_are_found(tmp_path):
    file = write(long(observed(drive(4, gap=15.0)), messages=False).eval("t = 1000 * t"), tmp_path / "log.csv")
    assert any("Is t in ms" in warning for warning in check(read_log(file, dt=100, max_gap=1e4)).warnings)


def test_the_commands_take_a_log_and_options(folders, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def shell(*words):
        return _status([*words]), capsys.readouterr().out

    status, out = shell("data", "check", str(folders / "with"), "--picture", "a.png")
    assert status == 0
    assert "not used: 621 relative measurements while one of the two is absent" in out
    assert "check: 9% of what was logged is not used, mostly 621 relative measurements" in out
    assert re.search(r"car2: .*, longest gap 7\.\d s from [45]\.\d s on", out)
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    word = f"{folders / 'with'}?dt=0.2&max_gap=10"
    options = ("method=kalman", "max_neighbours=0", "egos=car2")
    status, out = shell("run", "side_by_side", "--data", word, "--set", *options, "--out", "runs")
    assert status == 0
    assert "1 ego of with" in out
    assert "source" in shell("data", "show", str(folders / "with"))[1]
    assert shell("data", "check", "nowhere")[0] == 2
    (tmp_path / "one.csv").write_text("t,vehicle,x,y,note\n0,a,0,0,k\n1,a,1,0,k\n2,a,2,0,k\n")
    out = shell("data", "check", "one.csv")[1]
    assert (out.count("column note"), out.count("columns not read, as listed above. Name what")) == (1, 1)


def test_a_plane_has_two_dimensions(tmp_path):
    """Without heights NIS is per two degrees of freedom: 1, and not 2/3."""
    frame = long(observed(drive(4, steps=600, gap=15.0)), messages=False)
    frame = frame[~frame["kind"].isin(["z", "vz", "inclination"])]
    found = check(read_log(write(frame, tmp_path / "log.csv")))
    assert np.mean([row["nis"] for row in found.vehicles]) == pytest.approx(1.0, abs=0.1)


def test_a_report_of_a_log_shows_no_settings_of_simulated_noise(folders, tmp_path):
    given = {**FEW, "method": "gnss,kalman,joint,batch-smoother", "data": str(folders / "with"), "egos": "car0+car2"}
    co.run_study("side_by_side", tmp_path, settings=given, progress=False)
    page = report([tmp_path / "side_by_side"], tmp_path / "report.html").read_text()
    for words in ("Scenario", "town10", "Spoofed", "Train seeds"):
        assert words not in page
    for words in ("GNSS repeats a fix", "is not ranked"):
        assert words in page


def test_a_log_that_is_a_task_needs_a_truth_and_no_neighbour_counts(folders):
    assert [*roads(folders / "with"), *roads(folders / "without")] == ["with", "without"]
    assert not len(thinned("with", folders / "with")[0].links)
    with refused("must hold a truth"):
        thinned("without", folders / "without")

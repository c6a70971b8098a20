"""CSV, Parquet, TUM and SUMO FCD: round trips, and errors that name the thing and the mend."""

import time
import warnings
from dataclasses import replace

import numpy as np
import pandas as pd
import pymap3d
import pytest
from conftest import measured, refused
from make_fleet import write_table
from numpy import arange, nan, zeros
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from pyarrow.parquet import read_metadata

import coopoc as co
from coopoc.data.assemble import interpolate
from coopoc.data.registry import load_fleet
from coopoc.errors import InputError
from coopoc.studies.roads import road_row

GOOD = "id,t,x,y,z\na,0.0,0,0,0\nb,0.0,5,0,0\na,0.1,1,0,0\nb,0.1,5,1,0\na,0.2,2,0,0\nb,0.2,5,2,0\n"


@pytest.mark.parametrize("out", ["fleet.csv", "fleet.PARQUET"])
@pytest.mark.parametrize("name", ["town10-clients", "town04"])
def test_tables_come_back_bit_by_bit(tmp_path, name, out):
    fleet = load_fleet(name)
    fleet = replace(fleet, ids=("=a", *fleet.ids[1:]))
    write_table(fleet, tmp_path / out)
    assert load_fleet(tmp_path / out).digest == fleet.digest


def test_tum_files_are_what_evo_reads(tmp_path):
    """Independent check: evo reads the file that we write (evo is a tool of the tests only)."""
    fleet = load_fleet("town10-clients")
    x = fleet.position[:1550, 0]
    np.savetxt(tmp_path / "car.tum", np.c_[fleet.t[:1550], x, np.tile([0.0, 0.0, 0.0, 1.0], (1550, 1))], fmt="%.17g")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        file_interface = pytest.importorskip("evo.tools.file_interface", reason="pip install evo")
        path = file_interface.read_tum_trajectory_file(str(tmp_path / "car.tum"))
    assert_array_equal(path.positions_xyz, x)
    assert_allclose(path.timestamps, fleet.t[:1550], atol=1e-9)
    assert_array_equal(load_fleet(tmp_path).position[:, 0], x)


def test_velocity_is_derived_backwards_and_absence_is_a_missing_row(tmp_path):
    (tmp_path / "a.csv").write_text(GOOD.replace("b,0.0,5,0,0\n", ""))
    fleet = load_fleet(tmp_path / "a.csv")
    assert fleet.present.tolist() == [[True, False], [True, True], [True, True]]
    assert_allclose(fleet.velocity[1:, 1], [[0, 10, 0], [0, 10, 0]])
    assert "backward difference" in fleet.source


OFFSETS = (("a", 0.0), ("b", 0.05))
BAD = {
    "missing column": (GOOD.replace(",y,", ",north,", 1), "column y = missing", 'columns={"y"'),
    "missing velocity": ("id,t,x,y,z,vx\na,0,0,0,0,1\n", "column vy = missing", "are needed"),
    "NaN": (GOOD.replace("a,0.1,1,0,0", "a,0.1,nan,0,0"), "row 3, column x", "Correct the cell"),
    "text": (GOOD.replace("b,0.2,5,2,0", "b,0.2,5,two,0"), "row 6, column y = two", "finite number"),
    "no id": (GOOD.replace("b,0.1", ",0.1"), "row 4, column id", "name"),
    "twice": (GOOD.replace("a,0.1", "a,0.0"), "row 3, column t", "dt must be > 0"),
    "backwards": (GOOD.replace("a,0.2", "a,-0.2"), "row 5, column t", "Sort the rows"),
    "uneven": (GOOD + "a,0.5,2,0,0\nb,0.57,0,0,0\n", "equally spaced", "?dt=0.1"),
    "once": (GOOD + "c,0.2,0,0,0\n", "none for c at t = 0.2 s", "vx, vy, vz"),
    "empty": ("id,t,x,y,z\n", "0 rows", "complete"),
    "no header": ("", "header", "Export"),
    "spaces": (GOOD.replace(",", " "), "between commas, semicolons or tabs", "CSV"),
    "more cells than names": (GOOD.replace("0\n", "0,9\n"), "6 cells under 5 names", "header"),
    "interleaved": (
        "id,t,x,y,z,vx,vy,vz\n" + "".join(f"{v},{k / 10 + s},{k},0,0,9,0,0\n" for k in range(4) for v, s in OFFSETS),
        "vehicle a = 4 rows, but 4 instants",
        "Resample",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_table_names_the_thing_and_the_mend(tmp_path, case):
    text, thing, hint = BAD[case]
    (tmp_path / "drive.csv").write_text(text)
    with pytest.raises(InputError) as error:
        load_fleet(tmp_path / "drive.csv")
    assert thing in str(error.value)
    assert hint in str(error.value)


def test_dt_must_be_positive_and_resamples_stamps_that_differ(tmp_path):
    (tmp_path / "a.csv").write_text(GOOD)
    with refused("dt = 0: must be a number > 0 s"):
        load_fleet(tmp_path / "a.csv", dt=0)
    (tmp_path / "b.csv").write_text(GOOD.replace("b,0.1", "b,0.13"))
    fleet = load_fleet(tmp_path / "b.csv", dt=0.05)
    assert_allclose(fleet.position[:, 0, 0], [0, 0.5, 1, 1.5, 2], atol=1e-12)
    assert fleet.dt == 0.05


@pytest.mark.parametrize(("stamp", "thing"), [("0.2", "none for c at t = 0.2 s"), ("0.17", "c = 1 rows, but 0")])
def test_resampling_loses_no_vehicle(tmp_path, stamp, thing):
    (tmp_path / "a.csv").write_text(GOOD + f"c,{stamp},9,9,9\n")
    with refused(thing):
        load_fleet(tmp_path / "a.csv", dt=0.1)


TUM = "# t x y z qx qy qz qw\n0.0 0 0 0 0 0 0 1\n0.1 1 0 0 0 0 0 1\n"


def test_an_empty_tum_file_is_named_and_a_byte_order_mark_skipped(tmp_path):
    (tmp_path / "car.tum").write_text(TUM, encoding="utf-8-sig")
    assert load_fleet(tmp_path).ids == ("car",)
    (tmp_path / "lost.tum").write_text("# t x y z qx qy qz qw\n")
    with refused(r"lost\.tum = 0 lines"):
        load_fleet(tmp_path)


FCD = """<fcd-export>
 <timestep time="0.00"><vehicle id="e" x="10" y="5" angle="90" speed="7" slope="0"/></timestep>
 <timestep time="0.10"><vehicle id="e" x="10.7" y="5" angle="90" speed="7" slope="0"/>
  <vehicle id="n" x="0" y="0" z="3" angle="0" speed="2" slope="30"/></timestep>
</fcd-export>"""


def test_fcd_angles_are_clockwise_from_north_and_positions_the_front_bumper(tmp_path):
    """Closed form: a vehicle 4 m long that faces east has its middle 2 m west of its front bumper."""
    (tmp_path / "a.xml").write_text(FCD)
    fleet = load_fleet(tmp_path / "a.xml", vehicle_length=4.0)
    assert_allclose(fleet.position[:, 0], [[8, 5, 0], [8.7, 5, 0]], atol=1e-12)
    assert_allclose(fleet.velocity[:, 0], [[7, 0, 0], [7, 0, 0]], atol=1e-12)
    half = np.sqrt(3) / 2
    assert_allclose(fleet.position[1, 1], [0, -2 * half, 2], atol=1e-12)
    assert_allclose(fleet.velocity[1, 1], [0, 2 * half, 1], atol=1e-12)
    assert not fleet.present[0, 1]


@pytest.mark.parametrize(
    ("text", "thing"),
    [
        (FCD.replace('angle="0"', ""), "angle"),
        (FCD[:-9], "XML"),
        ("<a/>", "0 rows"),
        (FCD.replace('"10.7"', '"ten"'), "row 2, column x = ten"),
        (FCD.replace('"0.10"', '"nan"'), "row 2, column t = nan"),
    ],
)
def test_a_bad_fcd_file_is_named(tmp_path, text, thing):
    (tmp_path / "a.xml").write_text(text)
    with refused(thing):
        load_fleet(tmp_path / "a.xml")


def test_a_column_by_a_wrong_name_is_proposed(tmp_path):
    (tmp_path / "drive.csv").write_text(GOOD.replace("id,t,x,y,z", "id,t,easting,y,z"))
    with refused(r"column estings = missing: .* Did you mean easting\?"):
        load_fleet(tmp_path / "drive.csv", columns={"x": "estings"})


def test_a_left_handed_table_is_mirrored(tmp_path):
    """As CARLA exports it, with y to the right; stamps in ms."""
    fleet = load_fleet("town10").between(0, 100).select([0, 6])
    write_table(fleet, tmp_path / "drive.csv")
    frame = pd.read_csv(tmp_path / "drive.csv")
    frame.assign(t=1000 * frame["t"], y=-frame["y"], vy=-frame["vy"]).to_csv(tmp_path / "left.csv")
    read = load_fleet(f"{tmp_path / 'left.csv'}?scale=y:-1,vy:-1,t:1e-3")
    assert_allclose(read.position, fleet.position, atol=1e-9)
    assert_allclose(read.velocity, fleet.velocity, atol=1e-9)
    for scale, message in (({"yaw": -1}, "scale = 'yaw': must be one of t, x"), ({"y": 0}, "scale of y = 0: must not")):
        with refused(message):
            load_fleet(tmp_path / "left.csv", scale=scale)


def drive(t, **more: object):
    since = t - t[0]
    return pd.DataFrame({"id": "a", "t": t, "x": 8 * since, "y": 0.5 * since, "z": 0.0, **more})


@pytest.mark.parametrize("start", [0.0, 1.7e9])
def test_a_gap_is_one_whenever_time_starts(tmp_path, start):
    """13 s are missing between 4.9 and 18 s: 130 instants, and every other one is there."""
    t = start + np.round(np.r_[arange(0, 5, 0.1), arange(18, 23, 0.1)], 6)
    drive(t).to_csv(tmp_path / "a.csv")
    fleet = load_fleet(tmp_path / "a.csv", dt=0.1)
    assert (~fleet.present).sum() == 130
    assert fleet.present.sum() == len(t)
    bridged = load_fleet(tmp_path / "a.csv", dt=0.1, max_gap=13.2)
    assert bridged.present.all()
    assert_allclose(bridged.position[:, 0, 0], 8 * (bridged.t - start), atol=1e-5)


def test_interpolation_agrees_with_pandas():
    """Independent reference: pandas, with the gaps cut out by hand."""
    t = 1.7e9 + np.array([0.0, 0.1, 0.2, 0.9, 1.0])
    grid = 1.7e9 + arange(0, 1.01, 0.05)
    series = pd.Series(np.sin(t - 1.7e9), index=np.round(t - 1.7e9, 3))
    union = series.reindex(np.union1d(series.index, np.round(grid - 1.7e9, 3))).interpolate("index")
    wanted = union.reindex(np.round(grid - 1.7e9, 3)).to_numpy(copy=True)
    wanted[(grid - 1.7e9 > 0.2001) & (grid - 1.7e9 < 0.8999)] = nan
    assert_allclose(interpolate(t, series.to_numpy()[:, None], grid, 0.5)[:, 0], wanted, atol=1e-6)


def test_degrees_are_not_metres(tmp_path):
    t = arange(0, 5, 0.1)
    drive(t).assign(**{"x": 11.58 + 1e-5 * t, "y": 48.14 + 4e-5 * t}).to_csv(tmp_path / "a.csv")
    with refused(r"columns x, y = 11\.58\.\.11\.58.*look like degrees.*read_log"):
        load_fleet(tmp_path / "a.csv")
    assert load_fleet(tmp_path / "a.csv", any_scale=True).position[0, 0, 1] == 48.14


@pytest.mark.parametrize("unit", ["ms", "us", "ns"])
@pytest.mark.parametrize("zone", [None, "Europe/Berlin"])
def test_dates_are_seconds_since_1970(tmp_path, unit, zone):
    t = pd.to_datetime(1_700_000_000_000 + 100 * arange(5), unit="ms").astype(f"datetime64[{unit}]")
    stamps = t if zone is None else t.tz_localize("UTC").tz_convert(zone)
    frame = drive(arange(5) / 10).assign(t=stamps)
    frame.to_parquet(tmp_path / "a.parquet", index=False)
    frame.assign(t=[stamp.isoformat() for stamp in stamps]).to_csv(tmp_path / "a.csv")
    for name in ("a.parquet", "a.csv"):
        assert_allclose(load_fleet(tmp_path / name).t, 1.7e9 + arange(5) / 10, atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("a,0.1,1,0,0,7", r"row 2 = 6 cells under 5 names"),
        ("a,0.1,1,5,0,0", r"row 2 = 6 cells under 5 names.*decimal points"),
        ("a,0.1,1_0,0,0", r"row 2, column x = 1_0"),
        ("a,0.1,١,0,0", r"row 2, column x = ١"),
        ("a,0.1,1e308,0,0", r"row 2, column x = 1e\+308"),
    ],
)
def test_a_row_that_is_none_is_named(tmp_path, row, message):
    (tmp_path / "a.csv").write_text(f"id,t,x,y,z\na,0,0,0,0\n{row}\na,0.2,2,0,0\n")
    with refused(message):
        load_fleet(tmp_path / "a.csv")


def test_damaged_tables_are_named(tmp_path):
    drive(arange(50) / 10).to_parquet(tmp_path / "a.parquet")
    whole = (tmp_path / "a.parquet").read_bytes()
    rng = default_rng(1)
    for _ in range(60):
        at = int(rng.integers(len(whole)))
        (tmp_path / "a.parquet").write_bytes(
            whole[:at] + bytes(rng.integers(0, 256, 4, dtype=np.uint8)) + whole[at + 4 :]
        )
        try:
            load_fleet(tmp_path / "a.parquet")
        except InputError as error:
            assert "a.parquet" in str(error)  # noqa: PT017 (most mutants still load)


def test_what_no_memory_holds_is_refused_at_once(tmp_path):
    began = time.process_time()
    drive(1e18 + 1e8 * arange(5)).to_csv(tmp_path / "a.csv")
    with refused(r"a\.csv: column t with dt = 0\.1 s = .* steps .*nanoseconds"):
        load_fleet(tmp_path / "a.csv", dt=0.1, any_scale=True)
    (tmp_path / "b.csv").write_text(",".join(["t"] * 100_000) + "\n")
    with refused(r"b\.csv = 100000 columns: must be at most 5000"):
        load_fleet(tmp_path / "b.csv", format="table")
    assert time.process_time() - began < 5.0


def segment(folder):
    """A minute on a road to the north-east, as comma2k19 stores it; its fixes in degrees and its true places."""
    t = 5000 + arange(0, 60, 0.1)
    fixes = np.c_[37.7 + 1e-6 * arange(600), -122.4 + 1e-6 * arange(600), 0 * t + 50.0]
    ecef = np.column_stack(pymap3d.geodetic2ecef(*fixes.T))
    gnss = np.c_[fixes[:, :2], 0 * t + 1.4, 1e3 * t, fixes[:, 2], 0 * t + 38.4]
    for name, array in {
        "processed_log/GNSS/live_gnss_ublox/t": t,
        "processed_log/GNSS/live_gnss_ublox/value": gnss,
        "processed_log/CAN/speed/t": t,
        "processed_log/CAN/speed/value": np.full((600, 1), 1.4),
        "global_pose/frame_times": t,
        "global_pose/frame_positions": ecef,
    }.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        with (folder / name).open("wb") as file:
            np.save(file, array)
    return fixes, ecef


def test_a_segment_of_comma2k19(tmp_path):
    """Fixes lie on the truth, by pymap3d, and speed with course follows them."""
    fixes, _ = segment(tmp_path / "drive")
    log = co.read_log(tmp_path / "drive")
    true = np.column_stack(pymap3d.geodetic2enu(*fixes.T, *fixes[0]))
    assert_allclose(log.truth.position[1:-1, 0], true[1:-1], atol=1e-5)
    assert_allclose(log.recording.gnss[0, 1:-1, 0], true[1:-1], atol=1e-5)
    assert_allclose(log.recording.velocity[0, 2:-1, 0], np.diff(true, axis=0)[1:-1] / 0.1, atol=0.05)


def test_a_real_robot_of_libRSF():
    robot = co.read_log(measured("Indoor_UWB_Input.txt").parent, frame="body")
    assert robot.summary.read == {"ranges": 233}
    ego = robot.recording.ids.index("Indoor_UWB")
    track = co.PoseFilter("solo", begin=co.pose_start(robot.recording), gate=5.0)(robot.recording, [ego])
    assert np.sqrt(np.nanmean(np.square((track.x[0, :, 0] - robot.truth.position[:, ego])[:, :2]).sum(1))) < 0.2


def test_tensors_of_nclt_are_read_and_scored_as_published(tmp_path):
    """NumPy: mean of both wheels along either heading, the rms of an axis, all fixes."""
    torch, rng, drives = pytest.importorskip("torch"), default_rng(3), []
    for date, steps in (("2013-01-10", 90), ("2013-02-23", 60)):
        heading = np.linspace(0.0, 3.0, steps)
        way = np.cumsum(1.2 * np.c_[np.cos(heading), np.sin(heading)], axis=0)
        gps = way + rng.normal(0.0, 3.0, way.shape)
        gps[20:25] = nan
        imu = np.c_[0 * heading, 0 * heading, heading + 0.1, 0 * heading]
        arrays = {"filtered_gps": gps, "filtered_wheel": np.tile([1.1, 1.3], (steps, 1)), "imu_sensor": imu}
        arrays |= {"theta_gt": heading[:, None], "ground_truth": way, "initial_state": zeros(6)}
        drives.append({name: torch.tensor(array) for name, array in arrays.items()} | {"data_date": date})
    torch.save(drives[1:], tmp_path / "test.pt"), torch.save(drives, tmp_path / "val.pt")
    log = co.read_log(tmp_path / "val.pt")
    assert log.recording.ids == ("2013-01-10", "2013-01-10-true-heading", "2013-02-23", "2013-02-23-true-heading")
    own = np.linspace(0.0, 3.0, 90)[4:6].mean() + 0.1  # of the middle of a step
    assert_allclose(log.recording.velocity[0, 5, 0, :2], [1.2 * np.cos(own), 1.2 * np.sin(own)], rtol=1e-3)
    row = road_row("nclt", tmp_path, co.GNSS())
    held = pd.DataFrame(drives[1]["filtered_gps"].numpy()).ffill().to_numpy() - drives[1]["ground_truth"].numpy()
    assert row["axis_rms_m"]["2013-02-23"] == pytest.approx(np.sqrt((held**2).mean()), abs=1e-3)
    torch.save({"weights": torch.zeros(3)}, tmp_path / "val.pt")
    with refused("must be a list of drives"):
        co.read_log(tmp_path / "val.pt")


@pytest.mark.parametrize(
    ("name", "wrong", "thing"),
    [
        ("global_pose/frame_times", None, "global_pose/frame_times = "),
        ("global_pose/frame_positions", b"PK no array", "must be an array of numpy.save"),
        ("processed_log/CAN/speed/value", b"cut", "must be an array of numpy.save"),
        ("processed_log/CAN/speed/value", np.full((600, 1), nan), "not finite"),
        ("processed_log/CAN/speed/value", zeros((600, 2)), r"\(600, 2\): must be \(600, 1\)"),
        ("processed_log/CAN/speed/t", zeros((600, 2)), "as its times"),
        ("processed_log/CAN/speed/t", zeros(0), "must be an array of numpy.save"),
        ("processed_log/CAN/speed/t", np.float64(3.0), "must be an array of numpy.save"),
        ("processed_log/GNSS/live_gnss_ublox/value", np.array([[{}] * 6], object), "must be an array"),
        ("processed_log/GNSS/live_gnss_ublox/t", np.array(["a"] * 600), "must be an array"),
        ("processed_log/GNSS/live_gnss_ublox/t", b"huge", "must be an array of numpy.save"),
    ],
)
def test_a_damaged_array_of_comma2k19_is_named(tmp_path, name, wrong, thing):
    segment(tmp_path / "drive")
    file = tmp_path / "drive" / name
    good = file.read_bytes()
    if isinstance(wrong, bytes):
        file.write_bytes({b"cut": good[:-9], b"huge": good.replace(b"(600,)", b"(9e9,)")}.get(wrong, wrong))
    elif wrong is None:
        file.unlink()
    else:
        with file.open("wb") as out:
            np.save(out, wrong, allow_pickle=True)  # type: ignore[arg-type]
    with refused(thing):
        co.read_log(tmp_path / "drive")


@pytest.mark.parametrize(
    ("x", "lie"),
    [
        *((x, b"\x82\x00") for x in (zeros(200), [[0.0] * 200], ["a" * 2000], ["a" * 900] * 2)),
        (zeros(100), b"\xfe\x7f"),
    ],
)
def test_a_parquet_table_is_refused_by_its_pages(tmp_path, monkeypatch, x, lie):
    """Numbers in rows or in a list that are alike take 3 kB, and so does a word; the fourth is known once it is read. A
    footer that says 1 of each size changes nothing, nor one whose levels contradict, where Arrow's metadata abort; one
    that says 8191 is refused as it stands."""
    path = tmp_path / "a.parquet"
    pd.DataFrame({"x": x}).to_parquet(path)
    whole, chunk = path.read_bytes(), read_metadata(path).row_group(0).column(0)
    start = -8 - int.from_bytes(whole[-8:-4], "little")
    footer = whole[start:].replace(b"\x25\x02\x18\x01x", b"\x25\x00\x18\x01x", -1 if len(x) > 2 else 0)
    for size in (chunk.num_values, chunk.total_uncompressed_size):
        footer = footer.replace(bytes([2 * size % 128 | 128, size >> 6]), lie)
    path.write_bytes(whole[:start] + footer)
    monkeypatch.setattr("coopoc.data.cells.LARGEST_TABLE", 150)
    monkeypatch.setattr(pd.DataFrame, "astype", None)
    with refused("a.parquet = .* bytes: must hold at most 1200 bytes"):
        load_fleet(path)

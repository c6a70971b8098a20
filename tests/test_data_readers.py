"""CSV, Parquet, TUM and SUMO FCD: round trips, and errors that name the thing and the mend."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest

from coopoc.data.registry import convert, detect, load_fleet
from coopoc.data.assemble import assemble
from coopoc.data.fleet_files import write_table
from coopoc.data.fleet_files import read_tum
from coopoc.errors import InputError
from coopoc.world.fleet import Fleet

GOOD = "id,t,x,y,z\na,0.0,0,0,0\nb,0.0,5,0,0\na,0.1,1,0,0\nb,0.1,5,1,0\na,0.2,2,0,0\nb,0.2,5,2,0\n"


@pytest.mark.parametrize("out", ["fleet.csv", "fleet.parquet"])
@pytest.mark.parametrize("name", ["town10-clients", "town04"])
def test_tables_come_back_bit_by_bit(tmp_path: Path, name: str, out: str) -> None:
    written = convert(name, tmp_path / out)
    assert load_fleet(tmp_path / out).digest == written.digest == load_fleet(name).digest


def test_tum_comes_back_with_derived_velocity(tmp_path: Path) -> None:
    written = convert("town10-clients", tmp_path / "folder")
    read = load_fleet(tmp_path / "folder")
    assert read.ids == written.ids
    np.testing.assert_array_equal(read.position, written.position)
    np.testing.assert_allclose(read.velocity, written.velocity, atol=1e-9)


def test_tum_files_are_what_evo_reads(tmp_path: Path) -> None:
    """Independent check: evo reads the file that we write (evo is a tool of the tests only)."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        file_interface = pytest.importorskip("evo.tools.file_interface")
        fleet = convert("town10-clients", tmp_path / "folder")
        path = file_interface.read_tum_trajectory_file(str(tmp_path / "folder" / f"{fleet.ids[0]}.tum"))
    np.testing.assert_array_equal(path.positions_xyz, fleet.position[:1550, 0])
    np.testing.assert_allclose(path.timestamps, fleet.t[:1550], atol=1e-9)


def test_velocity_is_derived_backwards_and_absence_is_a_missing_row(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(GOOD.replace("b,0.0,5,0,0\n", ""))
    fleet = load_fleet(tmp_path / "a.csv")
    assert fleet.present.tolist() == [[True, False], [True, True], [True, True]]
    np.testing.assert_allclose(fleet.velocity[1:, 1], [[0, 10, 0], [0, 10, 0]])
    assert "backward difference" in fleet.source


OFFSETS = (("a", 0.0), ("b", 0.05))
BAD = {
    "missing column": (GOOD.replace(",y,", ",north,", 1), "column y = missing", 'columns={"y"'),
    "missing velocity": ("id,t,x,y,z,vx\na,0,0,0,0,1\n", "column vy = missing", "go together"),
    "NaN": (GOOD.replace("a,0.1,1,0,0", "a,0.1,nan,0,0"), "row 3, column x", "Interpolate"),
    "text": (GOOD.replace("b,0.2,5,2,0", "b,0.2,5,two,0"), "row 6, column y = two", "finite number"),
    "no id": (GOOD.replace("b,0.1", ",0.1"), "row 4, column id", "name"),
    "twice": (GOOD.replace("a,0.1", "a,0.0"), "row 3, column t", "dt must be > 0"),
    "backwards": (GOOD.replace("a,0.2", "a,-0.2"), "row 5, column t", "Sort the rows"),
    "uneven": (GOOD + "a,0.5,2,0,0\nb,0.57,0,0,0\n", "equally spaced", "--dt"),
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
def test_a_bad_table_names_the_thing_and_the_mend(tmp_path: Path, case: str) -> None:
    text, thing, hint = BAD[case]
    (tmp_path / "drive.csv").write_text(text)
    with pytest.raises(InputError) as error:
        load_fleet(tmp_path / "drive.csv")
    assert thing in str(error.value)
    assert hint in str(error.value)


def test_dt_must_be_positive_and_resamples_stamps_that_differ(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(GOOD)
    with pytest.raises(InputError, match="dt = 0 s: must be > 0"):
        load_fleet(tmp_path / "a.csv", dt=0)
    (tmp_path / "b.csv").write_text(GOOD.replace("b,0.1", "b,0.13"))
    fleet = load_fleet(tmp_path / "b.csv", dt=0.05)
    np.testing.assert_allclose(fleet.position[:, 0, 0], [0, 0.5, 1, 1.5, 2], atol=1e-12)
    assert fleet.dt == 0.05


@pytest.mark.parametrize(("stamp", "thing"), [("0.2", "none for c at t = 0.2 s"), ("0.17", "c = 1 rows, but 0")])
def test_resampling_loses_no_vehicle(tmp_path: Path, stamp: str, thing: str) -> None:
    (tmp_path / "a.csv").write_text(GOOD + f"c,{stamp},9,9,9\n")
    with pytest.raises(InputError, match=thing):
        load_fleet(tmp_path / "a.csv", dt=0.1)


@pytest.mark.parametrize("out", ["fleet.csv", "fleet.parquet"])
def test_ids_that_look_like_numbers_stay_as_they_are(tmp_path: Path, out: str) -> None:
    x = np.arange(12.0).reshape(2, 2, 3)
    fleet = Fleet(("007", "1e3"), [0, 0.1], x, x)
    write_table(fleet, tmp_path / out)
    assert load_fleet(tmp_path / out).ids == ("007", "1e3")
    assert load_fleet(tmp_path / out).digest == fleet.digest


def test_resampling_leaves_long_gaps_absent() -> None:
    t = np.array([0, 0.1, 0.2, 3.0, 3.1])
    fleet = assemble(["a"] * 5, t, np.outer(t, [1.0, 0, 0]), dt=0.1)
    assert fleet.present[:, 0].sum() == 5
    np.testing.assert_allclose(fleet.position[fleet.present[:, 0], 0, 0], t, atol=1e-12)


def test_columns_may_have_other_names(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(GOOD.replace("id,t,x", "car,time,x", 1))
    fleet = load_fleet(tmp_path / "a.csv", columns={"id": "car", "t": "time"})
    assert fleet.ids == ("a", "b")


TUM = "# t x y z qx qy qz qw\n0.0 0 0 0 0 0 0 1\n0.1 1 0 0 0 0 0 1\n"


@pytest.mark.parametrize(
    ("text", "thing"),
    [
        (TUM + "0.2 1 2\n", "car.tum: line 4"),
        (TUM + "0.2 nan 0 0 0 0 0 1\n", "car.tum: line 4"),
        (TUM + "0.1 1 0 0 0 0 0 1\n", "line 4, column t"),
    ],
)
def test_a_bad_tum_line_is_named(tmp_path: Path, text: str, thing: str) -> None:
    (tmp_path / "car.tum").write_text(text)
    with pytest.raises(InputError, match=thing):
        read_tum(tmp_path / "car.tum")


def test_an_empty_tum_file_is_named_and_a_byte_order_mark_skipped(tmp_path: Path) -> None:
    (tmp_path / "car.tum").write_text(TUM, encoding="utf-8-sig")
    assert load_fleet(tmp_path).ids == ("car",)
    (tmp_path / "lost.tum").write_text("# t x y z qx qy qz qw\n")
    with pytest.raises(InputError, match=r"lost\.tum = 0 lines"):
        load_fleet(tmp_path)


def test_an_empty_folder_is_no_tum_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"\.tum"):
        read_tum(tmp_path)


FCD = """<fcd-export>
 <timestep time="0.00"><vehicle id="e" x="10" y="5" angle="90" speed="7" slope="0"/></timestep>
 <timestep time="0.10"><vehicle id="e" x="10.7" y="5" angle="90" speed="7" slope="0"/>
  <vehicle id="n" x="0" y="0" z="3" angle="0" speed="2" slope="30"/></timestep>
</fcd-export>"""


def test_fcd_angles_are_clockwise_from_north_and_positions_the_front_bumper(tmp_path: Path) -> None:
    """Closed form: a vehicle 4 m long that faces east has its middle 2 m west of its front bumper."""
    (tmp_path / "a.xml").write_text(FCD)
    fleet = load_fleet(tmp_path / "a.xml", vehicle_length=4.0)
    np.testing.assert_allclose(fleet.position[:, 0], [[8, 5, 0], [8.7, 5, 0]], atol=1e-12)
    np.testing.assert_allclose(fleet.velocity[:, 0], [[7, 0, 0], [7, 0, 0]], atol=1e-12)
    half = np.sqrt(3) / 2
    np.testing.assert_allclose(fleet.position[1, 1], [0, -2 * half, 2], atol=1e-12)
    np.testing.assert_allclose(fleet.velocity[1, 1], [0, 2 * half, 1], atol=1e-12)
    assert not fleet.present[0, 1]


@pytest.mark.parametrize(
    ("text", "thing"),
    [
        (FCD.replace('angle="0"', ""), "angle"),
        (FCD[:-9], "XML"),
        ("<a/>", "0 rows"),
        (FCD.replace('"10.7"', '"ten"'), "vehicle e at time 0.10 s = 0.10 ten"),
        (FCD.replace('"0.10"', '"nan"'), "vehicle e at time nan s"),
    ],
)
def test_a_bad_fcd_file_is_named(tmp_path: Path, text: str, thing: str) -> None:
    (tmp_path / "a.xml").write_text(text)
    with pytest.raises(InputError, match=thing):
        load_fleet(tmp_path / "a.xml")


def test_formats_are_distinguished(tmp_path: Path) -> None:
    (tmp_path / "table.csv").write_text(GOOD)
    (tmp_path / "carla.csv").write_text(",".join(f"c{k}" for k in range(15)) + "\n")
    assert [detect(tmp_path / n) for n in ("table.csv", "carla.csv", "a.parquet", "a.xml", "a.xlsx", "a.txt")] == [
        "table",
        "carla",
        "table",
        "fcd",
        "carla",
        "tum",
    ]


@pytest.mark.parametrize(
    ("header", "format"),
    [
        ("id,t,x,y,z,yaw,vx,vy,vz", "carla"),
        ("ID,x,y,z,Yaw,Vx,Vy,Vz", "carla"),
        ("id,t,x,y,z,yaw", "table"),
        ("id,t,x,y,z," + ",".join("abcdefghi"), "table"),
    ],
)
def test_a_table_with_yaw_and_velocity_has_a_frame_to_find(tmp_path: Path, header: str, format: str) -> None:
    for encoding in ("utf-8", "utf-8-sig"):
        (tmp_path / "a.csv").write_text(header + "\n", encoding=encoding)
        assert detect(tmp_path / "a.csv") == format


def test_an_unknown_vehicle_is_named_with_the_known_ones() -> None:
    with pytest.raises(InputError, match=r"must be one of town10-clients-00, town10-clients-01"):
        load_fleet("town10-clients").index("town10-99")


def test_a_column_by_a_wrong_name_is_proposed(tmp_path: Path) -> None:
    (tmp_path / "drive.csv").write_text(GOOD.replace("id,t,x,y,z", "id,t,easting,y,z"))
    with pytest.raises(InputError, match=r"column estings = missing: .* Did you mean easting\?"):
        load_fleet(tmp_path / "drive.csv", columns={"x": "estings"})

"""The CARLA table: every combination of conventions is written from a known fleet and must be found again."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from coopoc.data.carla import read_carla
from coopoc.data.registry import load_fleet
from coopoc.errors import InputError
from coopoc.world.fleet import Fleet

HEADERS = ["id", "x", "y", "z", "yaw", "vx", "vy", "vz", "ax", "ay", "az", "wx", "wy", "wz"]
Table = Callable[..., pd.DataFrame]


@pytest.fixture(scope="module")
def fleet() -> Fleet:
    return load_fleet("town10").between(0, 250).select(range(0, 60, 3))


@pytest.fixture(scope="module")
def table(fleet: Fleet) -> Table:
    def write(
        order: str = "time", left: bool = True, degrees: bool = True, dt: float = 0.1, ids: bool = True
    ) -> pd.DataFrame:
        """The fleet as CARLA would export it; dt 0.3 slows everything down so that positions stay."""
        mirror = np.array([1, -1, 1]) if left else np.ones(3)
        x, u = fleet.position * mirror, fleet.velocity * mirror * (fleet.dt / dt)
        course = np.arctan2(-fleet.velocity[..., 1], fleet.velocity[..., 0])
        yaw = np.degrees(course) if degrees else course
        column = np.broadcast_to(100.0 + np.arange(len(fleet.ids)), yaw.shape) if ids else np.zeros(yaw.shape)
        rest = np.zeros((*yaw.shape, 6))
        cube = np.concatenate([column[..., None], x, yaw[..., None], u, rest], axis=2)
        rows = (cube if order == "time" else cube.transpose(1, 0, 2)).reshape(-1, 14)
        frame = pd.DataFrame(rows, columns=HEADERS)
        frame["id"] = frame["id"].astype(int)
        return frame

    return write


@pytest.mark.parametrize("dt", [0.1, 0.3])
@pytest.mark.parametrize("degrees", [True, False])
@pytest.mark.parametrize("left", [True, False])
@pytest.mark.parametrize("order", ["time", "vehicle"])
def test_every_convention_is_found(
    tmp_path: Path, fleet: Fleet, table: Table, order: str, left: bool, degrees: bool, dt: float
) -> None:
    table(order, left, degrees, dt).to_csv(tmp_path / "carla.csv")
    read = load_fleet(tmp_path / "carla.csv", format="carla")
    np.testing.assert_allclose(read.position, fleet.position, atol=1e-9)
    np.testing.assert_allclose(read.velocity, fleet.velocity * 0.1 / dt, atol=1e-9)
    assert read.dt == dt
    assert read.ids[:2] == ("100", "101")
    for word in (f"{order}-major", f"dt {dt:g} s", "left-handed" if left else "right-handed"):
        assert word in read.source
    assert ("degrees" if degrees else "radians") in read.source


def test_the_spreadsheet_layout_is_read_by_position(tmp_path: Path, fleet: Fleet, table: Table) -> None:
    frame = table()
    frame.columns = pd.Index([f"feature {k}" for k in range(14)])
    frame.iloc[: 20 * 60].to_excel(tmp_path / "locations.xlsx")
    read = load_fleet(tmp_path / "locations.xlsx", handedness="left")
    np.testing.assert_allclose(read.position, fleet.position[:60], atol=1e-9)


def test_without_ids_the_motion_gives_the_order(tmp_path: Path, fleet: Fleet, table: Table) -> None:
    for order in ("time", "vehicle"):
        table(order, ids=False).to_csv(tmp_path / "carla.csv")
        read = read_carla(tmp_path / "carla.csv", vehicles=20)
        np.testing.assert_allclose(read.position, fleet.position, atol=1e-9)


def test_stamps_may_be_given_and_rows_may_be_missing(tmp_path: Path, fleet: Fleet, table: Table) -> None:
    frame = table()
    frame["t"] = np.repeat(fleet.t, 20)
    frame.drop(index=[45]).to_csv(tmp_path / "carla.csv")
    read = load_fleet(tmp_path / "carla.csv", format="carla")
    assert int((~read.present).sum()) == 1
    assert not read.present[2, 5]
    np.testing.assert_allclose(read.position[:, 0], fleet.position[:, 0], atol=1e-9)
    assert "stamps given" in read.source


def _standing(frame: pd.DataFrame) -> pd.DataFrame:
    return frame.assign(vx=0.0, vy=0.0, vz=0.0)


def _unrelated_yaw(frame: pd.DataFrame) -> pd.DataFrame:
    """A few vehicles on one road: yaw agrees with the course without oncoming traffic."""
    frame = frame[frame["id"] == 100].reset_index(drop=True)
    return frame.assign(yaw=np.degrees(np.arctan2(frame["vy"], frame["vx"])))


BAD: dict[str, tuple[Callable[[pd.DataFrame], pd.DataFrame], dict[str, Any], str, str]] = {
    "dt": (lambda f: f.assign(vx=f["vx"] * 7), {}, "dt", "Pass dt="),
    "standing": (_standing, {}, "dt", "Pass dt="),
    "handedness": (_unrelated_yaw, {}, "handedness", 'Pass handedness="left"'),
    "ids": (lambda f: f.sample(frac=1, random_state=0), {}, "column id", "columns= with id and t"),
    "vehicles": (lambda f: f, {"vehicles": 7}, "vehicles = 7", "Pass vehicles="),
    "NaN": (lambda f: f.assign(y=f["y"].where(f.index != 3)), {}, "row 4, column y", "Interpolate"),
    "missing": (lambda f: f.drop(columns=["vx", "ax"]), {}, "column vx = missing", "columns="),
    "column": (lambda f: f, {"columns": {"x": "easting"}}, "columns['x'] = 'easting'", "header"),
    "header": (lambda f: f, {"columns": {"x": "xx"}}, "columns['x'] = 'xx'", "Did you mean x?"),
    "key": (lambda f: f, {"columns": {"yav": "x"}}, "columns['yav'] = 'x'", "Did you mean yaw?"),
    "order": (lambda f: f, {"order": "rows"}, "order = 'rows'", "detected"),
    "near": (lambda f: f, {"order": "times"}, "order = 'times'", "Did you mean time?"),
    "option": (lambda f: f, {"handedness": "up"}, "handedness = 'up'", "detected"),
    "interval": (lambda f: f, {"dt": -0.1}, "dt = -0.1 s", "in seconds"),
    "contradiction": (lambda f: f, {"order": "vehicle", "dt": 0.1}, "'vehicle': must be 'time'", "Leave it out"),
    "negative": (lambda f: f, {"vehicles": -3}, "vehicles = -3", "Pass vehicles="),
    "frames as t": (lambda f: f.assign(t=f.index // 20), {}, "column t = dt 1 s leaves 90% of |v|", "check the units"),
}


@pytest.mark.parametrize("name", ["carla.csv", "carla.xlsx"])
def test_a_file_without_a_table_is_named(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("")
    with pytest.raises(InputError, match=name):
        read_carla(tmp_path / name)


def test_a_spreadsheet_without_a_row_is_named(tmp_path: Path) -> None:
    pd.DataFrame().to_excel(tmp_path / "empty.xlsx", index=False, header=False)
    with pytest.raises(InputError, match=r"empty\.xlsx = 0 rows: must have a header"):
        read_carla(tmp_path / "empty.xlsx")


@pytest.mark.parametrize("case", BAD)
def test_what_the_numbers_leave_open_is_asked_for(tmp_path: Path, table: Table, case: str) -> None:
    change, options, thing, hint = BAD[case]
    change(table()).to_csv(tmp_path / "carla.csv", index=case != "missing")
    with pytest.raises(InputError) as error:
        read_carla(tmp_path / "carla.csv", **options)
    assert thing in str(error.value)
    assert hint in str(error.value)

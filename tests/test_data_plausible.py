"""Files that hold numbers which mean something else: time since 1970, degrees, dates, sizes that no memory holds."""

from __future__ import annotations

import time
import zipfile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from coopoc import InputError
from coopoc.data.registry import load_fleet
from coopoc.data.assemble import interpolate


def drive(t: np.ndarray, **more: object) -> pd.DataFrame:
    since = t - t[0]
    return pd.DataFrame({"id": "a", "t": t, "x": 8 * since, "y": 0.5 * since, "z": 0.0, **more})


@pytest.mark.parametrize("start", [0.0, 1.7e9])
def test_a_gap_is_one_whenever_time_starts(tmp_path: Path, start: float) -> None:
    """13 s are missing between 4.9 and 18 s: 130 instants, and every other one is there."""
    t = start + np.round(np.r_[np.arange(0, 5, 0.1), np.arange(18, 23, 0.1)], 6)
    drive(t).to_csv(tmp_path / "a.csv", index=False)
    fleet = load_fleet(tmp_path / "a.csv", dt=0.1)
    assert (~fleet.present).sum() == 130
    assert fleet.present.sum() == len(t)
    bridged = load_fleet(tmp_path / "a.csv", dt=0.1, max_gap=13.2)
    assert bridged.present.all()
    np.testing.assert_allclose(bridged.position[:, 0, 0], 8 * (bridged.t - start), atol=1e-5)


def test_interpolation_agrees_with_pandas() -> None:
    """Independent reference: pandas, with the gaps cut out by hand."""
    t = 1.7e9 + np.array([0.0, 0.1, 0.2, 0.9, 1.0])
    grid = 1.7e9 + np.arange(0, 1.01, 0.05)
    series = pd.Series(np.sin(t - 1.7e9), index=np.round(t - 1.7e9, 3))
    union = series.reindex(np.union1d(series.index, np.round(grid - 1.7e9, 3))).interpolate("index")
    wanted = union.reindex(np.round(grid - 1.7e9, 3)).to_numpy(copy=True)
    wanted[(grid - 1.7e9 > 0.2001) & (grid - 1.7e9 < 0.8999)] = np.nan
    np.testing.assert_allclose(interpolate(t, series.to_numpy()[:, None], grid, 0.5)[:, 0], wanted, atol=1e-6)


def test_a_vehicle_at_1_hz_is_there_at_10_hz(tmp_path: Path) -> None:
    slow, fast = drive(np.arange(20.0)), drive(np.arange(0, 19.05, 0.1))
    pd.concat([fast, slow.assign(id="slow", y=5.0)]).to_csv(tmp_path / "a.csv", index=False)
    fleet = load_fleet(tmp_path / "a.csv", dt=0.1)
    assert fleet.present.all()
    np.testing.assert_allclose(fleet.position[:, 1, 0], 8 * fleet.t, atol=1e-9)


def test_degrees_are_not_metres(tmp_path: Path) -> None:
    t = np.arange(0, 5, 0.1)
    degrees = {"x": 11.58 + 1e-5 * t, "y": 48.14 + 4e-5 * t}
    drive(t).assign(**degrees).to_csv(tmp_path / "a.csv", index=False)
    with pytest.raises(InputError, match=r"columns x, y = 11\.58\.\.11\.58.*look like degrees.*load_recording"):
        load_fleet(tmp_path / "a.csv")
    assert load_fleet(tmp_path / "a.csv", any_scale=True).position[0, 0, 1] == 48.14


def test_milliseconds_and_millimetres_are_not_seconds_and_metres(tmp_path: Path) -> None:
    t = np.arange(0, 5, 0.1)
    drive(t).assign(x=8e4 * t).to_csv(tmp_path / "a.csv", index=False)
    with pytest.raises(InputError, match=r"a typical speed of 8e\+04 m/s: must be below 500 m/s"):
        load_fleet(tmp_path / "a.csv")


@pytest.mark.parametrize("unit", ["ms", "us", "ns"])
@pytest.mark.parametrize("zone", [None, "Europe/Berlin"])
def test_dates_are_seconds_since_1970(tmp_path: Path, unit: str, zone: str | None) -> None:
    t = pd.to_datetime(1_700_000_000_000 + 100 * np.arange(5), unit="ms").astype(f"datetime64[{unit}]")
    stamps = t if zone is None else t.tz_localize("UTC").tz_convert(zone)
    frame = drive(np.arange(5) / 10).assign(t=stamps)
    frame.to_parquet(tmp_path / "a.parquet", index=False)
    frame.assign(t=[stamp.isoformat() for stamp in stamps]).to_csv(tmp_path / "a.csv", index=False)
    for name in ("a.parquet", "a.csv"):
        np.testing.assert_allclose(load_fleet(tmp_path / name).t, 1.7e9 + np.arange(5) / 10, atol=1e-6, rtol=0)


def test_durations_are_seconds(tmp_path: Path) -> None:
    drive(np.arange(5) / 10).assign(t=pd.to_timedelta(100 * np.arange(5), unit="ms")).to_parquet(tmp_path / "a.parquet")
    np.testing.assert_allclose(load_fleet(tmp_path / "a.parquet").t, np.arange(5) / 10)


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("a,0.1,1,0,0,7", r"row 2 = 6 cells under 5 names"),
        ("a,0.1,1,5,0,0", r"row 2 = 6 cells under 5 names.*decimal points"),
        ("a,0.1,1_0,0,0", r"row 2, column x = 1_0"),
        ("a,0.1,١,0,0", r"row 2, column x = ١"),
        ("a,0.1,1e308,0,0", r"row 2, column x = 1e\+308"),
        (f"{'a' * 5000},0.1,1,0,0", r"row 2, column id = a+\.\.\.: must have at most 200 characters"),
    ],
)
def test_a_row_that_is_none_is_named(tmp_path: Path, row: str, message: str) -> None:
    (tmp_path / "a.csv").write_text(f"id,t,x,y,z\na,0,0,0,0\n{row}\na,0.2,2,0,0\n")
    with pytest.raises(InputError, match=message):
        load_fleet(tmp_path / "a.csv")


def test_columns_of_other_types_are_named(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("id,t,x,y,z\na,0,True,0,0\na,1,False,0,0\n")
    with pytest.raises(InputError, match=r"column x = of type bool"):
        load_fleet(tmp_path / "a.csv")
    drive(np.arange(5) / 10).assign(x=pd.to_datetime(np.arange(5), unit="s")).to_parquet(tmp_path / "a.parquet")
    with pytest.raises(InputError, match=r"column x = of type datetime64"):
        load_fleet(tmp_path / "a.parquet")
    with pytest.raises(InputError, match=r"key of columns = 'time'.*must be one of id, t, x"):
        load_fleet(tmp_path / "a.parquet", columns={"time": "t"})


def test_damaged_tables_are_named(tmp_path: Path) -> None:
    drive(np.arange(50) / 10).to_parquet(tmp_path / "a.parquet")
    whole = (tmp_path / "a.parquet").read_bytes()
    rng = np.random.default_rng(1)
    for _ in range(60):
        at = int(rng.integers(len(whole)))
        (tmp_path / "a.parquet").write_bytes(
            whole[:at] + bytes(rng.integers(0, 256, 4, dtype=np.uint8)) + whole[at + 4 :]
        )
        try:
            load_fleet(tmp_path / "a.parquet")
        except InputError as error:
            assert "a.parquet" in str(error)  # noqa: PT017 (most mutants still load)


def test_what_no_memory_holds_is_refused_at_once(tmp_path: Path) -> None:
    began = time.process_time()
    drive(1e18 + 1e8 * np.arange(5)).to_csv(tmp_path / "a.csv", index=False)
    with pytest.raises(InputError, match=r"a\.csv: column t with dt = 0\.1 s = .* steps .*nanoseconds"):
        load_fleet(tmp_path / "a.csv", dt=0.1, any_scale=True)
    (tmp_path / "b.csv").write_text(",".join(["t"] * 100_000) + "\n")
    with pytest.raises(InputError, match=r"b\.csv = 100000 columns: must be at most 5000"):
        load_fleet(tmp_path / "b.csv", format="table")
    (tmp_path / "b.csv").write_text("id,t,x,y,z,x\na,0,0,0,0,0\n")
    with pytest.raises(InputError, match=r"header = 'x' twice"):
        load_fleet(tmp_path / "b.csv")
    assert time.process_time() - began < 5.0


@pytest.mark.parametrize("cell", ["XFD1048576", "A1048576"])
def test_a_small_spreadsheet_does_not_claim_all_memory(tmp_path: Path, cell: str) -> None:
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    book.active.append(["id", "x"])
    book.save(tmp_path / "a.xlsx")
    with zipfile.ZipFile(tmp_path / "a.xlsx") as source, zipfile.ZipFile(tmp_path / "b.xlsx", "w") as target:
        for part in source.namelist():
            text = source.read(part)
            if part.endswith("sheet1.xml"):
                far = f'<row r="1048576"><c r="{cell}"><v>1</v></c></row></sheetData>'.encode()
                text = text.replace(b'<dimension ref="A1:B1"', f'<dimension ref="A1:{cell}"'.encode())
                text = text.replace(b"</sheetData>", far)
            target.writestr(part, text)
    began = time.process_time()
    with pytest.raises(InputError, match=r"b\.xlsx"):
        load_fleet(tmp_path / "b.xlsx")
    assert time.process_time() - began < 8.0

"""Tables as other programs write them: semicolons, decimal commas, tabs, and headers of one's own in several files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from test_data_mistakes import GOOD, WIDE

import coopoc as co
from coopoc.data.registry import load_log


def same(a: co.Recording, b: co.Recording) -> bool:
    """Whether two recordings hold the same numbers."""
    pairs = ((getattr(a, name), getattr(b, name)) for name in ("t", "gnss", "velocity", "relative", "arrival"))
    return a.ids == b.ids and all(np.array_equal(one, other, equal_nan=True) for one, other in pairs)


@pytest.mark.parametrize("text", [GOOD, WIDE], ids=["long", "wide"])
@pytest.mark.parametrize("mark", [";", "\t"])
@pytest.mark.parametrize("point", [".", ","])
def test_separators_and_decimal_commas_change_nothing(tmp_path: Path, text: str, mark: str, point: str) -> None:
    (tmp_path / "a.csv").write_text(text)
    head, body = text.split("\n", 1)
    (tmp_path / "b.csv").write_text(
        "\n".join([head.replace(",", mark), body.replace(",", mark).replace(".", point)]), encoding="utf-8-sig"
    )
    assert same(co.load_recording(tmp_path / "a.csv"), co.load_recording(tmp_path / "b.csv"))


def parts(folder: Path) -> Path:
    """The good log in two tables whose headers differ, and its truth."""
    folder.mkdir()
    head, *rows = GOOD.splitlines()
    uwb = [row.replace("range", "uwb") for row in rows if ",range," in row]
    (folder / "radio.csv").write_text("\n".join([head.replace("partner", "peer"), *uwb]))
    rest = [row for row in rows if ",range," not in row]
    (folder / "car.csv").write_text("\n".join([head.replace("vehicle", "car"), *rest]))
    (folder / "truth.csv").write_text(WIDE.replace("speed,heading", "a,b"))
    return folder


def test_a_header_may_stand_in_one_of_several_tables(tmp_path: Path) -> None:
    (tmp_path / "whole.csv").write_text(GOOD)
    log = load_log(f"{parts(tmp_path / 'log')}?columns=vehicle:car,partner:peer&kinds=uwb:range")
    again = co.read_log(tmp_path / "log", columns={"vehicle": "car", "partner": "peer"}, kinds={"uwb": "range"})
    assert same(log.recording, again.recording)
    assert same(log.recording, co.load_recording(tmp_path / "whole.csv"))
    assert log.truth is not None


def test_a_header_that_no_table_has_is_named(tmp_path: Path) -> None:
    with pytest.raises(co.InputError, match=r"columns\['partner'\] = 'pear': is in no table, .* Did you mean peer"):
        co.read_log(parts(tmp_path / "log"), columns={"vehicle": "car", "partner": "pear"}, kinds={"uwb": "range"})
    with pytest.raises(co.InputError, match=r"columns\['t'\] = 'tme': is in no table, .*"):
        co.read_log(tmp_path / "log", columns={"t": "tme"}, ignore=["uwb"], truth=tmp_path / "log" / "car.csv")


def test_options_behind_a_question_mark_are_those_of_python(tmp_path: Path) -> None:
    text = "t,vehicle,latitude,longitude,height,vx,vy\n" + "".join(
        f"{k / 10},{name},{48.14 + 1e-5 * k},11.58,500,0,8\n" for k in range(20) for name in "ab"
    )
    (tmp_path / "a.csv").write_text(text)
    log = load_log(f"{tmp_path / 'a.csv'}?origin=48.1,11.5,510&clock=a:0.05,b:-0.05&ignore=vx,vy&max_gap=2")
    again = co.read_log(
        tmp_path / "a.csv", origin=(48.1, 11.5, 510.0), clock={"a": 0.05, "b": -0.05}, ignore=["vx", "vy"], max_gap=2.0
    )
    assert log.origin == (48.1, 11.5, 510.0)
    assert same(log.recording, again.recording)
    for words, message in (
        ("origin=48.1,11.5", "must be latitude, longitude and height"),
        ("clock=a:soon", "must be vehicle:seconds pairs"),
        ("kinds=uwb", "must be word:kind pairs"),
        ("dt=x", "must be a number of SI units"),
        ("any_scale=yes", "must be true or false"),
    ):
        with pytest.raises(co.InputError, match=message):
            load_log(f"{tmp_path / 'a.csv'}?{words}")


def test_places_need_no_times(tmp_path: Path) -> None:
    """The same log, once with the mast's place at the first instant, once in a table of its own without one."""
    head, *rows = GOOD.splitlines()
    begin = min(float(row.split(",")[0]) for row in rows)
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "log.csv").write_text("\n".join([head, *rows]))
    (tmp_path / "a" / "mast.csv").write_text(f"t,vehicle,x,y,z\n{begin},mast,5,6,0\n")
    (tmp_path / "b" / "mast.csv").write_text("vehicle,x,y,z\nmast,5,6,0\n")
    a, b = (co.read_log(tmp_path / name) for name in "ab")
    assert same(a.recording, b.recording)
    assert "mast" in b.recording.ids
    assert any("without times" in text for text in b.summary.assumed)
    (tmp_path / "b" / "mast.csv").write_text("vehicle,x,y,z\nmast,5,6,0\nmast,7,6,0\n")
    with pytest.raises(co.InputError, match=r"mast.csv: column t = missing: is needed; one of places alone has"):
        co.read_log(tmp_path / "b")
    (tmp_path / "c.csv").write_text("vehicle,x,y\nmast,5,6\npost,7,6\n")
    with pytest.raises(co.InputError, match="t = in no file"):
        co.read_log(tmp_path / "c.csv")


def test_a_wide_table_with_other_headers_is_told_how_to_name_its_columns(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("t,vehicle,Tempo\n0,red,8\n1,red,8\n")
    with pytest.raises(co.InputError, match=r'kinds=\{"...": "speed_kmh"\}'):
        co.read_log(tmp_path)


def test_columns_that_others_call_observer_and_neighbour_are_named(tmp_path: Path) -> None:
    """A table whose members stand under another header is no table of one vehicle that is named after the file."""
    (tmp_path / "whole.csv").write_text(GOOD)
    head, *rows = GOOD.splitlines()
    odd = [head.replace("vehicle", "Observer").replace("partner", "neighbour"), *rows]
    (tmp_path / "a.csv").write_text("\n".join(odd))
    with pytest.raises(co.InputError, match=r"column vehicle = missing: .*columns=\{\"vehicle\": \"Observer\"\}"):
        co.load_recording(tmp_path / "a.csv")
    with pytest.raises(co.InputError, match=r"column partner = missing: .*columns=\{\"partner\": \"neighbour\"\}"):
        co.read_log(tmp_path / "a.csv", columns={"vehicle": "Observer"})
    read = co.read_log(tmp_path / "a.csv", columns={"partner": "neighbour", "vehicle": "Observer"})
    assert same(read.recording, co.load_recording(tmp_path / "whole.csv"))

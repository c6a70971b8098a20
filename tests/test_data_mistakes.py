"""Typical mistakes in logs: each ends in the message that docs/your_data.md shows, with file, row and column."""

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
import pytest
from conftest import refused
from numpy import arange
from shell import ROOT
from strange_logs import strange

import coopoc as co
from coopoc.data.log.check import check
from coopoc.data.log.read import read_log
from coopoc.data.registry import kind_of
from coopoc.data.registry import read_log as load_log

PAGE = (ROOT / "docs" / "your_data.md").read_text()
GOOD = "t,vehicle,kind,partner,value,std,arrival\n" + "".join(
    f"{k / 10},red,x,,{0.8 * k:.1f},1.5,\n{k / 10},red,y,,0.0,1.5,\n"
    f"{k / 10},red,vx,,8.0,0.1,\n{k / 10},red,vy,,0.0,0.1,\n"
    f"{k / 10},red,range,blue,12.0,0.3,\n{k / 10},blue,x,,{0.8 * k + 12:.1f},1.5,\n{k / 10},blue,y,,0.5,1.5,\n"
    f"{k / 10},blue,vx,,8.0,0.1,\n{k / 10},blue,vy,,0.0,0.1,\n{k / 10},blue,message,red,,,{k / 10 + 0.1:.1f}\n"
    for k in range(20)
)
WIDE = "t,vehicle,x,y,speed,heading\n" + "".join(f"{k / 10},red,{0.8 * k:.1f},0,8.0,0.0\n" for k in range(20))
STILL = "t,vehicle,x,y,speed\n" + "".join(f"{k / 10},red,0,0,0.8\n" for k in range(20))


RANGES = "t,vehicle,partner,range\n0,tag,anchor,4.2\n1,tag,anchor,4.4\n"


def swap(old, new, text=GOOD):
    assert old in text
    return text.replace(old, new, 1)


def nanoseconds(text):
    return re.sub(r"(?m)^([\d.]+),", lambda m: f"{1_700_000_000_000_000_000 + int(float(m[1]) * 1e9)},", text)


ROW3 = "0.0,red,vx,,8.0,0.1,"
ECEF = "t,vehicle,x,y,z\n0,red,4176690,855230,4727230\n1,red,4176691,855230,4727230\n"
DEGREES = "t,vehicle,x,y\n" + "".join(f"{k},red,{11.58 + 1e-5 * k},{48.14 + 2e-5 * k}\n" for k in range(20))
SWAPPED = "t,vehicle,latitude,longitude\n0,red,116.39,39.9\n1,red,116.3901,39.9\n"
MISTAKES: dict[str, tuple[str, dict[str, Any], str]] = {
    "spaces between cells": (GOOD.replace(",", " "), {}, ""),
    "decimal commas": (swap(ROW3, "0.0,red,vx,,8,0,0.1,"), {}, "row 3"),
    "no column of time": (swap("t,vehicle", "time,vehicle"), {}, "log.csv: column t"),
    "a header twice": (swap("std", "value"), {}, "log.csv: header"),
    "an unknown kind": (swap("range", "dist"), {}, "row 5, column kind"),
    "separators of thousands, or a word": (swap(ROW3, '0.0,red,vx,,"1,234.5",0.1,'), {}, "row 3, column value"),
    "an empty value": (swap(ROW3, "0.0,red,vx,,,0.1,"), {}, "row 3, column value"),
    "a time of day without a date": (swap(ROW3, "12:00:01,red,vx,,8.0,0.1,"), {}, "row 3, column t"),
    "nanoseconds for seconds": (nanoseconds(GOOD), {}, "column t"),
    "degrees as x and y": (DEGREES, {}, "columns x, y"),
    "positions from the centre of the earth": (ECEF, {}, "column z"),
    "latitude and longitude swapped": (SWAPPED, {}, "row 1, latitude"),
    "degrees in both frames": (GOOD + "0.0,blue,latitude,,48.1,1,\n0.0,blue,longitude,,11.5,1,\n", {}, "row 1, x"),
    "a bearing in degrees": (swap("range,blue,12.0", "bearing,blue,45"), {}, "row 5, bearing"),
    "a compass in radians' column": (swap(",0.0\n", ",270\n", WIDE), {}, "row 1, heading"),
    "a negative range": (swap("range,blue,12.0", "range,blue,-3.2"), {}, "row 5, range"),
    "a range without a partner": (swap("range,blue", "range,"), {}, "row 5, column partner"),
    "no column of partners": (swap("kind,partner", "kind,target"), {}, "log.csv: column partner"),
    "a vehicle that measures itself": (swap("range,blue", "range,red"), {}, "row 5, column partner"),
    "a standard deviation of zero": (swap("x,,0.0,1.5", "x,,0.0,0"), {}, "row 1, standard deviation of x"),
    "a message that arrives before it is sent": (swap("red,,,0.1", "red,,,-0.5"), {}, "row 10, column arrival"),
    "speed without a heading": (STILL, {}, "row 1, speed"),
    "one fix and no motion but a yaw rate": (
        "t,vehicle,x,y,yaw_rate\n0,red,0,0,0.1\n1,red,,,0.1\n2,red,,,0.1\n",
        {},
        "vehicle red",
    ),
    "no fix at all": ("t,vehicle,vx,vy\n0,red,8,0\n1,red,8,0\n", {}, "fixes"),
    "ranges alone": (RANGES, {"dt": 0.5}, "fixes"),
    "ranges alone, in body frames": (RANGES, {"dt": 0.5, "frame": "body"}, "fixes, odometry"),
    "a truth of other vehicles": (GOOD, {"truth": "t,vehicle,x,y\n0,rot,0,0\n1,rot,8,0\n"}, "column vehicle"),
    "a clock of an unknown vehicle": (GOOD, {"clock": {"bleu": 0.1}}, ""),
    "an antenna of an unknown vehicle": (GOOD, {"antenna": {"bleu": (1, 0, 0)}}, ""),
    "a tag of an unknown vehicle": (GOOD, {"tag": {"bleu": (1, 0, 0)}}, ""),
    "an antenna of what has no course": (STILL.replace("0.8", "0"), {"antenna": (1, 0, 0)}, "antenna of red"),
    "a misspelt option": (GOOD, {"dts": 0.1}, "option"),
    "steps longer than the log": (GOOD, {"dt": 5.0}, "dt"),
    "one instant": ("t,vehicle,x,y\n3,red,0,0\n3,blue,9,0\n", {}, "log.csv: t"),
    "names of others": ("t,vehicle,lat,lon,vn\n0,red,48,11,0\n", {}, "log.csv: column kind"),
    "headers that are short": ("t,vehicle,lat,lon,speed\n0,red,48,11,0\n1,red,48,11,0\n", {}, "fixes"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_named_as_the_page_says(tmp_path, mistake):
    text, options, place = MISTAKES[mistake]
    (tmp_path / "log.csv").write_text(text)
    if "truth" in options:
        (tmp_path / "truth.csv").write_text(options["truth"])
        options = {"truth": tmp_path / "truth.csv"}
    with pytest.raises(co.InputError) as error:
        load_log(tmp_path / "log.csv", **options)
    (shown,) = re.findall(rf"^\| {re.escape(mistake)} \| `(.*)` \|$", PAGE, flags=re.MULTILINE)
    message, at = str(error.value), 0
    for part in shown.split(" ... "):
        assert part in message[at:], message
        at = message.index(part, at)
    assert place in message
    assert error.value.hint


def test_files_that_are_named_after_sensors_are_of_no_vehicle(tmp_path):
    (tmp_path / "gps.csv").write_text("t,x,y\n0,0,0\n1,8,0\n")
    (tmp_path / "imu.csv").write_text("t,speed,yaw_rate\n0,8,0\n1,8,0\n")
    with refused("fixes = of gps, not of imu: .* a column vehicle"):
        co.read_log(tmp_path)


def test_all_unknown_kinds_are_named_at_once(tmp_path):
    text = "t,car,kind,value\n0,red,gyro,0.1\n0,red,v2x,1\n0,red,gyro,0.1\n"
    (tmp_path / "log.csv").write_text(text)
    with refused(r"'gyro'.*\{\"gyro\": \.\.\.\}.*Unknown too: 'v2x'\."):
        co.read_log(tmp_path / "log.csv", columns={"vehicle": "car"})
    (tmp_path / "log.csv").write_text(text.replace("t,", "stamp,", 1))
    with refused(r"columns=\{\"t\": \"stamp\"\}"):
        co.read_log(tmp_path / "log.csv")


@pytest.mark.parametrize(
    "option",
    [
        {"columns": 3},
        {"kinds": [1]},
        {"ignore": 3},
        {"antenna": (1, 2)},
        {"origin": (1, 2)},
        {"any_scale": "x"},
        {"dt": "x"},
    ],
)
def test_options_of_the_wrong_kind_are_refused(tmp_path, option):
    (tmp_path / "log.csv").write_text(GOOD)
    with refused(next(iter(option))):
        read_log(tmp_path / "log.csv", **option)
    with refused("path = 3"):
        read_log(tmp_path / "log.csv", truth=3)


def test_every_mistake_of_the_page_is_tested():
    table = PAGE[PAGE.index("| mistake |") : PAGE.index("`coopoc data check` warns")]
    assert {row.split(" | ")[0][2:] for row in table.splitlines()[2:] if row} == set(MISTAKES)


def test_the_good_file_is_good(tmp_path):
    for text in (GOOD, WIDE):
        (tmp_path / "log.csv").write_text(text)
        assert not read_log(tmp_path / "log.csv").summary.refused


def test_a_row_that_comes_late_changes_nothing_and_is_named(tmp_path):
    late = "0.5,red,x,,4.0,1.5,\n"
    texts = {"a": GOOD, "b": swap(late, "") + late, "c": GOOD + "9e9,red,x,,4.0,1.5,\n", "d": nanoseconds(WIDE)}
    for name, text in texts.items():
        (tmp_path / f"{name}.csv").write_text(text)
    a, b = (read_log(tmp_path / name) for name in ("a.csv", "b.csv"))
    assert same(a.recording, b.recording)
    assert "stamps of red go back (first: b.csv: row 200)" in str(b.summary)
    with refused("c.csv: row 201, t = 9000000000 s"):
        read_log(tmp_path / "c.csv")
    with refused("d.csv: column t .* if all files are so"):
        read_log(tmp_path / "a.csv", truth=tmp_path / "d.csv")


KEPT: dict[str, tuple[Callable[[str], str], str]] = {
    "a partner that is misspelt": (
        lambda text: text.replace("range,blue", "range,bleu", 1),
        "relative measurements of members without a position",
    ),
    "a receiver that is misspelt": (
        lambda text: text.replace("message,red", "message,rde", 1),
        "messages to a receiver that is absent or has no position",
    ),
    "a row twice": (
        lambda text: text + text.splitlines()[1] + "\n",
        "repeated rows (same time, vehicle, kind and partner)",
    ),
    "a bearing of a vehicle that stands": (
        lambda text: text + "0.0,rsu,x,,5,1,\n0.0,rsu,y,,5,1,\n0.3,rsu,bearing,red,0.1,0.1,\n",
        "bearings at times without a heading",
    ),
    "odometry without a fix": (
        lambda text: text + "0.1,rsu,vx,,1,0.1,\n",
        "odometry and headings of vehicles without a position",
    ),
    "half a fix": (lambda text: text.replace("0.0,red,y,,0.0,1.5,\n", "", 1), "incomplete rows, without all of x, y"),
}


@pytest.mark.parametrize("case", KEPT)
def test_what_does_not_fit_is_counted_with_its_place(tmp_path, case):
    change, reason = KEPT[case]
    (tmp_path / "log.csv").write_text(change(GOOD))
    refused = read_log(tmp_path / "log.csv").summary.refused
    (found,) = [why for why in refused if why.startswith(reason)]
    number, place = refused[found]
    assert number == 1
    assert place.startswith("log.csv: row ")


def test_numbers_of_a_fix_with_other_stamps_are_named(tmp_path):
    """20 us apart, of half the fixes of one, and of all."""
    file = tmp_path / "log.csv"
    file.write_text(re.sub(r"(?m)^(0\.\d)(,blue,y)", r"\g<1>0002\2", GOOD))
    assert "stamps of x, y of blue differ" in str(check(read_log(file)).warnings)
    file.write_text(re.sub(r"(\.\d)(,blue,y)", r"\g<1>0002\2", GOOD))
    with refused("row 6, fixes of blue = never x, y .* at one time"):
        read_log(file)


def same(a, b):
    """Whether two recordings hold the same numbers."""
    pairs = ((getattr(a, name), getattr(b, name)) for name in ("t", "gnss", "velocity", "relative", "arrival"))
    return a.ids == b.ids and all(np.array_equal(one, other, equal_nan=True) for one, other in pairs)


@pytest.mark.parametrize("text", [GOOD, WIDE], ids=["long", "wide"])
@pytest.mark.parametrize(("mark", "point"), [(";", ","), ("\t", ".")])
def test_separators_and_decimal_commas_change_nothing(tmp_path, text, mark, point):
    (tmp_path / "a.csv").write_text(text)
    head, body = text.split("\n", 1)
    (tmp_path / "b.csv").write_text(
        "\n".join([head.replace(",", mark), body.replace(",", mark).replace(".", point)]), encoding="utf-8-sig"
    )
    assert same(co.read_log(tmp_path / "a.csv").recording, co.read_log(tmp_path / "b.csv").recording)


@pytest.mark.parametrize(("option", "time"), [("", ""), ("?columns=t:stamp.sec", ""), ("?columns=t:time", "time,")])
def test_seconds_and_nanoseconds_of_a_stamp_are_one_time(tmp_path, option, time):
    text = WIDE.replace("t,", f"{time}stamp.sec,stamp.nanosec,", 1)
    text = re.sub(r"(?m)^(\d)\.(\d)", r"\1.\2," * bool(time) + r"\1,\g<2>00000000", text)
    (tmp_path / "a.csv").write_text(WIDE)
    (tmp_path / "b.csv").write_text(text)
    assert same(co.read_log(tmp_path / "a.csv").recording, load_log(f"{tmp_path / 'b.csv'}{option}").recording)


def parts(folder):
    """The good log in two tables whose headers differ, and its truth."""
    folder.mkdir()
    head, *rows = GOOD.splitlines()
    uwb = [row.replace("range", "uwb") for row in rows if ",range," in row]
    (folder / "radio.csv").write_text("\n".join([head.replace("partner", "peer"), *uwb]))
    (folder / "car.csv").write_text(
        "\n".join([head.replace("vehicle", "car"), *[row for row in rows if ",range," not in row]])
    )
    (folder / "truth.csv").write_text(WIDE.replace("speed,heading", "a,b"))
    return folder


@pytest.mark.parametrize("name", ["t", ""])
def test_a_named_index_is_a_column_and_none_is_behind_the_last_comma(tmp_path, name):
    frame = pd.DataFrame({"t": [0.0, 1.0, 2.0], "x": [0.0, 9.0, 18.0], "y": 0.0, "vx": 9.0, "vy": 0.0})
    if name:
        frame.set_index(name).to_parquet(tmp_path / "a.parquet")
    else:
        (tmp_path / "a.csv").write_text(frame.to_csv(index=False).replace("\n", ",\n"))
    summary = co.read_log(tmp_path).summary
    assert summary.read["fixes"] == 3
    assert not summary.unread


def test_a_wide_table_repeats_a_fix_beside_each_partner(tmp_path):
    """The long table without a word is the reference; names are whole numbers that pandas has written as floats."""
    t, made = arange(0, 20, 0.5), {"wide": [], "long": []}
    names, at = ["1.0", "2.0", "007"], np.array([[0.0, 0.0], [0.0, 9.0], [12.0, 0.0]])
    for now in t.tolist():
        for k, name in enumerate(names):
            x, y = at[k] + [8 * now, 0.1 * k * now]
            made["long"] += [[now, name, kind, "", value] for kind, value in zip("xy", (x, y), strict=True)]
            for j in {0, 1, 2} - {k}:
                gap = np.hypot(*(at[j] + [8 * now, 0.1 * j * now] - [x, y]))
                made["wide"].append([now, name, x, y, names[j].removesuffix(".0"), gap])
                made["long"].append([now, name, "range", names[j].removesuffix(".0"), gap])
    heads = {"wide": "t,vehicle,x,y,partner,range", "long": "t,vehicle,kind,partner,value"}
    for form, rows in made.items():
        (tmp_path / f"{form}.csv").write_text("\n".join([heads[form], *(",".join(map(str, row)) for row in rows)]))
    wide, long = (co.read_log(tmp_path / f"{form}.csv") for form in made)
    assert same(wide.recording, long.recording)
    assert wide.recording.ids == ("1", "2", "007")
    assert not wide.summary.refused
    assert len(wide.recording.links) == 6 * len(t)


@pytest.mark.parametrize("period", [3600, 86400, 604800, 4294967.296, 619315200])
def test_clocks_that_begin_anew_go_on(tmp_path, period):
    """The end of summer time, seconds of the day at midnight, of the GPS week at its end, milliseconds of 32 bits,
    weeks of ten: the file with stamps that go on is the reference. One vehicle comes after the turn."""
    t, rows = period - 10 + arange(0, 20, 0.5), []
    for now in t.tolist():
        at = {"t": now, "x": 8 * (now - period), "vx": 8.0, "vy": 0.0}
        rows += [{**at, "vehicle": "a", "y": 0.0}, *[{**at, "vehicle": "b", "y": 5.0}] * (now > period + 2)]
    plain, anew = (pd.DataFrame(rows) for _ in "ab")
    anew["t"] %= period
    plain.to_csv(tmp_path / "plain.csv")
    anew.to_csv(tmp_path / "anew.csv")
    one, other = (co.read_log(tmp_path / name) for name in ("plain.csv", "anew.csv"))
    assert same(one.recording, other.recording)
    assert other.summary.assumed.keys() - one.summary.assumed.keys() == {
        f"stamps wrap around after {period} s: those of its first half come later"
    }
    after, file = plain["t"] >= period, tmp_path / "truth.csv"
    for truth in (plain, anew, *[anew[after]] * (period % 86400 == 0)):
        truth.drop(columns=["vx", "vy"]).to_csv(file)
        for name, log in (("plain.csv", one), ("anew.csv", other)):
            actual = load_log(f"{tmp_path / name}?truth={file}").truth
            there = np.isfinite(actual.position[..., 0])
            assert there.sum() == len(truth)
            np.testing.assert_allclose(actual.position[there], log.recording.gnss[0][there], atol=1e-9)
    assert kind_of(tmp_path / "anew.csv") == kind_of(tmp_path / "plain.csv") == "log"


def test_two_drives_of_a_file_stay_a_day_apart(tmp_path):
    drive = pd.DataFrame({"t": arange(20.0), "x": arange(20.0), "y": 0.0, "vx": 1.0, "vy": 0.0})
    pd.concat([drive, drive.assign(t=drive["t"] + 86400)]).to_csv(tmp_path / "a.csv")
    assert np.isfinite(co.read_log(tmp_path / "a.csv").recording.gnss[0, :, 0, 0]).sum() == 40


def test_a_header_may_stand_in_one_of_several_tables(tmp_path):
    (tmp_path / "whole.csv").write_text(f"# a, b\n{GOOD}")
    log = load_log(f"{parts(tmp_path / 'log')}?columns=vehicle:car,partner:peer&kinds=uwb:range")
    again = co.read_log(tmp_path / "log", columns={"vehicle": "car", "partner": "peer"}, kinds={"uwb": "range"})
    assert same(log.recording, again.recording)
    assert same(log.recording, co.read_log(tmp_path / "whole.csv").recording)
    assert log.truth is not None


def test_a_header_that_no_table_has_is_named(tmp_path):
    with refused(r"columns\['partner'\], a header = 'pear': must be .* Did you mean peer"):
        co.read_log(parts(tmp_path / "log"), columns={"vehicle": "car", "partner": "pear"}, kinds={"uwb": "range"})
    with refused(r"columns\['t'\], a header = 'tme': must be one of .*"):
        co.read_log(tmp_path / "log", columns={"t": "tme"}, ignore=["uwb"], truth=tmp_path / "log" / "car.csv")


def test_options_behind_a_question_mark_are_those_of_python(tmp_path):
    text = "t,vehicle,latitude,longitude,height,vx,vy\n" + "".join(
        f"{k / 10},{name},{48.14 + 1e-5 * k},11.58,500,0,8\n" for k in range(20) for name in ('"a,"', "b")
    )
    (tmp_path / "a.csv").write_text(text)
    log = load_log(f"{tmp_path / 'a.csv'}?origin=48.1,11.5,510&clock=a%2C:0.05,b:-0.05&ignore=vx,vy&max_gap=2")
    again = co.read_log(
        tmp_path / "a.csv", origin=(48.1, 11.5, 510.0), clock={"a,": 0.05, "b": -0.05}, ignore=["vx", "vy"], max_gap=2.0
    )
    assert log.origin == (48.1, 11.5, 510.0)
    assert same(log.recording, again.recording)
    for words, message in (
        ("origin=48.1,11.5", "must be latitude, longitude and height"),
        ("clock=a:soon", "must be vehicle:seconds pairs"),
        ("clock=b:1&clock=b:2", "each vehicle once"),
        ("antenna=a:1/2", "must be metres forward/left/up"),
        ("kinds=uwb", "must be word:kind pairs"),
        ("dt=x", "must be a number of SI units"),
        ("any_scale=yes", "must be true or false"),
        ("clock=a,b:1", "of a name a comma as %2C"),
        ("std=vx:-1", r"std of vx = -1.0: must be .* > 0"),
        ("scale=t:-1", r"scale of t = -1.0: must be .* > 0"),
        ("origin=nan,11.5,510", r"origin\[0\] = nan"),
        ("since=-5", "since, until"),
        ("scale=range:2", "scale = 'range': must be one of a,.height, "),
        ("offset=b.speed:2", "offset = 'b.speed'"),
        ("std=range:2", "std = 'range'"),
    ):
        with refused(message):
            load_log(f"{tmp_path / 'a.csv'}?{words}")


def test_an_option_without_an_effect_is_said_to_have_none(tmp_path):
    (tmp_path / "log.csv").write_text(WIDE)
    text = str(co.read_log(tmp_path / "log.csv", origin=(1, 2, 3), ignore=["imu"]).summary)
    assert "origin= has no effect" in text
    assert "ignore=imu has no effect" in text


def test_places_need_no_times(tmp_path):
    """The same log, once with the mast's place at the first instant, once in a table of its own without one."""
    head, *rows = GOOD.splitlines()
    begin = min(float(row.split(",")[0]) for row in rows)
    for name in "ab":
        (tmp_path / name).mkdir()
        (tmp_path / name / "log.csv").write_text("\n".join([head, *rows]))
    (tmp_path / "a" / "mast.csv").write_text(f"t,vehicle,x,y,z\n{begin},mast,5,6,0\n")
    (tmp_path / "b" / "mast.csv").write_text("vehicle,x,y,z\nmast,5,6,0\n")
    a, b = (read_log(tmp_path / name) for name in "ab")
    assert same(a.recording, b.recording)
    assert "mast" in b.recording.ids
    assert any("without times" in text for text in b.summary.assumed)
    (tmp_path / "b" / "mast.csv").write_text("vehicle,x,y,z\nmast,5,6,0\nmast,7,6,0\n")
    with refused(r"mast.csv: column t = missing: is needed; one of places alone has"):
        co.read_log(tmp_path / "b")
    (tmp_path / "c.csv").write_text("vehicle,x,y\nmast,5,6\npost,7,6\n")
    with refused("t = in no file"):
        co.read_log(tmp_path / "c.csv")


@pytest.mark.parametrize(
    ("code", "kinds"),
    [
        (-1, ["range"]),
        (0, ["range"]),
        (9999, ["range"]),
        (511, ["heading"]),
        (-1, ["heading"]),
        (0, ["x", "y"]),
        (10**9, ["x", "y"]),
    ],
)
def test_numbers_that_stand_for_none_are_none(tmp_path, code, kinds):
    """Every fourth row: the log is that with empty cells; one alone, or a mast at the origin, is what it says."""
    t = arange(0.0, 12.0, 0.2)
    car = pd.DataFrame({"t": t, "vehicle": "car", "x": 5e3 + 8 * t, "y": 300.0, "speed": 8.0, "heading": 0.01 * t})
    car = car.assign(partner="mast", range=np.hypot(car["x"], 300.0 + 10 * np.sin(t)))
    for name, rows, cell in (("a", slice(3, None, 4), code), ("b", slice(3, None, 4), np.nan), ("one", [3], code)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "mast.csv").write_text("vehicle,x,y\nmast,0,0\n")
        frame = car.astype(dict.fromkeys(kinds, float))
        frame.loc[frame.index[rows], kinds] = cell
        frame.to_csv(tmp_path / name / "car.csv")
    a, b = (read_log(tmp_path / name) for name in "ab")
    assert same(a.recording, b.recording)
    assert sum(number for why, (number, _) in a.summary.refused.items() if "none" in why) == 15 * len(kinds)
    if (code, *kinds) in ((-1, "range"), (0, "range"), (511, "heading")):
        with refused("row 4"):
            read_log(tmp_path / "one")
    car["heading"] = np.round(4 + 4.4 * np.sin(t / 5))  # whole degrees for radians: no number stands for none
    car.to_csv(tmp_path / "a" / "car.csv")
    with refused("heading = [78]: must be within"):
        read_log(tmp_path / "a")


def test_ranges_that_end_at_the_most_that_is_measured_are_left_out(tmp_path):
    """The same log without them is the reference."""
    rows, far = pd.read_csv(strange(tmp_path / "a", "drone") / "log.csv"), 60.0
    (tmp_path / "b").mkdir()
    rows.assign(range=rows["range"].clip(upper=far)).to_csv(tmp_path / "a" / "log.csv")
    rows[~rows["range"].ge(far)].to_csv(tmp_path / "b" / "log.csv")
    one, other = (read_log(tmp_path / name) for name in "ab")
    assert 100 < len(other.recording.links) < 0.9 * rows["range"].count()
    assert same(one.recording, other.recording)
    assert "at their maximum, of partners farther away" in str(one.summary)

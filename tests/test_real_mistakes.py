"""Real logs and graphs with the mistakes that people make: each is refused, or named by `check`, or known as invisible.

The data are MR.CLAM 6 (Vicon, wheels, cameras), CATS (receivers on a road) and the graph mrclam5a; as they are, `check`
has no warning that another test does not know.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import coopoc as co
from coopoc.data.log.check import check
from coopoc.data.log.read import read_log
from coopoc.data.registry import load_log
from coopoc.formats.g2o import write_g2o
from coopoc.formats.pyfg import read_pyfg

FOOT = 0.3048
Table = np.ndarray[Any, Any]
Edit = Callable[[Path], None]


@pytest.fixture(scope="module")
def clam(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first five minutes of MR.CLAM 6."""
    source, folder = shared / "mrclam" / "MRCLAM_Dataset6", tmp_path_factory.mktemp("clam")
    begin = np.loadtxt(source / "Robot1_Groundtruth.dat")[0, 0]
    for file in source.glob("*.dat"):
        table = np.loadtxt(file)
        timed = file.name.startswith("Robot")
        np.savetxt(folder / file.name, table[table[:, 0] < begin + 300] if timed else table, fmt="%.6f")
    return folder


def column(files: str, which: int, change: Callable[[Table], Table]) -> Edit:
    """A column of all files of a kind, changed."""

    def edit(folder: Path) -> None:
        for file in folder.glob(f"Robot*_{files}.dat"):
            table = np.loadtxt(file)
            table[:, which] = change(table[:, which])
            np.savetxt(file, table, fmt="%.6f")

    return edit


def swapped(files: str, one: int, two: int) -> Edit:
    def edit(folder: Path) -> None:
        for file in folder.glob(f"Robot*_{files}.dat"):
            table = np.loadtxt(file)
            table[:, [one, two]] = table[:, [two, one]]
            np.savetxt(file, table, fmt="%.6f")

    return edit


def both(*edits: Edit) -> Edit:
    def edit(folder: Path) -> None:
        for each in edits:
            each(folder)

    return edit


def commas(folder: Path) -> None:
    for file in folder.glob("*_Measurement.dat"):
        file.write_text(file.read_text().replace(".", ","))


CLAM: dict[str, tuple[Edit, str]] = {
    "range and bearing swapped": (
        swapped("Measurement", 2, 3),
        r"^Robot1_Measurement.* must have a bearing within a turn",
    ),
    "x and y swapped": (swapped("Groundtruth", 1, 2), r"robot1: fixes move -\d+ deg anticlockwise of the odometry"),
    "speed and yaw rate swapped": (swapped("Odometry", 1, 2), r"robot1: NIS is 9\.\d+, not 1"),
    "decimal commas": (commas, r"^Robot1_Measurement.dat: line \d+ = .*must be time barcode range bearing"),
    "y flipped": (column("Groundtruth", 2, np.negative), r"robot1: fixes move \d+ deg anticlockwise"),
    "y and headings flipped": (
        both(column("Groundtruth", 2, np.negative), column("Groundtruth", 3, np.negative)),
        r"azimuths miss the positions by .*no axis is mirrored",
    ),
    "bearings clockwise": (column("Measurement", 3, np.negative), r"azimuths miss the positions by .*anticlockwise"),
    "bearings in degrees": (column("Measurement", 3, np.degrees), r"^Robot1.*bearing within a turn .*in rad"),
    "headings in degrees": (column("Groundtruth", 3, np.degrees), r"^Robot1.*heading within a turn .*in rad"),
    "yaw rates in degrees": (column("Odometry", 2, np.degrees), r"^Robot\d_Odometry.*turn_rate within a turn"),
    "ranges in feet": (column("Measurement", 2, lambda v: v / FOOT), r"ranges miss the positions by .*in feet"),
    "positions in feet": (
        both(*(column("Groundtruth", k, lambda v: v / FOOT) for k in (1, 2))),
        r"fixes travel 3\.\d+ times as far as the odometry says. Are positions in feet",
    ),
    "speeds in feet a second": (column("Odometry", 1, lambda v: v / FOOT), r"fixes travel 0\.2\d .*feet a second"),
    "milliseconds": (
        both(*(column(f, 0, lambda v: 1e3 * v) for f in ("Groundtruth", "Odometry", "Measurement"))),
        r"^Robot1_Groundtruth.*looks like milliseconds",
    ),
}


def said(read: Callable[[], Any]) -> list[str]:
    """The error of a reader, or the warnings of the check."""
    try:
        return list(check(read()).warnings)
    except co.InputError as error:
        return [str(error)]


@pytest.mark.parametrize("mistake", CLAM)
def test_a_mistake_in_mrclam_is_named(clam: Path, tmp_path: Path, mistake: str) -> None:
    edit, message = CLAM[mistake]
    for file in clam.glob("*.dat"):
        (tmp_path / file.name).write_bytes(file.read_bytes())
    edit(tmp_path)
    found = said(lambda: load_log(tmp_path))
    assert any(re.search(message, warning) for warning in found), found


def test_mrclam_as_it_is_raises_no_warning_and_a_byte_order_mark_changes_nothing(clam: Path, tmp_path: Path) -> None:
    for file in clam.glob("*.dat"):
        (tmp_path / file.name).write_bytes(b"\xef\xbb\xbf" + file.read_bytes())
    marked, plain = load_log(tmp_path), load_log(clam)
    assert check(plain).warnings == ()
    np.testing.assert_array_equal(marked.recording.relative, plain.recording.relative)


def test_a_gap_of_mrclam_is_one_and_shown(clam: Path, tmp_path: Path) -> None:
    """A minute without Vicon: the robot is absent for it, and the check's table has its share."""
    for file in clam.glob("*.dat"):
        (tmp_path / file.name).write_bytes(file.read_bytes())
    table = np.loadtxt(clam / "Robot2_Groundtruth.dat")
    late = table[:, 0] - table[0, 0]
    np.savetxt(tmp_path / "Robot2_Groundtruth.dat", table[(late < 100) | (late > 160)], fmt="%.6f")
    log = load_log(tmp_path)
    gone = np.isnan(log.recording.velocity[0, :, 1, 0]).sum() * log.recording.dt
    assert 59.0 < gone < 61.0
    assert 0.7 < check(log).vehicles[1]["there"] < 0.85 < check(log).vehicles[0]["there"]


def sentence(words: list[str]) -> str:
    body = ",".join(words)
    return f"${body}*{reduce(lambda sum_, letter: sum_ ^ ord(letter), body, 0):02X}\n"


NMEA: dict[str, tuple[Callable[[list[str]], list[str]], str]] = {
    "latitude and longitude swapped": (lambda w: [*w[:2], w[4], "N", w[2], "E", *w[6:]], "0 fixes"),
    "decimal commas": (lambda w: [word.replace(".", ",") for word in w], "0 fixes"),
    "degrees for degrees and minutes": (lambda w: [*w[:2], "34.375284", w[3], "108.899189", *w[5:]], "0 fixes"),
}
INVISIBLE: dict[str, Callable[[list[str]], list[str]]] = {
    "S for N": lambda w: [*w[:3], "S", *w[4:]],
    "heights in feet": lambda w: [*w[:9], f"{float(w[9]) / FOOT:.3f}", *w[10:]],
}
"""Fixes alone have nothing to be compared with: docs/your_data.md lists these."""


@pytest.mark.parametrize("mistake", [*NMEA, *INVISIBLE, "none"])
def test_a_mistake_in_nmea_of_a_receiver(shared: Path, tmp_path: Path, mistake: str) -> None:
    """CATS, two receivers, two minutes; checksums are those of the changed sentences."""
    change = NMEA[mistake][0] if mistake in NMEA else INVISIBLE.get(mistake, lambda words: words)
    for name in ("AV_veh1", "AV_veh2"):
        lines = (shared / "cats_nmea" / f"{name}.nmea").read_text().splitlines()[:1200]
        changed = "".join(sentence(change(line[1:].partition("*")[0].split(","))) for line in lines)
        (tmp_path / f"{name}.nmea").write_text(changed)
    found = said(lambda: read_log(tmp_path))
    if mistake in NMEA:
        assert NMEA[mistake][1] in found[0]
    else:
        assert all("smaller than stated" in warning for warning in found)


def without_stamps(part: Any) -> Any:
    """A graph as g2o can hold it."""
    if not is_dataclass(part):
        return part
    changes = {f.name: without_stamps(getattr(part, f.name)) for f in fields(part)}
    if isinstance(changes.get("stamps"), np.ndarray):
        changes["stamps"] = np.full_like(changes["stamps"], np.nan)
    return replace(part, **changes)  # type: ignore[type-var]


def inverted(line: str) -> str:
    """An edge of poses in the plane with the covariance in the place of the information."""
    words = line.split()
    if words[0] == "EDGE_SE2":
        matrix = np.zeros((3, 3))
        matrix[np.triu_indices(3)] = [float(word) for word in words[6:12]]
        covariance = np.linalg.inv(matrix + np.triu(matrix, 1).T)
        words[6:12] = [f"{value:.12g}" for value in covariance[np.triu_indices(3)]]
    return " ".join(words)


def test_covariances_for_information_are_named_where_a_graph_is_solved(shared: Path, tmp_path: Path) -> None:
    write_g2o(without_stamps(read_pyfg(shared / "pyfg" / "mrclam5a.pyfg")), tmp_path / "right.g2o")
    lines = (tmp_path / "right.g2o").read_text().splitlines()
    (tmp_path / "wrong.g2o").write_text("\n".join(map(inverted, lines)) + "\n")
    found = {}
    for name in ("right", "wrong"):
        command = [sys.executable, "-m", "coopoc.cli", "solve", f"{name}.g2o", "--objective", "geodesic"]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        found[name] = json.loads(done.stdout)["misfit"], "covariances where the format has information" in done.stderr
    assert 0.1 < found["right"][0] < 1.0
    assert not found["right"][1]
    assert found["wrong"][0] < 1 / 30
    assert found["wrong"][1]

"""The .dat files of a UTIAS MR.CLAM folder, each checked line by line."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from coopoc.arrays import Floats, Ints
from coopoc.errors import InputError
from coopoc.formats.values import LARGEST

from .scale import check_time

SUBJECTS = 5
"""Subjects 1 to 5 are robots, those beyond are landmarks."""
DEGREES = "Convert degrees to radians."
TURN = 2 * np.pi + 1e-6


class Seen(NamedTuple):
    """Measurements of one folder.

    Attributes:
        rows: (M, 5) unix time s, observer, subject (both columns of `robots`), range m, bearing rad, by time.
        landmarks: (S, 5) unix time s, observer, subject (its number), range m, bearing rad, by time.
        absent: number of measurements of robots that have no files, which are not among the M.
        unknown: number of measurements of barcodes in no list, which are not among the M.
    """

    rows: Floats
    landmarks: Floats
    absent: int
    unknown: int


def robots(folder: Path) -> tuple[int, ...]:
    """Numbers of the robots that have a file of truth.

    Raises:
        InputError: there is none.
    """
    found = [
        re.fullmatch(r"Robot([1-9])_Groundtruth\.dat", file.name) for file in folder.glob("Robot*_Groundtruth.dat")
    ]
    numbers = tuple(sorted(int(match[1]) for match in found if match))
    if not numbers:
        raise _missing(folder, "Robot1_Groundtruth.dat")
    return numbers


def truth(folder: Path, robot: int) -> Floats:
    """(L, 4) unix time s, x m, y m, heading rad (unwrapped) of a robot by Vicon; times increase."""
    table = _read(folder / f"Robot{robot}_Groundtruth.dat", 4)
    _in_order(folder / f"Robot{robot}_Groundtruth.dat", table[:, 0], strictly=True)
    turn = "must have a heading within a turn, in rad"
    _refuse(folder / f"Robot{robot}_Groundtruth.dat", table, np.abs(table[:, 3]) > TURN, turn, DEGREES)
    table[:, 3] = np.unwrap(table[:, 3])
    return table


def odometry(folder: Path, robot: int) -> Floats:
    """(L, 3) unix time s, speed m/s, turn rate rad/s of a robot's wheels; times do not decrease."""
    table = _read(folder / f"Robot{robot}_Odometry.dat", 3)
    _in_order(folder / f"Robot{robot}_Odometry.dat", table[:, 0])
    slow = "must turn by less than a turn a second, in rad/s"
    _refuse(folder / f"Robot{robot}_Odometry.dat", table, np.abs(table[:, 2]) > TURN, slow, DEGREES)
    return table


def landmarks(folder: Path) -> Floats:
    """(M, 3) subject, x m, y m of the landmarks; of no length where the folder has no file of them."""
    file = folder / "Landmark_Groundtruth.dat"
    return _read(file, 5)[:, :3] if file.is_file() else np.empty((0, 3))


def measurements(folder: Path, numbers: tuple[int, ...]) -> Seen:
    """What the robots measured of each other. The second column of a file is a barcode, though its header says subject.

    Raises:
        InputError: with the line, a barcode or subject that stands twice, a robot that measures itself, a range that is
            not positive, a bearing beyond a turn, times that decrease.
    """
    subject_of = _barcodes(folder / "Barcodes.dat")
    parts, marks, absent, unknown = [np.empty((0, 5))], [np.empty((0, 5))], 0, 0
    for column, robot in enumerate(numbers):
        file = folder / f"Robot{robot}_Measurement.dat"
        table = _read(file, 4)
        _in_order(file, table[:, 0])
        subject = np.array([subject_of.get(code, 0) for code in table[:, 1].tolist()], dtype=np.int64)
        whose = "must be another's: a robot does not measure itself"
        _refuse(file, table, subject == robot, whose, "Check Barcodes.dat, or remove the line.")
        _refuse(file, table, table[:, 2] <= 0, "must have a range > 0 m", "Remove the line.")
        turn = "must have a bearing within a turn, in rad"
        _refuse(file, table, np.abs(table[:, 3]) > TURN, turn, DEGREES)
        here = np.isin(subject, numbers)
        of_mark = subject > SUBJECTS
        observer = np.full(len(subject), column)
        marks.append(np.column_stack([table[:, 0], observer, subject, table[:, 2:]])[of_mark])
        unknown += int((subject == 0).sum())
        absent += int(((subject > 0) & (subject <= SUBJECTS) & ~here).sum())
        seen = np.searchsorted(numbers, subject[here])
        parts.append(np.column_stack([table[here, 0], np.full(len(seen), column), seen, table[here, 2:]]))
    rows, seen_marks = (table[np.argsort(table[:, 0], kind="stable")] for table in map(np.vstack, (parts, marks)))
    return Seen(rows, seen_marks, absent, unknown)


def _barcodes(file: Path) -> dict[float, int]:
    table = _read(file, 2)
    for column, what in ((1, "barcode"), (0, "subject")):
        values = table[:, column]
        twice = np.ones(len(values), dtype=bool)
        twice[np.unique(values, return_index=True)[1]] = False
        _refuse(file, table, twice, f"must give each {what} once", "Remove the line that repeats it.")
        _refuse(file, table, values != np.rint(values), f"must have a whole number as {what}", "Unpack the set again.")
    return {code: int(subject) for subject, code in table.tolist()}


def _read(file: Path, columns: int) -> Floats:
    import pandas as pd

    allowed, hint = f"must hold {columns} numbers a line", "Unpack the set again."
    if not file.is_file():
        raise _missing(file.parent, file.name)
    try:
        table = pd.read_csv(file, sep=r"\s+", comment="#", header=None, dtype=float).to_numpy()
    except (ValueError, OverflowError):  # those of pandas for text, empty files and bytes among them
        table = np.empty((0, 0))
    if table.shape[1:] != (columns,) or not (np.abs(table) <= LARGEST).all():
        for number, words in _lines(file):
            if len(words) != columns or not all(map(_finite, words)):
                raise InputError(f"{file.name}: line {number}", " ".join(words)[:80], allowed, hint)
        raise InputError(file.name, "no line of numbers", allowed, hint)
    return np.array(table)


def _in_order(file: Path, t: Floats, strictly: bool = False) -> None:
    """InputError at a time that is in no seconds, and at the first that comes before the one above it, or with it."""
    check_time(t, file.name)
    gap = np.diff(t)
    bad = np.flatnonzero(gap <= 0 if strictly else gap < 0)
    if len(bad):
        row = int(bad[0])
        lines = [number for number, _ in _lines(file)]
        raise InputError(
            f"{file.name}: lines {lines[row]} and {lines[row + 1]}, column time",
            f"{t[row]:.6f} s, then {t[row + 1]:.6f} s",
            "must increase from line to line" if strictly else "must not decrease from line to line",
            "Mend or remove the stamp that is out of order.",
        )


def _refuse(file: Path, table: Floats, wrong: npt.ArrayLike, allowed: str, hint: str) -> None:
    rows: Ints = np.flatnonzero(wrong)
    if len(rows):
        lines = [number for number, _ in _lines(file)]
        found = " ".join(f"{value:.15g}" for value in table[rows[0]])
        raise InputError(f"{file.name}: line {lines[rows[0]]}", found, allowed, hint)


def _lines(file: Path) -> Iterator[tuple[int, list[str]]]:
    """(line number, words) of lines that are neither blank nor comments."""
    for number, line in enumerate(file.read_text("utf-8", errors="replace").split("\n"), 1):
        words = line.partition("#")[0].split()
        if words:
            yield number, words


def _finite(word: str) -> bool:
    try:
        return word.isascii() and "_" not in word and abs(float(word)) <= LARGEST
    except ValueError:
        return False


def _missing(folder: Path, name: str) -> InputError:
    hint = "Point at a folder MRCLAM_DatasetN with its .dat files."
    return InputError("folder", folder, f"has no {name}", hint)

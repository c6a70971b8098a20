"""NMEA 0183 sentences of a receiver as rows of a log: fixes, speed, course and standard deviations (GST)."""

from __future__ import annotations

import datetime
import re
from pathlib import Path
from typing import Any

import numpy as np

from coopoc.errors import InputError, MissingLibraryError

from .log_rows import Rows, rows_of
from .log_summary import Tally

KNOT = 1852 / 3600
DAY = 86400.0
LATITUDE, LONGITUDE = re.compile(r"\d\d[0-5]\d(\.\d*)?"), re.compile(r"\d{3}[0-5]\d(\.\d*)?")
"""Degrees and minutes: the parser takes the last digits before the point for minutes, however many there are."""
SLOW = 0.5
"""m/s, below which a course over ground is noise."""


def read_nmea(path: Path, tally: Tally) -> Rows:
    """Rows latitude, longitude, height (ellipsoidal: altitude and geoid separation), speed and compass_deg of a file,
    which is named after its vehicle.

    GGA gives fixes, RMC dates, speed and course, VTG speed and course, GST standard deviations. Without a date, time is
    seconds of the day and goes on after midnight.

    Args:
        path: .nmea file.
        tally: counts sentences that are damaged, fixes that the receiver calls invalid, and other sentences.

    Raises:
        InputError: no sentence with a fix.
        MissingLibraryError: pynmeagps is not installed.
    """
    try:
        from pynmeagps import NMEAReader, exceptions
    except ImportError:
        raise MissingLibraryError("pynmeagps", "reading NMEA", "'coopoc[nmea]'") from None
    errors = (
        exceptions.NMEAParseError,
        exceptions.NMEAMessageError,
        exceptions.NMEATypeError,
        exceptions.NMEAStreamError,
    )
    clock, found = _Clock(), _Found()
    for number, line in enumerate(path.read_bytes().split(b"\n"), 1):
        start = line.find(b"$")
        if start < 0:
            if line.strip():
                tally.refuse("lines of NMEA files that are no sentence", 1, f"{path.name}: line {number}")
            continue
        try:
            sentence: Any = NMEAReader.parse(line[start:].strip() + b"\r\n")
            if sentence is None:
                raise ValueError("incomplete")
            kind = sentence.msgID
            if kind in ("GGA", "RMC", "VTG", "GST"):
                getattr(found, kind.lower())(sentence, clock, number, path.name, tally)
            else:
                tally.unused(f"NMEA sentences {kind}", 1)
        except (*errors, ValueError, AttributeError, TypeError, KeyError, IndexError) as error:
            text = f"damaged NMEA sentences ({next(iter(str(error).splitlines()), '')[:60].partition(' - ')[0]})"
            tally.refuse("damaged NMEA sentences", 1, f"{path.name}: line {number}, {text}")
    if not found.t:
        hint = "Check that it holds GGA sentences with a fix."
        raise InputError(path.name, "0 fixes", "must hold NMEA sentences $..GGA", hint)
    return found.rows(path, clock.first_day)


class _Clock:
    """Seconds since 1970 if a date was seen, else seconds of the first day; times of day go on after midnight."""

    def __init__(self) -> None:
        self.day, self.last, self.first_day = 0.0, -np.inf, 0.0

    def at(self, time: Any, date: Any = None) -> float:
        seconds = time.hour * 3600 + time.minute * 60 + time.second + time.microsecond / 1e6
        if isinstance(date, datetime.date):
            self.day = (date - datetime.date(1970, 1, 1)).days * DAY
            self.first_day = self.first_day or self.day
        elif self.day + seconds < self.last - DAY / 2:
            self.day += DAY
        self.last = self.day + seconds
        return float(self.last)


class _Found:
    """Rows as they are found."""

    def __init__(self) -> None:
        self.t: list[float] = []
        self.kind: list[str] = []
        self.value: list[float] = []
        self.std: list[float] = []
        self.row: list[int] = []
        self.deviation: dict[float, tuple[float, float, float]] = {}
        self.moved: set[float] = set()

    def add(self, t: float, kind: str, value: Any, row: int) -> None:
        self.t.append(t)
        self.kind.append(kind)
        self.value.append(float(value))
        self.row.append(row)

    def gga(self, s: Any, clock: _Clock, row: int, file: str, tally: Tally) -> None:
        t = clock.at(s.time)
        if (s.lat or s.lon) and not (LATITUDE.fullmatch(s.payload[1]) and LONGITUDE.fullmatch(s.payload[3])):
            raise ValueError("latitude and longitude must be ddmm.mmm and dddmm.mmm")
        if not s.quality or s.lat == "" or s.lon == "":
            tally.refuse("fixes of quality 0", 1, f"{file}: line {row}")
            return
        height = float(s.alt or 0.0) + float(s.sep or 0.0)
        for kind, value in (("latitude", s.lat), ("longitude", s.lon), ("height", height)):
            self.add(t, kind, value, row)

    def rmc(self, s: Any, clock: _Clock, row: int, file: str, tally: Tally) -> None:
        t = clock.at(s.time, s.date)
        if s.status != "A":
            tally.refuse("velocities that the receiver calls invalid", 1, f"{file}: line {row}")
            return
        self.motion(t, float(s.spd or 0.0) * KNOT, s.cog, row)

    def vtg(self, s: Any, clock: _Clock, row: int, file: str, tally: Tally) -> None:
        if np.isfinite(clock.last) and s.sogk != "":
            self.motion(clock.last, float(s.sogk) / 3.6, s.cogt, row)

    def gst(self, s: Any, clock: _Clock, row: int, file: str, tally: Tally) -> None:
        self.deviation[clock.at(s.time)] = tuple(float(v) for v in (s.stdLat, s.stdLong, s.stdAlt))  # type: ignore[assignment]

    def motion(self, t: float, speed: float, course: Any, row: int) -> None:
        """RMC and VTG of one epoch say the same."""
        if t in self.moved:
            return
        self.moved.add(t)
        self.add(t, "speed", speed, row)
        if course not in ("", None) and speed > SLOW:
            self.add(t, "compass_deg", course, row)

    def rows(self, path: Path, first_day: float) -> Rows:
        place = {"latitude": 0, "longitude": 1, "height": 2}
        std = [
            self.deviation.get(t, (np.nan,) * 3)[place[kind]] if kind in place else np.nan
            for t, kind in zip(self.t, self.kind, strict=True)
        ]
        positive = np.where(np.array(std) > 0, std, np.nan)
        t = np.array(self.t)
        day = np.where(t < first_day, t + first_day, t)  # sentences before the first date are of its day
        names = [path.stem] * len(day)
        return rows_of(path.name, day, names, self.kind, np.array(self.value), np.array(self.row), std=positive)

"""NMEA 0183 sentences of a receiver as rows of a log: fixes, speed, course and standard deviations (GST)."""

import datetime
import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from coopoc import InputError, MissingLibraryError

from .log.units import Rows, Summary, of_kinds

KNOT, DAY_S = 1852 / 3600, 86400.0
"""m/s, and s."""
DEGREES = re.compile(r"\d\d[0-5]\d(\.\d*)?,\d{3}[0-5]\d(\.\d*)?")
"""Degrees and minutes, which the parser takes from the last digits before the point, however many there are."""
FIX = "latitude", "longitude", "height"
MIN_COG_SPEED_M_S = 0.5
"""m/s, below which a course over ground is noise."""


def is_nmea(path: Path) -> bool:
    """Whether a text begins with sentences of a receiver, whatever stands before them in the first lines."""
    with path.open("rb") as file:
        return bool(re.search(rb"\$..(GGA|RMC|GST),", file.read(2000)))


def read_nmea(path: Path, summary: Summary, **_: Any) -> Rows:
    """Rows latitude, longitude, height (ellipsoidal: altitude and geoid separation), speed and compass_deg of a file,
    which is named after its vehicle.

    GGA gives fixes, RMC dates, speed and course, GST standard deviations. Without a date, time is
    seconds of the day and goes on after midnight.

    Args:
        path: .nmea file.
        summary: counts sentences that are damaged, fixes that the receiver calls invalid, and other sentences.

    Raises:
        InputError: no sentence with a fix.
        MissingLibraryError: pynmeagps is not installed.
    """
    try:
        from pynmeagps import NMEAReader
    except ImportError:
        raise MissingLibraryError("pynmeagps", "reading NMEA", "'coopoc[nmea]'") from None
    sentences = _Sentences()
    for number, line in enumerate(path.read_bytes().split(b"\n"), 1):
        start, where = line.find(b"$"), f"{path.name}: line {number}"
        if start < 0:
            summary.refuse("lines of NMEA files that are no sentence", int(bool(line.strip())), where)
            continue
        try:
            sentence = NMEAReader.parse(line[start:].strip() + b"\r\n")
            if sentence is None:
                raise ValueError("incomplete")
            reason = sentences.add(sentence, number)
        except Exception as error:  # of pynmeagps: a damaged sentence meets them all
            where += f", {next(iter(str(error).splitlines()), '')[:60].partition(' - ')[0]}"
            reason = "damaged NMEA sentences"
        if reason.startswith("NMEA"):
            summary.unused[reason] += 1
        elif reason:
            summary.refuse(reason, 1, where)
    frame = pd.DataFrame.from_dict(sentences.rows, orient="index")
    if FIX[0] not in frame:
        raise InputError(path.name, "0 fixes", "must hold NMEA sentences $..GGA in ASCII", "Save it so, with fixes.")
    stds = frame.filter(regex="_std$").columns.tolist()
    frame[stds] = frame.groupby("t")[stds].transform("last")
    early = frame["t"] < sentences.first_day  # sentences before the first date
    frame["height"] += frame["separation"].ffill().bfill().fillna(0.0)
    return of_kinds(frame.assign(t=frame["t"] + sentences.first_day * early, vehicle=path.stem), path.name)


class _Sentences:
    """What sentences say; seconds since 1970 from the first date on, else seconds of the first day."""

    def __init__(self) -> None:
        self.rows: dict[int, dict[str, float]] = {}
        self.day, self.last, self.first_day = 0.0, -np.inf, 0.0

    def add(self, s: Any, number: int) -> str:
        """Take a sentence of a line; why it was left out, or nothing."""
        if s.msgID not in ("GGA", "RMC", "GST"):
            return f"NMEA sentences {s.msgID}"
        self._clock(s.time, getattr(s, "date", None))
        if s.msgID == "GGA":
            if (s.lat or s.lon) and not DEGREES.fullmatch(f"{s.payload[1]},{s.payload[3]}"):
                raise ValueError("latitude and longitude must be ddmm.mmm and dddmm.mmm")
            if not s.quality or s.lat == "" or s.lon == "":
                return "fixes of quality 0"
            numbers = [np.nan if number == "" else float(number) for number in (s.lat, s.lon, s.alt, s.sep)]
            row = dict(zip((*FIX, "separation"), numbers, strict=True))
        elif s.msgID == "GST":
            stds = zip(FIX, map(float, (s.stdLat, s.stdLong, s.stdAlt)), strict=True)
            row = {f"{kind}_std": std if std > 0 else np.nan for kind, std in stds}
        elif s.status != "A":
            return "velocities that the receiver calls invalid"
        else:
            row = {"speed": float(s.spd or 0.0) * KNOT}
            if s.cog not in ("", None) and row["speed"] > MIN_COG_SPEED_M_S:
                row["compass_deg"] = float(s.cog)
        self.rows[number] = {"t": self.last, **row}
        return ""

    def _clock(self, time: Any, date: Any) -> None:
        seconds = time.hour * 3600 + time.minute * 60 + time.second + time.microsecond / 1e6
        self.day += DAY_S * (self.day + seconds < self.last - DAY_S / 2)
        if isinstance(date, datetime.date):
            passed, self.day = self.day, (date - datetime.date(1970, 1, 1)).days * DAY_S
            self.first_day = self.first_day or self.day - passed
        self.last = self.day + seconds

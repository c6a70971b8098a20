"""libRSF's text (TU Chemnitz) as rows of a log: ranges to anchors that stand, odometry, and true points."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from coopoc.errors import InputError
from coopoc.formats.values import read_words, to_numbers

from .log.units import Rows, Summary, rows_of

FORMS = {
    "range2": "t range cov x y anchor",
    "range3": "t range cov x y z anchor",
    "odom2diff": "t first second sideways half_track cov_first cov_second cov_sideways",
    "odom3": "t vx vy vz wx wy wz cov_vx cov_vy cov_vz cov_wx cov_wy cov_wz",
    "point2": "t x y",
    "point3": "t x y z",
}
"""Tag -> the numbers behind it, in m, s and rad; more may follow."""
POSITIVE = ("cov", "half_track", "cov_first", "cov_second", "cov_vx", "cov_wz")


def is_librsf(path: Path) -> bool:
    """Whether a text file begins with one of these tags."""
    with path.open("rb") as file:
        return file.readline(100).partition(b" ")[0].decode("ascii", "replace") in FORMS


def read_librsf(path: Path, summary: Summary, **_: Any) -> Rows:
    """Rows range, speed and yaw_rate of a file, the place of each anchor, and the truth's x, y, z.

    A vehicle is named after its file, without _Input or _GT. Of odom2diff the speed is the mean of the wheels' and the
    yaw rate (second - first) / (2 half_track), as libRSF's PredictOdometry2Diff has it and a drive shows; the data
    set's readme names the wheels the other way. Of odom3 they are vx and wz.

    Args:
        path: .txt file.
        summary: counts the lines with other tags.

    Raises:
        InputError: a line that does not have its form, a variance or a width that is not positive, an anchor that
            moves.
    """
    every: dict[str, list[tuple[int, list[str]]]] = {}
    for number, (tag, *words) in read_words(path):
        every.setdefault(tag, []).append((number, words))
    vehicle, tables = re.sub("_(input|gt)$", "", path.stem, flags=re.IGNORECASE), list[pd.DataFrame]()
    for tag, lines in every.items():
        if tag not in FORMS:
            summary.leave(f"{path.name}: lines {tag}", len(lines))
            continue
        names, numbers = FORMS[tag].split(), [number for number, _ in lines]
        cut = [words[: len(names)] for _, words in lines]
        frame = pd.DataFrame(to_numbers(path.name, numbers, cut, f"{tag} {FORMS[tag]}", len(names)), numbers, names)
        for name in frame.columns.intersection([*POSITIVE]):
            if (wrong := frame[name] <= 0).any():
                line = int(wrong.to_numpy().argmax())
                allowed = f"must be {tag} {FORMS[tag]}, {name} > 0"
                raise InputError(f"{path.name}: line {numbers[line]}", " ".join(cut[line])[:80], allowed, "Mend it.")
        tables += _rows(frame.assign(vehicle=vehicle), path.name)
    rows = pd.concat(tables) if tables else pd.DataFrame()
    return rows_of(rows, path.name)


def _rows(f: pd.DataFrame, file: str) -> list[pd.DataFrame]:
    """Tables of rows of the lines with one tag."""
    axes = [axis for axis in "xyz" if axis in f]
    if "anchor" in f:
        f = f.assign(partner=f["anchor"].map("{:g}".format))
        places = f.drop_duplicates(["partner", *axes])
        if (again := places.duplicated("partner")).any():
            given = f"anchor {places['partner'][again].iloc[0]} elsewhere"
            raise InputError(f"{file}: line {places.index[again][0]}", given, "must stand", "Leave out what moves.")
        stands = places.assign(vehicle=places["partner"], partner="", t=np.nan)
        return [_of(f, "range", f["range"], f["cov"]), *(_of(stands, axis, stands[axis]) for axis in axes)]
    if "half_track" in f:
        track, both = 2 * f["half_track"], f["cov_first"] + f["cov_second"]
        rates = (f["first"] + f["second"]) / 2, (f["second"] - f["first"]) / track
        return [_of(f, "speed", rates[0], both / 4), _of(f, "yaw_rate", rates[1], both / track**2)]
    if "wz" in f:
        return [_of(f, "speed", f["vx"], f["cov_vx"]), _of(f, "yaw_rate", f["wz"], f["cov_wz"])]
    return [_of(f.assign(true=1.0), axis, f[axis]) for axis in axes]


def _of(frame: pd.DataFrame, kind: str, value: Any, variance: Any = np.nan) -> pd.DataFrame:
    known = frame[frame.columns.intersection(["t", "vehicle", "partner", "true"])]
    return known.assign(kind=kind, value=value, std=np.sqrt(variance))

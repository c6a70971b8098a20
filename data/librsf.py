"""libRSF's text (TU Chemnitz) as rows of a log: ranges to anchors that stand, odometry, and true points."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from coopoc import InputError
from coopoc.formats.values import read_words, to_numbers

from .log.units import Rows, Summary, of_kinds

FORMS = {
    "range2": "t range range_cov x y partner",
    "range3": "t range range_cov x y z partner",
    "odom2diff": "t first second sideways half_track first_cov second_cov sideways_cov",
    "odom3": "t speed sideways lift wx wy yaw_rate speed_cov sideways_cov lift_cov wx_cov wy_cov yaw_rate_cov",
    "point2": "t x y",
    "point3": "t x y z",
}
"""Tag -> the numbers behind it, in m, s and rad; more may follow."""


def is_librsf(path: Path) -> bool:
    """Whether a text file begins with one of these tags."""
    with path.open("rb") as file:
        return file.readline(100).partition(b" ")[0].decode("ascii", "replace") in FORMS


def read_librsf(path: Path, summary: Summary, **_: Any) -> Rows:
    """Rows range, speed and yaw_rate of a file, the place of each anchor, and the truth's x, y, z.

    A vehicle is named after its file, without _Input or _GT. Of odom2diff the speed is the mean of the wheels' and the
    yaw rate (second - first) / (2 half_track), as libRSF's PredictOdometry2Diff has it and a drive shows; the data
    set's readme names the wheels the other way.

    Args:
        path: .txt file.
        summary: counts the lines with other tags.

    Raises:
        InputError: a line that does not have its form, no line with a tag.
    """
    every, vehicle = dict[str, dict[int, list[str]]](), re.sub("(?i)_(input|gt)$", "", path.stem)
    for number, (tag, *words) in read_words(path):
        every.setdefault(tag, {})[number] = words
    parts = []
    for tag, lines in every.items():
        if tag not in FORMS:
            summary.unused[f"{path.name}: lines {tag}"] += len(lines)
            continue
        names = FORMS[tag].split()
        table = to_numbers(
            path.name, [*lines], [words[: len(names)] for words in lines.values()], f"{tag} {FORMS[tag]}", len(names)
        )
        f = pd.DataFrame(table, [*lines], names).assign(vehicle=vehicle, true=float(tag.startswith("point")))
        if tag == "odom2diff":
            both, track = f["first_cov"] + f["second_cov"], 2 * f["half_track"]
            speed, yaw_rate = (f["first"] + f["second"]) / 2, (f["second"] - f["first"]) / track
            f = f.assign(speed=speed, yaw_rate=yaw_rate, speed_cov=both / 4, yaw_rate_cov=both / track**2)
        f = f.assign(**{f"{name[:-3]}std": f[name].clip(0) ** 0.5 for name in map(str, f) if name.endswith("_cov")})
        if "partner" in f:
            f["partner"] = f["partner"].map("{:g}".format)
            anchors = f.drop(columns="range").assign(vehicle=f["partner"], partner="", t=np.nan)
            parts.append(anchors.drop_duplicates(["vehicle", "x", "y"]))
            f = f.drop(columns=[*"xyz"], errors="ignore")
        parts.append(f)
    if not parts:
        raise InputError(
            path.name,
            "none of them",
            f"must hold lines that begin with {', '.join(FORMS)}",
            "Check that this is the file you meant.",
        )
    return of_kinds(pd.concat(parts), path.name)

"""Segments of comma2k19 (NumPy arrays without an ending) as rows of a log: fixes, speed, course, true positions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pymap3d

from coopoc.arrays import Floats
from coopoc.errors import InputError

from .log.units import Rows, Summary, rows_of
from .nmea import SLOW

FIXES, SPEED, TRUTH = "processed_log/GNSS/live_gnss_ublox/", "processed_log/CAN/speed/", "global_pose/frame_"
"""Arrays of a segment; others are not read."""
PLACE = ("latitude", "longitude", "height")


def is_segment(path: Path) -> bool:
    """Whether a folder is a segment."""
    return (path / FIXES / "value").is_file()


def read_segment(path: Path, summary: Summary) -> Rows:
    """Rows latitude, longitude, height and compass_deg of the u-blox receiver, speed of the CAN bus, and the truth: the
    fused positions of the camera. The compass is the receiver's course, of a car that moves.

    Args:
        path: of the folder.
        summary: takes what is assumed.

    Raises:
        InputError: an array that is missing, damaged, of another shape or without finite numbers.
    """
    at, latitude, longitude, speed, _, height, course = _arrays(path, f"{FIXES}t", f"{FIXES}value", 6)
    when, driven = _arrays(path, f"{SPEED}t", f"{SPEED}value", 1)
    true_t, *ecef = _arrays(path, f"{TRUTH}times", f"{TRUTH}positions", 3)
    summary.assume("the heading is the course that the receiver states while it moves")
    columns = [(at, *row, 0.0) for row in zip(PLACE, (latitude, longitude, height), strict=True)]
    columns += [(true_t, *row, 1.0) for row in zip(PLACE, pymap3d.ecef2geodetic(*ecef), strict=True)]
    columns += [(when, "speed", driven, 0.0), (at[speed > SLOW], "compass_deg", course[speed > SLOW], 0.0)]
    rows = [pd.DataFrame({"t": t, "kind": kind, "value": value, "true": true}) for t, kind, value, true in columns]
    return rows_of(pd.concat(rows, ignore_index=True).assign(vehicle=path.name), path.name)


def _arrays(path: Path, times: str, values: str, columns: int) -> list[Floats]:
    """Times (M,) and the columns (M,) of an array."""
    read = list[Floats]()
    for name in (times, values):
        try:
            with (path / name).open("rb") as file:
                if file.read(6) != b"\x93NUMPY":
                    raise ValueError("no NumPy array")
            array = np.array(np.load(path / name, mmap_mode="r"), dtype=float)  # a header may claim more than there is
        except (OSError, ValueError, TypeError, OverflowError, SyntaxError) as error:
            given = next(iter(str(error).splitlines()), type(error).__name__)[:200]
            raise InputError(f"{path.name}/{name}", given, "must be an array of numpy.save", "Copy it again.") from None
        wanted = (len(array) if array.ndim and not read else len(read[0]) if read else 1,)
        wanted += (columns,) * len(read)
        if array.shape != wanted or not array.size or not np.isfinite(array).all():
            allowed = f"must be {wanted}, all finite numbers"
            raise InputError(f"{path.name}/{name}", f"an array {array.shape}", allowed, "Copy it again.")
        read += [*array.T] if read else [array]
    return read

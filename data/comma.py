"""Segments of comma2k19 (NumPy arrays without an ending) as rows of a log: fixes, speed, heading, true positions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pymap3d

from coopoc.arrays import Floats
from coopoc.errors import InputError

from .log.units import Rows, Summary, rows_of
from .nmea import SLOW

FIXES, SPEED, TRUTH = "processed_log/GNSS/live_gnss_ublox", "processed_log/CAN/speed", "global_pose"
"""Folders of a segment; others of it are not read."""


def is_segment(path: Path) -> bool:
    """Whether a folder is a segment."""
    return (path / FIXES / "value").is_file()


def read_segment(path: Path, summary: Summary, **_: Any) -> Rows:
    """Rows latitude, longitude, height and compass_deg of the u-blox receiver, speed of the CAN bus, and the truth: the
    fused positions of the camera. The compass is the receiver's course, of a car that moves.

    Args:
        path: of the folder.
        summary: takes what is assumed.

    Raises:
        InputError: an array that is missing, damaged, or of another shape.
    """
    (at, fixes), (moving, speed) = (
        (_array(path, f"{part}/t"), _array(path, f"{part}/value", columns))
        for part, columns in ((FIXES, 6), (SPEED, 1))
    )
    when, ecef = _array(path, f"{TRUTH}/frame_times"), _array(path, f"{TRUTH}/frame_positions", 3)
    for part, t, values in ((FIXES, at, fixes), (SPEED, moving, speed), (TRUTH, when, ecef)):
        if len(t) != len(values):
            raise InputError(f"{path.name}/{part}", f"{len(values)} rows", f"must be {len(t)}", "Copy it again.")
    true = np.column_stack(pymap3d.ecef2geodetic(*ecef.T))
    drives = fixes[:, 2] > SLOW
    summary.assume("the heading is the course that the receiver states while it moves")
    names = ("latitude", "longitude", "height")
    parts = [
        *((at, name, fixes[:, k], 0.0) for name, k in zip(names, (0, 1, 4), strict=True)),
        (at[drives], "compass_deg", fixes[drives, 5], 0.0),
        (moving, "speed", speed[:, 0], 0.0),
        *((when, name, true[:, k], 1.0) for k, name in enumerate(names)),
    ]
    rows = [pd.DataFrame({"t": t, "kind": kind, "value": value, "true": of}) for t, kind, value, of in parts]
    return rows_of(pd.concat(rows, ignore_index=True).assign(vehicle=path.name), path.name)


def _array(path: Path, name: str, columns: int = 0) -> Floats:
    """(M,) finite numbers of an array, or (M, columns)."""
    field, shape = f"{path.name}/{name}", f"(M, {columns})" if columns else "(M,)"
    try:
        with (path / name).open("rb") as file:
            if file.read(6) != b"\x93NUMPY":
                raise ValueError("no NumPy array")
        array = np.load(path / name, mmap_mode="r")  # a header that claims more than there is, is refused
        values = np.array(array, dtype=float)
    except (OSError, ValueError, TypeError, OverflowError, SyntaxError) as error:
        given = next(iter(str(error).splitlines()), type(error).__name__)[:200]
        raise InputError(field, given, f"must be an array {shape} of numpy.save", "Copy it again.") from None
    if values.shape[1:] != (columns,) * (columns > 0) or not len(values) or not np.isfinite(values).all():
        given = f"{values.shape}" + " with others" * bool(values.size and not np.isfinite(values).all())
        raise InputError(field, given, f"must be {shape}, M > 0, all finite numbers", "Copy it again.")
    return values

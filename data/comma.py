"""Segments of comma2k19 (NumPy arrays without an ending) as rows of a log: fixes, speed, course, true positions."""

from pathlib import Path

import numpy as np
import pandas as pd
import pymap3d

from coopoc.arrays import Floats
from coopoc.errors import InputError, said

from .log.units import Rows, Summary, of_kinds
from .nmea import MIN_COG_SPEED_M_S

PARTS = {
    ("processed_log/GNSS/live_gnss_ublox/value", "t"): "latitude longitude fast utc height compass_deg",
    ("processed_log/CAN/speed/value", "t"): "speed",
    ("global_pose/frame_positions", "frame_times"): "x y z",
}
"""Array and that of its times beside it -> names of its columns; others are not read."""


def is_segment(path: Path) -> bool:
    """Whether a folder is a segment."""
    return (path / next(iter(PARTS))[0]).is_file()


def read_segment(path: Path, summary: Summary) -> Rows:
    """Rows latitude, longitude, height and compass_deg of the u-blox receiver, speed of the CAN bus, and the truth: the
    fused positions of the camera. The compass is the receiver's course, of a car that moves.

    Args:
        path: of the folder.
        summary: takes what is assumed.

    Raises:
        InputError: an array that is missing, damaged, of another shape or without finite numbers.
    """
    tables = []
    for (name, times), columns in PARTS.items():
        table, t = (_array(path, part) for part in (name, str(Path(name).with_name(times))))
        if (shape := (len(t), len(columns.split()))) != table.shape or t.shape[1] > 1:
            raise InputError(
                f"{path.name}/{name}", f"{table.shape}", f"must be {shape}, as its times", "Copy it again."
            )
        tables.append(pd.DataFrame(table, columns=columns.split()).assign(t=t))
    fixes, _, true = tables
    fixes.loc[fixes["fast"] < MIN_COG_SPEED_M_S, "compass_deg"] = np.nan
    summary.assume("the heading is the course that the receiver states while it moves")
    latitude, longitude, height = pymap3d.ecef2geodetic(*true[[*"xyz"]].to_numpy().T)
    tables[2] = true[["t"]].assign(true=1.0, latitude=latitude, longitude=longitude, height=height)
    return of_kinds(pd.concat(tables, ignore_index=True).assign(vehicle=path.name), path.name)


def _array(path: Path, name: str) -> Floats:
    """(M, columns) finite numbers, M > 0."""
    try:
        array = np.array(np.load(path / name, mmap_mode="r"), float)  # a header may claim more than there is
        array = array.reshape(len(array), -1)
        if not np.isfinite(array).all():
            raise ValueError("numbers that are not finite")
    except Exception as error:  # of NumPy: a damaged file meets them all
        raise InputError(
            f"{path.name}/{name}", said(error), "must be an array of numpy.save", "Copy it again."
        ) from None
    return array

"""load_fleet: a fleet by name or file; read_log: the user's own measurements; fetch: public ones by name."""

from pathlib import Path
from typing import Any

from .plugins import find
from .world.fleet import Fleet


def load_fleet(name_or_path: str | Path, **options: Any) -> Fleet:
    """Fleet of a bundled dataset or of a file or folder: CSV, Parquet, TUM, SUMO FCD, MR.CLAM.

    Args:
        name_or_path: a name that `coopoc data list` shows, or a path.
        options: of the reader, such as dt in seconds.

    Raises:
        InputError: an unknown name (the message lists all), or a file with a fault.

    >>> load_fleet("town10")
    Fleet(town10: 60 vehicles x 900 steps, dt 0.1 s)
    """
    fleet: Fleet = find("coopoc.readers", "load")(name_or_path, **options)
    return fleet


def read_log(path: str | Path, **options: Any) -> Any:
    """`coopoc.data.log.read.Log` of one's own measurements, tables (CSV, Parquet), NMEA, ROS bags, PyFG: recording,
    truth (None without one), summary.

    docs/your_data.md describes the tables.

    Args:
        path: a file, or a folder whose files belong to one drive.
        options: of the reader, see `coopoc.data.log.read.read_log`, such as dt in seconds and columns.

    Raises:
        InputError: names file, row, column, value, what is allowed and how to correct it.
    """
    return find("coopoc.readers", "log")(path, **options)


def fetch(name: str) -> Path:
    """Local path of a public data set, downloaded once and verified by SHA-256; see `coopoc.data.fetch.fetch`.

    Args:
        name: a name that `coopoc data list` shows, such as "plaza1".

    Returns:
        The file or folder that `load_fleet`, `read_log` and `read_graph` take.

    Raises:
        InputError: an unknown name, no network, other bytes: with the address and where to put the file by hand.
    """
    path: Path = find("coopoc.readers", "fetch")(name)
    return path

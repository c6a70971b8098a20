"""load_fleet: a bundled fleet by name, or the user's own file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .plugins import find
from .world.fleet import Fleet


def load_fleet(name_or_path: str | Path, **options: Any) -> Fleet:
    """Fleet of a bundled dataset or of a file or folder: CSV, Parquet, TUM, SUMO FCD, CARLA table, MR.CLAM.

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

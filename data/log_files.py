"""Files of a log: which they are, and what their rows hold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from coopoc.errors import InputError

from .bag import is_bag
from .kinds import KINDS
from .log_rows import Rows
from .log_summary import Tally
from .log_tables import LONG, read_rows
from .nmea import read_nmea

TABLES, NMEA = (".csv", ".parquet", ".xlsx"), (".nmea", ".nme")
OF_FLEETS = {"id", "t", "x", "y", "z", "vx", "vy", "vz"}
"""Columns of a table of drives."""
OF_LOGS = {"kind", "partner", "arrival", *KINDS} - OF_FLEETS - {"speed", "heading", "height"}
"""Columns that no table of drives has."""
TRUTH = "truth"
"""Stem of the file of a folder that holds the truth."""


def log_files(path: Path, columns: Mapping[str, str] | None = None) -> bool:
    """Whether a path is a log: a bag, NMEA, a folder with such files or tables, or a table with a column of a log.

    Args:
        path: of a file or folder.
        columns: names in the file, as `read_log` takes them; a key that only a log has makes it one.

    >>> log_files(Path("drive.nmea")), log_files(Path("drive.parquet"), {"latitude": "lat"})
    (True, True)
    """
    if is_bag(path):
        return True
    if path.is_dir():
        return any(file.suffix.lower() in (*TABLES, *NMEA) for file in path.iterdir())
    if path.suffix.lower() in NMEA:
        return True
    if path.suffix.lower() not in TABLES:
        return False
    return bool(set(columns or ()) & ({*LONG, *KINDS} - OF_FLEETS)) or bool(OF_LOGS & set(_header(path)))


def _header(path: Path) -> list[str]:
    """Column names of a table, none where the file cannot be read (its reader will name the fault)."""
    if path.suffix.lower() == ".parquet":
        from pyarrow import ArrowException
        from pyarrow.parquet import read_schema

        try:
            return [str(name).lower() for name in read_schema(path).names]
        except (OSError, ArrowException):
            return []
    if path.suffix.lower() != ".csv" or not path.is_file():
        return []
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        return [word.strip().strip('"').lower() for word in file.readline(10_000).split(",")]


def files_of(path: Path, truth: Path | None) -> tuple[list[Path], Path | None]:
    """The files of a log that hold measurements, and the one of the truth: named, or `truth.*` of the folder."""
    if not path.exists():
        raise InputError("path", str(path), "must be a file or a folder", "Check the path.")
    if truth is not None and not truth.is_file():
        raise InputError("truth", str(truth), "must be a file", "Check the path.")
    if path.is_file():
        return [path], truth
    found = sorted(file for file in path.iterdir() if file.suffix.lower() in (*TABLES, *NMEA))
    own = [file for file in found if file.stem.lower() == TRUTH]
    files = [file for file in found if file not in own and file != truth]
    if not files:
        endings = ", ".join((*TABLES, *NMEA))
        raise InputError("path", str(path), f"must hold files in {endings}", "Point at the folder of the log.")
    return files, truth or (own[0] if own else None)


def rows_of_file(
    file: Path, tally: Tally, columns: Mapping[str, str] | None, kinds: Mapping[str, str] | None, ignore: Sequence[str]
) -> Rows:
    """The rows of one file, NMEA or a table, in the order of the file; what is refused is counted in the tally."""
    if file.suffix.lower() in NMEA:
        return read_nmea(file, tally)
    return read_rows(file, tally, columns, kinds, ignore)

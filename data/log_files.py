"""Files of a log: which they are, and what their rows hold."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

from coopoc.errors import InputError
from coopoc.plugins import suggestion

from .bag import is_bag
from .cells import read_xlsx, separator_of
from .kinds import KINDS
from .log_rows import Rows
from .log_summary import Tally
from .log_tables import LONG, named, read_rows
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
    return bool(set(columns or ()) & ({*LONG, *KINDS} - OF_FLEETS)) or bool(
        OF_LOGS & {header.lower() for header in headers(path)}
    )


def headers(path: Path) -> list[str]:
    """Column names of a table; none where the file cannot be read: its reader will name the fault."""
    try:
        if path.suffix.lower() == ".parquet":
            from pyarrow.parquet import read_schema

            return [str(name) for name in read_schema(path).names]
        if path.suffix.lower() == ".xlsx":
            return [str(name) for name in read_xlsx(path).columns]
        with path.open(encoding="utf-8-sig", newline="") as file:
            line = file.readline(10_000)
            return [word.strip() for word in next(csv.reader([line], delimiter=separator_of(line)), [])]
    except Exception:  # of Arrow, zlib, openpyxl, csv
        return []


def check_headers(columns: Mapping[str, str], tables: Sequence[Path], name: str) -> None:
    """InputError for a name of a column that none of the tables of a log has."""
    found = {header for table in tables if table.suffix.lower() in TABLES for header in headers(table)}
    for key, given in columns.items():
        for header in named(given):
            if header not in found:
                allowed = f"is in no table, which have {', '.join(sorted(found))}"
                hint = suggestion(header, found, "Name a column of a table.")
                raise InputError(f"{name}: columns[{key!r}]", repr(header), allowed, hint)


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

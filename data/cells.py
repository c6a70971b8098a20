"""Cells of CSV, Parquet and Excel tables: every row has the header's columns, every number is one, every id a name."""

from __future__ import annotations

import csv
import zipfile
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from coopoc.arrays import Floats
from coopoc.errors import InputError, MissingLibraryError
from coopoc.formats.values import LARGEST

if TYPE_CHECKING:
    import pandas as pd

TEXT = ("must be a table with a header and cells between commas, semicolons or tabs", "Export it again as CSV.")
COLUMNS, CELLS, UNPACKED = 5000, 20_000_000, 2**30
"""Most columns of a table, most cells of a spreadsheet, and most bytes of one when it is unpacked."""


def read_frame(path: Path, *text: str) -> pd.DataFrame:
    """Table of a .parquet, .xlsx or (any other ending) CSV file; `text` as in `read_csv`."""
    read = {".parquet": read_parquet, ".xlsx": read_xlsx}.get(path.suffix)
    return read(path) if read else read_csv(path, *text)


def read_csv(path: Path, *text: str) -> pd.DataFrame:
    """Table of a CSV file whose columns `text`, if it has them, are kept as they are written: "007" stays "007".

    Between semicolons or tabs, as spreadsheets write them in half of Europe, decimal commas are numbers, too.

    Raises:
        InputError: one column, no header, two columns of one name, or a row that is longer than the header.
    """
    import pandas as pd

    separator, header = _checked_rows(path)
    keep: Any = {name: str.strip for name in header if name.strip() in text}
    form: Any = {"sep": separator, "decimal": "." if separator == "," else ",", "encoding": "utf-8-sig"}
    if tuple(int(part) for part in pd.__version__.split(".")[:2]) < (3, 1):
        form |= {"float_precision": "round_trip"}  # the default became exact in 3.1
    try:
        frame: pd.DataFrame = pd.read_csv(path, skipinitialspace=True, converters=keep, index_col=False, **form)
    except (pd.errors.ParserError, pd.errors.EmptyDataError, UnicodeError, ValueError, OverflowError) as error:
        raise InputError(path.name, _line(error), *TEXT) from None
    return frame.rename(columns=lambda name: str(name).strip())


def read_parquet(path: Path) -> pd.DataFrame:
    """Table of a Parquet file.

    Raises:
        InputError: a file that is damaged or no Parquet.
    """
    import pandas as pd
    from pyarrow import ArrowException

    try:
        return pd.read_parquet(path)
    except (ArrowException, OSError, ValueError, KeyError, TypeError, OverflowError) as error:
        raise InputError(path.name, _line(error), "must be a Parquet table", "Write the file again.") from None


def read_xlsx(path: Path) -> pd.DataFrame:
    """Table of the first sheet of an Excel file.

    Raises:
        InputError: no spreadsheet, or one that grows beyond CELLS cells.
        MissingLibraryError: openpyxl is not installed.
    """
    import pandas as pd

    try:
        from openpyxl import load_workbook
    except ImportError:
        raise MissingLibraryError("openpyxl", "reading a spreadsheet", "'coopoc[excel]'") from None
    rows: list[tuple[Any, ...]] = []
    size = 0
    try:
        with zipfile.ZipFile(path) as packed:
            if sum(part.file_size for part in packed.infolist()) > UNPACKED:
                raise _too_large(path, f"more than {UNPACKED >> 20} MB unpacked")
        book = load_workbook(path, read_only=True, data_only=True)
        sheet = book.worksheets[0]
        sheet.reset_dimensions()  # what the file claims to be its size may be anything
        for row in sheet.iter_rows(values_only=True):
            size += len(row) + 1
            if size > CELLS:
                raise _too_large(path, f"more than {CELLS:,} cells")
            rows.append(row)
        book.close()
    except InputError:
        raise
    except Exception as error:  # of zlib, zipfile, expat, openpyxl: a damaged file meets them all
        raise InputError(path.name, _line(error), "must be an .xlsx spreadsheet", "Export it again.") from None
    rows = [row for row in rows if any(cell is not None for cell in row)]
    if not rows:
        raise InputError(path.name, "0 rows", "must have a header and rows", "Export it again.")
    width = max(map(len, rows))
    header = [
        f"column {k}" if h is None else str(h) for k, h in enumerate([*rows[0], *[None] * (width - len(rows[0]))])
    ]
    _check_header(path.name, header)
    return pd.DataFrame([[*row, *[None] * (width - len(row))] for row in rows[1:]], columns=header)


def numeric(frame: pd.DataFrame, column: str, file: str) -> Floats:
    """A column as finite numbers; InputError with the row of the first cell that is none."""
    import pandas as pd

    given = frame[column]
    if given.dtype.kind in "bmM":
        allowed = "must be a finite number"
        raise InputError(f"{file}: column {column}", f"of type {given.dtype}", allowed, "Convert the column.")
    try:
        values = pd.to_numeric(given, errors="coerce").to_numpy(dtype=float)
    except (TypeError, ValueError, OverflowError):  # a list in a cell, an integer of a thousand digits
        values = np.array([_number(cell) for cell in given])
    bad = np.flatnonzero(~(np.abs(values) <= LARGEST))
    if len(bad):
        raise InputError(
            f"{file}: row {bad[0] + 1}, column {column}",
            str(given.iloc[int(bad[0])])[:60],
            "must be a finite number",
            "Interpolate the value, or remove the row: a missing row means that the vehicle is absent.",
        )
    return values


def seconds(frame: pd.DataFrame, column: str, file: str) -> Floats:
    """A column of times: numbers are seconds, dates become seconds since 1970 (UTC), durations seconds.

    >>> import pandas as pd
    >>> seconds(pd.DataFrame({"t": pd.to_datetime([0, 100], unit="ms")}), "t", "drive.parquet").tolist()
    [0.0, 0.1]
    """
    import pandas as pd

    given = frame[column]
    kind = getattr(given.dtype, "kind", "O")
    words = kind == "O" or isinstance(given.dtype, pd.StringDtype)
    if words and len(given) and not pd.to_numeric(given, errors="coerce").notna().any():
        dates = pd.to_datetime(given, errors="coerce", format="ISO8601", utc=True)
        if dates.notna().all():
            given, kind = dates, "M"
    if kind not in "mM":
        try:
            return numeric(frame, column, file)
        except InputError as error:
            allowed = "must be seconds, or a date as 2024-05-01T12:00:00Z"
            raise InputError(error.field, error.value, allowed, "Mend the cell, or remove the row.") from None
    missing = np.flatnonzero(given.isna().to_numpy())
    if len(missing):
        where = f"{file}: row {missing[0] + 1}, column {column}"
        raise InputError(where, "empty", "must be a time", "Fill it in, or remove the row.")
    if kind == "m":
        return np.asarray(given.dt.total_seconds(), dtype=float)
    utc = pd.to_datetime(given, utc=True)
    return np.asarray(utc.dt.as_unit("us").astype("int64").to_numpy() / 1e6, dtype=float)  # in ns years end at 2262


def words(frame: pd.DataFrame, column: str, file: str) -> list[str]:
    """A column of names; InputError with the row of the first empty cell."""
    given = frame[column]
    bad = np.flatnonzero((given.isna() | (given.astype(str).str.strip() == "")).to_numpy())
    if len(bad):
        raise InputError(f"{file}: row {bad[0] + 1}, column {column}", "empty", "must be a name", "Fill it in.")
    return [str(v).strip() for v in given.tolist()]


def separator_of(header: str) -> str:
    """What separates the cells of a CSV file, by its first line: a comma, else a semicolon, else a tab.

    >>> separator_of("t;vehicle;x;y")
    ';'
    """
    return next((mark for mark in ",;\t" if mark in header), ",")


def _checked_rows(path: Path) -> tuple[str, list[str]]:
    """What separates the cells of a CSV file, and its header; no row has more cells."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            separator = separator_of(file.readline())
            file.seek(0)
            rows = csv.reader(file, skipinitialspace=True, delimiter=separator)
            header = next(rows, [])
            _check_header(path.name, header)
            count = 0
            for row in rows:
                count += bool(row)
                if len(row) > len(header):
                    raise InputError(
                        f"{path.name}: row {count}",
                        f"{len(row)} cells under {len(header)} names",
                        "must have one cell per name in the header",
                        "Name every column in the header; between commas, write decimal points and quote text.",
                    )
    except (csv.Error, UnicodeError) as error:
        raise InputError(path.name, _line(error), *TEXT) from None
    return separator, header


def _check_header(file: str, header: list[str]) -> None:
    if len(header) < 2:
        raise InputError(file, repr("".join(header))[:80], *TEXT)
    if len(header) > COLUMNS:
        raise InputError(file, f"{len(header)} columns", f"must be at most {COLUMNS}", "Write one row per instant.")
    twice = [name for name, count in Counter(name.strip() for name in header).items() if count > 1]
    if twice:
        allowed = "must name one column only"
        raise InputError(f"{file}: header", f"{twice[0][:40]!r} twice", allowed, "Rename or remove the other one.")


def _number(cell: object) -> float:
    try:
        return float(str(cell)) if str(cell).isascii() and "_" not in str(cell) else np.nan
    except ValueError:
        return np.nan


def _too_large(path: Path, size: str) -> InputError:
    hint = "Export the table as CSV, without empty rows and columns."
    return InputError(path.name, size, "must be a table of at most that size", hint)


def _line(error: BaseException) -> str:
    """First line of a message."""
    return next(iter(str(error).splitlines()), type(error).__name__)[:200]

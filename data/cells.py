"""Reading a table once: CSV or Parquet as a frame of named columns, whose numbers, times and names are checked.

Every table is read here; fleets (`fleet_files`) and logs (`log.tables`) are its uses. The
index of a frame is the row in the file, from 1, so that an error names it whatever part of the frame is at hand.
"""

import csv
import os
import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pandas as pd
from pandas import DataFrame

from coopoc.arrays import Bools, Floats, named, number, one_of
from coopoc.errors import InputError, said, suggestion, unknown
from coopoc.formats.values import MAX_NUMBER

TABLES = (".csv", ".parquet")
Names = Mapping[str, str]
"""Name here -> name in a file; of kinds the other way round."""
Factors = Mapping[str, float]
"""Name of a column, kind, vehicle or pair -> number."""
WHOLE = re.compile(r"^(\d+)\.0$")
"""What a spreadsheet or pandas makes of a whole number beside empty cells: 7.0 is the name 7."""
MAX_COLUMNS = 5000
"""Most columns of a table."""
USUAL_HEADERS = {
    "vehicle": "vehicle observer robot car agent sender vehicle_id robot_id id name mmsi",
    "partner": "partner neighbour neighbor to target subject other anchor receiver landmark",
    "t": "t time timestamp stamp seconds datetime utc tow sow",
    "latitude": "latitude lat",
    "longitude": "longitude lon lng long",
    "height": "height alt altitude",
    "compass_deg": "compass bearing course cog track",
    "speed": "speed sog",
    "yaw_rate": "yaw_rate yawrate gyro gyr",
    "heading": "heading yaw hdg",
    "x": "easting east",
    "y": "northing north",
    "vx": "ve veast",
    "vy": "vn vnorth",
}
"""Words in headers that others give to the columns, in wide tables."""
PLAIN = "must be a finite number as -1234.5, without a unit, separators of thousands or N, S, E, W"
SECONDS = "must be seconds, or a date as 2024-05-01T12:00:00Z, to which pandas.to_datetime converts others"
"""What a number, and a time, is in a cell."""
OTHER_MEANINGS = "rate vertical acc accel accuracy std sigma error variance cov"
"""Words beside which these mean something else."""


UNNAMED = "unnamed"
"""Column without a header, as of an index that pandas writes, where it does not count rows."""
LARGEST_TABLE = 2**27
"""Numbers in a Parquet table: 1 GB."""


def read_frame(path: Path, *text: str) -> DataFrame:
    """Table of a .parquet or (any other ending) CSV file.

    Args:
        path: of the file; CSV between commas, or between semicolons or tabs with decimal commas.
        text: columns of a CSV file that are kept as they are written: "007" stays "007".

    Raises:
        InputError: a damaged file, one column, no header, two columns of one name, or a row longer than the header.
    """
    try:
        frame = _read_parquet(path) if path.suffix.lower() == ".parquet" else _read_csv(path, text)
    except (InputError, ImportError):
        raise
    except Exception as error:  # of pandas and Arrow: a damaged file meets them all
        raise _no_table(path, said(error)) from None
    frame.columns = pd.Index([*map(_plain, frame.columns)])
    _check_header(path, list(frame.columns))
    if "" in frame and (frame[""].dtype.kind == "i" or frame[""].isna().all()):
        frame = frame.drop(columns="")  # numbers of rows, as pandas writes them, or what is behind a last comma
    frame = frame.rename(columns={"": UNNAMED})
    frame.index += 1
    return frame


def _plain(name: object) -> str:
    """A header as it is compared, "" of an index without a name."""
    return str(name).strip().removeprefix("__index_level_0__")


def _read_parquet(path: Path) -> DataFrame:
    """The table, words as objects.

    A column, a list or a word that is the same throughout takes no room in the file, and what the footer says of sizes
    may be false (some of it makes Arrow abort): they are counted in the headers of the pages, and each word is read
    once, however often it stands.
    """
    from pyarrow.parquet import read_table

    def within(count: int) -> None:
        if count > LARGEST_TABLE:
            allowed = f"must hold at most {8 * LARGEST_TABLE} bytes when it is unpacked"
            raise InputError(path.name, f"{rows} rows, {8 * count} bytes", allowed, "Split the drive.")

    with path.open("rb") as file:
        file.seek(-8, os.SEEK_END)
        file.seek(-8 - int.from_bytes(file.read(4), "little"), os.SEEK_END)
        footer, count = _thrift(file), 0
        rows, chunks = footer[3], [chunk[3] for group in footer[4] for chunk in group[1]]
        within(sum(chunk[5] for chunk in chunks))
        for chunk in chunks:
            at = min(chunk[9], chunk.get(11) or chunk[9])
            end = at + chunk[7]
            while at < end:
                file.seek(at)
                page = _thrift(file)
                count += max(page[2] // 8, *(page[kind][1] for kind in {5, 7, 8} & page.keys()), 0)
                at = file.tell() + page[3]
        within(count)
    table = read_table(path, read_dictionary=[b".".join(chunk[3]).decode() for chunk in chunks])
    frame: DataFrame = table.to_pandas(ignore_metadata=True)
    words = frame.select_dtypes("category")
    within(len(frame) * max((len(str(word)) for name in words for word in words[name].cat.categories), default=0) // 8)
    return frame.astype(dict.fromkeys(words, object))


def _thrift(file: BinaryIO, kind: int = 12) -> Any:
    """Magnitude, bytes, list or struct (fields by number) in Thrift's compact protocol, as Parquet writes them."""

    def integer() -> int:
        byte = file.read(1)[0]
        return byte if byte < 128 else byte - 128 + 128 * integer()

    if kind == 8:
        return file.read(integer())
    if kind == 9:
        head = file.read(1)[0]
        return [_thrift(file, head & 15) for _ in range(head >> 4 if head < 240 else integer())]
    if kind < 12:
        return integer() // 2
    fields, field = dict[int, Any](), 0
    while head := file.read(1)[0]:
        field = field + (head >> 4) if head >> 4 else integer() // 2
        fields[field] = head & 15 > 2 and _thrift(file, head & 15)  # a bool of a struct takes no byte
    return fields


def headers(path: Path) -> list[str]:
    """Column names of a table; none where the file cannot be read: `read_frame` names the fault."""
    try:
        if path.suffix.lower() == ".parquet":
            from pyarrow.parquet import read_schema

            names = read_schema(path).names
        else:
            names = _first_lines(path)[1]
        return [_plain(name) or UNNAMED for name in names]
    except Exception:  # of Arrow and csv
        return []


def numeric(frame: DataFrame, column: str, file: str, allowed: str = PLAIN) -> Floats:
    """A column as finite numbers; InputError with the row of the first cell that is none, and what is allowed."""
    cells = frame[column]
    if cells.dtype.kind in "bmM":
        raise InputError(f"{file}: column {column}", f"of type {cells.dtype}", allowed, "Convert the column.")
    try:
        values = pd.to_numeric(cells, errors="coerce").to_numpy(dtype=float)
    except (TypeError, ValueError, OverflowError):  # a list in a cell, an integer of a thousand digits
        values = pd.to_numeric(cells.map(lambda cell: str(cell)[:300]), errors="coerce").to_numpy(dtype=float)
    _refuse(cells, ~(abs(values) <= MAX_NUMBER), file, allowed)
    return values


def seconds(frame: DataFrame, column: str, file: str) -> Floats:
    """A column of times: numbers are seconds, dates become seconds since 1970 (UTC), durations seconds.

    >>> import pandas as pd
    >>> seconds(pd.DataFrame({"t": pd.to_datetime([0, 100], unit="ms")}), "t", "drive.parquet").tolist()
    [0.0, 0.1]
    """
    column_values = frame[column]
    kind = column_values.dtype.kind
    if kind == "O" and len(column_values) and not pd.to_numeric(column_values, errors="coerce").notna().any():
        dates = pd.to_datetime(column_values, errors="coerce", format="ISO8601", utc=True)
        if dates.notna().all():
            column_values, kind = dates, "M"
    if kind not in "mM":
        return numeric(frame, column, file, SECONDS)
    _refuse(column_values, column_values.isna().to_numpy(), file, "must be a time")
    if kind == "m":
        return np.asarray(column_values.dt.total_seconds(), float)
    utc = pd.to_datetime(column_values, utc=True)
    return np.asarray(utc.dt.as_unit("us").astype("int64").to_numpy() / 1e6, float)  # in ns years end at 2262


def factors(mapping: Factors | None, names: Collection[str], field: str = "scale") -> dict[str, float]:
    """Numbers by name; InputError for a name that is none of `names`, for 0, and for a deviation or a scale of times
    that is not positive."""
    for name, value in named(field, mapping or {}, f"Give {field}={{name: number}}.").items():
        one_of(field, name, names)
        least = 1e-12 if field == "std" or name == "t" else -MAX_NUMBER
        if not number(
            f"{field} of {name}",
            value,
            least,
            MAX_NUMBER,
            allowed=f"a finite number other than 0{', and > 0' * (least > 0)}",
        ):
            raise InputError(f"{field} of {name}", value, "must not be 0", "Leave it out.")
    return dict(mapping or {})


def words(frame: DataFrame, column: str, file: str) -> list[str]:
    """A column of names; InputError with the row of the first empty cell."""
    cells = frame[column]
    named_cells = filled(cells)
    _refuse(cells.astype(object).where(named_cells, "empty"), ~named_cells, file, "must be a name")
    texts = cells.astype(str)
    return texts.map({text: WHOLE.sub(r"\1", text.strip()) for text in texts.unique()}).tolist()


def filled(cells: "pd.Series[Any]") -> Bools:
    """(L,) True where a cell holds something."""
    return np.asarray(cells.notna() & (cells.astype(str).str.strip() != ""))


def named_columns(
    frame: DataFrame, columns: Names, allowed: Sequence[str], needed: Sequence[str], file: str
) -> DataFrame:
    """The frame with our names of its columns.

    Args:
        frame: of `read_frame`.
        columns: our name -> header in the file, where they differ.
        allowed: our names.
        needed: those that must be there.
        file: named in errors.

    Raises:
        InputError: a key of `columns` that is not allowed, a header that stands for two names, or a missing column.
    """
    for key in columns:
        if key not in allowed:
            raise unknown(f"{file}: key of columns", key, allowed, 'Give columns={"t": "name in the file"}.')
    renamed = frame.rename(columns={header: key for key, header in columns.items()})
    for key, header in columns.items():
        if (renamed.columns == key).sum() > 1:
            raise InputError(
                f"{file}: columns[{key!r}]",
                repr(header),
                f"would be a second column {key}: the file has one of that name",
                "Rename or remove one of them.",
            )
        if header in frame:
            renamed[key] = frame[header]  # which may stand for several
    for key in needed:
        header = columns.get(key, key)
        if header not in frame:
            raise missing_column(file, header, frame, f"columns {', '.join(needed)} are needed", key)
    return renamed


def usual_key(header: str) -> str:
    """Our name of the column that a header of others has, by the words in it; "" for none.

    >>> [usual_key(header) for header in ("UnixTimeMillis", "GPS_lat [deg]", "BearingDegrees", "yaw_acc", "UTM_North")]
    ['t', 'latitude', 'compass_deg', '', 'y']
    """
    parts = {header.lower(), *(word.lower() for word in re.findall(r"[a-z]+|[A-Z]+(?![a-z])|[A-Z][a-z]+", header))}
    usual = (key for key, words in USUAL_HEADERS.items() if not parts.isdisjoint(words.split()))
    return next(usual, "") if parts.isdisjoint(OTHER_MEANINGS.split()) else ""


def missing_column(file: str, column: str, frame: DataFrame, allowed: str, key: str = "", more: str = "") -> InputError:
    """The error of a table without a column; `key` is our name of it, and the hint a header that may be meant, and
    `more`."""
    key, names = key or column, list(frame.columns)
    usual = next((header for header in names if usual_key(header) == key), "")
    header = usual or "..."
    hint = f'Add it, or pass columns={{"{key}": "{header}"}}; with a command, FILE?columns={key}:{header}.'
    if usual:
        hint = f"Did you mean {usual}? {hint}"
    return InputError(
        f"{file}: column {column}",
        "missing",
        f"{allowed}; the file has {', '.join(names)}",
        suggestion(column, names, hint) + more,
    )


def _read_csv(path: Path, text: Sequence[str]) -> DataFrame:
    separator, header, first, above = _first_lines(path)
    _check_header(path, header)
    if len(first) > len(header):  # the only row that pandas does not compare with the header
        raise _too_wide(path, 1, len(first), len(header))
    form: dict[str, Any] = {"sep": separator, "decimal": "." if separator == "," else ",", "names": header, "header": 0}
    form |= {"skiprows": above, "index_col": False, "skipinitialspace": True, "encoding": "utf-8-sig"}
    if tuple(map(int, pd.__version__.split(".")[:2])) < (3, 1):
        form["float_precision"] = "round_trip"  # the default became exact in 3.1
    form["converters"] = {name: str.strip for name in header if name.strip() in text}
    try:
        table: DataFrame = pd.read_csv(path, **form)
        return table
    except pd.errors.ParserError as error:
        wide = re.search(r"fields in line (\d+), saw (\d+)", str(error))
        raise _too_wide(path, int(wide[1]) - 1 - above, int(wide[2]), len(header)) if wide else error from None


def _first_lines(path: Path) -> tuple[str, list[str], list[str], int]:
    """Separator of a CSV file, its header, its first row, and how many lines of comments, which begin with #, are above
    the header, which may, too."""
    with path.open(encoding="utf-8-sig", newline="") as file:
        lines = [file.readline(100_000)]
        while lines[-1].startswith("#"):
            lines.append(file.readline(100_000))
        separator = next((mark for mark in ",;\t" if mark in lines[-1]), ",")
        above = len(lines) - 1
        above -= above > 0 and 0 < lines[-2].count(separator) == lines[-1].count(separator)
        file.seek(0)
        for _ in range(above):
            file.readline()
        rows = csv.reader(file, skipinitialspace=True, delimiter=separator)
        return separator, next(rows, []), next(filter(None, rows), []), above


def _check_header(path: Path, header: Sequence[str]) -> None:
    if len(header) < 2:
        raise _no_table(path, repr("".join(header))[:80])
    if len(header) > MAX_COLUMNS:
        raise InputError(
            path.name, f"{len(header)} columns", f"must be at most {MAX_COLUMNS}", "Write one row per instant."
        )
    name, count = Counter(name.strip() for name in header).most_common(1)[0]
    if count > 1:
        raise InputError(
            f"{path.name}: header",
            f"{name[:40]!r} twice",
            "must name one column only",
            "Rename or remove the other one; write a header, if this is the first row.",
        )


def _refuse(cells: "pd.Series[Any]", wrong: Bools, file: str, allowed: str) -> None:
    """InputError that names the first wrong cell."""
    bad = np.flatnonzero(wrong)
    if len(bad):
        raise InputError(
            f"{file}: row {cells.index[bad[0]]}, column {cells.name}",
            str(cells.iloc[bad[0]])[:60].strip() or "empty",
            allowed,
            "Correct the cell, or remove the row: a missing row means that there was no measurement.",
        )


def _too_wide(path: Path, row: int, cells: int, names: int) -> InputError:
    return InputError(
        f"{path.name}: row {row}",
        f"{cells} cells under {names} names",
        "must have one cell per name in the header",
        "Name every column in the header; between commas, write decimal points and quote text.",
    )


def _no_table(path: Path, actual: str) -> InputError:
    return InputError(
        path.name,
        actual,
        "must be a table with a header and cells between commas, semicolons or tabs, or of Parquet",
        "Export it again as CSV in UTF-8, unpacked, that begins with the header, without empty rows and columns.",
    )

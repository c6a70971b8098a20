"""Tables of a log: one row per measurement (long), or one column per kind (wide)."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pandas import DataFrame

from coopoc.arrays import AnyArray, Bools
from coopoc.errors import InputError, suggestion

from ..cells import (
    Names,
    filled,
    headers,
    missing_column,
    named_columns,
    numeric,
    read_frame,
    seconds,
    usual_key,
    words,
)
from .units import KINDS, Rows, Summary, in_group, rows_of

LONG = ("t", "vehicle", "kind", "partner", "value", "std", "arrival")
UNIT_SUFFIXES = {"m", "cm", "mm", "rad", "deg", "rate", "raw"}
"""Behind the name of a kind, these are no partners."""
OF_FLEETS = {"id", "t", "x", "y", "z", "vx", "vy", "vz"}
"""Columns of a table of drives."""
COLUMNS = (*LONG, *KINDS, *(f"{kind}_std" for kind in KINDS))
OF_LOGS = {*COLUMNS} - OF_FLEETS - {"vehicle", "value", "std", "speed", "heading", "height"}
"""Columns that no table of drives has."""


def is_log_table(path: Path, columns: Names | None) -> bool:
    """Whether a table has a column that only a log has, by its header or by our names in `columns`; or one
    without an id that lacks heights or has speeds, as no table of drives does."""
    in_file, ours = {name.lower() for name in headers(path)}, set(columns or ())
    drive = "id" in in_file | ours or ("z" in in_file | ours and not {"speed", "heading"} & in_file)
    return bool(ours & ({*LONG, *KINDS} - OF_FLEETS) or OF_LOGS & in_file or (in_file and not drive))


def read_log_table(
    path: Path,
    summary: Summary,
    *,
    columns: Names,
    kinds: Names,
    ignore: Sequence[str],
    **_: Any,
) -> Rows:
    """Rows of a CSV or Parquet table, long if it has a column kind, else wide.

    Args:
        path: of the file. Without a column vehicle, the file is named after its vehicle.
        summary: counts what is not used.
        columns: names in the file, as {"t": "time", "latitude": "lat"}; one that the file lacks is left out.
        kinds: names in the column kind, as {"uwb": "range"}.
        ignore: kinds in the file that are left out.

    Raises:
        InputError: with the row and the column, a cell that is no number, no time or no name, an unknown kind, a kind
            without its partner, a value that belongs to another unit.
    """
    file = path.name
    frame = read_frame(path, *(columns.get(key, key) for key in ("vehicle", "partner", "kind", "arrival")))
    frame = _with_whole_stamps(frame, columns)
    beside = {f"{key}_std": f"{name}_std" for key, name in columns.items() if key in KINDS and f"{name}_std" in frame}
    frame = named_columns(frame, {**beside, **columns}, COLUMNS, (), file)
    if "t" not in frame:
        placed = {"x", "y"} <= {*frame} or {"latitude", "longitude"} <= {*frame}
        if not (placed and "vehicle" in frame and frame["vehicle"].is_unique):
            raise missing_column(
                file, "t", frame, "is needed; one of places alone has vehicle, x, y, each vehicle once"
            )
        summary.assume("members of a table without times stand where it says, from the first instant on")
    if "vehicle" not in frame:
        frame = frame.assign(vehicle=path.stem)
    read = _long if "kind" in frame else _wide
    rows = rows_of(read(frame, file, summary, kinds, ignore), file)
    if "partner" not in frame and (in_group(rows, "relative") & rows["partner"].eq("")).any():
        raise missing_column(file, "partner", frame, "is needed")
    return rows


def _with_whole_stamps(frame: DataFrame, columns: Names) -> DataFrame:
    """The frame with stamps of whole seconds and nanoseconds beside them, as of ROS, in one column: t, if none is."""
    numbers = frame.select_dtypes("number")
    for name in numbers:
        match = re.fullmatch(r"(.*?)n(?:ano)?(secs?)", str(name))
        if match and (whole := match[1] + match[2]) in numbers:
            frame = frame.assign(**{whole: frame[whole] + 1e-9 * frame[name]}).drop(columns=name)
            return frame if {"t", columns.get("t")} & {*frame} else frame.rename(columns={whole: "t"})
    return frame


def _long(frame: DataFrame, file: str, summary: Summary, kinds: Names, ignore: Sequence[str]) -> DataFrame:
    kind = pd.Series(words(frame, "kind", file), frame.index)
    left = kind.isin(ignore)
    summary.unused.update("kind " + kind[left] + ", as ignore= asks")
    kind = kind[~left].replace(dict(kinds))
    strange = kind[~kind.isin(KINDS)]
    if len(strange):
        first, *others = dict.fromkeys(strange.tolist())
        more = f" Unknown too: {', '.join(map(repr, others))}." if others else ""
        hint = f'Map it with kinds={{"{first}": ...}}, or leave it out: ignore=["{first}"].{more}'
        raise InputError(
            f"{file}: row {strange.index[0]}, column kind",
            repr(first),
            f"must be one of {', '.join(KINDS)}",
            f"{suggestion(first, KINDS, '')} {hint}".lstrip(),
        )
    return _cells(frame[~left].assign(kind=kind), file, "value", "std")


def _wide(frame: DataFrame, file: str, summary: Summary, kinds: Names, ignore: Sequence[str]) -> DataFrame:
    frame = frame.rename(columns={**kinds, **{f"{name}_std": f"{kind}_std" for name, kind in kinds.items()}})
    columns = {"arrival" if kind == "message" else kind: (kind, "") for kind in KINDS}
    for name in () if "partner" in frame else map(str, frame.select_dtypes(exclude=["bool", "datetime", "datetimetz"])):
        if (named := _of_partner(name)) and pd.to_numeric(frame[name].astype(str), errors="coerce").notna().any():
            columns[name] = named
    columns = {name: of for name, of in columns.items() if name in frame and of[0] not in ignore}
    if not columns:
        allowed = f"must be there, or columns named after kinds ({', '.join(KINDS)})"
        usual = [f"{key}:{header}" for header in map(str, frame) if (key := usual_key(header)) not in ("", header)]
        more = f" Without one, name the others: ?columns={','.join(usual) or 'speed_kmh:...'}."
        raise missing_column(file, "kind", frame, allowed, more=more)
    own = [name for name, (_, partner) in columns.items() if not partner]
    if "std" in frame and {KINDS[columns[name][0]].group for name in own} == {"fix"}:
        summary.assume(f"column std of {file} is the standard deviation of each of {', '.join(own)}")
        frame = frame.assign(**{f"{name}_std": frame["std"] for name in own}).drop(columns="std")
    for column in frame.columns.difference(
        ["t", "vehicle", "partner", *columns, *(f"{name}_std" for name in columns)], sort=False
    ):
        near = f"Did you mean {near}?" if (near := usual_key(column)) and "partner" not in frame else ""
        like = near or suggestion(column, (*LONG, *KINDS), "")
        if column == "std":
            like = f"which belongs to no kind (name it {next(iter(columns))}_std)"
        summary.unused[f"{file}: column {column}{', ' * bool(like)}{like}"] += len(frame)
    parts = []
    for name, (kind, partner) in columns.items():
        needed = frame.columns.intersection(["t", "vehicle", "partner", name, f"{name}_std"])
        part = frame.loc[filled(frame[name]), needed].assign(kind=kind)
        if partner:
            part["partner"] = partner
        parts.append(_cells(part, file, name, f"{name}_std"))
    return pd.concat(parts)


def _of_partner(column: str) -> tuple[str, str] | None:
    """Kind and partner of a column such as range_car2 or azimuth_deg_car2; None for another."""
    kinds = [kind for kind in KINDS if KINDS[kind].group == "relative" and column.startswith(f"{kind}_")]
    kind = max(kinds, key=len, default="")
    partner = column[len(kind) + 1 :]
    is_column = not kind or column in KINDS or partner in UNIT_SUFFIXES or column.endswith("_std")
    return None if is_column else (kind, partner)


def _cells(frame: DataFrame, file: str, value: str, std: str) -> DataFrame:
    """Times, names and numbers of a table with a column kind; `value` and `std` are the columns of these."""
    message = (frame["kind"] == "message").to_numpy()
    for mask, column in ((~message, value), (message, "arrival")):
        if mask.any() and column not in frame:
            raise missing_column(file, column, frame, "is needed")

    def read(reader: Callable[..., Any], column: str, there: Bools, blank: Any = np.nan) -> AnyArray:
        """What a column holds in the rows that have it."""
        cells = np.full(len(frame), blank, object if blank == "" else float)
        if there.any():
            cells[there] = reader(frame[there], column, file)
        return cells

    made: dict[str, Any] = {"vehicle": words(frame, "vehicle", file), "value": read(numeric, value, ~message)}
    if std in frame:
        made["std"] = read(numeric, std, filled(frame[std]))
    if "t" in frame:
        made["t"] = seconds(frame, "t", file)
    if "partner" in frame:
        made["partner"] = read(words, "partner", filled(frame["partner"]), "")
    if message.any():
        cells = frame["arrival"]
        lost = message & (cells.astype(str).str.strip().str.lower() == "lost").to_numpy()
        if cells.dtype.kind in "OUT":  # as it may hold "lost", whatever the decimal mark
            frame = frame.assign(arrival=cells.astype(str).str.replace(",", "."))
        made["arrival"] = np.where(lost, np.inf, read(seconds, "arrival", message & ~lost))
    return frame[["kind"]].assign(**made)

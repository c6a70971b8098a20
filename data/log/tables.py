"""Tables of a log: one row per measurement (long), or one column per kind (wide)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from coopoc.arrays import Bools, Floats
from coopoc.errors import InputError, suggestion

from ..cells import (
    TABLES,
    filled,
    headers,
    missing_column,
    named_columns,
    numeric,
    optional,
    read_frame,
    seconds,
    words,
)
from .units import KINDS, Rows, Summary, rows_of, stacked

if TYPE_CHECKING:
    import pandas as pd

LONG = ("t", "vehicle", "kind", "partner", "value", "std", "arrival")
OF_FLEETS = {"id", "t", "x", "y", "z", "vx", "vy", "vz"}
"""Columns of a table of drives."""
OF_LOGS = {"kind", "partner", "arrival", *KINDS} - OF_FLEETS - {"speed", "heading", "height"}
"""Columns that no table of drives has."""
ITSELF = "must be another member: a vehicle neither measures itself nor sends to itself"
UNIT = "Is it in another unit? Other kinds: {kinds}. Or an angle over several turns? Write it within one."


def is_log_table(path: Path, columns: Mapping[str, str] | None = None) -> bool:
    """Whether a file is a table with a column that only a log has, by its header or by our names in `columns`."""
    if path.suffix.lower() not in TABLES:
        return False
    return bool(
        set(columns or ()) & ({*LONG, *KINDS} - OF_FLEETS) or OF_LOGS & {name.lower() for name in headers(path)}
    )


def read_log_table(
    path: Path,
    summary: Summary,
    *,
    columns: Mapping[str, str] | None = None,
    kinds: Mapping[str, str] | None = None,
    ignore: Sequence[str] = (),
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
    file, given = path.name, dict(columns or {})
    frame = read_frame(path, *(given.get(key, key) for key in ("vehicle", "partner", "kind", "arrival")))
    known = (*LONG, *KINDS, *(f"{kind}_std" for kind in KINDS))
    frame = named_columns(frame, given, known, (), file)
    if "t" not in frame.columns:
        placed = {"x", "y"} <= set(frame.columns) or {"latitude", "longitude"} <= set(frame.columns)
        if not (placed and "vehicle" in frame.columns and frame["vehicle"].is_unique):
            allowed = "is needed; one of places alone has vehicle, x, y, each vehicle once"
            raise missing_column(file, "t", list(frame.columns), allowed)
        summary.assume("members of a table without times stand where it says, from the first instant on")
    if "vehicle" not in frame.columns:
        frame = frame.assign(vehicle=path.stem)
    read = _long if "kind" in frame.columns else _wide
    rows = read(frame, file, summary, kinds or {}, ignore)
    if "partner" not in frame.columns and rows.in_group("relative").any():
        raise missing_column(file, "partner", list(frame.columns), "is needed")
    _check(rows)
    return rows


def _long(frame: pd.DataFrame, file: str, summary: Summary, kinds: Mapping[str, str], ignore: Sequence[str]) -> Rows:
    frame = frame.assign(kind=words(frame, "kind", file))
    left = frame["kind"].isin(list(ignore))
    for kind, count in frame["kind"][left].value_counts(sort=False).items():
        summary.leave(f"kind {kind}, as ignore= asks", int(count))
    frame = frame[~left].assign(kind=frame["kind"][~left].replace(dict(kinds)))
    strange = frame["kind"][~frame["kind"].isin(list(KINDS))]
    if len(strange):
        first, *others = dict.fromkeys(strange.tolist())
        more = f" Unknown too: {', '.join(map(repr, others))}." if others else ""
        hint = f'Map it with kinds={{"{first}": ...}}, or leave it out: ignore=["{first}"].{more}'
        hint = f"{suggestion(first, KINDS, '')} {hint}".lstrip()
        field, allowed = f"{file}: row {strange.index[0]}, column kind", f"must be one of {', '.join(KINDS)}"
        raise InputError(field, repr(first), allowed, hint)
    return _rows(frame, file, "value", "std")


def _wide(frame: pd.DataFrame, file: str, summary: Summary, kinds: Mapping[str, str], ignore: Sequence[str]) -> Rows:
    frame = frame.rename(columns={**kinds, **{f"{name}_std": f"{kind}_std" for name, kind in kinds.items()}})
    value = {kind: "arrival" if kind == "message" else kind for kind in KINDS if kind not in ignore}
    value = {kind: column for kind, column in value.items() if column in frame.columns}
    if not value:
        allowed = f"must be there, or columns named after kinds ({', '.join(KINDS)})"
        error = missing_column(file, "kind", list(frame.columns), allowed)
        hint = f'{error.hint} Or name the columns: kinds={{"...": "speed_kmh"}}.'
        raise InputError(error.field, error.value, error.allowed, hint)
    if "std" in frame.columns and {KINDS[kind].group for kind in value} == {"fix"}:
        summary.assume(f"column std of {file} is the standard deviation of each of {', '.join(value)}")
        frame = frame.assign(**{f"{kind}_std": frame["std"] for kind in value}).drop(columns="std")
    used = {"t", "vehicle", "partner", *value.values(), *(f"{kind}_std" for kind in value)}
    for column in frame.columns:
        if column not in used:
            hint = f", which belongs to no kind (name it {next(iter(value))}_std)" if column == "std" else ""
            summary.leave(f"{file}: column {column}{hint}", len(frame))
    return stacked(
        [
            _rows(frame[filled(frame[column])].assign(kind=kind), file, kind, f"{kind}_std")
            for kind, column in value.items()
        ]
    )


def _rows(frame: pd.DataFrame, file: str, value: str, std: str) -> Rows:
    """Rows of a table with a column kind, whose values and standard deviations are in the columns of these names."""
    message = (frame["kind"] == "message").to_numpy()
    for mask, column in ((~message, value), (message, "arrival")):
        if mask.any() and column not in frame.columns:
            raise missing_column(file, column, list(frame.columns), "is needed")
    values = np.full(len(frame), np.nan)
    if not message.all():
        values[~message] = numeric(frame[~message], value, file)
    rows: dict[str, Any] = {
        "t": seconds(frame, "t", file) if "t" in frame.columns else np.nan,
        "vehicle": words(frame, "vehicle", file),
        "partner": "",
        "value": values,
        "std": optional(frame, std, file),
        "arrival": _arrivals(frame, file, message),
    }
    if "partner" in frame.columns:
        rows["partner"] = frame["partner"].astype(str).str.strip().where(filled(frame["partner"]), "")
    return rows_of(frame[["kind"]].assign(**rows), file)


def _arrivals(frame: pd.DataFrame, file: str, message: Bools) -> Floats:
    """Times of arrival, infinite for "lost"; NaN for what is no message."""
    times = np.full(len(frame), np.nan)
    if message.any():
        cells: Any = frame["arrival"]
        lost = message & (cells.astype(str).str.strip().str.lower() == "lost").to_numpy()
        times[lost] = np.inf
        if cells.dtype.kind in "OUT" or str(cells.dtype) == "str":
            cells = cells.astype(str).str.replace(",", ".")  # text, as it may hold "lost", whatever the decimal mark
        arrived = message & ~lost
        if arrived.any():
            times[arrived] = seconds(frame.assign(arrival=cells)[arrived], "arrival", file)
    return times


def _check(rows: Rows) -> None:
    """InputError at the first value that cannot be meant in its unit, or that lacks its partner."""
    limit = np.array([KINDS[kind].limit for kind in rows.kind.tolist()])
    alone = rows.in_group("relative") & (rows.partner == "")
    for wrong, column, value, allowed, hint in (
        (np.abs(rows.value) > limit, "{kind}", "value", "must be within +-{limit:.4g}", UNIT),
        (rows.of("range") & (rows.value <= 0), "{kind}", "value", "must be > 0", "Remove the row."),
        (rows.of("inclination") & (rows.value < 0), "{kind}", "value", "must be >= 0", "Remove the row."),
        (rows.std <= 0, "standard deviation of {kind}", "std", "must be > 0", "Leave it empty where it is unknown."),
        (alone, "column partner", "partner", "must be a name", "Name the vehicle or road-side unit."),
        (rows.partner == rows.vehicle, "column partner", "partner", ITSELF, "Mend or remove the row."),
    ):
        if wrong.any():
            k = int(np.argmax(wrong))
            kind = rows.kind[k]
            others = ", ".join(name for name in KINDS if KINDS[name].name == KINDS[kind].name)
            given = getattr(rows, value)[k]
            shown = (repr(given) if given else "empty") if value == "partner" else f"{given:.10g}"
            allowed, hint = allowed.format(limit=limit[k]), hint.format(kinds=others)
            raise InputError(f"{rows.place(k)}, {column.format(kind=kind)}", shown, allowed, hint)

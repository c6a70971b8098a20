"""Tables of a log: one row per measurement (long), or one column per kind (wide)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from coopoc.arrays import Bools, Floats
from coopoc.errors import InputError
from coopoc.plugins import suggestion

from ..cells import (
    TABLES,
    USUAL,
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
from .units import ANGLES, KINDS, Rows, Summary, rows_of, stacked

if TYPE_CHECKING:
    import pandas as pd

LONG = ("t", "vehicle", "kind", "partner", "value", "std", "arrival")
OF_FLEETS = {"id", "t", "x", "y", "z", "vx", "vy", "vz"}
"""Columns of a table of drives."""
OF_LOGS = {"kind", "partner", "arrival", *KINDS} - OF_FLEETS - {"speed", "heading", "height"}
"""Columns that no table of drives has."""
LOST = ("lost", "-1")


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
    read = _long if "kind" in frame.columns else _wide
    rows = read(frame, path, summary, kinds or {}, ignore)
    if "partner" not in frame.columns and rows.in_group("relative").any():
        raise missing_column(file, "partner", list(frame.columns), "is needed")
    _check(rows)
    return rows


def _long(frame: pd.DataFrame, path: Path, summary: Summary, kinds: Mapping[str, str], ignore: Sequence[str]) -> Rows:
    file = path.name
    frame = frame.assign(kind=words(frame, "kind", file))
    left = frame["kind"].isin(list(ignore))
    for kind, count in frame["kind"][left].value_counts(sort=False).items():
        summary.leave(f"kind {kind}, as ignore= asks", int(count))
    frame = frame[~left].assign(kind=frame["kind"][~left].replace(dict(kinds)))
    strange = frame["kind"][~frame["kind"].isin(list(KINDS))]
    if len(strange):
        one, *others = dict.fromkeys(strange.tolist())
        more = f" Unknown too: {', '.join(map(repr, others))}." if others else ""
        hint = f'Map it with kinds={{"{one}": ...}}, or leave it out: ignore=["{one}"].{more}'
        hint = f"{suggestion(one, KINDS, '')} {hint}".lstrip()
        where, allowed = f"{file}: row {strange.index[0]}, column kind", f"must be one of {', '.join(KINDS)}"
        raise InputError(where, repr(one), allowed, hint)
    return _rows(frame, path, "value", "std")


def _wide(frame: pd.DataFrame, path: Path, summary: Summary, kinds: Mapping[str, str], ignore: Sequence[str]) -> Rows:
    file = path.name
    frame = frame.rename(columns={**kinds, **{f"{name}_std": f"{kind}_std" for name, kind in kinds.items()}})
    used = [kind for kind in KINDS if kind in frame.columns and kind not in ignore and kind != "message"]
    used += ["message"] if {"message", "arrival"} & set(frame.columns) else []
    if not used:
        allowed = f"must be there, or columns named after kinds ({', '.join(KINDS)})"
        wanted = 'name the columns: kinds={"...": "speed_kmh"}'
        error = missing_column(file, "kind", list(frame.columns), allowed)
        raise InputError(error.field, error.value, error.allowed, f"{error.hint} Or {wanted}.")
    if "std" in frame.columns:
        bare = [kind for kind in used if f"{kind}_std" not in frame.columns]
        if bare and (len(used) == 1 or all(KINDS[kind].group == "fix" for kind in used)):
            summary.assume(f"column std of {file} is the standard deviation of each of {', '.join(bare)}")
            frame = frame.assign(**{f"{kind}_std": frame["std"] for kind in bare})
        else:
            summary.leave(f"{file}: column std, which belongs to no kind (name it {used[0]}_std)", len(frame))
        frame = frame.drop(columns="std")
    known = {"t", "vehicle", "partner", "arrival", *used, *(f"{kind}_std" for kind in used)}
    for column in frame.columns:
        if column not in known:
            summary.leave(f"{file}: column {column}", len(frame))
    parts = []
    for kind in used:
        column = "arrival" if kind == "message" else kind
        if column not in frame.columns:
            raise missing_column(file, column, list(frame.columns), "is needed")
        parts.append(_rows(frame[filled(frame[column])].assign(kind=kind), path, kind, f"{kind}_std"))
    return stacked(parts)


def _rows(frame: pd.DataFrame, path: Path, value: str, std: str) -> Rows:
    """Rows of a table with a column kind, whose values and standard deviations are in the columns of these names."""
    file, given = path.name, frame.columns
    message = (frame["kind"] == "message").to_numpy()
    values = np.full(len(frame), np.nan)
    if not message.all():
        if value not in given:
            raise missing_column(file, value, list(given), "is needed")
        values[~message] = numeric(frame[~message], value, file)
    vehicles = [path.stem] * len(frame)
    if "vehicle" in given:
        vehicles = words(frame, "vehicle", file)
    elif any(frame[name].nunique() > 1 for name in given if name.lower() in USUAL["vehicle"]):
        raise missing_column(file, "vehicle", list(given), "is needed")
    partner = frame["partner"] if "partner" in given else frame["kind"]
    there = filled(partner) & ("partner" in given)
    rows = {
        "t": seconds(frame, "t", file) if "t" in given else np.nan,
        "vehicle": vehicles,
        "partner": partner.astype(str).str.strip().where(there, ""),
        "value": values,
        "std": optional(frame, std, file),
        "arrival": _arrivals(frame, file, message),
    }
    return rows_of(frame[["kind"]].assign(**rows), file)


def _arrivals(frame: pd.DataFrame, file: str, message: Bools) -> Floats:
    """Times of arrival, infinite for "lost"; NaN for what is no message."""
    out = np.full(len(frame), np.nan)
    if not message.any():
        return out
    if "arrival" not in frame.columns:
        raise missing_column(file, "arrival", list(frame.columns), "is needed")
    given: Any = frame["arrival"]
    lost = message & given.astype(str).str.strip().str.lower().isin(LOST).to_numpy()
    out[lost] = np.inf
    there = message & ~lost
    if given.dtype.kind in "OUT" or str(given.dtype) == "str":
        given = given.astype(str).str.replace(",", ".")  # text, as it may hold "lost", whatever the decimal mark
    if there.any():
        out[there] = seconds(frame.assign(arrival=given)[there], "arrival", file)
    return out


def _check(rows: Rows) -> None:
    """InputError at the first value that cannot be meant in its unit, or that lacks its partner."""

    def refuse(kind: str, wrong: Bools, what: str, given: str, allowed: str, hint: str) -> None:
        bad = np.flatnonzero((rows.kind == kind) & wrong)
        if len(bad):
            value = {"value": f"{rows.value[bad[0]]:.10g}", "std": f"{rows.std[bad[0]]:g}"}.get(given)
            shown = value or repr(rows.partner[bad[0]]).replace("''", "empty")
            raise InputError(f"{rows.place(int(bad[0]))}, {what}", shown, allowed, hint)

    for name in dict.fromkeys(rows.kind.tolist()):
        kind = KINDS[name]
        hint = f"Is it in another unit? Other kinds: {', '.join(n for n in KINDS if KINDS[n].name == kind.name)}."
        hint += " Or counted on over several turns? Write it within one." if kind.name in ANGLES else ""
        refuse(name, np.abs(rows.value) > kind.limit, name, "value", f"must be within +-{kind.limit:.4g}", hint)
        if name in ("range", "inclination"):
            sign = ">" if name == "range" else ">="
            wrong = (rows.value <= 0) if name == "range" else (rows.value < 0)
            refuse(name, wrong, name, "value", f"must be {sign} 0", "Remove the row.")
        hint = "Leave it empty where it is unknown; sensors= gives one for all."
        refuse(name, rows.std <= 0, f"standard deviation of {name}", "std", "must be > 0", hint)
        if kind.group == "relative":
            hint = f"Name the vehicle or road-side unit to which the {name} was measured."
            refuse(name, rows.partner == "", "column partner", "partner", "must be a name", hint)
        allowed = "must be another member: a vehicle neither measures itself nor sends to itself"
        wrong = rows.partner == rows.vehicle
        refuse(name, wrong, "column partner", "partner", allowed, "Mend or remove the row.")

"""Tables of a log: one row per measurement (long), or one column per kind (wide)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from coopoc.arrays import AnyArray, Bools, Floats, Ints
from coopoc.errors import InputError
from coopoc.plugins import suggestion, unknown

from .cells import numeric, read_frame, seconds, words
from .kinds import ANGLES, KINDS
from .log_summary import Tally

if TYPE_CHECKING:
    import pandas as pd

from .log_rows import Rows, rows_of, stacked

LONG = ("t", "vehicle", "kind", "partner", "value", "std", "arrival")
LOST = ("lost", "-1")
USUAL = {
    "vehicle": ("observer", "robot", "car", "agent", "sender", "vehicle_id", "robot_id", "car_id", "agent_id"),
    "partner": ("neighbour", "neighbor", "to", "target", "subject", "other", "peer", "anchor", "receiver", "landmark"),
    "t": ("time", "timestamp", "stamp", "time_s", "seconds", "sec", "datetime", "utc", "rostime"),
    "value": ("measurement", "val", "data"),
    "arrival": ("received", "arrival_time", "t_arrival", "rx_time"),
}
"""Headers that others give to the columns."""
DECIMAL_COMMA = r"^\s*(-?\d+),(\d+)\s*$"
"""A number in text: a column that may hold words is read as it is written."""


def read_rows(
    path: Path,
    tally: Tally,
    columns: Mapping[str, str] | None = None,
    kinds: Mapping[str, str] | None = None,
    ignore: Sequence[str] = (),
) -> Rows:
    """Rows of a CSV, Parquet or Excel table, long if it has columns kind and value, else wide.

    Args:
        path: of the file. Without a column vehicle, the file is named after its vehicle.
        tally: counts what is not used.
        columns: names in the file, as {"t": "time", "latitude": "lat"}; one that the file lacks is left out. "car|from"
            is whichever of the two the file has.
        kinds: names in the column kind, as {"uwb": "range"}.
        ignore: kinds in the file that are left out.

    Raises:
        InputError: with the row and the column, a cell that is no number, no time or no name, an unknown kind, a kind
            without its partner, a value that belongs to another unit.
    """
    given, file = dict(columns or {}), path.name
    for key in given:
        if key not in (*LONG, *KINDS) and key.removesuffix("_std") not in KINDS:
            raise unknown(f"{file}: key of columns", key, (*LONG, *KINDS), 'Give columns={"t": "name in the file"}.')
    text = [header for key in ("vehicle", "partner", "kind", "arrival") for header in named(given.get(key, key))]
    frame = read_frame(path, *text)
    names: dict[str, str] = {}
    for key, header in given.items():
        there = [one for one in named(header) if one in frame.columns]
        if len(there) > 1:
            hint = "Name the one that is meant."
            raise InputError(f"{file}: columns[{key!r}]", repr(header), f"are both there: {', '.join(there)}", hint)
        if there:
            names[key] = there[0]
    frame = frame.rename(columns={header: key for key, header in names.items()})
    if twice := next((key for key in names if (frame.columns == key).sum() > 1), None):
        allowed = f"is not the only column {twice} then: the file has one of that name"
        raise InputError(f"{file}: columns[{twice!r}]", repr(names[twice]), allowed, "Rename or remove one of the two.")
    if "t" not in frame.columns:
        if not _are_places(frame):
            raise _no_column(file, "t", frame)
        frame.insert(0, "t", 0.0)
        tally.assume("members of a table without times stand where it says, from the first instant on")
        rows = _wide(frame, path, tally, {}, ignore)
        return _checked(replace(rows, t=np.full(len(rows), np.nan)))
    read = _long if {"kind", "value"} <= set(frame.columns) or "kind" in frame.columns else _wide
    rows = read(frame, path, tally, dict(kinds or {}), ignore)
    if "partner" not in frame.columns and (rows.group == "relative").any():
        raise _no_column(file, "partner", frame)
    return _checked(rows)


def named(header: str) -> list[str]:
    """The headers that a word of `columns` names: itself, or those between "|".

    >>> named("car|from")
    ['car', 'from']
    """
    return [one.strip() for one in header.split("|")]


def _are_places(frame: pd.DataFrame) -> bool:
    """Whether a table without times holds one place for each of its members."""
    placed = {"x", "y"} <= set(frame.columns) or {"latitude", "longitude"} <= set(frame.columns)
    return placed and "vehicle" in frame.columns and bool(frame["vehicle"].is_unique)


def _long(frame: pd.DataFrame, path: Path, tally: Tally, kinds: Mapping[str, str], ignore: Sequence[str]) -> Rows:
    file = path.name
    found = np.array(words(frame, "kind", file), dtype=object)
    left = np.isin(found, list(ignore))
    for kind in dict.fromkeys(found[left].tolist()):
        tally.unused(f"kind {kind}, as ignore= asks", int((found == kind).sum()))
    frame, row, found = frame[~left], np.flatnonzero(~left) + 1, found[~left]
    kind = np.array([kinds.get(one, one) for one in found.tolist()], dtype=object)
    for k, one in enumerate(kind.tolist()):
        if one not in KINDS:
            more = ", ".join(dict.fromkeys(f"{other!r}" for other in kind.tolist() if other not in {one, *KINDS}))
            hint = (
                f'{suggestion(one, KINDS, "")} Map it with kinds={{"{one}": ...}} (--kinds), or leave it out: '
                f'ignore=["{one}"] (--ignore).{f" Unknown too: {more}." if more else ""}'
            )
            raise InputError(
                f"{file}: row {row[k]}, column kind", repr(one), f"must be one of {', '.join(KINDS)}", hint.lstrip()
            )
    message = kind == "message"
    value = np.full(len(frame), np.nan)
    if not message.all():
        if "value" not in frame.columns:
            raise _no_column(file, "value", frame)
        value[~message] = _numeric(frame["value"][~message], "value", file, row[~message])
    return rows_of(
        file,
        _times(frame, "t", file, row),
        _vehicles(frame, path, row),
        kind.tolist(),
        value,
        row,
        partner=_partners(frame),
        std=_optional(frame, "std", file, row),
        arrival=_arrivals(frame, file, row, message),
    )


def _wide(frame: pd.DataFrame, path: Path, tally: Tally, kinds: Mapping[str, str], ignore: Sequence[str]) -> Rows:
    file = path.name
    for name, kind in kinds.items():
        frame = frame.rename(columns={name: kind, f"{name}_std": f"{kind}_std"})
    used = [kind for kind in KINDS if kind in frame.columns and kind not in ignore]
    if "arrival" in frame.columns and "message" not in used:
        used.append("message")
    if "message" in used and "arrival" not in frame.columns:
        raise _no_column(file, "arrival", frame)
    if not used:
        raise _no_column(file, "kind", frame)
    frame = _own_std(frame, used, tally, file)
    groups = {KINDS[kind].group for kind in used}
    known = {"t", "vehicle", *used, *(f"{kind}_std" for kind in used)}
    known |= {"partner"} if groups & {"relative", "message"} else set()
    known |= {"arrival"} if "message" in used else set()
    for column in frame.columns:
        if column not in known:
            tally.unused(f"{file}: column {column}", len(frame))
    parts, every = [], np.arange(1, len(frame) + 1)
    for kind in used:
        given = frame["arrival" if kind == "message" else kind]
        there = (given.notna() & (given.astype(str).str.strip() != "")).to_numpy()
        part, row = frame[there], every[there]
        message = np.full(len(part), kind == "message")
        parts.append(
            rows_of(
                file,
                _times(part, "t", file, row),
                _vehicles(part, path, row),
                [kind] * len(part),
                np.full(len(part), np.nan) if kind == "message" else _numeric(part[kind], kind, file, row),
                row,
                partner=_partners(part),
                std=_optional(part, f"{kind}_std", file, row),
                arrival=_arrivals(part, file, row, message),
            )
        )
    return stacked(parts)


def _own_std(frame: pd.DataFrame, used: Sequence[str], tally: Tally, file: str) -> pd.DataFrame:
    """The table with a column `std`, which names no kind, as that of every kind where all of them are in metres."""
    if "std" not in frame.columns:
        return frame
    alone = len(used) == 1 or all(KINDS[kind].group == "fix" for kind in used)
    bare = [kind for kind in used if f"{kind}_std" not in frame.columns]
    if not alone or not bare:
        tally.unused(f"{file}: column std, which belongs to no kind (name it {used[0]}_std)", len(frame))
        return frame.drop(columns="std")
    tally.assume(f"column std of {file} is the standard deviation of each of {', '.join(bare)}")
    return frame.assign(**{f"{kind}_std": frame["std"] for kind in bare}).drop(columns="std")


def _checked(rows: Rows) -> Rows:
    """The rows, if every value can be meant in its unit and what needs a partner has one."""
    for kind in dict.fromkeys(rows.kind.tolist()):
        k, here = KINDS[kind], np.flatnonzero(rows.kind == kind)
        value = rows.value[here]
        far = here[np.abs(value) > k.limit]
        if len(far):
            hint = f"Is it in another unit? Other kinds: {', '.join(n for n in KINDS if KINDS[n].name == k.name)}."
            hint += " Or counted on over several turns? Write it within one." if k.name in ANGLES else ""
            allowed = f"must be within +-{k.limit:.4g}"
            raise InputError(f"{rows.place(far[0])}, {kind}", f"{rows.value[far[0]]:.10g}", allowed, hint)
        bound = {"range": "> 0", "inclination": ">= 0"}.get(kind)
        low = here[(value < 0) | ((value == 0) & (bound == "> 0"))] if bound else here[:0]
        if len(low):
            raise InputError(
                f"{rows.place(low[0])}, {kind}", f"{rows.value[low[0]]:.10g}", f"must be {bound}", "Remove the row."
            )
        bad = here[~(np.isnan(rows.std[here]) | (rows.std[here] > 0))]
        if len(bad):
            where = f"{rows.place(bad[0])}, standard deviation of {kind}"
            hint = "Leave it empty where it is unknown; sensors= gives one for all."
            raise InputError(where, f"{rows.std[bad[0]]:g}", "must be > 0", hint)
        if k.group == "relative":
            alone = here[rows.partner[here] == ""]
            if len(alone):
                hint = f"Name the vehicle or road-side unit to which the {kind} was measured."
                raise InputError(f"{rows.place(alone[0])}, column partner", "empty", "must be a name", hint)
        itself = here[rows.partner[here] == rows.vehicle[here]]
        if len(itself):
            where = f"{rows.place(itself[0])}, column partner"
            allowed = "must be another member: a vehicle neither measures itself nor sends to itself"
            raise InputError(where, repr(rows.partner[itself[0]]), allowed, "Mend or remove the row.")
    return rows


def _numeric(cells: Any, column: str, file: str, row: Ints) -> Floats:
    """`numeric` of some rows of a table, with their own numbers in errors."""
    frame = cells.to_frame(column).set_index(row - 1)
    try:
        return numeric(frame, column, file)
    except InputError as error:
        raise _renumbered(error, file, column, row) from None


def _times(frame: pd.DataFrame, column: str, file: str, row: Ints) -> Floats:
    try:
        return seconds(frame, column, file)
    except InputError as error:
        raise _renumbered(error, file, column, row) from None


def _renumbered(error: InputError, file: str, column: str, row: Ints) -> InputError:
    """The error of a part of a table with the row of the whole."""
    head = f"{file}: row "
    if not error.field.startswith(head):
        return error
    k = int(error.field[len(head) :].partition(",")[0]) - 1
    return InputError(
        f"{head}{row[k]}, column {column}", error.value, error.allowed, "Mend the cell, or remove the row."
    )


def _optional(frame: pd.DataFrame, column: str, file: str, row: Ints) -> Floats:
    """A column of numbers in which cells may be empty."""
    out = np.full(len(frame), np.nan)
    if column in frame.columns:
        there = (frame[column].notna() & (frame[column].astype(str).str.strip() != "")).to_numpy()
        out[there] = _numeric(frame[column][there], column, file, row[there])
    return out


def _arrivals(frame: pd.DataFrame, file: str, row: Ints, message: Bools) -> Floats:
    """Times of arrival, infinite for "lost"; NaN for what is no message."""
    out = np.full(len(frame), np.nan)
    if not message.any():
        return out
    if "arrival" not in frame.columns:
        raise _no_column(file, "arrival", frame)
    text = frame["arrival"].astype(str).str.strip().str.lower()
    lost = message & text.isin(LOST).to_numpy()
    out[lost] = np.inf
    there = message & ~lost
    if there.any():
        part = frame[there].copy()
        if part["arrival"].dtype.kind in "OUT" or str(part["arrival"].dtype) == "str":
            part["arrival"] = part["arrival"].astype(str).str.replace(DECIMAL_COMMA, r"\1.\2", regex=True)
        out[there] = _times(part, "arrival", file, row[there])
    return out


def _vehicles(frame: pd.DataFrame, path: Path, row: Ints) -> list[str]:
    """Names of the vehicles; the file's own name without such a column, unless another one seems to hold them."""
    if "vehicle" not in frame.columns:
        named_otherwise = [c for c in frame.columns if str(c).lower() in USUAL["vehicle"]]
        if any(frame[c].nunique() > 1 for c in named_otherwise):
            raise _no_column(path.name, "vehicle", frame)
        return [path.stem] * len(frame)
    try:
        return words(frame, "vehicle", path.name)
    except InputError as error:
        raise _renumbered(error, path.name, "vehicle", row) from None


def _partners(frame: pd.DataFrame) -> AnyArray:
    if "partner" not in frame.columns:
        return np.full(len(frame), "", dtype=object)
    return np.array(["" if p != p or p is None else str(p).strip() for p in frame["partner"].tolist()], dtype=object)


def _no_column(file: str, column: str, frame: pd.DataFrame) -> InputError:
    headers = [str(c) for c in frame.columns]
    if column == "kind":
        allowed = f"must be there, or columns named after kinds ({', '.join(KINDS)}); the file has {', '.join(headers)}"
    else:
        places = "; one of places alone has vehicle, x, y, each vehicle once" if column == "t" else ""
        allowed = f"is needed{places}; the file has {', '.join(headers)}"
    near = [h for h in headers if h.lower() in USUAL.get(column, ())]
    header = near[0] if near else "..."
    wanted = f'columns={{"{column}": "{header}"}} (--columns {column}={header})'
    if column == "kind":
        wanted += ', or name the columns: kinds={"...": "speed_kmh"} (--kinds ...=speed_kmh)'
    hint = (
        f"Did you mean {near[0]}? Pass {wanted}." if near else suggestion(column, headers, f"Add it, or pass {wanted}.")
    )
    return InputError(f"{file}: column {column}", "missing", allowed, hint)

"""Reader of a CARLA export such as the paper's data set (IEEE DataPort 10.21227/511y-4s83), as CSV or XLSX.

That file needs a login and was not seen. The layout follows the same author's public loader of a similar spreadsheet
(github.com/piperigkos/Cooperative-Localization-and-Tracking): an index column, then id, x, y, z, yaw, velocity,
acceleration, angular velocity, rows time-major. What may differ is detected or given.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from coopoc.arrays import Floats
from coopoc.errors import InputError
from coopoc.plugins import suggestion, unknown
from coopoc.world.fleet import Fleet

from .cells import numeric, read_frame, seconds
from .conventions import INTERVALS, disagreement, frame, interval, row_order
from .rows import assemble

if TYPE_CHECKING:
    import pandas as pd

Columns = Mapping[str, str | int]
ORDERS = ("time", "vehicle")
LAYOUT = ("id", "x", "y", "z", "yaw", "vx", "vy", "vz")
"""Columns 0..7 after the index column; accelerations and angular velocities follow and are not used."""
NEEDED = ("x", "y", "z", "vx", "vy", "vz")
AGREED = 0.3
"""|dx/dt - v| / |v| below which an interval is believed: the candidates differ by factors of 1.5 and more."""


def read_carla(
    path: Path,
    *,
    columns: Columns | None = None,
    dt: float | None = None,
    vehicles: int | None = None,
    order: str | None = None,
    handedness: str | None = None,
) -> Fleet:
    """Fleet of a CARLA table in a right-handed frame; Fleet.source records what was detected.

    Args:
        path: .csv or .xlsx with a header row; m, m/s.
        columns: header names or positions of id, t, x, y, z, yaw, vx, vy, vz; default: headers of these names, else
            LAYOUT behind one index column. t (s) is optional: without it rows are equally spaced.
        dt: s; without t: None = found from |dx/dt - v|. With t: resample.
        vehicles: N, needed if there is no usable id column.
        order: "time" (row = t N + i) or "vehicle" (row = i T + t); None = found from the ids, or from the motion.
        handedness: "left" (CARLA: y is flipped) or "right"; None = found from yaw and from the side of the traffic.

    Raises:
        InputError: missing columns, cells that are no numbers, or a convention that the numbers leave open: the message
            names the option to pass.
    """
    _check_options(order, handedness, dt)
    table = read_frame(path)
    names = _columns(table, dict(columns or {}), path.name)
    rows = {
        key: (seconds if key == "t" else numeric)(table, name, path.name) for key, name in names.items() if key != "id"
    }
    ids = [str(v) for v in table[names["id"]]] if "id" in names and vehicles is None else None
    if "t" in rows:
        if ids is None:
            raise InputError(
                f"{path.name}: column t", "given", "needs a column id", "Name it in columns=, drop vehicles=."
            )
        fleet = assemble(ids, rows["t"], _xyz(rows, "{}"), _xyz(rows, "v{}"), dt=dt, file=path.name)
        size = disagreement(fleet.position, fleet.velocity, fleet.dt)
        if np.isfinite(size) and size >= AGREED:
            raise InputError(
                f"{path.name}: column t",
                f"dt {fleet.dt:g} s leaves {size:.0%} of |v|",
                "must be seconds that agree with positions and velocities",
                "Name another column t, drop it, or check the units.",
            )
        notes = [f"stamps given, |dx/dt - v| is {size:.1%} of |v|"]
    else:
        fleet, notes = _without_stamps(rows, ids, vehicles, order, dt, path.name)
    side, why = (handedness, "as given") if handedness else frame(rows.get("yaw"), _xyz(rows, "v{}"), fleet)
    flip = np.array([1.0, -1.0, 1.0]) if side == "left" else np.ones(3)
    notes.append(f"{side}-handed ({why})" + (", y flipped" if side == "left" else ""))
    return replace(
        fleet,
        position=fleet.position * flip,
        velocity=fleet.velocity * flip,
        name=path.stem,
        source=f"CARLA table {path.name}: " + "; ".join(notes),
    )


def _without_stamps(
    rows: dict[str, Floats], ids: list[str] | None, vehicles: int | None, order: str | None, dt: float | None, file: str
) -> tuple[Fleet, list[str]]:
    """Fleet in the frame of the file, and what was found out."""
    count = vehicles or len(set(ids or ()))
    steps, rest = divmod(len(rows["x"]), max(count, 1))
    if count < 1 or rest or steps < 2:
        raise InputError(
            f"{file}: vehicles",
            count,
            f"must divide the {len(rows['x'])} rows into two or more steps",
            "Pass vehicles= (their number), or columns= with id and t.",
        )
    by_ids = row_order(ids) if ids is not None else None
    if order and by_ids and count > 1 and order != by_ids:
        raise InputError("order", repr(order), f"must be {by_ids!r} by the ids", "Leave it out, or pass vehicles=.")
    found = order or by_ids
    if ids is not None and found is None:
        raise InputError(
            f"{file}: column id",
            f"{count} names",
            "must repeat in a cycle or come in blocks of equal length",
            "Pass columns= with id and t, or vehicles= if the column is no id.",
        )
    x, v = _xyz(rows, "{}"), _xyz(rows, "v{}")
    orders = (found,) if found else ORDERS
    residuals = {o: interval(_grid(x, o, count), _grid(v, o, count), dt) for o in orders}
    best, *others = sorted(residuals, key=lambda o: residuals[o][1])
    if others and residuals[best][1] > 0.5 * residuals[others[0]][1]:
        raise InputError("order", "unknown", 'must be "time" or "vehicle": both fit the motion', "Pass order=.")
    step, size = residuals[best]
    if dt is None and not size < AGREED:
        raise InputError(
            "dt",
            f"{step:g} s fits best but leaves {size:.0%} of |v|",
            "positions and velocities must agree on one of " + ", ".join(f"{d:g}" for d in INTERVALS) + " s",
            "Pass dt=, and check order, vehicles and columns.",
        )
    names = tuple(dict.fromkeys(ids)) if ids is not None else tuple(f"vehicle{k:03d}" for k in range(count))
    fleet = Fleet(names, step * np.arange(steps), _grid(x, best, count), _grid(v, best, count))
    return fleet, [f"{best}-major, {count} vehicles x {steps} steps, dt {step:g} s, |dx/dt - v| is {size:.1%} of |v|"]


def _grid(rows: Floats, order: str, vehicles: int) -> Floats:
    """(T, N, 3) of rows."""
    return rows.reshape(-1, vehicles, 3) if order == "time" else rows.reshape(vehicles, -1, 3).transpose(1, 0, 2)


def _xyz(rows: dict[str, Floats], form: str) -> Floats:
    return np.column_stack([rows[form.format(axis)] for axis in "xyz"])


def _columns(table: pd.DataFrame, given: dict[str, str | int], file: str) -> dict[str, str]:
    """Name in the table of each column that is used."""
    headers = [str(c) for c in table.columns]
    known = {h.strip().lower(): h for h in headers}
    names = {key: known[key] for key in (*LAYOUT, "t") if key in known}
    if not set(NEEDED) <= set(names) and len(headers) in (14, 15):
        names = dict(zip(LAYOUT, headers[len(headers) - 14 :], strict=False))
    for key, column in given.items():
        valid = column in headers if isinstance(column, str) else 0 <= column < len(headers)
        if key not in (*LAYOUT, "t") or not valid:
            wrong, near = (column, list(headers)) if key in (*LAYOUT, "t") else (key, [*LAYOUT, "t"])
            raise InputError(
                f"{file}: columns[{key!r}]",
                repr(column),
                f"keys are {', '.join(LAYOUT)}, t; the file has {', '.join(headers)}",
                suggestion(wrong, near, "Name a header or give its position, counted from 0."),
            )
        names[key] = column if isinstance(column, str) else headers[column]
    missing = [key for key in NEEDED if key not in names]
    if missing:
        raise InputError(
            f"{file}: column {missing[0]}",
            "missing",
            f"the file has {', '.join(headers)}",
            f'Name it: columns={{"{missing[0]}": "..."}} (id, t and yaw too, if there are any).',
        )
    return names


def _check_options(order: str | None, handedness: str | None, dt: float | None) -> None:
    for name, value, allowed in (("order", order, ORDERS), ("handedness", handedness, ("left", "right"))):
        if value is not None and value not in allowed:
            raise unknown(name, value, allowed, "Or leave it out to have it detected.")
    if dt is not None and not dt > 0:
        raise InputError("dt", f"{dt} s", "must be > 0", "Give the sampling interval in seconds.")

"""The folder of a study: one Parquet file per cell, written whole or not at all, with a checksum."""

import json
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from ..errors import InputError
from ..formats.seals import UNSEALED, holds, sealed
from ..paths import write
from .cell import Cell, Row

OWN_COLUMNS = ("cell", "status", "reason", "cell_seconds")
FINISHED, FAILED = "cells", "failed"
"""Folders of the cells, by their last outcome."""


@dataclass(frozen=True)
class Outcome:
    """Rows of a cell, or the reason why there are none."""

    cell: Cell
    rows: pa.Table | None
    reason: str
    trace: str
    seconds: float


def content(
    path: Path, fields: Mapping[str, Any], hint: str = "Give a folder in which coopoc run has finished a study."
) -> dict[str, Any]:
    """Fields of a JSON file in the folder of a study.

    Args:
        path: of the file.
        fields: name -> type that the file must have.
        hint: if there is no such file, and none in a folder below.

    Raises:
        InputError: no such file, no JSON, or a field that is missing or of another type.
    """
    if not path.is_file():
        below = sorted(path.parent.glob(f"*/{path.name}"))
        hint = f"Give {below[0].parent}." if below else hint
        raise InputError("folder", str(path.parent), f"holds no {path.name}", hint)
    try:
        text = path.read_text("utf-8")
        document = json.loads(text)
        if "\\ud" in text.lower():
            json.dumps(document, ensure_ascii=False).encode()  # half of a surrogate pair is no text: a ValueError
    except (ValueError, RecursionError) as error:
        raise damaged(path, str(error)) from None
    if not isinstance(document, dict):
        raise damaged(path, f"a {type(document).__name__} instead of fields")
    for name, kind in fields.items():
        if not isinstance(document.get(name), kind):
            raise damaged(
                path, f"{name} is a {type(document[name]).__name__}" if name in document else f"{name} is missing"
            )
    return document


def damaged(path: Path, damage: str) -> InputError:
    """The error for a file of a folder that cannot be used."""
    hint = "Repeat coopoc run: finished cells are kept."
    return InputError("folder", str(path.parent), f"holds a damaged {path.name} ({damage})", hint)


def save(folder: Path, outcome: Outcome) -> None:
    """Write the rows of a finished cell and remove its earlier failure; of a failed one its reason, in another file."""
    cell, rows, status = outcome.cell, outcome.rows, "failed" if outcome.rows is None else "ok"
    own = {"cell": cell.name, "status": status, "reason": outcome.reason, "cell_seconds": outcome.seconds}
    if rows is None:
        _save(_file(folder, cell.name, FAILED), to_table([{**cell.params, **own, "traceback": outcome.trace}]))
        return
    before, after = (
        {name: pa.repeat(pa.scalar(value), rows.num_rows) for name, value in each.items()}
        for each in (cell.params, own)
    )
    table = pa.table({**before, **dict(zip(rows.column_names, rows.columns, strict=True)), **after})
    _save(_file(folder, cell.name), table)
    _file(folder, cell.name, FAILED).unlink(missing_ok=True)


def load(folder: Path, name: str, kind: str = FINISHED) -> pa.Table | None:
    """Rows of a finished cell, or the row of one whose last outcome FAILED; None if there are none, or (with a warning)
    if the file is damaged."""
    path = _file(folder, name, kind)
    if not path.exists():
        return None
    try:
        content = path.read_bytes()
        if not holds(content):
            raise pa.ArrowInvalid("its checksum is wrong")
        table = pq.read_table(BytesIO(content))
        if set(OWN_COLUMNS) <= set(table.column_names) and set(table["cell"].to_pylist()) == {name}:
            return table
        damage = "it does not hold the rows of this cell"
    except (pa.ArrowException, OSError) as error:
        damage = str(error)
    warnings.warn(f"{path} is damaged and will be computed again: {damage}", RuntimeWarning, stacklevel=2)
    return None


def to_table(rows: Sequence[Row]) -> pa.Table:
    """Arrow table with the union of the rows' columns, in order of first appearance; absent values are null."""
    names = dict.fromkeys(name for row in rows for name in row)
    return pa.table({name: pa.array([row.get(name) for row in rows]) for name in names})


def _save(path: Path, table: pa.Table) -> None:
    buffer = BytesIO()
    pq.write_table(table.replace_schema_metadata({"checksum": UNSEALED}), buffer)
    write(path, sealed(buffer.getvalue()))


def _file(folder: Path, name: str, kind: str = FINISHED) -> Path:
    return folder / kind / f"{name}.parquet"

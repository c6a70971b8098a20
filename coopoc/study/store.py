"""The folder of a study: one Parquet file per cell, written whole or not at all."""

from __future__ import annotations

import json
import os
import tempfile
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from ..errors import InputError
from .study import Cell, Row

OWN_COLUMNS = ("cell", "status", "reason", "cell_seconds")


def write(path: Path, content: str | bytes | Callable[[Any], object]) -> None:
    """Write a file atomically: a temporary neighbour, flushed to disk, then renamed onto `path`.

    Whoever is killed in between leaves the old file or none, and never half a file.

    Raises:
        OSError: of a full or read-only disk, with the path.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _write(path, content)
    except OSError as error:
        text = f"{error.strerror or error}. What is finished is kept: make room and repeat"
        raise OSError(error.errno, text, str(path)) from error


def _write(path: Path, content: str | bytes | Callable[[Any], object]) -> None:
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
    try:
        with os.fdopen(handle, "wb") as file:
            if callable(content):
                content(file)
            else:
                file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(name, 0o644)
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def content(path: Path, absent: str, mend: str) -> dict[str, Any]:
    """What a JSON file of a folder holds; InputError with `absent` and `mend` if there is none, or if it is damaged."""
    if not path.is_file():
        raise InputError("folder", str(path.parent), absent, mend)
    try:
        found: dict[str, Any] = json.loads(path.read_text())
    except ValueError as error:
        damage = f"holds a damaged {path.name} ({error})"
        raise InputError("folder", str(path.parent), damage, "Repeat coopoc run: finished cells are kept.") from None
    return found


def save(folder: Path, cell: Cell, rows: pa.Table, seconds: float) -> None:
    """Keep the rows of a finished cell, and forget that it failed before."""
    own = {"cell": cell.name, "status": "ok", "reason": "", "cell_seconds": seconds}
    before, after = ({name: pa.repeat(pa.scalar(value), rows.num_rows) for name, value in each.items()}
                     for each in (cell.params, own))  # fmt: skip
    table = pa.table({**before, **dict(zip(rows.column_names, rows.columns, strict=True)), **after})
    write(_finished(folder, cell.name), lambda file: pq.write_table(table, file))
    _failed(folder, cell.name).unlink(missing_ok=True)


def save_failure(folder: Path, cell: Cell, reason: str, trace: str, seconds: float) -> None:
    """Keep the reason of a failed cell where the next run does not take it for finished."""
    own = {"cell": cell.name, "status": "failed", "reason": reason, "cell_seconds": seconds, "traceback": trace}
    table = to_table([{**cell.params, **own}])
    write(_failed(folder, cell.name), lambda file: pq.write_table(table, file))


def copy(source: Path, target: Path, name: str, failed: bool) -> None:
    """Copy the file of a finished or failed cell from one folder to another as it is; a finished one failed no more."""
    place = _failed if failed else _finished
    if source != target:
        write(place(target, name), place(source, name).read_bytes())
    if not failed:
        _failed(target, name).unlink(missing_ok=True)


def load(folder: Path, name: str) -> pa.Table | None:
    """Rows of a finished cell; None if there are none, or (with a warning) if the file is damaged."""
    return _read(_finished(folder, name), name)


def load_failure(folder: Path, name: str) -> pa.Table | None:
    """The row of a failed cell, if that was its last outcome; None (with a warning) if the file is damaged."""
    return _read(_failed(folder, name), name)


def _read(path: Path, name: str) -> pa.Table | None:
    if not path.exists():
        return None
    try:
        table = pq.read_table(path, partitioning=None)
        if set(OWN_COLUMNS) <= set(table.column_names) and set(table["cell"].to_pylist()) == {name}:
            return table
        damage = "it does not hold the rows of this cell"
    except (pa.ArrowException, OSError) as error:
        damage = str(error)
    warnings.warn(f"{path} is damaged and will be computed again: {damage}", RuntimeWarning, stacklevel=3)
    return None


def to_table(rows: Sequence[Row]) -> pa.Table:
    """Arrow table with the union of the rows' columns, in order of first appearance; absent values are null."""
    names = dict.fromkeys(name for row in rows for name in row)
    return pa.table({name: pa.array([row.get(name) for row in rows]) for name in names})


def _finished(folder: Path, name: str) -> Path:
    return folder / "cells" / f"{name}.parquet"


def _failed(folder: Path, name: str) -> Path:
    return folder / "failed" / f"{name}.parquet"

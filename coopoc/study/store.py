"""The folder of a study: one Parquet file per cell, written whole or not at all, with a checksum; its manifest (study,
settings, cells, environments) and the lock of who writes it.
"""

import json
import re
import warnings
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq
from filelock import FileLock, Timeout

from ..errors import InputError
from ..formats.seals import UNSEALED, holds, sealed
from ..paths import file_name, write
from .cell import Cell, Params, Row

OWN_COLUMNS = ("cell", "status", "reason", "cell_seconds")
FINISHED, FAILED = "cells", "failed"
"""Folders of the cells, by their last outcome."""


class Outcome(NamedTuple):
    """Rows of a cell, or the reason why there are none."""

    cell: Cell
    rows: pa.Table | None
    reason: str
    trace: str
    seconds: float


def content(path: Path, fields: Mapping[str, Any], hint: str = "") -> dict[str, Any]:
    """Fields of a JSON file in the folder of a study.

    Args:
        path: of the file.
        fields: name -> type that the file must have.
        hint: of errors about a file that coopoc run does not write.

    Raises:
        InputError: no such file, no JSON, or a field that is missing or of another type.
    """
    if not path.is_file():
        below = sorted(path.parent.glob(f"*/{path.name}"))
        hint = f"Give {below[0].parent}." if below else hint or "Give a folder that coopoc run has finished."
        raise InputError("folder", str(path.parent), f"holds no {path.name}", hint)
    try:
        text = path.read_text("utf-8")
        document: dict[str, Any] = json.loads(text)
        if "\\ud" in text.lower():
            json.dumps(document, ensure_ascii=False).encode()  # half of a surrogate pair is no text: a ValueError
    except (ValueError, RecursionError) as error:
        raise damaged(path, str(error), hint) from None
    for name, kind in fields.items():
        if not isinstance(document, dict) or not isinstance(document.get(name), kind):
            raise damaged(path, f"it has no {kind.__name__} {name}", hint)
    return document


def damaged(path: Path, damage: str, hint: str = "") -> InputError:
    """The error for a file of a folder that cannot be used."""
    hint = hint or "Repeat coopoc run: finished cells are kept."
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


MANIFEST = "manifest.json"
_FIELDS = {"study": str, "question": str, "axes": list, "settings": dict, "cells": dict, "environment": dict}


@dataclass(frozen=True)
class Manifest:
    """A folder of results.

    Args:
        study: name of the study.
        question: of the study.
        axes: names of the parameters that vary.
        settings: name -> value, the same in all cells.
        cells: name -> parameters of the cell.
        environment: version of each library, the processor and the revision, see `environments`.
    """

    study: str
    question: str
    axes: Sequence[str]
    settings: Params
    cells: Mapping[str, Params]
    environment: Mapping[str, str]

    def save(self, folder: Path) -> None:
        """Write the manifest. If the cells are the same as before, each environment that computed them is named."""
        stored, used = json.loads(json.dumps(asdict(self), default=str)), [self.environment]  # tuples become lists
        with suppress(InputError):
            before = read(folder)
            if asdict(replace(before, environment=self.environment)) == stored:
                used = [before.environment, *used]
        stored["environment"] = environments(used)
        write(folder / MANIFEST, json.dumps(stored, indent=1) + "\n")


def read(folder: Path) -> Manifest:
    """The manifest in a folder.

    Raises:
        InputError: none, a damaged one, or one whose names are no file names: they would lead out of the folder.
    """
    path = folder / MANIFEST
    fields = content(path, _FIELDS)
    manifest = Manifest(**{name: fields[name] for name in _FIELDS})
    texts, cells = (*manifest.axes, *manifest.environment.values()), manifest.cells.values()
    if not (all(isinstance(text, str) for text in texts) and all(isinstance(params, dict) for params in cells)):
        raise damaged(path, "axes, cells or environment")
    file_name("study", manifest.study, f"Run the study again: {path} was not written by coopoc run.")
    if wrong := next((name for name in manifest.cells if not re.fullmatch("[0-9a-f]{20}", name)), None):
        raise damaged(path, f"{wrong[:60]!r} is no name of a cell")
    return manifest


def environments(used: Sequence[Mapping[str, str]]) -> dict[str, str]:
    """Each field once; where machines or versions differ, all of its values.

    >>> environments([{"python": "3.11"}, {"python": "3.12"}])
    {'python': '3.11; 3.12'}
    """
    values = defaultdict[str, dict[str, None]](dict)
    for each in used:
        for name, listed in each.items():
            values[name] |= dict.fromkeys(listed.split("; "))
    return {name: "; ".join(each) for name, each in values.items()}


@contextmanager
def locked(folder: Path, own: Manifest) -> Iterator[None]:
    """Make the folder, write its manifest, and lock both for this process.

    A second run would replace the manifest under the first one. The operating system releases the lock when the
    process ends, however it ends.

    Args:
        folder: of the study.
        own: manifest to write.

    Raises:
        InputError: another run holds the folder, or it cannot be written.
    """
    lock = FileLock(folder / ".lock")
    try:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            lock.acquire(blocking=False)
            for left in (*folder.glob(".*.part"), *folder.glob("*/.*.part")):  # of processes that were killed
                left.unlink()
            own.save(folder)
        except Timeout:
            wait = "Wait until it ends, or choose another --out."
            raise InputError("out", str(folder), "is in use by another run", wait) from None
        except OSError as error:
            allowed = f"cannot be written ({error.strerror or error})"
            raise InputError("out", str(folder), allowed, "Choose another --out.") from None
        yield
    finally:
        lock.release()

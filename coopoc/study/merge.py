"""merge: bring folders of one study together, as machines without a common disk fill them shard by shard."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import pyarrow as pa

from ..arrays import listed
from ..errors import InputError
from ..file_names import given_path, inside
from . import store
from .manifest import NAME, different, environments, locked, read


@dataclass(frozen=True)
class Merged:
    """What a merge found: the folder, its cells, and how many are finished, failed, and nowhere to be found."""

    folder: Path
    cells: int
    finished: int
    failed: int
    missing: int


def merge(folders: Sequence[str | Path], out: str | Path) -> Merged:
    """Copy every finished cell of several folders of one study into `out/<study>`; the folders stay as they are.

    A cell that is finished anywhere is finished, one that only failed is a failure. Of a cell that is there twice the
    first stays (what `out` holds already comes before all), with a warning if the numbers are not the same.

    Args:
        folders: of one study, run with the same settings. out: folder of all studies.

    Raises:
        InputError: no folder, folders whose manifests differ (environments may), or a folder that a run holds.
    """
    out, folders = given_path(out), listed("folders", folders, "Give a list of folders.")
    if not folders:
        raise InputError("folders", "none", "must be at least one", "Example: coopoc merge a/small b/small --out all.")
    sources = [given_path(folder) for folder in folders]
    target = out / read(sources[0]).study
    for path in (target, *(target / kind for kind in ("cells", "failed"))):
        inside(out, path)
    if (target / NAME).is_file():
        sources = [target, *(folder for folder in sources if folder != target)]
    first, *others = manifests = [read(folder) for folder in sources]
    for folder, other in zip(sources[1:], others, strict=True):
        if fields := different(first, other):
            hint = "Merge folders of one study that ran with the same --set."
            raise InputError("folders", f"{sources[0]} and {folder}", f"differ in {', '.join(fields)}", hint)
    with locked(target, replace(first, environment=environments([each.environment for each in manifests]))):
        states = [_bring(sources, target, name) for name in first.cells]
    return Merged(target, len(states), states.count("finished"), states.count("failed"), states.count("missing"))


def _bring(sources: Sequence[Path], target: Path, name: str) -> str:
    tables = {folder: table for folder in sources if (table := store.load(folder, name)) is not None}
    if tables:
        folder, kept = next(iter(tables.items()))
        if other := next((f for f, table in tables.items() if _numbers(table) != _numbers(kept)), None):
            text = f"cell {name} has other numbers in {other} than in {folder}: those of {folder} are taken"
            warnings.warn(text, RuntimeWarning, stacklevel=3)
        store.copy(folder, target, name, failed=False)
        return "finished"
    failed = next((folder for folder in sources if store.load_failure(folder, name) is not None), None)
    if failed is None:
        return "missing"
    store.copy(failed, target, name, failed=True)
    return "failed"


def _numbers(table: pa.Table) -> str:
    """All but the timings, every digit of it; NaN is NaN."""
    return repr({name: column for name, column in table.to_pydict().items() if not name.endswith("seconds")})

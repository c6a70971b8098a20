"""Manifest: study, settings, cells and environments of a folder of results, and the lock of who writes it."""

import json
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from ..errors import InputError
from ..paths import file_name, write
from . import store

NAME = "manifest.json"
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
    settings: Mapping[str, Any]
    cells: Mapping[str, Mapping[str, Any]]
    environment: Mapping[str, str]

    def save(self, folder: Path) -> None:
        """Write the manifest. If the cells are the same as before, each environment that computed them is named."""
        stored, used = json.loads(json.dumps(asdict(self), default=str)), [self.environment]  # tuples become lists
        with suppress(InputError):
            before = read(folder)
            if asdict(replace(before, environment=self.environment)) == stored:
                used = [before.environment, *used]
        stored["environment"] = environments(used)
        write(folder / NAME, json.dumps(stored, indent=1) + "\n")


def read(folder: Path) -> Manifest:
    """The manifest in a folder.

    Raises:
        InputError: none, a damaged one, or one whose names are no file names: they would lead out of the folder.
    """
    path = folder / NAME
    fields = store.content(path, _FIELDS)
    manifest = Manifest(**{name: fields[name] for name in _FIELDS})
    texts, cells = (*manifest.axes, *manifest.environment.values()), manifest.cells.values()
    if not (all(isinstance(text, str) for text in texts) and all(isinstance(params, dict) for params in cells)):
        raise store.damaged(path, "axes, cells or environment")
    file_name("study", manifest.study, f"Run the study again: {path} was not written by coopoc run.")
    if wrong := next((name for name in manifest.cells if not re.fullmatch("[0-9a-f]{20}", name)), None):
        raise store.damaged(path, f"{wrong[:60]!r} is no name of a cell")
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

"""The manifest of a folder, and who may work there: one run, or shards of one manifest at the same time."""

from __future__ import annotations

import fcntl
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO, Any

from ..errors import InputError
from .environment import environment
from .store import content, write
from .study import Cell, Study

Manifest = dict[str, Any]
NAME = "manifest.json"


def manifest(study: Study, cells: Sequence[Cell], workers: Iterable[Mapping[str, str]] = ()) -> Manifest:
    """What the folder of a study is, as it reads when it comes back from its file; `workers` are environments, too."""
    found: Manifest = {
        "study": study.name, "question": study.question, "axes": list(study.axes), "settings": dict(study.settings),
        "cells": [{"name": cell.name, "params": dict(cell.params)} for cell in cells],
        "environment": environments([environment(), *workers]),
    }  # fmt: skip
    return dict(json.loads(json.dumps(found, default=str)))


def read(folder: Path) -> Manifest:
    """The manifest in a folder; InputError if there is none, or if it is damaged."""
    return content(folder / NAME, f"holds no {NAME}", "Give a folder that coopoc run has made.")


@contextmanager
def held(folder: Path, mine: Manifest, shard: str = "") -> Iterator[None]:
    """Make the folder, write its manifest, and keep both for this process, or for shards of the same manifest.

    A second run would swap the manifest under the first. Who comes first writes it; whoever comes in while others are
    at work must bring the same. The locks go with the process, however that ends.

    Raises:
        InputError: another run or the same shard holds it, shards with another manifest do, or it cannot be written.
    """
    with ExitStack() as stack:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            door, place = (stack.enter_context((folder / name).open("a+")) for name in (".door", ".lock"))
            fcntl.flock(door, fcntl.LOCK_EX)  # nobody else comes in meanwhile; this takes milliseconds
            _enter(folder, mine, place, shard)
            if shard:
                own = stack.enter_context((folder / f".shard-{shard.replace('/', '-of-')}").open("a+"))
                if not _locked(own, fcntl.LOCK_EX):
                    raise _in_use(folder, f"another process with shard {shard}")
            fcntl.flock(door, fcntl.LOCK_UN)
        except OSError as error:
            allowed = f"cannot be written ({error.strerror})"
            raise InputError("out", str(folder), allowed, "Choose another --out.") from None
        yield


@contextmanager
def alone(folder: Path, waits: Callable[[], object]) -> Iterator[None]:
    """One process at a time: what shards share is made by the first and found by the others, who call `waits`."""
    with (folder / ".prepare").open("a+") as lock:
        if not _locked(lock, fcntl.LOCK_EX):
            waits()
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def different(one: Manifest, other: Manifest) -> list[str]:
    """In what two manifests differ, their environments apart.

    >>> different({"settings": {"runs": 4}}, {"settings": {"runs": 2}})
    ['runs (4, 2)']
    """
    found = []
    for field in dict.fromkeys((*one, *other)):
        a: Any = one.get(field)
        b: Any = other.get(field)
        if field == "settings":
            found += [f"{name} ({a.get(name)}, {b.get(name)})" for name in {**a, **b} if a.get(name) != b.get(name)]
        elif field == "cells" and a != b:
            same = len({cell["name"] for cell in a} & {cell["name"] for cell in b})
            found.append(f"cells ({len(a)} and {len(b)}, {same} of them the same)")
        elif field != "environment" and a != b:
            found.append(f"{field} ({a}, {b})")
    return found


def environments(found: Sequence[Mapping[str, str]]) -> dict[str, str]:
    """Each field once; where machines or versions differ, all of its values.

    >>> environments([{"python": "3.11"}, {"python": "3.12"}])
    {'python': '3.11; 3.12'}
    """
    fields = dict.fromkeys(name for each in found for name in each)
    values = {name: [v for each in found if name in each for v in each[name].split("; ")] for name in fields}
    return {name: "; ".join(dict.fromkeys(listed)) for name, listed in values.items()}


def _enter(folder: Path, mine: Manifest, place: IO[str], shard: str) -> None:
    if _locked(place, fcntl.LOCK_EX):
        for left in (*folder.glob(".*.part"), *folder.glob("*/.*.part")):  # by who was killed while writing
            left.unlink()
    else:
        if not (shard and _locked(place, fcntl.LOCK_SH)):
            raise _in_use(folder, "another run")
        if fields := different(mine, read(folder)):
            raise _in_use(folder, f"shards that differ in {', '.join(fields)}")
    _describe(folder, mine)
    if shard:
        fcntl.flock(place, fcntl.LOCK_SH)


def _describe(folder: Path, mine: Manifest) -> None:
    """Write the manifest. If the cells are the same as before, they may come from any environment that is named."""
    try:
        before = json.loads((folder / NAME).read_text())
    except (FileNotFoundError, ValueError):
        before = mine
    known = [mine["environment"]] if different(mine, before) else [before["environment"], mine["environment"]]
    write(folder / NAME, json.dumps({**mine, "environment": environments(known)}, indent=1) + "\n")


def _locked(file: IO[str], kind: int) -> bool:
    try:
        fcntl.flock(file, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _in_use(folder: Path, by: str) -> InputError:
    return InputError("out", str(folder), f"is in use by {by}", "Wait until it ends, or choose another --out.")

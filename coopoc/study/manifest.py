"""Manifest: the study, the settings, the cells and the environments that a folder of results stands on."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..file_names import file_name
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

    def as_stored(self) -> Manifest:
        """The manifest as it comes back from its file, where a tuple has become a list."""
        return Manifest(**json.loads(json.dumps(asdict(self), default=str)))

    def save(self, folder: Path) -> None:
        """Write the manifest. If the cells are the same as before, each environment that computed them is named."""
        try:
            before = read(folder)
            known = [self.environment] if different(self, before) else [before.environment, self.environment]
        except InputError:
            known = [self.environment]
        found = replace(self, environment=environments(known))
        store.write(folder / NAME, json.dumps(asdict(found), indent=1, default=str) + "\n")


def read(folder: Path) -> Manifest:
    """The manifest in a folder.

    Raises:
        InputError: none, a damaged one, or one whose names are no file names: they would lead out of the folder.
    """
    path = folder / NAME
    given = store.content(path, _FIELDS, f"holds no {NAME}", "Give a folder that coopoc run has made.")
    found = Manifest(**{name: given[name] for name in _FIELDS})
    texts = [*found.axes, *found.environment.values()]
    if not all(isinstance(text, str) for text in texts) or not all(isinstance(p, dict) for p in found.cells.values()):
        raise store.damaged(path, "axes, cells or environment")
    file_name("study", found.study, f"Run the study again: {path} was not written by coopoc run.")
    if wrong := next((name for name in found.cells if not re.fullmatch("[0-9a-f]{20}", name)), None):
        raise store.damaged(path, f"{wrong[:60]!r} is no name of a cell")
    return found


def different(one: Manifest, other: Manifest) -> list[str]:
    """Differences between two manifests, their environments apart.

    >>> one = Manifest("demo", "?", [], {"runs": 4}, {}, {})
    >>> different(one, replace(one, settings={"runs": 2}))
    ['runs (4, 2)']
    """
    a, b = one.settings, other.settings
    found = [f"{name} ({a.get(name)}, {b.get(name)})" for name in {**a, **b} if a.get(name) != b.get(name)]
    if one.cells != other.cells:
        same = len(one.cells.keys() & other.cells.keys())
        found.append(f"cells ({len(one.cells)} and {len(other.cells)}, {same} of them the same)")
    pairs = [(field, getattr(one, field), getattr(other, field)) for field in ("study", "question", "axes")]
    return found + [f"{field} ({x}, {y})" for field, x, y in pairs if x != y]


def environments(found: Sequence[Mapping[str, str]]) -> dict[str, str]:
    """Each field once; where machines or versions differ, all of its values.

    >>> environments([{"python": "3.11"}, {"python": "3.12"}])
    {'python': '3.11; 3.12'}
    """
    fields = dict.fromkeys(name for each in found for name in each)
    values = {name: [v for each in found if name in each for v in each[name].split("; ")] for name in fields}
    return {name: "; ".join(dict.fromkeys(listed)) for name, listed in values.items()}

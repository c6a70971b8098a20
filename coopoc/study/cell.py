"""Cell: one point of a study's grid, named by the hash of everything that changes its numbers."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from ..errors import InputError

Scalar: TypeAlias = str | int | float | bool | None
Params: TypeAlias = Mapping[str, Any]
Row: TypeAlias = dict[str, Any]


@dataclass(frozen=True)
class Cell:
    """One point of the grid.

    Args:
        params: its own parameters.
        given: its own parameters and the settings of the study.
        name: `digest` of everything that changes the numbers.
    """

    params: Mapping[str, Scalar]
    given: Params
    name: str


def digest(content: Any) -> str:
    """First 20 hex digits of the SHA-256 of canonical JSON: the same content has the same name on every machine.

    >>> digest({"a": 1, "b": [0.5]}) == digest({"b": (0.5,), "a": np.int64(1)})
    True
    """
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), default=_plain)
    return hashlib.sha256(text.encode()).hexdigest()[:20]


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise InputError("settings", repr(value), "must be numbers, words, or lists of them", "Pass a name, not an object.")

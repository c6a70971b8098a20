"""Cell: one point of a study's grid, named by a hash of all that changes its numbers; values as --set gives them."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..errors import InputError

Scalar = str | int | float | bool | None
Params = Mapping[str, Any]
Row = dict[str, Any]


class Cell(NamedTuple):
    """One point of the grid.

    Attributes:
        params: its own parameters.
        settings: its own parameters and the settings of the study.
        name: `digest` of everything that changes the numbers.
    """

    params: Mapping[str, Scalar]
    settings: Params
    name: str


def digest(content: Any) -> str:
    """First 20 hex digits of the SHA-256 of canonical JSON: the same content has the same name on every machine.

    >>> digest({"a": 1, "b": [0.5]}) == digest({"b": (0.5,), "a": np.int64(1)})
    True
    """

    def plain(value: Any) -> Any:
        if isinstance(value, np.generic | np.ndarray):
            return value.tolist()
        hint = "Pass a name, not an object."
        raise InputError("settings", repr(value), "must be numbers, words, or lists of them", hint)

    text = json.dumps(content, sort_keys=True, separators=(",", ":"), default=plain)
    return hashlib.sha256(text.encode()).hexdigest()[:20]


_BOOLS = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}


def assignments(texts: Sequence[str]) -> Mapping[str, str]:
    """["runs=100", "data=town10"] -> {"runs": "100", "data": "town10"}.

    Raises:
        InputError: no "=", or one name twice.

    >>> assignments(["runs=100"])
    {'runs': '100'}
    """
    pairs = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not name:
            raise InputError("--set", repr(text), "must be key=value", "Write for example: --set runs=100.")
        if name in pairs:
            raise InputError("--set", repr(text), f"gives {name} twice", "Give it once.")
        pairs[name] = value
    return pairs


def entries(value: Any) -> Sequence[Any]:
    """Entries of a list; a text is split at commas, anything else is one.

    >>> entries("0,3"), entries(4)
    (['0', '3'], [4])
    """
    if isinstance(value, str):
        return value.split(",")
    return value if isinstance(value, list | tuple) else [value]


def parse(name: str, value: Any, default: Any) -> Any:
    """`value` as the type of `default`: text is read, numbers are checked; a tuple is split at commas, and a list of
    words for one word is joined by "+".

    Raises:
        InputError: it cannot be read as that type.

    >>> parse("runs", "100", 30), parse("egos", "0,3", (0,)), parse("data", "town10", "town04")
    (100, (0, 3), 'town10')
    """
    if isinstance(default, list | tuple):
        return tuple(parse(name, v, default[0] if default else None) for v in entries(value) if v != "")
    if default is None:
        return None if value is None or str(value).lower() == "none" else _guess(value)
    kind = type(default)
    if kind is str and isinstance(value, list | tuple):
        return "+".join(map(str, value))
    try:
        if kind is bool:
            return _BOOLS[str(value).lower()]
        if isinstance(value, bool) or (kind is int and isinstance(value, float) and value % 1):
            raise ValueError
        return kind(value)
    except (ValueError, KeyError, TypeError, OverflowError):
        words = {int: "a whole number", float: "a number", bool: "true or false"}.get(kind, kind.__name__)
        raise InputError(name, repr(value), f"must be {words}", f"The default is {default!r}.") from None


def _guess(value: Any) -> Any:
    for kind in (int, float):
        try:
            return kind(value) if isinstance(value, str) else value
        except ValueError:
            continue
    return value

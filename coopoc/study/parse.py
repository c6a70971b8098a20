"""Read the text of --set key=value as the type of the default that it replaces."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ..errors import InputError

_BOOLS = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}


def assignments(texts: Sequence[str]) -> Mapping[str, str]:
    """["runs=100", "data=town10"] -> {"runs": "100", "data": "town10"}.

    Raises:
        InputError: no "=", or one name twice.

    >>> assignments(["runs=100"])
    {'runs': '100'}
    """
    pairs: dict[str, str] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not name:
            raise InputError("--set", repr(text), "must be key=value", "Write for example: --set runs=100.")
        if name in pairs:
            raise InputError("--set", repr(text), f"gives {name} twice", "Give it once.")
        pairs[name] = value
    return pairs


def parse(name: str, value: Any, default: Any) -> Any:
    """`value` as the type of `default`: text is read, numbers are checked; a tuple is split at commas, and a list of
    words for one word is joined by "+".

    Raises:
        InputError: it cannot be read as that type.

    >>> parse("runs", "100", 30), parse("egos", "0,3", (0,)), parse("data", "town10", "town04")
    (100, (0, 3), 'town10')
    """
    if isinstance(default, list | tuple):
        items = value.split(",") if isinstance(value, str) else value if isinstance(value, list | tuple) else [value]
        return tuple(parse(name, v, default[0] if default else None) for v in items if v != "")
    if value is None or default is None:
        return None if value is None or str(value).lower() == "none" else _guess(value)
    kind = type(default)
    if kind is str and isinstance(value, list | tuple):
        return "+".join(map(str, value))
    try:
        if kind is bool:
            return _BOOLS[str(value).lower()]
        if kind is int and isinstance(value, float):
            return _whole(value)
        return kind(value)
    except (ValueError, KeyError, TypeError, OverflowError):
        words = {int: "a whole number", float: "a number", bool: "true or false"}.get(kind, kind.__name__)
        raise InputError(name, repr(value), f"must be {words}", f"The default is {default!r}.") from None


def _whole(value: float) -> int:
    if value != int(value):
        raise ValueError(value)
    return int(value)


def _guess(value: Any) -> Any:
    for kind in (int, float):
        try:
            return kind(value) if isinstance(value, str) else value
        except ValueError:
            continue
    return value

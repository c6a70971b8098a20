"""A data set and how to read it in one word: "drive.csv?dt=0.1&max_gap=2&columns=t:time,id:car"."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from coopoc.errors import InputError

NUMBERS = ("dt", "max_gap", "vehicle_length")
FLAGS = ("any_scale",)


def split(name_or_path: str | Path) -> tuple[str, dict[str, Any]]:
    """Name or path, and the reader's options behind a question mark, which every command with --data takes.

    A path that exists is never split. dt, max_gap and vehicle_length are numbers, vehicles a whole number, any_scale is
    true or false, columns is a list of name:header, and any other option is text.

    Raises:
        InputError: an option without a value, twice, or with a value of another kind.

    >>> split("drive.csv?dt=0.1&columns=t:time,id:car")
    ('drive.csv', {'dt': 0.1, 'columns': {'t': 'time', 'id': 'car'}})
    """
    text = str(name_or_path)
    name, mark, query = text.partition("?")
    if not mark or Path(text).exists():
        return text, {}
    options: dict[str, Any] = {}
    for part in query.split("&"):
        key, equals, value = part.partition("=")
        if not (key and equals and value) or key in options:
            hint = 'Write NAME?option=value&option=value, such as "drive.csv?dt=0.1".'
            raise InputError("data", repr(text), "must give each option behind ? one value", hint)
        options[key] = _value(key, value)
    return name, options


def joined(name_or_path: str | Path, options: Mapping[str, Any]) -> str:
    """The word that `split` takes apart.

    >>> joined("drive.csv", {"dt": 0.1, "columns": {"t": "time"}, "max_gap": None})
    'drive.csv?dt=0.1&columns=t:time'
    """
    words = []
    for key, value in options.items():
        if isinstance(value, Mapping):
            words.append(f"{key}={','.join(f'{name}:{header}' for name, header in value.items())}")
        elif value is not None:
            words.append(f"{key}={value}")
    return f"{name_or_path}?{'&'.join(words)}" if words else str(name_or_path)


def _value(key: str, value: str) -> Any:
    if key == "columns":
        pairs = [pair.partition(":") for pair in value.split(",")]
        if not all(name and colon and header for name, colon, header in pairs):
            hint = "Write columns=t:time,id:car, the name here and the header in the file."
            raise InputError(key, repr(value), "must be name:header pairs", hint)
        return {name.strip(): header.strip() for name, _, header in pairs}
    if key in FLAGS:
        if value.lower() not in ("true", "false"):
            raise InputError(key, repr(value), "must be true or false", f"Write {key}=true.")
        return value.lower() == "true"
    if key in NUMBERS or key == "vehicles":
        try:
            return int(value) if key == "vehicles" else float(value)
        except ValueError:
            kind = "a whole number" if key == "vehicles" else "a number of SI units"
            raise InputError(key, repr(value), f"must be {kind}", f"Write {key}=0.1 or the like.") from None
    return value

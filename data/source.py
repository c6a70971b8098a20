"""A data set and how to read it in one word: "drive.csv?dt=0.1&max_gap=2&columns=t:time,id:car"."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from coopoc.errors import InputError
from coopoc.file_names import given_path


def split(name_or_path: str | Path) -> tuple[str, dict[str, Any]]:
    """Name or path, and the reader's options behind a question mark, which every command with --data takes.

    A path that exists is never split. READ has the options that are more than text.

    Raises:
        InputError: an option without a value, twice, or with a value of another kind.

    >>> split("drive.csv?dt=0.1&columns=t:time,id:car")
    ('drive.csv', {'dt': 0.1, 'columns': {'t': 'time', 'id': 'car'}})
    """
    text = name_or_path if isinstance(name_or_path, str) else str(given_path(name_or_path))
    name, mark, query = text.partition("?")
    given_path(name)
    if not mark or _exists(text):
        return text, {}
    options: dict[str, Any] = {}
    for part in query.split("&"):
        key, equals, value = part.partition("=")
        if not (key and equals and value) or key in options:
            hint = 'Write NAME?option=value&option=value, such as "drive.csv?dt=0.1".'
            raise InputError("data", repr(text), "must give each option behind ? one value", hint)
        options[key] = _value(key, value)
    return name, options


def _exists(text: str) -> bool:
    try:
        return given_path(text).exists()
    except InputError:  # options may be longer than the name of a file
        return False


def _value(key: str, value: str) -> Any:
    read, allowed, example = READ.get(key, (str, "", ""))
    try:
        return read(value)
    except ValueError:
        raise InputError(key, repr(value), f"must be {allowed}", f"Write {key}={example}.") from None


def _pairs(text: str) -> dict[str, str]:
    pairs = [pair.partition(":") for pair in text.split(",")]
    if not all(name and colon and other for name, colon, other in pairs):
        raise ValueError
    return {name.strip(): other.strip() for name, _, other in pairs}


def _seconds(text: str) -> dict[str, float]:
    return {name: float(value) for name, value in _pairs(text).items()}


def _flag(text: str) -> bool:
    if text.lower() not in ("true", "false"):
        raise ValueError
    return text.lower() == "true"


def _list(text: str) -> tuple[str, ...]:
    return tuple(word.strip() for word in text.split(","))


def _place(text: str) -> tuple[float, float, float]:
    latitude, longitude, height = map(float, text.split(","))
    return latitude, longitude, height


SI = (float, "a number of SI units", "0.1")
READ: Mapping[str, tuple[Callable[[str], Any], str, str]] = {
    "dt": SI,
    "max_gap": SI,
    "since": SI,
    "until": SI,
    "vehicle_length": SI,
    "vehicles": (int, "a whole number", "4"),
    "any_scale": (_flag, "true or false", "true"),
    "columns": (_pairs, "name:header pairs, the name here and the header in the file", "t:time,id:car"),
    "kinds": (_pairs, "word:kind pairs, the word in the file and the kind here", "uwb:range"),
    "clock": (_seconds, "vehicle:seconds pairs", "blue:0.35"),
    "ignore": (_list, "words between commas", "imu,lidar"),
    "origin": (_place, "latitude, longitude and height", "48.14,11.58,520"),
}
"""Option -> what makes its value of a text, what is allowed, an example; others stay text."""

"""Parse a data set's name with options and its part: "drive.csv?dt=0.1&columns=t:time,id:car&since=300"."""

import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, TypeVar, cast
from urllib.parse import unquote

import numpy as np

from coopoc import Fleet, InputError, Recording
from coopoc.errors import suggestion
from coopoc.paths import given_path
from coopoc.plugins import in_file, names

from .fetch import bring, local

Function = TypeVar("Function", bound=Callable[..., Any])
Drive = TypeVar("Drive", Fleet, Recording)
STEP_ROUNDING = 1e-9
"""Share of a step by which a time may miss one."""


def split(name_or_path: str | Path) -> tuple[str, dict[str, Any]]:
    """Name or path, and the reader's options behind a question mark, which every command with --data takes.

    A path that exists is never split. A public data set that has been fetched is its path. READ has the options that
    are more than text.

    Raises:
        InputError: an option without a value, a name that has two, a value of another kind, a data set that is to be
            fetched.

    >>> split("drive.csv?dt=0.1&columns=t:time,id:car")
    ('drive.csv', {'dt': 0.1, 'columns': {'t': 'time', 'id': 'car'}})
    """
    text = os.path.expanduser(name_or_path if isinstance(name_or_path, str) else given_path(name_or_path))
    name, mark, query = text.partition("?")
    given_path(name)
    if os.path.exists(text):
        return text, {}
    name = name if os.path.exists(name) else str(local(name) or name)
    if not mark:
        return name, {}
    texts: dict[str, str] = {}
    for part in query.split("&"):
        key, equals, value = part.partition("=")
        texts[key] = f"{texts[key]},{value}" if key in texts else value
        if not (key and equals and value):
            raise InputError(
                "data",
                repr(text),
                "must give each option behind ? one value",
                'Write NAME?option=value&option=value, such as "drive.csv?dt=0.1".',
            )
    options = {}
    for key, value in texts.items():
        read, allowed, example = READ.get(key, (str, "", ""))
        try:
            options[key] = read(value)
        except ValueError:
            raise InputError(
                key,
                repr(value),
                f"must be {allowed}",
                f"Write {key}={example}; of a name a comma as %2C, a colon as %3A, & as %26.",
            ) from None
    return name, options


def while_unchanged(made: Function) -> Function:
    """lru_cache for a function whose first argument names data, until its files change."""
    stored = lru_cache(3)(lambda files, *given: made(*given))

    def current(data: str, *given: Any) -> Any:
        name = split(data)[0]
        paths = Path(name.rpartition(":")[0]), Path(name), *Path(name).rglob("*")
        files = [(path.absolute(), path.stat().st_ctime_ns) for path in paths if path.is_file()]
        return stored(str(files), data, *given)

    return cast("Function", current)


def there(name: str) -> None:
    """InputError for what is neither the name of a data set nor a path."""
    registered = names("coopoc.datasets")
    if not (in_file(name) or name in registered or Path(name).exists()):
        hint = bring(name, "List all data sets with coopoc data list, or check the path.")
        raise InputError(
            "data",
            repr(name),
            f"must be one of {', '.join(registered)} or the path of a file or folder",
            suggestion(name, registered, hint),
        )


def parted(data: Drive, since: float | None = None, until: float | None = None) -> Drive:
    """The part of a Fleet or a Recording from `since` to before `until` s after its first step; of a Recording a note
    names it. Without both it is the whole.

    Raises:
        InputError: fewer than two steps.
    """
    if since is None and until is None:
        return data
    begin, end, t = since or 0.0, np.inf if until is None else until, data.t
    first, last = np.searchsorted(t - t[0], np.array([begin, end]) - STEP_ROUNDING * (t[1] - t[0])).tolist()
    if not (last - first >= 2 and 0 <= begin < end):
        actual, length = f"since {begin:g} s until {end:g} s", f"{t[-1] - t[0]:g} s"
        raise InputError(
            "since, until", actual, f"must leave two steps of the {length}", "Count from the first step, 0 s."
        )
    part: Drive = data.between(first, last)
    if isinstance(part, Recording):
        return replace(
            part, notes=(*part.notes, f"from {begin:g} s on" if until is None else f"from {begin:g} s to {end:g} s")
        )
    return part


def pairs(text: str, value: Callable[[str], Any] = str) -> dict[str, Any]:
    """Names and values, as "t:time,id:car", a comma of a name as %2C; ValueError for anything else, or a name twice."""
    made = [[unquote(word.strip()) for word in pair.partition(":")] for pair in text.split(",")]
    if not all(map(all, made)) or len({name for name, *_ in made}) < len(made):
        raise ValueError(text)
    return {name: value(word) for name, _, word in made}


def _place(text: str) -> tuple[float, float, float]:
    x, y, z = map(float, text.replace("/", ",").split(","))
    return x, y, z


TRUE = "false", "true"
"""Words for False and True."""
READ: Mapping[str, tuple[Callable[[str], Any], str, str]] = {
    **dict.fromkeys(("dt", "max_gap", "since", "until", "vehicle_length"), (float, "a number of SI units", "0.1")),
    **dict.fromkeys(("any_scale", "mutual"), (lambda text: bool(TRUE.index(text.lower())), "true or false", "true")),
    "columns": (pairs, "name:header pairs, the name here and the header in the file", "t:time,id:car"),
    "kinds": (pairs, "word:kind pairs, the word in the file and the kind here", "uwb:range"),
    **dict.fromkeys(
        ("scale", "std", "offset"),
        (partial(pairs, value=float), "name:number pairs, each name once", "range:0.001,t:1e-3"),
    ),
    **dict.fromkeys(
        ("antenna", "tag"),
        (
            lambda text: pairs(text, _place) if ":" in text else _place(text),
            "metres forward/left/up, or vehicle:forward/left/up pairs",
            "car1:1.2/0.3/0",
        ),
    ),
    "clock": (partial(pairs, value=float), "vehicle:seconds pairs, each vehicle once", "blue:0.35"),
    "ignore": (lambda text: tuple(map(str.strip, text.split(","))), "words between commas", "imu,lidar"),
    "origin": (_place, "latitude, longitude and height", "48.14,11.58,520"),
}
"""Option -> what makes its value of a text, what is allowed, an example; others stay text."""

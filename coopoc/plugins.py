"""Entry points: how the core meets datasets, methods, studies, backends and commands that it never imports."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from importlib import metadata
from typing import Any

from .errors import InputError
from .one_file import from_file, in_file

GROUPS = {"coopoc.datasets": "data set", "coopoc.methods": "method", "coopoc.studies": "study",
          "coopoc.backends": "backend", "coopoc.recipes": "recipe", "coopoc.nets": "net",
          "coopoc.commands": "command"}  # fmt: skip
"""Group -> what one of its names is called."""


def points(group: str) -> Mapping[str, metadata.EntryPoint]:
    """Entry points of a group by name, none of them loaded; InputError if two distributions claim one name.

    They are made anew as Python's own: once the backport importlib_metadata is imported, as Dask does, Python's finder
    gives entry points of a class of its own.
    """
    found: dict[str, metadata.EntryPoint] = {}
    for point in sorted(metadata.entry_points(group=group), key=lambda p: p.name):
        other = found.setdefault(point.name, metadata.EntryPoint(point.name, point.value, point.group))
        if other.value != point.value:
            claims = f"is claimed by {other.value} and {point.value}"
            raise InputError(group, repr(point.name), claims, "Uninstall one of the two.")
    return found


def names(group: str) -> tuple[str, ...]:
    """All names in a group. An entry point that holds a mapping stands for the names in it.

    >>> isinstance(names("coopoc.methods"), tuple)
    True
    """
    return tuple(sorted(n for name, point in points(group).items() for n in _members(point) or [name]))


def find(group: str, name: str) -> Any:
    """The object registered under `name`, loaded now; its library is imported only here.

    Args:
        group: one of GROUPS, or a third party's own.
        name: an entry point, a key of an entry point that holds a mapping, or "folder/mine.py:NAME", a name in a file.

    Raises:
        InputError: no such name (lists the names and the nearest one), or two distributions claim it.

    >>> find("nothing", "x")
    Traceback (most recent call last):
    ...
    coopoc.errors.InputError: nothing = 'x': must be one of (there is none). There is none to use.
    """
    if in_file(name):
        return from_file(name, GROUPS.get(group, group))
    registered = points(group)
    loaded = registered[name].load() if name in registered else None
    if loaded is not None and not isinstance(loaded, Mapping):
        return loaded
    for point in registered.values():
        members = _members(point)
        if name in members:
            return members[name]
    raise unknown(GROUPS.get(group, group), name, names(group))


def _members(point: metadata.EntryPoint) -> Mapping[str, Any]:
    """What an entry point that holds a mapping stands for. One that cannot be loaded keeps its own name, and says why
    when somebody asks for it."""
    try:
        loaded = point.load()
    except Exception:
        return {}
    return loaded if isinstance(loaded, Mapping) else {}


def unknown(noun: str, name: str, known: Iterable[str]) -> InputError:
    """The error for a name that is not registered: lists what is, and proposes the nearest.

    >>> print(unknown("method", "kalmann", ["gnss", "kalman"]))
    method = 'kalmann': must be one of gnss, kalman. Did you mean kalman?
    """
    known = list(known)
    near = difflib.get_close_matches(name, known, n=1)
    listed = noun in GROUPS.values()
    other = "List all with: coopoc list." if listed else "Use one of these names." if known else "There is none to use."
    mend = f"Did you mean {near[0]}?" if near else other
    return InputError(noun, repr(name), "must be one of " + (", ".join(known) or "(there is none)"), mend)

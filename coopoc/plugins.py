"""Entry points: how the core meets datasets, methods, studies, backends and commands that it never imports."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from importlib import metadata
from typing import Any

from .errors import InputError

GROUPS = ("coopoc.datasets", "coopoc.methods", "coopoc.studies", "coopoc.backends", "coopoc.commands")


def names(group: str) -> tuple[str, ...]:
    """Sorted names that installed distributions register under a group.

    >>> isinstance(names("coopoc.methods"), tuple)
    True
    """
    return tuple(sorted({point.name for point in metadata.entry_points(group=group)}))


def find(group: str, name: str) -> Any:
    """The object registered under `name`, loaded now; its library is imported only here.

    Args:
        group: one of GROUPS, or a third party's own.
        name: as in `names(group)`.

    Raises:
        InputError: no such name (lists the names and the nearest one), or two distributions claim it.

    >>> find("coopoc.studies", "no such study")
    Traceback (most recent call last):
    ...
    coopoc.errors.InputError: study = 'no such study': ...
    """
    points = {point.value: point for point in metadata.entry_points(group=group, name=name)}
    if len(points) == 1:
        return next(iter(points.values())).load()
    noun = group.rpartition(".")[2].removesuffix("s")
    if points:
        raise InputError(noun, repr(name), f"is claimed by {sorted(points)}", "Uninstall all but one of them.")
    raise unknown(noun, name, names(group))


def unknown(noun: str, name: str, known: Iterable[str]) -> InputError:
    """The error for a name that is not registered: lists what is, and proposes the nearest.

    >>> print(unknown("method", "kalmann", ["gnss", "kalman"]))
    method = 'kalmann': must be one of gnss, kalman. Did you mean kalman?
    """
    known = list(known)
    near = difflib.get_close_matches(name, known, n=1)
    mend = f"Did you mean {near[0]}?" if near else "List all with: coopoc list."
    return InputError(noun, repr(name), "must be one of " + (", ".join(known) or "(none is installed)"), mend)

"""A part of a data set by time: "mylog?since=300", "mylog?until=300"."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from coopoc.arrays import Floats
from coopoc.errors import InputError
from coopoc.world.fleet import Fleet
from coopoc.world.recording import Recording

ROUNDING = 1e-9
"""Share of a step by which a time may miss one."""


def steps(t: Floats, since: float = 0.0, until: float = np.inf) -> tuple[int, int]:
    """First step and last + 1 of those that are at least `since` and less than `until` s after the first one.

    Raises:
        InputError: fewer than two steps.

    >>> steps(np.array([7.0, 7.5, 8.0, 8.5]), until=1.0)
    (0, 2)
    """
    first, last = np.searchsorted(t - t[0], np.array([since, until]) - ROUNDING * (t[1] - t[0]))
    if not last - first >= 2:
        given, length = f"since {since:g} s until {until:g} s", f"{t[-1] - t[0]:g} s"
        raise InputError("since, until", given, f"must leave two steps of the {length}", "Count from the first step.")
    return int(first), int(last)


def parted(data: Any, since: float | None = None, until: float | None = None) -> Any:
    """The part of a Fleet or a Recording from `since` to `until` s after its first step; of a Recording a note names
    it. Without both it is the whole."""
    if since is None and until is None:
        return data
    begin, end = since or 0.0, np.inf if until is None else until
    part: Fleet | Recording = data.between(*steps(data.t, begin, end))
    if isinstance(part, Recording):
        note = f"from {begin:g} s on" if until is None else f"from {begin:g} s to {end:g} s"
        return replace(part, notes=(*part.notes, note))
    return part

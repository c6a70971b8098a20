"""Metrics by name: a number for each run and ego, one file or entry point each."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from ..arrays import Floats, checked
from ..methods.track import Track
from ..plugins import find
from ..world.fleet import Fleet
from .metrics import max_error, nees, rt_le


def mean_nees(track: Track, fleet: Fleet) -> Floats:
    """Mean over time of the normalised estimation error squared, (R, E); 3 for a consistent filter."""
    return np.asarray(np.nanmean(nees(track, fleet), axis=1))


METRICS: Mapping[str, Callable[[Track, Fleet], Floats]] = {
    "rt_le_m": rt_le,
    "max_error_m": max_error,
    "nees": mean_nees,
}
"""Column of a table -> function of a Track and its Fleet; a unit that is not SI stands in the name."""


def measure(name: str, track: Track, fleet: Fleet) -> Floats:
    """One metric of a track, (R, E).

    Args:
        name: one of METRICS, an entry point in `coopoc.metrics`, or "mine.py:NAME", a function of Track and Fleet.
        track: the estimates.
        fleet: the truth.

    Raises:
        InputError: an unknown name, another shape than (R, E), or an error of the metric itself.

    >>> from coopoc import GNSS, Sensors, observe
    >>> fleet = Fleet(("a",), [0, 0.1], np.zeros((2, 1, 3)), np.zeros((2, 1, 3)))
    >>> measure("rt_le_m", GNSS()(observe(fleet, Sensors(), runs=5)), fleet).shape
    (5, 1)
    """
    return checked(name, find("coopoc.metrics", name)(track, fleet), "(R, E)", (len(track.x), len(track.egos)))

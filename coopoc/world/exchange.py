"""Exchange: which vehicles of the whole fleet are in contact at each step, and which of their messages arrive."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import Ints
from ..errors import InputError
from .recording import Recording


@dataclass(frozen=True, eq=False)
class Exchange:
    """Pairs of vehicles in contact, sorted by step.

    Two vehicles are in contact at a step if at least one measures the other.

    Args:
        step: (P,) of the pair.
        first: (P,) column, less than `second`.
        second: (P,) column.
        start: (T+1,) start[t]:start[t+1] are the pairs of step t.
        link: (P,) link of the Recording by which `first` measures `second`, -1 for none.
        link_back: (P,) link by which `second` measures `first`, -1 for none.
        arrival: (R, P) step at which the first message of the two ways arrives, -1 for never.
    """

    step: Ints
    first: Ints
    second: Ints
    start: Ints
    link: Ints
    link_back: Ints
    arrival: Ints


def exchange(recording: Recording) -> Exchange:
    """Contacts of all vehicles.

    Args:
        recording: observed by all vehicles.

    Raises:
        InputError: the links of some vehicles were not recorded.

    >>> from coopoc import Fleet, Sensors, V2X, observe
    >>> fleet = Fleet(("a", "b"), [0, 0.1], np.zeros((2, 2, 3)) + [[[0, 0, 0], [9, 0, 0]]], np.zeros((2, 2, 3)))
    >>> exchange(observe(fleet, Sensors(), V2X())).arrival
    array([[0, 1]])
    """
    silent = sorted(set(range(len(recording.ids))) - set(recording.observers))
    if silent:
        raise InputError(
            "observers",
            f"without {[recording.ids[c] for c in silent[:4]]}",
            "must be all vehicles here",
            "Leave observe(..., observers=...) at its default.",
        )
    step, first, second, link, back = _pairs(recording)
    ways = np.stack([np.where(way >= 0, recording.arrival[:, way], -1) for way in (link, back)])
    ways[ways - step > recording.v2x.max_age / recording.dt + 1e-9] = -1
    arrival = np.where(ways.min(axis=0) < 0, ways.max(axis=0), ways.min(axis=0))
    start = np.searchsorted(step, np.arange(len(recording.t) + 1))
    return Exchange(step, first, second, start, link, back, arrival)


def _pairs(recording: Recording) -> tuple[Ints, Ints, Ints, Ints, Ints]:
    """Step, columns and the two links of each pair, sorted by step, then columns."""
    links, vehicles = recording.links, len(recording.ids)
    forward = links.observer < links.neighbour
    first = np.where(forward, links.observer, links.neighbour)
    second = np.where(forward, links.neighbour, links.observer)
    key, pair = np.unique((links.step * vehicles + first) * vehicles + second, return_inverse=True)
    link, back = np.full((2, len(key)), -1, dtype=np.int64)
    link[pair[forward]] = np.flatnonzero(forward)
    back[pair[~forward]] = np.flatnonzero(~forward)
    return key // vehicles**2, key // vehicles % vehicles, key % vehicles, link, back

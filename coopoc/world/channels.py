"""Channels by name: presets of V2X, one file or entry point each."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from ..errors import InputError
from ..plugins import find
from .v2x import V2X

CHANNELS: Mapping[str, Callable[[int], V2X]] = {"ideal": V2X.ideal, "cam": V2X.cam, "bsm": V2X.bsm, "cpm": V2X.cpm}
"""Largest number of neighbours -> V2X. "ideal" counts payload only."""


def channel(name: str, max_neighbours: int = 6) -> V2X:
    """The channel of a name.

    Args:
        name: one of CHANNELS, an entry point in `coopoc.channels`, or "mine.py:NAME", a function of the number K.
        max_neighbours: K.

    Raises:
        InputError: an unknown name, or a function that returns no V2X.

    >>> channel("bsm", 4).rate
    10.0
    """
    found = find("coopoc.channels", name)(max_neighbours)
    if not isinstance(found, V2X):
        raise InputError(
            "channel", name, f"returned {type(found).__name__}, no V2X", "Return V2X(max_neighbours, ...)."
        )
    return found

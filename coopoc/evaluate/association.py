"""Which pose of an estimate belongs to which of the truth."""

from __future__ import annotations

import numpy as np

from ..arrays import Floats, Ints, checked, number
from ..errors import InputError


def associated(estimate: Floats, truth: Floats, max_diff: float = 0.01, offset: float = 0.0) -> tuple[Ints, Ints]:
    """Indices (n,), (n,) of stamps that belong together: for each of the shorter list the nearest of the longer.

    Args:
        estimate: (M,) s, increasing.
        truth: (K,) s, increasing.
        max_diff: s, stamps further apart than this belong to nothing.
        offset: s, added to the estimate's stamps.

    Raises:
        InputError: no stamps belong together.

    Source: the association of evo (`sync.associate_trajectories`), which gives the same pairs.

    >>> associated(np.array([0.0, 0.1, 0.2]), np.array([0.101, 0.2]))
    (array([1, 2]), array([0, 1]))
    """
    x, y = checked("estimate", estimate, "(M,)", (-1,)), checked("truth", truth, "(K,)", (-1,))
    max_diff, x = number("max_diff", max_diff), x + number("offset", offset, -np.inf)
    swap = len(x) > len(y)
    short, long = (y, x) if swap else (x, y)
    after = (
        np.clip(np.searchsorted(long, short), 1, max(len(long) - 1, 1)) if len(long) > 1 else np.zeros(len(short), int)
    )
    before = np.maximum(after - 1, 0)
    nearest = (
        np.where(np.abs(long[before] - short) <= np.abs(long[after] - short), before, after) if len(long) else after
    )
    kept = np.flatnonzero(np.abs(long[nearest] - short) <= max_diff) if len(long) else np.zeros(0, int)
    if not len(kept):
        spans = f"{span(x)} and {span(y)}"
        hint = "Check the unit of the stamps, the clocks (offset) and the rates (max_diff)."
        raise InputError("stamps", spans, f"must agree within {max_diff:g} s somewhere", hint)
    pair = (kept.astype(np.int64), nearest[kept].astype(np.int64))
    return (pair[1], pair[0]) if swap else pair


def span(t: Floats) -> str:
    """First and last stamp with all their digits.

    >>> span(np.array([0.1, 1311868230.5]))
    '0.1..1311868230.5 s'
    """
    return f"{t[0].item()!r}..{t[-1].item()!r} s" if len(t) else "no stamps"

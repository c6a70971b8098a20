"""The token bucket of one receiver that takes the nearest first: `coopoc.world.schedules.within_cap` in one pass."""

from __future__ import annotations

import numpy as np

from ..arrays import AnyArray, Ints
from .compiling.compile import as_written


@as_written
def nearest_first(arrival: AnyArray, size: AnyArray, start: AnyArray, fill: float, depth: float) -> Ints:
    """Arrivals (R, M), -1 for rejected messages. One that does not fit never will in this step: tokens only go.

    Args:
        arrival: as in `within_cap`.
        size: as in `within_cap`.
        start: as in `within_cap`.
        fill: bytes a step.
        depth: bytes, also at first.
    """
    accepted, tokens, last = np.full(arrival.shape, -1, np.int64), np.full(len(arrival), depth), 0
    for t in range(len(start) - 1):
        now = -1
        for run in range(len(arrival)):
            for link in range(start[t], start[t + 1]):
                now = max(now, arrival[run, link])
        if now < 0:
            continue
        for run in range(len(arrival)):
            tokens[run] = min(tokens[run] + fill * (now - last), depth)
            for link in range(start[t], start[t + 1]):
                if arrival[run, link] >= 0 and size[link] <= tokens[run] + 1e-9:
                    accepted[run, link] = arrival[run, link]
                    tokens[run] -= size[link]
        last = now
    return accepted

"""The choice among starts: a few steps from each, cheapest first, and the lowest goes on."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from ..arrays import Floats, frozen
from .problem import Problem
from .sparse import keep, sparse
from .trust_region import Arrival, arrive

STEPS = 12
"""Of each start; a good one has nearly arrived by then."""
SAME = 1e-3
"""Share by which costs may differ and count as the same minimum: the cheaper start then stays."""
TOLERANCE = 1e-3
"""m or rad, a step at which a start has arrived for the purpose."""


def race(problem: Problem, starts: Mapping[str, Callable[[], Floats]]) -> Problem:
    """The problem from the start that leads lowest; its x0 is where the steps from there have led.

    A start from which no step was refused and no promise failed by half is taken at once: the others are tried where
    the first had trouble. A problem that is not large takes the first.

    Args:
        problem: at any start.
        starts: name -> x0 (n, ambient), cheapest first.
    """
    system, best = sparse(problem), np.inf
    for name, start in starts.items():
        tried = problem.replace_unchecked(x0=start(), start=name)
        if system is None:
            return tried
        assert tried.x0 is not None
        end = arrive(system, tried.x0, STEPS, TOLERANCE)
        cost = system.cost(end.x)
        if cost < (1.0 - SAME) * best:
            best, chosen = cost, keep(system, tried.replace_unchecked(x0=frozen(end.x)))
        if smooth(end):
            break
    return chosen


def smooth(end: Arrival) -> bool:
    """Whether all promises came true by half and more."""
    share = end.record[:, 2]
    return bool(np.isfinite(share).all() and (np.abs(share - 1.0) < 0.5).all())

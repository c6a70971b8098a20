"""The choice among starts: a few steps from each, cheapest first, and the lowest goes on."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from ..arrays import Floats, frozen
from .problem import Problem
from .search import Search
from .sparse import keep, sparse
from .trust_region import Arrival, arrive

STEPS = 12
"""Of each start at first; a good one has nearly arrived by then."""
ROUNDS = ((3.0, 25), (1.25, 200))
"""Those whose cost is within the first number of the least go on by as many steps as the second says."""
SAME = 1e-3
"""Share by which costs may differ and count as the same minimum: the cheaper start then stays."""
TOLERANCE = 1e-3
"""m or rad, a step at which a start has arrived for the purpose."""


def race(problem: Problem, starts: Mapping[str, Callable[[], Floats]]) -> tuple[Problem, Search]:
    """The problem from the start that leads lowest, its x0 where the steps from there have led; and the search.

    A start from which no step was refused and no promise failed by half ends the search: others are tried where the
    first had trouble, and all whose costs are near the least go on (ROUNDS). A problem that is not large takes the
    first.

    Args:
        problem: at any start.
        starts: name -> x0 (n, ambient), cheapest first.
    """
    system, tried, taken = sparse(problem), {}, 0
    for name, start in starts.items():
        x = start()
        if system is None:
            return problem.replace_unchecked(x0=frozen(x)), Search(name)
        end = arrive(system, x, STEPS, TOLERANCE)
        tried[name], taken = (system.cost(end.x), end.x), taken + end.iterations
        if smooth(end):
            break
    assert system is not None
    least = min(cost for cost, _ in tried.values())
    for within, steps in ROUNDS:
        if all(cost <= (1.0 + SAME) * least for cost, _ in tried.values()):
            break
        close = {name: x for name, (cost, x) in tried.items() if cost <= within * least}
        if len(close) > 1:
            ends = {name: arrive(system, x, steps, TOLERANCE) for name, x in close.items()}
            tried = {name: (system.cost(end.x), end.x) for name, end in ends.items()}
            taken += sum(end.iterations for end in ends.values())
            least = min(cost for cost, _ in tried.values())
    name, x = next((name, x) for name, (cost, x) in tried.items() if cost <= (1.0 + SAME) * least)
    return keep(problem, problem.replace_unchecked(x0=frozen(x))), Search(name, taken)


def smooth(end: Arrival) -> bool:
    """Whether all promises came true by half and more."""
    share = end.record[:, 2]
    return bool(np.isfinite(share).all() and (np.abs(share - 1.0) < 0.5).all())

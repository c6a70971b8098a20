"""Multi-start: a few steps of Levenberg-Marquardt from each start, and the lowest goes on."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from ...arrays import Floats, frozen
from ..algebra.sparse import sparse
from ..assess.assess import expected
from ..descent.levenberg_marquardt import Arrival, arrive
from ..model.problem import Problem, Search

STEPS = 12
"""Of each start at first; a good one has nearly arrived by then."""
ROUNDS = ((3.0, 25), (1.25, 200))
"""Those whose cost is within the first number of the least go on by as many steps as the second says, of several with
the same cost the cheapest alone."""
SAME = 1e-3
"""Share by which costs may differ and count as the same minimum: the cheaper start then stays."""
TOLERANCE = 1e-3
"""m or rad, a step at which a start has arrived for the purpose."""
EXCESS = 5.0
"""Standard deviations above its mean, under the noise that is assumed, from which a cost is not believed."""
MORE = 50
"""Steps before it is judged."""


def race(
    problem: Problem,
    starts: Mapping[str, Callable[[], Floats]],
    growing: Callable[[Problem], tuple[Floats, int]] | None,
    relaxed: Callable[[Problem], Floats] | None,
    unwound: Callable[[Floats], bool],
) -> tuple[Problem, Search]:
    """The problem from the start that leads lowest, its x0 where the steps from there have led; and the search.

    All starts are tried, and those whose costs are near the least go on (ROUNDS), unless one leads by steps of which
    none was refused and whose promises came true by half and more, to a cost which the assumed noise explains, and to
    an end that is `unwound` or to which another led as smoothly. Where the noise does not explain the end and the steps
    to it had trouble, the growing start is tried, too, unless a second start led there, and then the relaxation. Where
    the steps went straight the noise is taken as stated too small, which a note of the Solution leaves open.

    Args:
        problem: at any start.
        starts: name -> x0 (n, ambient), cheapest first.
        growing: problem -> x0 and iterations of a start that is tried late, "incremental"; or None.
        relaxed: problem -> x0, "relaxed", of one that is tried last; None where it would take too long.
        unwound: x -> whether no other minimum of a lower cost is to be feared.
    """
    system, tried, taken, calm = sparse(problem), {}, 0, list[float]()
    mean, variance = expected(problem, system.size)
    limit, straight = mean + EXCESS * np.sqrt(variance), set[str]()
    for name, start in starts.items():
        x = start()
        end = arrive(system, x, STEPS, TOLERANCE)
        tried[name], taken = (system.cost(end.x), end.x), taken + end.iterations
        if smooth(end):
            cost, calm = tried[name][0], [*calm, tried[name][0]]
            alike = sum(abs(cost - other) <= SAME * cost for other in calm) > 1
            if cost <= limit and (alike or unwound(end.x)):
                return problem.replace_unchecked(x0=frozen(end.x)), Search(name, taken)
            straight |= {name} if end.converged else set()
    reached = {name: cost for name, (cost, _) in tried.items()}
    least = min(reached.values())
    for within, steps in ROUNDS:
        if all(cost <= (1.0 + SAME) * least for cost, _ in tried.values()):
            break
        tried = _distinct(tried)
        close = {name: x for name, (cost, x) in tried.items() if cost <= within * least}
        if len(close) > 1:
            ends = {name: arrive(system, x, steps, TOLERANCE) for name, x in close.items()}
            tried = {name: (system.cost(end.x), end.x) for name, end in ends.items()}
            taken += sum(end.iterations for end in ends.values())
            reached |= {name: cost for name, (cost, _) in tried.items()}
            least = min(reached.values())
    name, x = next((name, x) for name, (cost, x) in tried.items() if cost <= (1.0 + SAME) * least)
    alone = sum(cost <= (1.0 + SAME) * least for cost in reached.values()) == 1

    def better(late: str, start: Floats) -> tuple[str, Floats]:
        nonlocal taken
        end = arrive(system, start, MORE, TOLERANCE)
        taken += end.iterations
        return (late, end.x) if system.cost(end.x) < (1.0 - SAME) * system.cost(x) else (name, x)

    if growing is not None and alone and name not in straight and system.cost(x) > limit:
        end = arrive(system, x, MORE, TOLERANCE)
        x, taken = end.x, taken + end.iterations
        if system.cost(x) > limit:
            grown, steps = growing(problem)
            taken += steps
            name, x = better("incremental", grown)
    if relaxed is not None and name not in straight and system.cost(x) > limit:
        name, x = better("relaxed", relaxed(problem.replace_unchecked(x0=frozen(x))))
    return problem.replace_unchecked(x0=frozen(x)), Search(name, taken)


def _distinct(tried: dict[str, tuple[float, Floats]]) -> dict[str, tuple[float, Floats]]:
    """Those whose cost differs from that of every one before, which is cheaper."""
    found: dict[str, tuple[float, Floats]] = {}
    for name, (cost, x) in tried.items():
        if all(abs(cost - other) > SAME * min(cost, other) for other, _ in found.values()):
            found[name] = cost, x
    return found


def smooth(end: Arrival) -> bool:
    """Whether all promises came true by half and more, without damping; that an exact Hessian was not positive definite
    is no trouble, since J^T J goes on."""
    _, damping, share = end.record.T
    return bool(not damping.any() and (np.abs(share[np.isfinite(share)] - 1.0) < 0.5).all())

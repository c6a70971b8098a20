"""A start that grows: the first poses of all robots are solved, then more with them, so that odometry drifts little."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...arrays import Bools, Floats, Ints
from ...formats.graph import Graph
from ..algebra.sparse import sparse
from ..descent.trust_region import arrive
from ..model.part import restricted
from ..model.problem import Problem
from ..model.space import carried
from .trilateration import located

STAGE = 25
"""Poses of the longest robot that are added at a time, at least."""
STAGES = 60
"""At most, unless odometry turns by more than DRIFT in one."""
MOST = 200
"""Whatever the odometry."""
DRIFT = 0.5
"""rad, standard deviation by which odometry may turn in a stage: beyond it a stage begins in no basin."""
STEPS = 5
"""Of each stage."""
TOLERANCE = 1e-2
"""m or rad, a step at which a stage has arrived for the purpose."""
HOLDING = 2
"""Ranges per dimension from which a point is placed by them."""


class Growth(NamedTuple):
    """Where a start is: nodes (n, ambient), which are solved (n,), by how many ranges points were placed (n,), and
    iterations so far."""

    x: Floats
    solved: Bools
    ranges: Ints
    iterations: int


def incremental_start(graph: Graph, problem: Problem) -> tuple[Floats, int]:
    """Nodes (n, ambient) and iterations: each stage solves the measurements among the poses so far.

    A stage begins at the answer of the one before, which it continues by the relative poses of the problem's x0. Points
    join when they are seen or have a prior, as x0 has them, or where enough ranges place them.

    References:
        Kaess et al., iSAM, T-RO 2008: an estimate that follows the measurements in time.
    """
    assert problem.x0 is not None
    count, n = _stages(graph), len(graph.names)
    now = Growth(problem.x0.copy(), np.zeros(n, dtype=bool), np.zeros(n, dtype=np.int64), 0)
    for stage in range(count):
        now = _extended(graph, problem, now, (stage + 1) / count)
    return now.x, now.iterations


def _stages(graph: Graph) -> int:
    """How many stages: STAGES, or as many as odometry needs to turn by no more than DRIFT in each."""
    longest = max(len(places) for places in graph.robots.values())
    turns = graph.relative_pose.covariance[:, graph.dimension :, graph.dimension :]
    variance = np.median(np.einsum("mii->m", turns) / turns.shape[-1]) if len(turns) else 0.0
    drifting = min(longest * variance / DRIFT**2, MOST)
    return max(min(longest // STAGE, max(STAGES, int(drifting))), 1)


def _extended(graph: Graph, problem: Problem, now: Growth, share: float) -> Growth:
    """The start after a stage that takes the first `share` of each robot's poses."""
    assert problem.x0 is not None
    space, x, used = problem.space, now.x, np.zeros(len(graph.names), dtype=bool)
    for places in graph.robots.values():
        new = places[: int(np.ceil(share * len(places)))]
        used[new] = True
        old = new[now.solved[new]]
        if len(old) and len(old) < len(places):
            x[places[len(old) :]] = carried(space, problem.x0[places[len(old) :]], problem.x0[old[-1]], x[old[-1]])
    used |= _joining(graph, now, used, space.dimension)
    part = restricted(problem, used, x)
    system = sparse(part, least=0)
    if system is None:
        return now._replace(solved=used)
    end = arrive(system, np.array(part.x0), STEPS, TOLERANCE)
    x[used] = end.x
    return now._replace(solved=used, iterations=now.iterations + end.iterations)


def _joining(graph: Graph, now: Growth, used: Bools, d: int) -> Bools:
    """(n,) which points the poses so far hold; in x those with ranges alone are placed by them, and anew whenever these
    have doubled: few may have placed them on the wrong side."""
    joins, nodes = np.zeros(len(used), dtype=bool), graph.ranges.nodes
    for edges in (graph.relative_point, graph.point_prior):
        if len(edges):
            joins[edges.nodes[:, -1][used[edges.nodes[:, 0]] | ~graph.is_pose[edges.nodes[:, 0]]]] = True
    for point in np.flatnonzero(~graph.is_pose & ~joins).tolist():
        rows = np.flatnonzero((nodes == point).any(axis=1))
        other = nodes[rows].sum(axis=1) - point
        seen = used[other]
        count = int(seen.sum())
        joins[point] = count >= HOLDING * d + 1
        if joins[point] and count >= 2 * now.ranges[point]:
            now.x[point, :d] = located(now.x[other[seen], :d], graph.ranges.distance[rows[seen]])
            now.ranges[point] = count
    return joins

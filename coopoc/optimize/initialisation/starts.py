"""Where the solve of a graph starts: chained odometry, a spanning tree over all relative poses, linear solves."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ...arrays import Bools, Floats, Ints
from ...errors import InputError
from ...formats.graph import Graph
from ..model.space import Space
from .linear_start import linear_start
from .trilateration import located
from .walk import Moves, Roots, walk


def chained(graph: Graph, apart: bool = False) -> Floats:
    """(n, ambient): each robot's poses along its own relative poses, from a pose with a prior, else from its first
    vertex in the file; where the file has none, or `apart`, from a place on a ring."""
    edges = graph.relative_pose.nodes
    letter = np.array([ord(name[0]) for name in graph.names])
    return _landmarks(graph, *_walked(graph, letter[edges[:, 0]] == letter[edges[:, 1]], _roots(graph, apart)))


def tree(graph: Graph) -> Floats:
    """(n, ambient): poses along the spanning tree of least variance over all relative poses, loop closures and those
    between robots too; what it does not join hangs on as in `chained`."""
    every = np.ones(len(graph.relative_pose), dtype=bool)
    return _landmarks(graph, *_walked(graph, every, _roots(graph, False)))


def file(graph: Graph) -> Floats:
    """(n, ambient): the vertices as they are.

    Raises:
        InputError: a vertex without a position.
    """
    unknown = ~np.isfinite(graph.position).all(axis=1)
    if unknown.any():
        name = graph.names[int(np.flatnonzero(unknown)[0])]
        raise InputError("start", "'file'", f"needs a position of {name} in the file", 'Use start="odometry".')
    return Space(graph.dimension, has_rotation=True).join(graph.position, graph.rotation)


def separated(graph: Graph, x0: Floats) -> Floats:
    """x0 with ends of a range that lie in one place moved apart by a share NUDGE of it, each another way: there a range
    has no direction."""
    position, (i, j) = x0[:, : graph.dimension], graph.ranges.nodes.T
    distance = graph.ranges.distance
    rows = np.flatnonzero(np.linalg.norm(position[j] - position[i], axis=1) < 1e-9 * distance)
    way = 2.4 * np.arange(len(rows))
    step = NUDGE * distance[rows, None] * np.stack([np.cos(way), np.sin(way)], axis=1)
    position[j[rows], :2] += step
    return x0


STARTS: dict[str, Callable[[Graph], Floats]] = {
    "odometry": chained,
    "apart": lambda graph: chained(graph, apart=True),
    "file": file,
    "tree": tree,
    "linear": lambda graph: linear_start(graph, chained(graph)),
}


def contenders(graph: Graph) -> tuple[str, ...]:
    """The starts that may differ on a graph, cheapest first: without loops all are chained odometry."""
    edges = graph.relative_pose.nodes
    loops = len(edges) + len(graph.relative_point) + len(graph.point_prior) + len(graph.pose_prior)
    moved = len(graph.names) - len(np.setdiff1d(np.flatnonzero(~graph.is_pose), graph.relative_point.nodes[:, -1]))
    if loops <= moved - 1:
        return ("odometry",)
    letter = np.array([ord(name[0]) for name in graph.names])
    own = int((letter[edges[:, 0]] == letter[edges[:, 1]]).sum())
    closed = len(edges) > own or own > int(graph.is_pose.sum()) - len(graph.robots)
    return ("odometry", "tree", "linear") if closed else ("odometry", "linear")


NUDGE = 0.01
"""Share of a range."""


def _roots(graph: Graph, apart: bool) -> list[tuple[int, Floats, Floats]]:
    """Poses with a prior at that, then each robot's first."""
    priors, found = graph.pose_prior, []
    if not apart:
        found = [(int(i), priors.position[k], priors.rotation[k]) for k, i in enumerate(priors.nodes[:, 0])]
    robots = [places for places in graph.robots.values() if len(places)]
    around = float(graph.ranges.distance.mean()) if len(graph.ranges) else 1.0
    for k, places in enumerate(robots):
        first, angle = int(places[0]), 2.0 * np.pi * k / len(robots)
        if not apart and np.isfinite(graph.position[first]).all():
            found.append((first, graph.position[first], graph.rotation[first]))
        else:
            at = np.zeros(graph.dimension)
            at[:2] = around * np.cos(angle), around * np.sin(angle)
            found.append((first, at, np.eye(graph.dimension)))
    return found


def _walked(graph: Graph, used: Bools, roots: Roots) -> tuple[Floats, Floats, Bools]:
    """The walk along the `used` relative poses, whose length is their variance."""
    edges = graph.relative_pose
    length = np.trace(edges.covariance, axis1=1, axis2=2) + 1e-12 if len(edges) else np.empty(0)
    moves = Moves(edges.nodes[used], edges.position[used], edges.rotation[used], length[used])
    return walk(len(graph.names), graph.dimension, moves, roots)


def _landmarks(graph: Graph, position: Floats, rotation: Floats, known: Bools) -> Floats:
    """Nodes with the points at their priors, where a pose sees them, or by ranges."""
    points = graph.point_prior
    position[points.nodes[:, 0]], known[points.nodes[:, 0]] = points.position, True
    for (i, j), at in zip(graph.relative_point.nodes.tolist(), graph.relative_point.position, strict=True):
        if not known[j]:
            position[j], known[j] = position[i] + rotation[i] @ at, True
    _by_ranges(graph, position, known)
    return Space(graph.dimension, has_rotation=True).join(position, rotation)


def _by_ranges(graph: Graph, position: Floats, known: Bools) -> None:
    """Points that are only ranged, in place."""
    nodes, r = graph.ranges.nodes, graph.ranges.distance
    for j in np.flatnonzero(~known & ~graph.is_pose).tolist():
        rows = np.flatnonzero((nodes == j).any(axis=1))
        others: Ints = nodes[rows].sum(axis=1) - j
        seen = known[others]
        if seen.any():
            position[j] = located(position[others[seen]], r[rows[seen]])
        known[j] = True

"""A graph of poses and landmarks as a Problem, and where to start it."""

from __future__ import annotations

from collections import deque
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from ..arrays import Bools, Floats
from ..errors import InputError
from ..formats import load_graph
from ..formats.graph import Graph
from ..plugins import unknown
from .factor import Factor
from .problem import Problem
from .space import Space

Objective = Literal["chordal", "geodesic"]
Start = Literal["odometry", "apart", "file"]


def read_graph(path: str | Path, objective: Objective = "chordal", start: Start = "odometry") -> Problem:
    """The problem of a PyFG or g2o file; see `from_graph`.

    Raises:
        InputError: a line that is wrong, with file and number; an unknown suffix, objective or start.
    """
    return from_graph(load_graph(path), objective, start)


def from_graph(graph: Graph, objective: Objective = "chordal", start: Start = "odometry") -> Problem:
    """The problem of a graph, with the first pose fixed where the graph has neither priors nor fixed vertices.

    chordal: kappa |R_j - R_i R_ij|_F^2 + tau |t_j - t_i - R_i t_ij|^2, tau = d / trace(cov_t) and kappa = 1 / var_theta
    in the plane, 3 / (2 trace(cov_R)) in space, as SE-Sync (Rosen et al., IJRR 2019) and CORA (arXiv 2302.11614) have
    it: quadratic, so that it can be certified. geodesic: |log(T_ij^-1 T_i^-1 T_j)|^2 with the full covariance.

    Args:
        graph: of `coopoc.formats.load_graph`.
        start: "odometry" chains each robot's relative poses from its first vertex in the file; "apart" from a ring as
            wide as the mean range, all facing one way, as if nothing were known of how the robots stand to each other;
            "file" takes the vertices as they are. Landmarks are put where the first pose that measures them sees them,
            or by the ranges to them.

    >>> from coopoc.formats.edges import RangeEdges
    >>> ranges = RangeEdges([[0, 1]], [5.0], [0.01])
    >>> from_graph(Graph(2, ("A0", "L0"), [True, False], [[0, 0], [3, 4]], [[0], [0]], ranges=ranges))
    Problem(2 nodes in the plane; 1 range)
    """
    for name, value, allowed in (("objective", objective, Objective), ("start", start, Start)):
        if value not in get_args(allowed):
            raise unknown(name, value, get_args(allowed))
    poses = tuple(np.flatnonzero(graph.is_pose).tolist())
    fixed = tuple(graph.fixed.tolist())
    if not fixed and not len(graph.pose_prior) and not len(graph.point_prior):
        fixed = poses[:1]
    x0 = _file(graph) if start == "file" else _chained(graph, start == "apart")
    x0 = x0 if poses else x0[:, : graph.dimension]
    return Problem(graph.names, _factors(graph, objective), x0, dimension=graph.dimension, poses=poses, fixed=fixed)


def _factors(graph: Graph, objective: Objective) -> tuple[Factor, ...]:
    space, found = Space(graph.dimension, has_rotation=True), []
    for kind, edges in (("relative_pose", graph.relative_pose), ("pose", graph.pose_prior)):
        if not len(edges):
            continue
        z = space.join(edges.position, edges.rotation)
        if objective == "geodesic":
            found.append(Factor(kind, edges.nodes, z, cov=edges.covariance))
        else:
            found.append(Factor(f"{kind}_chordal", edges.nodes, z, std=_chordal_std(edges.covariance, graph.dimension)))
    for kind, points in (("relative_position", graph.relative_point), ("position", graph.point_prior)):
        if not len(points):
            continue
        if objective == "geodesic":
            found.append(Factor(kind, points.nodes, points.position, cov=points.covariance))
        else:
            std = np.sqrt(_mean_variance(points.covariance))[:, None].repeat(graph.dimension, axis=1)
            found.append(Factor(kind, points.nodes, points.position, std=std))
    if len(graph.ranges):
        edges_ = graph.ranges
        found.append(Factor("range", edges_.nodes, edges_.distance[:, None], std=np.sqrt(edges_.variance)[:, None]))
    return tuple(found)


def _mean_variance(covariance: Floats) -> Floats:
    return np.asarray(np.einsum("mii->m", covariance) / covariance.shape[-1])


def _chordal_std(covariance: Floats, d: int) -> Floats:
    """(M, d + d^2) of a relative pose with covariance (M, D, D): position entries, then rotation entries."""
    position = np.sqrt(_mean_variance(covariance[:, :d, :d]))
    turn = np.einsum("mii->m", covariance[:, d:, d:])
    rotation = np.sqrt(turn if d == 2 else 2.0 * turn / 3.0)
    return np.concatenate([position[:, None].repeat(d, 1), rotation[:, None].repeat(d * d, 1)], axis=1)


def _file(graph: Graph) -> Floats:
    unknown = ~np.isfinite(graph.position).all(axis=1)
    if unknown.any():
        name = graph.names[int(np.flatnonzero(unknown)[0])]
        raise InputError("start", "'file'", f"needs a position of {name} in the file", 'Use start="odometry".')
    return Space(graph.dimension, has_rotation=True).join(graph.position, graph.rotation)


def _chained(graph: Graph, apart: bool) -> Floats:
    """Poses along the relative poses from each robot's first vertex, landmarks from what measures them."""
    space = Space(graph.dimension, has_rotation=True)
    position = np.zeros_like(graph.position)
    rotation = np.tile(np.eye(graph.dimension), (len(graph.names), 1, 1))
    known = np.zeros(len(graph.names), dtype=bool)
    robots = [places for places in graph.robots.values() if len(places)]
    around = float(graph.ranges.distance.mean()) if len(graph.ranges) else 1.0
    for k, places in enumerate(robots):
        first = places[0]
        known[first] = True
        if not apart and np.isfinite(graph.position[first]).all():
            position[first], rotation[first] = graph.position[first], graph.rotation[first]
        else:
            angle = 2.0 * np.pi * k / len(robots)
            position[first, :2] = around * np.cos(angle), around * np.sin(angle)
    _walk(graph, position, rotation, known)
    for (i, j), at in zip(graph.relative_point.nodes.tolist(), graph.relative_point.position, strict=True):
        if not known[j]:
            position[j], known[j] = position[i] + rotation[i] @ at, True
    _by_ranges(graph, position, known)
    return space.join(position, rotation)


def _walk(graph: Graph, position: Floats, rotation: Floats, known: Bools) -> None:
    """Breadth-first over relative poses between poses of one robot, in place."""
    edges = graph.relative_pose
    beside: dict[int, list[tuple[int, int, bool]]] = {}
    for k, (i, j) in enumerate(edges.nodes.tolist()):
        if graph.names[i][0] == graph.names[j][0]:
            beside.setdefault(i, []).append((j, k, True))
            beside.setdefault(j, []).append((i, k, False))
    waiting = deque(np.flatnonzero(known).tolist())
    while waiting:
        i = waiting.popleft()
        for j, k, forward in beside.get(i, ()):
            if known[j]:
                continue
            moved, turned = edges.position[k], edges.rotation[k]
            if not forward:
                moved, turned = -turned.T @ moved, turned.T
            position[j], rotation[j], known[j] = position[i] + rotation[i] @ moved, rotation[i] @ turned, True
            waiting.append(j)


def _by_ranges(graph: Graph, position: Floats, known: Bools) -> None:
    """Points that are only ranged: linear least squares of r_k^2 - r_0^2, in place."""
    nodes, r = graph.ranges.nodes, graph.ranges.distance
    for j in np.flatnonzero(~known & ~graph.is_pose).tolist():
        rows = np.flatnonzero((nodes == j).any(axis=1))
        others = nodes[rows][nodes[rows] != j]
        seen = known[others]
        p, d = position[others[seen]], r[rows[seen]]
        if len(p) > graph.dimension:
            matrix = np.concatenate([2.0 * p, np.ones((len(p), 1))], axis=1)
            found = np.linalg.lstsq(matrix, np.square(p).sum(axis=1) - d * d, rcond=None)[0]
            position[j] = found[: graph.dimension]
        elif len(p):
            position[j] = p[0] + d[0] * np.eye(graph.dimension)[0]
        known[j] = True

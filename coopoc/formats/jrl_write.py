"""Graph -> JRL file: every measurement in the entry of the robot that made it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ..arrays import Floats, instance
from ..errors import InputError
from ..file_names import given_path
from .edges import ENDS, PoseEdges, RangeEdges
from .graph import Graph
from .jrl_values import TYPES, key_of, write_covariance, write_value


def write_jrl(
    graph: Graph,
    path: str | Path,
    unit: float = 1.0,
    values: Literal["groundtruth", "initialization"] = "initialization",
) -> None:
    """Write a JRL file, whose measurements belong to the robot of their first pose.

    Args:
        graph: with a stamp for every measurement.
        path: of the file, whose stem becomes the name of the data set.
        unit: s of one unit of the stamps, which are whole numbers: 1e-9 for nanoseconds.
        values: what the vertices' positions are.

    Raises:
        InputError: fixed vertices, measured points (JRL has bearing and range instead), ranges between points, a
            measurement without a stamp, or one that is no whole number of units.

    >>> from .edges import RangeEdges
    >>> import tempfile
    >>> near = RangeEdges([[0, 1]], [2], [1], stamps=[3])
    >>> pair = Graph(2, ("a0", "b0"), [True] * 2, np.zeros((2, 2)), np.zeros((2, 1)), ranges=near)
    >>> write_jrl(pair, file := Path(tempfile.mkdtemp()) / "near.jrl")
    >>> json.loads(file.read_text())["measurements"]["a"][0]["stamp"]
    3
    """
    instance("graph", graph, Graph)
    for field, count in (("fixed", len(graph.fixed)), ("relative_point", len(graph.relative_point))):
        if count:
            raise InputError(field, f"{count} of them", "JRL has no record for it", f"Write the graph without {field}.")
    robots = list(graph.robots) or sorted({name[0] for name in graph.names})
    entries: dict[str, dict[int, list[Any]]] = {robot: {} for robot in robots}
    maker = [name[0] if name[0] in robots else "" for name in graph.names]
    for kind in ENDS:
        edges = getattr(graph, kind)
        stamps = _whole(kind, edges.stamps, unit)
        for row, nodes in enumerate(edges.nodes.tolist()):
            robot = next((maker[k] for k in nodes if graph.is_pose[k]), maker[nodes[0]]) or robots[0]
            for k in nodes:
                maker[k] = maker[k] or robot  # a landmark belongs to the robot that measures it first
            entries[robot].setdefault(stamps[row], []).append(_measurement(graph, kind, row))
    whole: dict[str, Any] = {"name": given_path(path).stem, "robots": robots, "measurements": {}, values: {}}
    for robot in robots:
        own = [row for row, letter in enumerate(maker) if (letter or robots[0]) == robot]
        whole["measurements"][robot] = [{"stamp": t, "measurements": m} for t, m in sorted(entries[robot].items())]
        whole[values][robot] = [_vertex(graph, row) for row in own if np.isfinite(graph.position[row]).all()]
    given_path(path).write_text(json.dumps(whole) + "\n")


def _measurement(graph: Graph, kind: str, row: int) -> dict[str, Any]:
    edges: Any = getattr(graph, kind)
    nodes = edges.nodes[row].tolist()
    roles = tuple("pose" if graph.is_pose[k] else "point" for k in nodes)
    order = nodes if roles[0] == "pose" else nodes[::-1]
    roles = tuple("pose" if graph.is_pose[k] else "point" for k in order)
    found = [tag for tag, t in TYPES.items() if (t.kind, t.dimension, t.ends) == (kind, graph.dimension, roles)]
    if not found:
        ends = " and ".join(graph.names[k] for k in nodes)
        raise InputError(f"{kind}[{row}]", f"between {ends}", "JRL ranges from a pose", "Leave the measurement out.")
    tag = found[0]
    if isinstance(edges, RangeEdges):
        value, covariance = edges.distance[row : row + 1], edges.variance[row].reshape(1, 1)
    else:
        value, covariance = edges.position[row], edges.covariance[row]
    if isinstance(edges, PoseEdges):
        value = np.concatenate([value, edges.orientation[row]])
    names = ("key",) if len(nodes) == 1 else ("key1", "key2")
    keys = {name: key_of(graph.names[k]) for name, k in zip(names, order, strict=True)}
    measured = {"prior" if len(nodes) == 1 else "measurement": write_value(TYPES[tag].measured, value)}
    return {"type": tag, **keys, **measured, "covariance": write_covariance(covariance)}


def _vertex(graph: Graph, row: int) -> dict[str, Any]:
    pose = bool(graph.is_pose[row])
    value = np.concatenate([graph.position[row], graph.orientation[row]]) if pose else graph.position[row]
    return {**write_value(f"{'Pose' if pose else 'Point'}{graph.dimension}", value), "key": key_of(graph.names[row])}


def _whole(kind: str, stamps: Floats, unit: float) -> list[int]:
    """Stamps (M,) in units."""
    counted = np.rint(stamps / unit)
    rounding = np.maximum(1e-3 * unit, 2.0 * np.spacing(np.abs(stamps)))  # of seconds since 1970: 5e-7 s
    off = np.flatnonzero(~(np.abs(stamps - unit * counted) <= rounding) | ~(counted >= 0) | ~(counted < 2.0**64))
    if len(off):
        given = f"{stamps[off[0]]} s"
        allowed = f"must be a whole number >= 0 of {unit:g} s"
        raise InputError(f"stamp of {kind}[{off[0]}]", given, allowed, "Give unit=1e-9, or write graph.stamped(t).")
    return list(map(int, counted))

"""Hard variants of a factor graph: cropped, without most of its loops, with odometry that is worse."""

from dataclasses import replace
from typing import Any

import numpy as np

from coopoc.formats.graph import Graph
from coopoc.formats.values import to_orientation
from coopoc.optimize.model.space import exp

FIELDS = ("relative_pose", "relative_point", "ranges", "pose_prior", "point_prior")


def odometry(graph: Graph) -> np.ndarray:
    """(M,) True for relative poses between one robot's consecutive poses."""
    place = np.full(len(graph.names), -1)
    for places in graph.robots.values():
        place[places] = np.arange(len(places))
    letter = np.array([ord(name[0]) for name in graph.names])
    i, j = graph.relative_pose.nodes.T
    return (letter[i] == letter[j]) & (np.abs(place[i] - place[j]) == 1)


def kept(edges: Any, keep: np.ndarray, number: np.ndarray | None = None) -> Any:
    """The edges that are kept, with vertices numbered anew."""
    changes = {name: getattr(edges, name)[keep] for name in edges.__dataclass_fields__}
    if number is not None:
        changes["nodes"] = number[changes["nodes"]]
    return type(edges)(**changes)


def cropped(graph: Graph, share: float = 0.5) -> Graph:
    """The first `share` of each robot's poses, and the landmarks that at least three of their measurements hold."""
    keep = ~graph.is_pose
    for places in graph.robots.values():
        keep[places[: max(2, int(share * len(places)))]] = True
    held = np.zeros(len(graph.names), dtype=int)
    for field in FIELDS:
        edges = getattr(graph, field)
        inside = keep[edges.nodes].all(axis=1) if len(edges) else np.zeros(0, dtype=bool)
        np.add.at(held, edges.nodes[inside].ravel(), 1 if field == "ranges" else 3)
    keep &= graph.is_pose | (held >= 3)
    number = np.cumsum(keep) - 1
    changes = {
        field: kept(edges, keep[edges.nodes].all(axis=1), number)
        for field in FIELDS
        if len(edges := getattr(graph, field))
    }
    fixed = graph.fixed[keep[graph.fixed]] if len(graph.fixed) else graph.fixed
    vertices = {name: getattr(graph, name)[keep] for name in ("is_pose", "position", "orientation", "stamps")}
    names = tuple(name for name, stays in zip(graph.names, keep, strict=True) if stays)
    return replace(graph, names=names, fixed=number[fixed] if len(fixed) else fixed, **vertices, **changes)


def fewer_loops(graph: Graph, share: float = 0.1, seed: int = 0) -> Graph:
    """A `share` of all that is not odometry, and four measurements of each landmark at least."""
    rng = np.random.default_rng(seed)
    changes, enough = {}, np.zeros(len(graph.names), dtype=int)
    for field in ("relative_pose", "relative_point", "ranges"):
        edges = getattr(graph, field)
        keep = rng.random(len(edges)) < share
        if field == "relative_pose" and len(edges):
            keep |= odometry(graph)
        elif len(edges):
            for k in rng.permutation(len(edges)):
                points = [i for i in edges.nodes[k] if not graph.is_pose[i]]
                keep[k] |= any(enough[i] < 4 for i in points)
                enough[points] += keep[k]
        if len(edges):
            changes[field] = kept(edges, keep)
    return replace(graph, **changes)


def worse_odometry(graph: Graph, factor: float, seed: int = 0) -> Graph:
    """Odometry whose standard deviations are `factor` times as large, and which has an error to match."""
    rng, edges, chosen = np.random.default_rng(seed), graph.relative_pose, odometry(graph)
    d, count = graph.dimension, int(chosen.sum())
    covariance = np.array(edges.covariance)
    extra = (factor**2 - 1.0) * covariance[chosen]
    root = np.linalg.cholesky(extra + 1e-18 * np.eye(extra.shape[-1]))
    step = (root @ rng.normal(size=(count, extra.shape[-1], 1)))[..., 0]
    position, orientation = np.array(edges.position), np.array(edges.orientation)
    position[chosen] += step[:, :d]
    orientation[chosen] = to_orientation(edges.rotation[chosen] @ exp(step[:, d:]))
    covariance[chosen] *= factor**2
    return replace(
        graph, relative_pose=replace(edges, position=position, orientation=orientation, covariance=covariance)
    )


VARIANTS = {
    "as it is": lambda graph: graph,
    "first half": cropped,
    "tenth of its loops": fewer_loops,
    "odometry x 3": lambda graph: worse_odometry(graph, 3.0),
    "odometry x 10": lambda graph: worse_odometry(graph, 10.0),
}

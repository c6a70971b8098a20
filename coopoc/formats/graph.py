"""Graph: the vertices and measurements of a PyFG or g2o file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import InitVar, dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from ..arrays import Ints, frozen
from .check import check, no_edges
from .edges import ENDS, PointEdges, PoseEdges, RangeEdges
from .vertices import Vertices


def _row(field: str, row: int) -> str:
    return f"{field}[{row}]"


@dataclass(frozen=True, eq=False)
class Graph(Vertices):
    """A factor graph as a file holds it: n poses and points, and what was measured between them.

    Orientations are kept as the file writes them (an angle or a quaternion), so that writing what was read changes no
    bit; `rotation` gives matrices.

    Args:
        dimension: 2 or 3.
        names: (n,) unique, a letter and a number as A0 or L3, in the order of the file.
        is_pose: (n,) True for poses, False for points.
        position: (n, d) m, what the vertex lines hold: the truth in PyFG, an initial guess in g2o; NaN where unknown.
        orientation: (n, 1) rad in 2-D, (n, 4) qx qy qz qw in 3-D, the identity for points; NaN where unknown.
        stamps: (n,) s; NaN for points and where the file has none.
        relative_pose: measurements of pose pairs.
        relative_point: measurements of points from poses.
        ranges: measured distances.
        pose_prior: measured poses.
        point_prior: measured points.
        fixed: (F,) places in names of the vertices that stay where they are (g2o's FIX).
        place: (field, row) -> where it came from, for messages; readers pass the line of the file.

    Raises:
        InputError: shapes, a repeated or malformed name, an edge to a vertex that is not there, to itself or of the
            wrong kind, a number that is not finite, a quaternion that is not of unit length, a covariance that is not
            positive semi-definite, a negative variance or range.

    >>> Graph(2, ("A0", "L0"), [True, False], [[0, 0], [3, 4]], [[0], [0]], ranges=RangeEdges([[0, 1]], [5], [0.01]))
    Graph(2-D: 1 poses of 1 robots, 1 points; 1 ranges)
    """

    relative_pose: PoseEdges = PoseEdges()
    relative_point: PointEdges = PointEdges()
    ranges: RangeEdges = RangeEdges()
    pose_prior: PoseEdges = PoseEdges()
    point_prior: PointEdges = PointEdges()
    fixed: Ints = ()  # type: ignore[assignment]
    place: InitVar[Callable[[str, int], str] | None] = None

    def __post_init__(self, place: Callable[[str, int], str] | None) -> None:
        object.__setattr__(self, "names", tuple(self.names))
        object.__setattr__(self, "is_pose", frozen(self.is_pose, bool))
        object.__setattr__(self, "fixed", frozen(self.fixed, np.int64))
        for field in ("position", "orientation", "stamps"):
            object.__setattr__(self, field, frozen(getattr(self, field)))
        if not len(self.stamps):
            object.__setattr__(self, "stamps", frozen(np.full(len(self.names), np.nan)))
        for field in ENDS:
            if not len(getattr(self, field)):
                object.__setattr__(self, field, no_edges(field, self.dimension))
        check(self, {field: getattr(self, field) for field in ENDS}, self.fixed, place or _row)

    @cached_property
    def robots(self) -> Mapping[str, Ints]:
        """Letter -> places in names of that robot's poses, in the order of the file."""
        letter = np.array([name[0] for name in self.names])
        first = dict.fromkeys(letter[self.is_pose].tolist())
        return {one: np.flatnonzero(self.is_pose & (letter == one)) for one in first}

    def stamped(self, stamps: npt.ArrayLike) -> Graph:
        """The same graph with other stamps, an edge that of its first pose, else point; NaN takes them away.

        Args:
            stamps: a number or (n,), s; points do not keep them.

        >>> graph = Graph(2, ("A0", "A1"), [True, True], np.zeros((2, 2)), np.zeros((2, 1)))
        >>> graph.stamped([0, 0.1]).stamps
        array([0. , 0.1])
        """
        every = np.broadcast_to(np.asarray(stamps, dtype=float), len(self.names))
        own = np.where(self.is_pose, every, np.nan)
        edges = {}
        for field in ENDS:
            edge = getattr(self, field)
            first = np.where(self.is_pose[edge.nodes[:, 0]], edge.nodes[:, 0], edge.nodes[:, -1])
            edges[field] = replace(edge, stamps=every[first])
        return replace(self, stamps=own, **edges)

    def __repr__(self) -> str:
        poses = int(self.is_pose.sum())
        measured = [f"{len(getattr(self, field))} {field}" for field in ENDS if len(getattr(self, field))]
        return (
            f"Graph({self.dimension}-D: {poses} poses of {len(self.robots)} robots, {len(self.names) - poses} points"
            + (f"; {', '.join(measured)}" if measured else "")
            + (f"; {len(self.fixed)} fixed)" if len(self.fixed) else ")")
        )

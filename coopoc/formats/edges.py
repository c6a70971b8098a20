"""Measurements of a graph file: poses, points and ranges between the vertices that it names."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from ..arrays import Floats, Ints, frozen
from ..short_repr import short_repr
from .rotations import to_rotation

ENDS: dict[str, tuple[str, ...]] = {  # what the vertices of each kind of edge must be
    "pose_prior": ("pose",),
    "point_prior": ("point",),
    "relative_pose": ("pose", "pose"),
    "relative_point": ("pose", "point"),
    "ranges": ("any", "any"),
}


class Edges:
    """Base of the three kinds: read-only arrays with one row per measurement, NaN for a stamp that is not given."""

    nodes: Ints
    stamps: Floats

    def __len__(self) -> int:
        return len(self.nodes)

    def __post_init__(self) -> None:
        for field in fields(self):  # type: ignore[arg-type]
            dtype: Any = np.int64 if field.name == "nodes" else np.float64
            object.__setattr__(self, field.name, frozen(getattr(self, field.name), dtype))
        if not len(self.stamps):
            object.__setattr__(self, "stamps", frozen(np.full(len(self.nodes), np.nan)))

    def rows(self, chosen: Ints) -> Self:
        """Some of the measurements.

        >>> RangeEdges([[0, 1], [0, 2]], [5.0, 6.0], [0.1, 0.1]).rows(np.array([1])).distance
        array([6.])
        """
        return replace(self, **{field.name: getattr(self, field.name)[chosen] for field in fields(self)})  # type: ignore[arg-type, type-var]


@dataclass(frozen=True, eq=False)
class PoseEdges(Edges):
    """M measured poses: of the second vertex in the frame of the first, or of a single vertex in the world (priors).

    Args:
        nodes: (M, 2), or (M, 1) for priors: places in Graph.names.
        position: (M, d) m.
        orientation: (M, 1) rad in 2-D, (M, 4) qx qy qz qw in 3-D, as in the file; of matrices by `to_orientation`.
        covariance: (M, D, D) of x, y, theta (D = 3), or of x, y, z and the rotation vector (D = 6), m and rad.
        stamps: (M,) s.

    >>> PoseEdges([[0, 1]], [[1, 0]], [[0.0]], [np.eye(3)]).rotation.shape
    (1, 2, 2)
    """

    nodes: Ints = ()  # type: ignore[assignment]
    position: Floats = ()  # type: ignore[assignment]
    orientation: Floats = ()  # type: ignore[assignment]
    covariance: Floats = ()  # type: ignore[assignment]
    stamps: Floats = ()  # type: ignore[assignment]

    __repr__ = short_repr

    @cached_property
    def rotation(self) -> Floats:
        """(M, d, d)."""
        return to_rotation(self.orientation)


@dataclass(frozen=True, eq=False)
class PointEdges(Edges):
    """M measured points: of the second vertex in the frame of the first, or of a single vertex in the world (priors).

    Args:
        nodes: (M, 2), or (M, 1) for priors.
        position: (M, d) m.
        covariance: (M, d, d) m^2.
        stamps: (M,) s.

    >>> len(PointEdges([[0, 1]], [[1, 0]], [np.eye(2)]))
    1
    """

    nodes: Ints = ()  # type: ignore[assignment]
    position: Floats = ()  # type: ignore[assignment]
    covariance: Floats = ()  # type: ignore[assignment]
    stamps: Floats = ()  # type: ignore[assignment]

    __repr__ = short_repr


@dataclass(frozen=True, eq=False)
class RangeEdges(Edges):
    """M measured distances between any two vertices.

    Args:
        nodes: (M, 2).
        distance: (M,) m.
        variance: (M,) m^2.
        stamps: (M,) s.

    >>> len(RangeEdges([[0, 1]], [5.0], [0.01]))
    1
    """

    nodes: Ints = ()  # type: ignore[assignment]
    distance: Floats = ()  # type: ignore[assignment]
    variance: Floats = ()  # type: ignore[assignment]
    stamps: Floats = ()  # type: ignore[assignment]

    __repr__ = short_repr

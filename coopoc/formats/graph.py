"""Graph: the vertices and measurements of a PyFG or g2o file, and the rules that they keep."""

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import InitVar, dataclass, fields
from functools import cached_property
from operator import attrgetter

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Bools, Floats, Ints, frozen
from ..errors import InputError
from ..text import short_repr
from .values import MIN_DIAGONAL, QUATERNION_ROUNDING, to_rotation

ENDS = {  # what the vertices of each kind of edge must be
    "pose_prior": ("pose",),
    "point_prior": ("point",),
    "relative_pose": ("pose", "pose"),
    "relative_point": ("pose", "point"),
    "ranges": ("any", "any"),
}
NAME = re.compile(r"[A-Za-z](0|[1-9][0-9]{0,16})")
MATRIX_ROUNDING = 1e-9
"""What may be left below zero, or unequal, of the largest eigenvalue or entry."""
Location = Callable[[str, int], str]


class Edges:
    """Base of the three kinds: read-only arrays with one row per measurement, NaN for a stamp that is not given."""

    nodes: Ints
    stamps: Floats

    __repr__ = short_repr

    def __len__(self) -> int:
        return len(self.nodes)

    def __post_init__(self) -> None:
        for field in fields(self):  # type: ignore[arg-type]
            dtype = np.int64 if field.name == "nodes" else np.float64
            object.__setattr__(self, field.name, frozen(getattr(self, field.name), dtype))
        if not len(self.stamps):
            self.__dict__["stamps"] = frozen(np.full(len(self.nodes), np.nan))


@dataclass(frozen=True, eq=False, repr=False)
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

    @cached_property
    def rotation(self) -> Floats:
        """(M, d, d)."""
        return to_rotation(self.orientation)


@dataclass(frozen=True, eq=False, repr=False)
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


@dataclass(frozen=True, eq=False, repr=False)
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


def edges_of(kind: str, nodes: ArrayLike, values: Floats, covariance: Floats, stamps: ArrayLike) -> Edges:
    """Edges of a kind from the rows of a file.

    Args:
        kind: as in `ENDS`.
        nodes: (M, 1 or 2).
        values: (M, C) a distance, a position, or a position and an orientation.
        covariance: (M, D, D).
        stamps: (M,) s.
    """
    if kind == "ranges":
        return RangeEdges(nodes, values[:, 0], covariance[:, 0, 0], stamps)  # type: ignore[arg-type]
    if "point" in kind:
        return PointEdges(nodes, values, covariance, stamps)  # type: ignore[arg-type]
    d = 2 if values.shape[1] == 3 else 3
    return PoseEdges(nodes, values[:, :d], values[:, d:], covariance, stamps)  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class Graph:
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
        guess: the vertices are an initial guess, as in g2o, from which a solve begins by default.
        notes: what the reader changed, such as noise that it repaired.
        location: (field, row) -> where it came from, for messages; readers pass the line of the file.

    Raises:
        InputError: shapes, a repeated or malformed name, an edge to a vertex that is not there, to itself or of the
            wrong kind, a number that is not finite, a quaternion that is not of unit length, a covariance that is not
            positive semi-definite, a negative variance or range.

    >>> Graph(2, ("A0", "L0"), [True, False], [[0, 0], [3, 4]], [[0], [0]], ranges=RangeEdges([[0, 1]], [5], [0.01]))
    Graph(2-D: 1 poses of 1 robots, 1 points; 1 ranges)
    """

    dimension: int
    names: tuple[str, ...]
    is_pose: Bools
    position: Floats
    orientation: Floats
    stamps: Floats = ()  # type: ignore[assignment]
    relative_pose: PoseEdges = PoseEdges()
    relative_point: PointEdges = PointEdges()
    ranges: RangeEdges = RangeEdges()
    pose_prior: PoseEdges = PoseEdges()
    point_prior: PointEdges = PointEdges()
    fixed: Ints = ()  # type: ignore[assignment]
    guess: bool = False
    notes: tuple[str, ...] = ()
    location: InitVar[Callable[[str, int], str] | None] = None

    def __post_init__(self, location: Callable[[str, int], str] | None) -> None:
        self.__dict__["names"] = tuple(self.names)
        self.__dict__["is_pose"] = frozen(self.is_pose, bool)
        self.__dict__["fixed"] = frozen(self.fixed, int)
        for field in ("position", "orientation", "stamps"):
            self.__dict__[field] = frozen(getattr(self, field))
        if not len(self.stamps):
            self.__dict__["stamps"] = frozen(np.full(len(self.names), np.nan))
        for field in ENDS:
            if not len(edges := getattr(self, field)):
                empty = {name: np.zeros(shape) for name, shape in shapes(field, self.dimension, 0).items()}
                self.__dict__[field] = type(edges)(**empty)
        check(self, location or (lambda field, row: f"{field}[{row}]"))

    @cached_property
    def rotation(self) -> Floats:
        """(n, d, d), the identity for points."""
        return to_rotation(self.orientation)

    @cached_property
    def robots(self) -> Mapping[str, Ints]:
        """Letter -> places in names of that robot's poses, in the order of the file."""
        letter = np.array([name[0] for name in self.names])
        first = dict.fromkeys(letter[self.is_pose].tolist())
        return {robot: np.flatnonzero(self.is_pose & (letter == robot)) for robot in first}

    def __repr__(self) -> str:
        poses = int(self.is_pose.sum())
        measured = [f"{len(getattr(self, field))} {field}" for field in ENDS if len(getattr(self, field))]
        return (
            f"Graph({self.dimension}-D: {poses} poses of {len(self.robots)} robots, {len(self.names) - poses} points"
            + (f"; {', '.join(measured)}" if measured else "")
            + (f"; {len(self.fixed)} fixed)" if len(self.fixed) else ")")
        )


def shapes(field: str, dimension: int, rows: int) -> dict[str, tuple[int, ...]]:
    """Shape of every array of a kind of edge with that many rows.

    >>> shapes("ranges", 2, 5)["nodes"]
    (5, 2)
    """
    common = {"nodes": (rows, len(ENDS[field])), "stamps": (rows,)}
    if field == "ranges":
        return {**common, "distance": (rows,), "variance": (rows,)}
    if "point" in field:
        return {**common, "position": (rows, dimension), "covariance": (rows, dimension, dimension)}
    turn, size = (1, 3) if dimension == 2 else (4, 6)
    return {**common, **{"position": (rows, dimension), "orientation": (rows, turn), "covariance": (rows, size, size)}}


def check(graph: Graph, location: Location) -> None:
    """InputError at the first rule that a graph breaks: `Graph` lists them.

    Args:
        graph: all its fields as arrays.
        location: (field, row) -> where it came from.
    """
    if graph.dimension not in (2, 3):
        raise InputError("dimension", graph.dimension, "must be 2 or 3", "Give the dimension of the positions.")
    n, d = len(graph.names), graph.dimension
    if not n:
        raise InputError("names", "0 vertices", "must be at least one", "Check that the file is complete.")
    kinds = {field: getattr(graph, field) for field in ENDS}
    wanted = {"is_pose": (n,), "position": (n, d), "orientation": (n, 1 if d == 2 else 4), "stamps": (n,)}
    for field, edges in kinds.items():
        wanted |= {f"{field}.{name}": shape for name, shape in shapes(field, d, len(edges)).items()}
    for name, shape in wanted.items():
        if (actual := attrgetter(name)(graph).shape) != shape:
            raise InputError(name, f"shape {actual}", f"must have shape {shape}", "Give one row per vertex or edge.")
    _vertices(graph, location)
    for field, edges in kinds.items():
        if len(edges):
            _ends(graph, field, edges.nodes, location)
            _values(edges, field, location)
    fixed = graph.fixed
    _refuse(location, "fixed", (fixed < 0) | (fixed >= n), fixed, f"must be in 0..{n - 1}", "Give indices into names.")


def _vertices(graph: Graph, location: Location) -> None:
    names, first = graph.names, dict[str, int]()
    for row, name in enumerate(names):
        if not NAME.fullmatch(name):
            raise InputError(location("names", row), repr(name), "must be a letter and a number as A0", "Rename it.")
        if first.setdefault(name, row) != row:
            before = f"must be given once, and is at {location('names', first[name])}"
            raise InputError(location("names", row), f"vertex {name}", before, "Remove or rename one of them.")
    infinite = np.isinf(np.hstack([graph.position, graph.orientation])).any(axis=1)
    allowed = "must be finite, or NaN where unknown"
    _refuse(
        location, "names", infinite, [f"vertex {name} at infinity" for name in names], allowed, "Correct the number."
    )
    timed = [f"stamp {stamp} of {name}" for stamp, name in zip(graph.stamps, names, strict=True)]
    wrong = np.isfinite(graph.stamps) & ~graph.is_pose
    _refuse(location, "names", wrong, timed, "must be NaN: a point has none", "Give stamps to poses only.")
    _unit(graph.orientation, "names", location)


def _ends(graph: Graph, field: str, nodes: Ints, location: Location) -> None:
    n = len(graph.names)
    outside, hint = ((nodes < 0) | (nodes >= n)).any(axis=1), "Give indices into names."
    _refuse(location, field, outside, nodes, f"must be in 0..{n - 1}", hint, "vertices ")
    for end, role in enumerate(ENDS[field]):
        if role != "any":
            wrong, called = graph.is_pose[nodes[:, end]] != (role == "pose"), np.array(graph.names)[nodes[:, end]]
            _refuse(
                location,
                field,
                wrong,
                called,
                f"must be a {role} in {field}",
                "Check the order of the vertices.",
                "vertex ",
            )
    loops, twice = (nodes[:, :1] == nodes[:, 1:]).any(axis=1), [f"{graph.names[k]} twice" for k in nodes[:, 0]]
    _refuse(location, field, loops, twice, "must be two vertices", "Remove the measurement.")


def _values(edges: Edges, field: str, location: Location) -> None:
    """InputError for numbers that no edge may have; what is exact or of the least size may stay.

    >>> exact = [np.zeros((2, 2)), MIN_DIAGONAL * np.eye(2)]
    >>> _values(PointEdges([[0], [0]], np.zeros((2, 2)), exact), "point_prior", str)
    """
    for name in [n for n in shapes(field, 2, 0) if n not in ("nodes", "stamps")]:
        values = getattr(edges, name).reshape(len(edges), -1)
        mend, actual = "Correct the number.", f"{name} "
        _refuse(location, field, ~np.isfinite(values).all(axis=1), values, "must be finite", mend, actual)
        if name in ("distance", "variance"):
            _refuse(
                location, field, values[:, 0] < 0, [f"{value:g}" for (value,) in values], "must be >= 0", mend, actual
            )
        if name in ("variance", "covariance"):
            size = values[:, :: math.isqrt(values.shape[1]) + 1]  # the diagonal
            extreme = (((size > 0) & (size < MIN_DIAGONAL)) | (size > 1 / MIN_DIAGONAL)).any(axis=1)
            allowed = f"must be 0, or of a size in {MIN_DIAGONAL:g}..{1 / MIN_DIAGONAL:g}: its inverse overflows"
            _refuse(location, field, extreme, values, allowed, mend, actual)
        if name == "orientation":
            _unit(getattr(edges, name), field, location)
        if name == "covariance":
            covariance = getattr(edges, name)
            eigenvalues = np.linalg.eigvalsh(covariance)
            least = MATRIX_ROUNDING * np.maximum(eigenvalues[:, -1], 0)
            uneven = abs(covariance - covariance.mT).max(axis=(-2, -1))
            wrong, hint = (eigenvalues[:, 0] < -least) | (uneven > least), "Order of the upper triangle: by rows."
            _refuse(location, field, wrong, covariance, "must be symmetric and positive semi-definite", hint, actual)


def _unit(orientation: Floats, field: str, location: Location) -> None:
    if orientation.shape[-1] == 4:
        off = abs(np.linalg.norm(orientation, axis=1) - 1) > QUATERNION_ROUNDING
        allowed, hint = (
            f"must have length 1 to within {QUATERNION_ROUNDING:g}",
            "Order is qx qy qz qw; 0 0 0 1 is no rotation.",
        )
        _refuse(location, field, off, orientation, allowed, hint, "quaternion ")


def _refuse(
    location: Location, field: str, wrong: ArrayLike, values: ArrayLike, allowed: str, hint: str, label: str = ""
) -> None:
    """InputError at the first row that is wrong, with what is given there."""
    rows = np.flatnonzero(wrong)
    if len(rows):
        entry = f"{label}{np.asarray(values)[rows[0]].tolist()}"
        raise InputError(location(field, int(rows[0])), entry, allowed, hint)

"""The rules of a Graph, each at the row, and for readers the line, that breaks it."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping

import numpy as np
import numpy.typing as npt

from ..arrays import AnyArray, Bools, Floats, Ints
from ..errors import InputError
from .edges import ENDS, Edges, PointEdges, PoseEdges, RangeEdges
from .noise import LEAST
from .rotations import UNIT
from .vertices import Vertices

NAME = re.compile(r"[A-Za-z](0|[1-9][0-9]{0,14})")
ROUNDING = 1e-9  # what may be left below zero, or unequal, of the largest eigenvalue or entry
Place = Callable[[str, int], str]


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
    poses = {"position": (rows, dimension), "orientation": (rows, turn), "covariance": (rows, size, size)}
    return {**common, **poses}


def no_edges(field: str, dimension: int) -> Edges:
    """None of a kind, with the shapes that many would have."""
    empty: dict[str, AnyArray] = {name: np.zeros(shape) for name, shape in shapes(field, dimension, 0).items()}
    kind = RangeEdges if field == "ranges" else PointEdges if "point" in field else PoseEdges
    return kind(**empty)


def check(vertices: Vertices, measured: Mapping[str, Edges], fixed: Ints, place: Place) -> None:
    """InputError at the first rule that a graph breaks: `Graph` lists them.

    Args:
        vertices: poses and points.
        measured: kind of edge -> its edges.
        fixed: (F,) vertices that stay where they are.
        place: (field, row) -> where it came from.
    """
    _vertices(vertices, place)
    for field, edges in measured.items():
        for name, shape in shapes(field, vertices.dimension, len(edges)).items():
            _shape(f"{field}.{name}", getattr(edges, name), shape)
        if len(edges):
            _ends(vertices, field, edges.nodes, place)
            _values(edges, field, place)
    outside = _first((fixed < 0) | (fixed >= len(vertices.names)))
    if outside is not None:
        allowed = f"must be in 0..{len(vertices.names) - 1}"
        raise InputError(place("fixed", outside), fixed[outside], allowed, "Give places in names.")


def _vertices(graph: Vertices, place: Place) -> None:
    n = len(graph.names)
    if graph.dimension not in (2, 3):
        raise InputError("dimension", graph.dimension, "must be 2 or 3", "Give the dimension of the positions.")
    if not n:
        raise InputError("names", "0 vertices", "must be at least one", "Check that the file is complete.")
    turn = 1 if graph.dimension == 2 else 4
    wanted = {"is_pose": (n,), "position": (n, graph.dimension), "orientation": (n, turn), "stamps": (n,)}
    for field, shape in wanted.items():
        _shape(field, getattr(graph, field), shape)
    first: dict[str, int] = {}
    for row, name in enumerate(graph.names):
        if not NAME.fullmatch(name):
            raise InputError(place("names", row), repr(name), "must be a letter and a number as A0", "Rename it.")
        if first.setdefault(name, row) != row:
            before = f"must be given once, and is at {place('names', first[name])}"
            raise InputError(place("names", row), f"vertex {name}", before, "Remove or rename one of them.")
    infinite = _first(np.isinf(np.hstack([graph.position, graph.orientation])).any(axis=1))
    if infinite is not None:
        raise InputError(
            place("names", infinite),
            f"vertex {graph.names[infinite]} at infinity",
            "must be finite, or NaN where unknown",
            "Mend the number.",
        )
    timed = _first(np.isfinite(graph.stamps) & ~graph.is_pose)
    if timed is not None:
        raise InputError(
            place("names", timed),
            f"stamp {graph.stamps[timed]} of {graph.names[timed]}",
            "must be NaN: a point has none",
            "Give stamps to poses only.",
        )
    _unit(graph.orientation, "names", place)


def _ends(graph: Vertices, field: str, nodes: Ints, place: Place) -> None:
    outside = _first(((nodes < 0) | (nodes >= len(graph.names))).any(axis=1))
    if outside is not None:
        raise InputError(
            place(field, outside),
            f"vertices {nodes[outside].tolist()}",
            f"must be in 0..{len(graph.names) - 1}",
            "Give places in names.",
        )
    for end, role in enumerate(ENDS[field]):
        wrong = None if role == "any" else _first(graph.is_pose[nodes[:, end]] != (role == "pose"))
        if wrong is not None:
            raise InputError(
                place(field, wrong),
                f"vertex {graph.names[nodes[wrong, end]]}",
                f"must be a {role} in {field}",
                "Check the order of the vertices.",
            )
    loop = _first((nodes[:, :1] == nodes[:, 1:]).any(axis=1))
    if loop is not None:
        raise InputError(
            place(field, loop),
            f"{graph.names[nodes[loop, 0]]} twice",
            "must be two vertices",
            "Remove the measurement.",
        )


def _values(edges: Edges, field: str, place: Place) -> None:
    for name in [n for n in shapes(field, 2, 0) if n not in ("nodes", "stamps")]:
        values: Floats = getattr(edges, name).reshape(len(edges), -1)
        row = _first(~np.isfinite(values).all(axis=1))
        if row is not None:
            raise InputError(place(field, row), f"{name} {values[row].tolist()}", "must be finite", "Mend the number.")
        row = _first(values[:, 0] < 0) if name in ("distance", "variance") else None
        if row is not None:
            raise InputError(place(field, row), f"{name} {values[row, 0]:g}", "must be >= 0", "Mend the number.")
        if name in ("variance", "covariance"):
            size = values[:, :: math.isqrt(values.shape[1]) + 1]  # the diagonal
            row = _first((((size > 0) & (size < LEAST)) | (size > 1 / LEAST)).any(axis=1))
            if row is not None:
                allowed = f"must be 0, or of a size in {LEAST:g}..{1 / LEAST:g}: its inverse overflows"
                raise InputError(place(field, row), f"{name} {values[row].tolist()}", allowed, "Mend the number.")
    if isinstance(edges, PoseEdges):
        _unit(edges.orientation, field, place)
    if isinstance(edges, PoseEdges | PointEdges):
        row = _first(~_semidefinite(edges.covariance))
        if row is not None:
            raise InputError(
                place(field, row),
                f"covariance {edges.covariance[row].tolist()}",
                "must be symmetric and positive semi-definite",
                "Check the order of the upper triangle: by rows.",
            )


def _semidefinite(covariance: Floats) -> Bools:
    eigenvalues = np.linalg.eigvalsh(covariance)
    least = ROUNDING * np.maximum(eigenvalues[:, -1], 0)
    uneven = np.abs(covariance - covariance.swapaxes(-1, -2)).max(axis=(-2, -1))
    return np.asarray((eigenvalues[:, 0] >= -least) & (uneven <= least))


def _unit(orientation: Floats, field: str, place: Place) -> None:
    if orientation.shape[-1] == 4:
        row = _first(np.abs(np.linalg.norm(orientation, axis=1) - 1) > UNIT)
        if row is not None:
            raise InputError(
                place(field, row),
                f"quaternion {orientation[row].tolist()}",
                f"must have length 1 to within {UNIT:g}",
                "Order is qx qy qz qw; 0 0 0 1 is no rotation.",
            )


def _shape(field: str, array: AnyArray, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise InputError(field, f"shape {array.shape}", f"must have shape {shape}", "One row per vertex or edge.")


def _first(bad: npt.ArrayLike) -> int | None:
    rows = np.flatnonzero(bad)
    return int(rows[0]) if len(rows) else None

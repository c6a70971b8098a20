"""The rules of a Graph, each at the row, and for readers the line, that breaks it."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from ..arrays import AnyArray, Floats, Ints
from ..errors import InputError
from .values import LEAST, UNIT

if TYPE_CHECKING:
    from .graph import Edges, Graph

ENDS: dict[str, tuple[str, ...]] = {  # what the vertices of each kind of edge must be
    "pose_prior": ("pose",),
    "point_prior": ("point",),
    "relative_pose": ("pose", "pose"),
    "relative_point": ("pose", "point"),
    "ranges": ("any", "any"),
}
NAME = re.compile(r"[A-Za-z](0|[1-9][0-9]{0,14})")
ROUNDING = 1e-9
"""What may be left below zero, or unequal, of the largest eigenvalue or entry."""
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


def check(graph: Graph, place: Place) -> None:
    """InputError at the first rule that a graph breaks: `Graph` lists them.

    Args:
        graph: all its fields as arrays.
        place: (field, row) -> where it came from.
    """
    if graph.dimension not in (2, 3):
        raise InputError("dimension", graph.dimension, "must be 2 or 3", "Give the dimension of the positions.")
    n, d = len(graph.names), graph.dimension
    if not n:
        raise InputError("names", "0 vertices", "must be at least one", "Check that the file is complete.")
    wanted = {"is_pose": (n,), "position": (n, d), "orientation": (n, 1 if d == 2 else 4), "stamps": (n,)}
    for field, shape in wanted.items():
        _shape(field, getattr(graph, field), shape)
    _vertices(graph, place)
    for field in ENDS:
        edges = getattr(graph, field)
        for name, shape in shapes(field, d, len(edges)).items():
            _shape(f"{field}.{name}", getattr(edges, name), shape)
        if len(edges):
            _ends(graph, field, edges.nodes, place)
            _values(edges, field, place)
    fixed = graph.fixed
    _refuse(place, "fixed", (fixed < 0) | (fixed >= n), fixed, f"must be in 0..{n - 1}", "Give places in names.")


def _vertices(graph: Graph, place: Place) -> None:
    names, first = graph.names, dict[str, int]()
    for row, name in enumerate(names):
        if not NAME.fullmatch(name):
            raise InputError(place("names", row), repr(name), "must be a letter and a number as A0", "Rename it.")
        if first.setdefault(name, row) != row:
            before = f"must be given once, and is at {place('names', first[name])}"
            raise InputError(place("names", row), f"vertex {name}", before, "Remove or rename one of them.")
    infinite = np.isinf(np.hstack([graph.position, graph.orientation])).any(axis=1)
    allowed = "must be finite, or NaN where unknown"
    _refuse(place, "names", infinite, [f"vertex {name} at infinity" for name in names], allowed, "Mend the number.")
    timed = [f"stamp {stamp} of {name}" for stamp, name in zip(graph.stamps, names, strict=True)]
    wrong = np.isfinite(graph.stamps) & ~graph.is_pose
    _refuse(place, "names", wrong, timed, "must be NaN: a point has none", "Give stamps to poses only.")
    _unit(graph.orientation, "names", place)


def _ends(graph: Graph, field: str, nodes: Ints, place: Place) -> None:
    n = len(graph.names)
    outside, hint = ((nodes < 0) | (nodes >= n)).any(axis=1), "Give places in names."
    _refuse(place, field, outside, nodes, f"must be in 0..{n - 1}", hint, "vertices ")
    for end, role in enumerate(ENDS[field]):
        if role != "any":
            wrong, called = graph.is_pose[nodes[:, end]] != (role == "pose"), np.array(graph.names)[nodes[:, end]]
            _refuse(
                place,
                field,
                wrong,
                called,
                f"must be a {role} in {field}",
                "Check the order of the vertices.",
                "vertex ",
            )
    loops, twice = (nodes[:, :1] == nodes[:, 1:]).any(axis=1), [f"{graph.names[k]} twice" for k in nodes[:, 0]]
    _refuse(place, field, loops, twice, "must be two vertices", "Remove the measurement.")


def _values(edges: Edges, field: str, place: Place) -> None:
    for name in [n for n in shapes(field, 2, 0) if n not in ("nodes", "stamps")]:
        values: Floats = getattr(edges, name).reshape(len(edges), -1)
        mend, given = "Mend the number.", f"{name} "
        _refuse(place, field, ~np.isfinite(values).all(axis=1), values, "must be finite", mend, given)
        if name in ("distance", "variance"):
            _refuse(place, field, values[:, 0] < 0, [f"{value:g}" for (value,) in values], "must be >= 0", mend, given)
        if name in ("variance", "covariance"):
            size = values[:, :: math.isqrt(values.shape[1]) + 1]  # the diagonal
            extreme = (((size > 0) & (size < LEAST)) | (size > 1 / LEAST)).any(axis=1)
            allowed = f"must be 0, or of a size in {LEAST:g}..{1 / LEAST:g}: its inverse overflows"
            _refuse(place, field, extreme, values, allowed, mend, given)
        if name == "orientation":
            _unit(getattr(edges, name), field, place)
        if name == "covariance":
            covariance: Floats = getattr(edges, name)
            eigenvalues = np.linalg.eigvalsh(covariance)
            least = ROUNDING * np.maximum(eigenvalues[:, -1], 0)
            uneven = np.abs(covariance - covariance.swapaxes(-1, -2)).max(axis=(-2, -1))
            wrong, hint = (eigenvalues[:, 0] < -least) | (uneven > least), "Order of the upper triangle: by rows."
            _refuse(place, field, wrong, covariance, "must be symmetric and positive semi-definite", hint, given)


def _unit(orientation: Floats, field: str, place: Place) -> None:
    if orientation.shape[-1] == 4:
        off = np.abs(np.linalg.norm(orientation, axis=1) - 1) > UNIT
        allowed, hint = f"must have length 1 to within {UNIT:g}", "Order is qx qy qz qw; 0 0 0 1 is no rotation."
        _refuse(place, field, off, orientation, allowed, hint, "quaternion ")


def _refuse(
    place: Place, field: str, wrong: npt.ArrayLike, given: npt.ArrayLike, allowed: str, hint: str, label: str = ""
) -> None:
    """InputError at the first row that is wrong, with what is given there."""
    rows = np.flatnonzero(wrong)
    if len(rows):
        entry = np.asarray(given)[rows[0]].tolist()
        raise InputError(place(field, int(rows[0])), f"{label}{entry}", allowed, hint)


def _shape(field: str, array: AnyArray, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise InputError(field, f"shape {array.shape}", f"must have shape {shape}", "One row per vertex or edge.")

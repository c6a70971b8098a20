"""quadratic: the QCQP of a problem (qcqp.py), each measurement a few rows of A."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np

from ...arrays import Floats, Ints
from ...errors import InputError
from ..model.factor import Factor
from ..model.problem import Problem
from .qcqp import Quadratic

Terms = list[tuple[Floats, Ints]]
"""Coefficients (M, k, c) and columns (M, c): k rows of A per measurement."""


def quadratic(problem: Problem) -> Quadratic:
    """The QCQP of a single problem.

    Exact for position, displacement (any weights; among poses the same for all axes), range, relative_position (one
    weight), pose_chordal and relative_pose_chordal (one weight for the position, one for the rotation). Other kinds
    have no such form; `surrogate` replaces some of them.

    Raises:
        InputError: another kind, weights that differ between axes where a rotation acts, a robust loss, constraints, B
            realisations.

    >>> problem = Problem(("a", "b")).add("position", ["a", "b"], [[0, 0, 0], [4, 0, 0]], std=1.0)
    >>> quadratic(problem.add("range", ("a", "b"), 5.0, std=0.5)).rows.shape
    (3, 6)
    """
    _check(problem)
    d, n = problem.dimension, len(problem.names)
    world = [f for f in problem.factors if f.kind in WORLD]
    stacked = any(one_weight(f.root) is None for f in world if f.kind != "pose_chordal")
    if stacked and problem.poses:
        _refuse(next(f for f in world if f.kind != "pose_chordal" and one_weight(f.root) is None))
    fixes = [f.z[:, :d] for f in world if f.kind != "displacement"]
    origin = np.concatenate(fixes).mean(axis=0) if fixes else np.zeros(d)
    edges = [f.nodes for f in problem.factors if f.kind == "range"]
    place = _Place(
        d, n, np.array(problem.poses, dtype=np.int64), stacked, bool(world or problem.fixed), sum(map(len, edges))
    )
    terms, first = [], 0
    for factor in problem.factors:
        terms += TERMS[factor.kind](place, factor, first if factor.kind == "range" else origin)
        first += len(factor.nodes) * (factor.kind == "range")
    x = np.zeros((n, problem.space.ambient)) if problem.x0 is None else problem.x0
    position, rotation = problem.space.position(x), np.array(problem.space.rotation(x))
    if not problem.fixed:
        rotation[:] = np.eye(d)
    rows, kept = _substitute_fixed(
        _sparse(terms, place.size), place, np.array(problem.fixed, np.int64), position - origin, rotation
    )
    poses = np.setdiff1d(place.poses, problem.fixed)
    k, top = len(place.frame) if stacked else d, len(place.frame) + d * len(poses)
    return Quadratic(
        rows=rows[:, kept],
        stiefel=np.arange(top).reshape(-1, k),
        sphere=top + np.arange(place.ranges * place.width).reshape(place.ranges, place.width),
        dimension=d,
        stacked=stacked,
        framed=place.framed,
        nodes=np.setdiff1d(np.arange(n), problem.fixed),
        poses=poses,
        position=position,
        rotation=rotation,
        origin=origin,
        edges=np.concatenate(edges) if edges else np.empty((0, 2), np.int64),
    )


def _substitute_fixed(rows: Any, place: _Place, fixed: Ints, position: Floats, rotation: Floats) -> tuple[Any, Ints]:
    """A with the terms of fixed nodes moved to the frame, t_i = p_i^T H and R_i^T = R_i^T H, and the columns to
    keep."""
    if not len(fixed):
        return rows, np.arange(place.size)
    from scipy.sparse import csr_array

    at = place.position(fixed)
    columns, values = [at.ravel()], [position[fixed].reshape(at.size, -1)]
    turned = np.intersect1d(fixed, place.poses)
    if len(turned):
        columns.append(place.rotation(turned).ravel())
        values.append(np.swapaxes(rotation[turned], 1, 2).reshape(-1, place.dimension))
    gone = np.concatenate(columns)
    moved = rows[:, gone] @ csr_array(np.concatenate(values))
    total = rows + moved @ csr_array(
        (np.ones(len(place.frame)), (np.arange(len(place.frame)), place.frame)), shape=(len(place.frame), place.size)
    )
    return csr_array(total), np.setdiff1d(np.arange(place.size), gone)


@dataclass(frozen=True, eq=False)
class _Place:
    """Where the rows of X are: `ambient` of them per unit vector and per position."""

    dimension: int
    nodes: int
    poses: Ints
    stacked: bool
    framed: bool
    ranges: int

    @property
    def width(self) -> int:
        return self.dimension if self.stacked else 1

    @property
    def frame(self) -> Ints:
        return np.arange((1 if self.stacked else self.dimension) * self.framed)

    @property
    def top(self) -> int:
        """Rows in Stiefel blocks."""
        return len(self.frame) + self.dimension * len(self.poses)

    @property
    def size(self) -> int:
        return self.top + self.width * (self.ranges + self.nodes)

    def rotation(self, node: Ints) -> Ints:
        order = np.full(self.nodes, -1, dtype=np.int64)
        order[self.poses] = np.arange(len(self.poses))
        return len(self.frame) + self.dimension * order[node][:, None] + np.arange(self.dimension)

    def unit(self, edge: Ints) -> Ints:
        return self.top + self.width * edge[:, None] + np.arange(self.width)

    def position(self, node: Ints) -> Ints:
        return self.top + self.width * (self.ranges + node[:, None]) + np.arange(self.width)


def _position(place: _Place, factor: Factor, origin: Floats) -> Terms:
    return _in_frame(place, factor, factor.z - origin)


def _pose(place: _Place, factor: Factor, origin: Floats) -> Terms:
    """w (t_i - z), and w (R_i^T - R_z^T H)."""
    d = place.dimension
    (i,) = factor.nodes.T
    w, angular = (weight[:, None, None] for weight in _weights(factor, d))
    frame = np.tile(place.frame, (len(i), 1))
    seen = factor.z[:, None, :d] - origin
    turn = np.swapaxes(factor.z[:, d:].reshape(-1, d, d), 1, 2)
    ahead = np.broadcast_to(np.eye(d), turn.shape)
    return [
        (np.concatenate([w, -w * seen], axis=2), np.concatenate([place.position(i), frame], axis=1)),
        (angular * np.concatenate([ahead, -turn], axis=2), np.concatenate([place.rotation(i), frame], axis=1)),
    ]


def _displacement(place: _Place, factor: Factor, origin: Floats) -> Terms:
    return _in_frame(place, factor, factor.z)


def _in_frame(place: _Place, factor: Factor, z: Floats) -> Terms:
    """W (t_i - z), or W (t_j - t_i - z), z in the world's frame."""
    root = factor.root if place.stacked else factor.root[:, :1, :1]
    seen = z[:, :, None] if place.stacked else z[:, None, :]
    ends = [-root, root][2 - factor.nodes.shape[1] :]
    columns = [*(place.position(node) for node in factor.nodes.T), np.tile(place.frame, (len(z), 1))]
    return [(np.concatenate([*ends, -root @ seen], axis=2), np.concatenate(columns, axis=1))]


def _range(place: _Place, factor: Factor, first: int) -> Terms:
    """w (t_j - t_i + r s), s from row `first` of the unit vectors."""
    root = factor.root * np.eye(place.width)
    edge = first + np.arange(len(factor.nodes))
    columns = [*(place.position(node) for node in factor.nodes.T), place.unit(edge)]
    return [(np.concatenate([-root, root, factor.z[..., None] * root], axis=2), np.concatenate(columns, axis=1))]


def _relative_position(place: _Place, factor: Factor, origin: Floats) -> Terms:
    """w (t_j - t_i - z R_i^T), as rows."""
    i, j = factor.nodes.T
    w = _weights(factor, place.dimension)[0][:, None, None]
    columns = np.concatenate([place.position(i), place.position(j), place.rotation(i)], axis=1)
    return [(np.concatenate([-w, w, -w * factor.z[:, None, : place.dimension]], axis=2), columns)]


def _relative_pose(place: _Place, factor: Factor, origin: Floats) -> Terms:
    """The relative position, and w (R_j^T - R_ij^T R_i^T)."""
    d = place.dimension
    i, j = factor.nodes.T
    turn = np.swapaxes(factor.z[:, d:].reshape(-1, d, d), 1, 2)
    w = _weights(factor, d)[1][:, None, None]
    rows = w * np.concatenate([-turn, np.broadcast_to(np.eye(d), turn.shape)], axis=2)
    columns = np.concatenate([place.rotation(i), place.rotation(j)], axis=1)
    return [*_relative_position(place, factor, origin), (rows, columns)]


TERMS: dict[str, Callable[[_Place, Factor, Any], Terms]] = {
    "position": _position,
    "displacement": _displacement,
    "range": _range,
    "relative_position": _relative_position,
    "pose_chordal": _pose,
    "relative_pose_chordal": _relative_pose,
}
"""Measurements of this form."""
WORLD = ("position", "displacement", "pose_chordal")
"""Measurements in the world's frame."""


def _weights(factor: Factor, d: int) -> tuple[Floats, Floats]:
    """(M,) of the position and, if there is one, of the rotation; InputError if either is not one number."""
    root = factor.root
    position, turn = one_weight(root[:, :d, :d]), one_weight(root[:, d:, d:])
    if position is None or turn is None or root[:, :d, d:].any() or root[:, d:, :d].any():
        _refuse(factor)
    return position, turn


def one_weight(root: Floats) -> Floats | None:
    """(M,) w if every W (M, k, k) is w I, else None."""
    weight = root[:, 0, 0] if root.size else np.zeros(len(root))
    return weight if np.allclose(root, weight[:, None, None] * np.eye(root.shape[-1]), rtol=1e-9, atol=0.0) else None


def _sparse(terms: Terms, size: int) -> Any:
    from scipy.sparse import csr_array

    data, row, col, top = [], [], [], 0
    for value, columns in terms:
        count, k, _ = value.shape
        at = top + np.arange(count * k).reshape(count, k, 1)
        data.append(value.ravel())
        row.append(np.broadcast_to(at, value.shape).ravel())
        col.append(np.broadcast_to(columns[:, None], value.shape).ravel())
        top += count * k
    return csr_array((np.concatenate(data), (np.concatenate(row), np.concatenate(col))), shape=(top, size))


def _check(problem: Problem) -> None:
    if problem.batch is not None:
        raise InputError("problem", repr(problem), "must be a single realisation", "Pick one with problem.pick(0).")
    if not problem.factors:
        raise InputError("problem", repr(problem), "has no measurements", "Add factors: problem.add(...).")
    if problem.constraints:
        raise InputError("constraints", problem.constraints[0], "have no place in a relaxation", "Leave them out.")
    for factor in problem.factors:
        if factor.kind not in TERMS:
            hint = "Use surrogate(problem), which replaces what it can and lists it."
            raise InputError("kind", repr(factor.kind), f"is not quadratic: it must be one of {sorted(TERMS)}", hint)
        if factor.loss is not None:
            raise InputError("loss", factor.loss.name, "is not quadratic: must be None", "Use least squares.")


def _refuse(factor: Factor) -> NoReturn:
    raise InputError(
        f"std of {factor.kind}",
        "differs between axes",
        "must be one number for the position and one for the rotation "
        "where poses turn: other weights are no QCQP of this form, and would cost the relaxation its tightness",
        "Use surrogate(problem), which replaces them by one and lists it.",
    )

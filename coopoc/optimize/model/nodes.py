"""Nodes of a problem as users give them, checked: names and indices, dimensions, poses, points in the space."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ...arrays import Floats, Ints
from ...errors import InputError, shown
from ...plugins import suggestion
from .constraint import Constraint
from .factor import Factor
from .inputs import numbers
from .measurements import lookup
from .space import Space


def indices(index: Callable[[Any], int], kind: str, nodes: Any) -> Ints:
    """Nodes (M, arity) of a kind from one node, a tuple or rows of them, each found by `index`."""
    arity = lookup(kind).arity
    places = several(nodes)
    flat = [p for row in places for p in (several(row) if isinstance(row, list | tuple | np.ndarray) else [row])]
    if len(flat) % arity or not flat:
        raise InputError("nodes", nodes, f"must name {arity} points per {kind}", "Give points by name or index.")
    return np.array([index(p) for p in flat]).reshape(-1, arity)


def several(nodes: Any) -> list[Any]:
    """What an iterable holds; a name, a number and an array without an axis are one node.

    >>> several("car"), several(np.array(3)), several(("a", 1))
    (['car'], [array(3)], ['a', 1])
    """
    scalar = isinstance(nodes, np.ndarray) and not nodes.ndim
    return [nodes] if scalar or isinstance(nodes, str) or not isinstance(nodes, Iterable) else list(nodes)


def rows(kind: str, z: npt.ArrayLike, count: int) -> Floats:
    """z (count, size) or with a leading batch axis, from a number, a row or rows."""
    values = numbers(f"z of {kind}", z)
    return values.reshape(count, -1) if values.ndim < 2 and values.size % count == 0 else values


def check_item(item: object, names: Sequence[str], poses: Collection[int], dimension: int) -> None:
    """InputError unless the nodes exist, have a rotation where the kind needs one, and the dimension fits."""
    if not isinstance(item, Factor | Constraint):
        hint = "Add measurements with Problem.add, constraints with Problem.constrain."
        raise InputError("factors, constraints", shown(item), "must be Factors and Constraints", hint)
    known, nodes = item.measurement, item.nodes
    if len(beyond := nodes[(nodes < 0) | (nodes >= len(names))]):
        raise no_such_node(int(beyond[0]), names)
    if item.dimension not in (None, dimension):
        hint = f"Make it with Problem(names, dimension={item.dimension})." if known.plane else "Leave it out."
        raise InputError(f"{item.kind}", f"for {item.dimension} dimensions", f"must fit a problem of {dimension}", hint)
    observers = {"world": nodes[:, :0], "body": nodes[:, :1], "relative": nodes}[known.frame]
    turning = poses if isinstance(poses, frozenset) else frozenset(poses) if observers.size else frozenset()
    if lacking := sorted(set(observers.ravel().tolist()) - turning):
        allowed = "must be a pose: the measurement is in its body frame"
        raise InputError(f"nodes of {item.kind}", names[lacking[0]], allowed, "Name it in Problem(names, poses=[...]).")


def no_such_node(node: Any, names: Sequence[str]) -> InputError:
    """The error for a node that is neither a name nor an index."""
    known = ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")
    allowed = f"must be an index < {len(names)} or one of {known}"
    return InputError("node", shown(node), allowed, suggestion(node, names, "Name the point when the Problem is made."))


def points(space: Space, n: int, field: str, x: npt.ArrayLike, ranks: tuple[int, ...] = (2, 3)) -> Floats:
    """x as an array (n, ambient) or (B, n, ambient); InputError if it is not one, or holds matrices of no rotation."""
    array = numbers(field, x)
    if array.ndim not in ranks or array.shape[-2:] != (n, space.ambient) or not np.isfinite(array).all():
        batch = f", or (B, n, {space.ambient})" if 3 in ranks else ""
        given = f"shape {array.shape}" if np.isfinite(array).all() else "not finite"
        hint = "Make it with coopoc.optimize.pose." if space.has_rotation else "Give one row of metres per point."
        raise InputError(field, given, f"must be finite with shape ({n}, {space.ambient}){batch}", hint)
    if space.has_rotation:
        turned = space.rotation(array)
        if np.abs(turned @ np.swapaxes(turned, -1, -2) - np.eye(space.dimension)).max(initial=0.0) > 1e-6:
            raise InputError(field, "a matrix that is no rotation", "must hold rotations", "Use coopoc.optimize.pose.")
    return array

"""The measurement registry: one formula on components serves NumPy, torch and CasADi, and is differentiated exactly."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from ...arrays import Bools, Floats, instance, number, one_of
from ...errors import InputError, unknown
from ...one_file import in_file
from ...plugins import find, names
from ...world import links as polar
from .space import Space

Component = Literal["coordinate", "distance", "angle", "turn"]
Frame = Literal["world", "body", "relative"]
Formula = Callable[..., Sequence[Any]]


@dataclass(frozen=True, eq=False)
class Measurement:
    """A sensor's measurement of one node (arity 1) or of a second node from a first (arity 2).

    Args:
        name: kind of the factors that carry it.
        arity: 1 or 2 nodes.
        frame: of the formula's vector. "world": the vector x, y, z of the point, or second - first. "body": that vector
            as the first node, a pose, sees it, R_i^T (p_j - p_i). "relative": it and the 3x3 components of R_i^T R_j;
            of one node, its own position and rotation.
        components: nature of each residual: a coordinate, a distance (m, > 0), an angle (rad, residuals wrap) or part
            of a rotation vector (rad).
        formula: (x, y, z, m) or (x, y, z, R, m), with the `constants` before m -> one number per component; m is a
            namespace with sqrt, atan2 and where.
        linear: the formula is the world vector itself.
        plane: components that a problem of dimension 2 keeps (z = 0 there); None if it has none of them.
        constants: how many numbers each measurement carries, such as the time between two positions.
        compares_poses: z is a pose (Space.ambient numbers), and the formula also gets it: (x, y, z, R, pose z, m).
    """

    name: str
    arity: int
    frame: Frame
    components: tuple[Component, ...]
    formula: Formula
    linear: bool = False
    plane: tuple[int, ...] | None = None
    constants: int = 0
    compares_poses: bool = False

    def kept(self, dimension: int) -> tuple[int, ...]:
        """Components in a space of 2 or 3 dimensions; InputError if there are none."""
        if dimension == 3:
            return tuple(range(len(self.components)))
        if self.plane is None:
            raise InputError("kind", repr(self.name), "does not exist in two dimensions", "Use points (x, y, z).")
        return self.plane

    def size(self, dimension: int = 3) -> int:
        """Residuals per measurement."""
        return len(self.kept(dimension))

    def given(self, dimension: int = 3) -> int:
        """Numbers z per measurement."""
        return Space(dimension, has_rotation=True).ambient if self.compares_poses else self.size(dimension)

    def angles(self, dimension: int = 3) -> Bools:
        """(size,) True where a component is an angle."""
        return np.array([self.components[k] == "angle" for k in self.kept(dimension)])

    def predict(self, vector: Floats, constants: Sequence[float] = ()) -> Floats:
        """(..., size) h of vectors (..., d), for kinds that see no rotation."""
        shape = vector.shape[:-1]
        nothing = np.zeros((*shape, self.size(vector.shape[-1])))
        return self.difference(vector, None, nothing, np.broadcast_to(constants, (*shape, len(constants))))

    def residual(self, local: Sequence[Any], z: Iterable[Any], constants: Iterable[Any], m: Any) -> list[Any]:
        """h(x) - z in any namespace; angles are not wrapped.

        Args:
            local: x, y[, z] of the vector, then, if the frame is relative, the d^2 components of the rotation.
            z: `given` numbers.
            constants: `constants` numbers.
        """
        dimension = 2 if len(local) in (2, 6) else 3
        kept = self.kept(dimension)
        arguments = embed(local, dimension)
        if self.compares_poses:
            return [self.formula(*arguments, embed([*z], dimension), m)[k] for k in kept]
        predicted = self.formula(*arguments, *constants, m)
        return [predicted[k] - number for k, number in zip(kept, z, strict=True)]

    def difference(self, local: Floats, rotation: Floats | None, z: Floats, constants: Floats) -> Floats:
        """(..., size) residuals h(x) - z, angles in [-pi, pi).

        Args:
            local: (..., d) vector.
            rotation: (..., d, d), or None unless the frame is relative.
            z: (..., given).
            constants: (..., constants).
        """
        numbers = columns(local)
        if rotation is not None:
            numbers += columns(rotation.reshape(*rotation.shape[:-2], -1))
        parts = self.residual(numbers, columns(z), columns(constants), np)
        gap: Floats = np.stack(np.broadcast_arrays(*parts), axis=-1)
        dimension = local.shape[-1]
        for k, component in enumerate(self.kept(dimension)):
            if self.components[component] == "angle":
                gap[..., k] = polar.wrap(gap[..., k])
        return gap


def columns(array: Floats) -> list[Floats]:
    """The components of (..., k), views (...)."""
    return [array[..., k] for k in range(array.shape[-1])]


def embed(numbers: Sequence[Any], dimension: int) -> list[Any]:
    """x, y, z and, if there are more numbers, the 3x3 components of the rotation: a plane is z = 0 in space."""
    d = dimension
    at = [*numbers[:d], *[0.0 * numbers[0]] * (3 - d)]  # of the namespace's own type
    if len(numbers) == d:
        return at
    turned = [[numbers[d + d * i + j] if max(i, j) < d else float(i == j) for j in range(3)] for i in range(3)]
    return [*at, turned]


MEASUREMENTS: dict[str, Measurement] = {}


def measurement(
    name: str,
    arity: int,
    components: tuple[Component, ...],
    frame: Frame = "world",
    linear: bool = False,
    plane: tuple[int, ...] | None = None,
    constants: int = 0,
    compares_poses: bool = False,
) -> Callable[[Formula], Formula]:
    """Register a formula as a measurement (see Measurement for the arguments); the formula itself is returned.

    Raises:
        InputError: the name is taken, so that nothing is silently overwritten; an arity other than 1 or 2, an unknown
            component or frame, or `linear` without three coordinates of a world vector.

    >>> MEASUREMENTS["range"].difference(np.array([3.0, 4.0, 0.0]), None, np.array([4.0]), np.empty(0))
    array([1.])
    """

    instance("name", name, str, 'Give the kind of its factors, such as "range".')
    if isinstance(arity, bool) or not isinstance(arity, int) or arity not in (1, 2):
        raise InputError("arity", arity, "must be 1 (a node) or 2 (a pair)", "The formula gets one vector x, y, z.")
    given = components if isinstance(components, tuple | list) else ()
    if not given or not all(isinstance(component, str) and component in get_args(Component) for component in given):
        hint = "Give one per number that the formula returns."
        raise InputError("components", components, f"must be among {get_args(Component)}", hint)
    one_of("frame", frame, get_args(Frame))
    constants = number("constants", constants, 0, kind=int, allowed=">= 0", hint="How many numbers each one carries.")
    if instance("linear", linear, bool) and (tuple(components) != ("coordinate",) * 3 or frame != "world"):
        raise InputError(
            "linear", linear, "means that the formula is the vector itself, in the world frame", "Leave it out."
        )

    def register(formula: Formula) -> Formula:
        if name in MEASUREMENTS and not _edited(MEASUREMENTS[name].formula, formula):
            raise InputError("measurement", repr(name), "is registered already", "Choose another name.")
        MEASUREMENTS[name] = Measurement(
            name, arity, frame, tuple(components), formula, linear, plane, constants, compares_poses
        )
        return formula

    return register


def lookup(kind: str) -> Measurement:
    """The measurement of a kind: a registered one, an entry point of "coopoc.measurements" or "folder/mine.py:NAME".

    Raises:
        InputError: no such kind (lists the kinds and the nearest one), or the object is no measurement.
    """
    if not isinstance(kind, str):
        raise unknown("kind", kind, sorted(MEASUREMENTS))
    if kind in MEASUREMENTS:
        return MEASUREMENTS[kind]
    if not in_file(kind) and kind not in names("coopoc.measurements"):
        raise unknown("kind", kind, sorted({*MEASUREMENTS, *names("coopoc.measurements")}))
    formula = find("coopoc.measurements", kind)
    for registered in MEASUREMENTS.values():
        if registered.formula is formula:
            return registered
    raise InputError("kind", repr(kind), "is no measurement", "Decorate the formula: @measurement(name, arity, ...).")


def _edited(before: Formula, after: Formula) -> bool:
    """Whether both come from one file that was loaded again after a change ("mine.py:NAME")."""
    same = before.__code__.co_filename == after.__code__.co_filename
    return same and before.__module__ != after.__module__

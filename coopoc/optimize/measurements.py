"""The measurement registry: one formula on components serves NumPy, torch and CasADi, and is differentiated exactly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from ..arrays import Bools, Floats
from ..errors import InputError
from ..world import spherical as polar
from . import dual

Component = Literal["coordinate", "distance", "angle"]
Formula = Callable[[Any, Any, Any, Any], tuple[Any, ...]]


@dataclass(frozen=True, eq=False)
class Measurement:
    """What a sensor sees of one point (arity 1) or of the vector from a first point to a second (arity 2).

    Args:
        name: kind of the factors that carry it.
        arity: 1: the formula gets the point's x, y, z; 2: the difference second - first.
        components: nature of each number: a coordinate (m), a distance (m, > 0) or an angle (rad, residuals wrap).
        linear: the formula is the vector itself.
        formula: (x, y, z, m) -> one number per component, m a namespace with sqrt and atan2.
    """

    name: str
    arity: int
    components: tuple[Component, ...]
    linear: bool
    formula: Formula

    @property
    def size(self) -> int:
        """Numbers per measurement."""
        return len(self.components)

    @property
    def angles(self) -> Bools:
        """(size,) True where a component is an angle."""
        return np.array([c == "angle" for c in self.components])

    def predict(self, vector: Floats) -> Floats:
        """(..., size) measurements that vectors (..., 3) would give."""
        if self.linear:
            return vector
        return np.stack(self.formula(vector[..., 0], vector[..., 1], vector[..., 2], np), axis=-1)

    def differentiate(self, vector: Floats) -> tuple[Floats, Floats]:
        """(..., size) measurements and (..., size, 3) their derivatives by the vector, or (size, 3) if linear."""
        if self.linear:
            return vector, np.eye(3)
        value = np.empty((*vector.shape[:-1], self.size))
        slope = np.empty((*vector.shape[:-1], self.size, 3))
        for k, part in enumerate(self.formula(*dual.seeds(vector), dual)):
            value[..., k] = part.value
            slope[..., k, :] = np.moveaxis(np.broadcast_to(part.slope, (3, *vector.shape[:-1])), 0, -1)
        return value, slope

    def difference(self, predicted: Floats, measured: Floats) -> Floats:
        """predicted - measured, angles in [-pi, pi)."""
        gap = predicted - measured
        for k, component in enumerate(self.components):
            if component == "angle":
                gap[..., k] = polar.wrap(gap[..., k])
        return gap


MEASUREMENTS: dict[str, Measurement] = {}


def measurement(
    name: str, arity: int, components: tuple[Component, ...], linear: bool = False
) -> Callable[[Formula], Formula]:
    """Register a formula (x, y, z, m) -> components as a measurement; the formula itself is returned.

    Raises:
        InputError: the name is taken, so that nothing is silently overwritten; an arity other than 1 or 2, an unknown
            component, or `linear` without three coordinates.

    >>> MEASUREMENTS["range"].predict(np.array([3.0, 4.0, 0.0]))
    array([5.])
    """

    if arity not in (1, 2):
        raise InputError("arity", arity, "must be 1 (a point) or 2 (a pair)", "The formula gets one vector x, y, z.")
    if not components or not set(components) <= set(get_args(Component)):
        mend = "Give one per number that the formula returns."
        raise InputError("components", components, f"must be among {get_args(Component)}", mend)
    if linear and components != ("coordinate",) * 3:
        raise InputError("linear", linear, "means that the formula is the vector itself", "Leave it out.")

    def register(formula: Formula) -> Formula:
        if name in MEASUREMENTS:
            raise InputError("measurement", repr(name), "is registered already", "Choose another name.")
        MEASUREMENTS[name] = Measurement(name, arity, components, linear, formula)
        return formula

    return register


def lookup(kind: str) -> Measurement:
    """The measurement of a kind; InputError that lists the kinds if there is none."""
    if kind not in MEASUREMENTS:
        raise InputError("kind", repr(kind), f"must be one of {sorted(MEASUREMENTS)}", "Or register it: @measurement.")
    return MEASUREMENTS[kind]


@measurement("position", arity=1, components=("coordinate",) * 3, linear=True)
def position(x: Any, y: Any, z: Any, m: Any = np) -> tuple[Any, ...]:
    """Where a point is, such as a GNSS fix: m."""
    return x, y, z


@measurement("displacement", arity=2, components=("coordinate",) * 3, linear=True)
def displacement(dx: Any, dy: Any, dz: Any, m: Any = np) -> tuple[Any, ...]:
    """The vector from the first point to the second, such as odometry dt u: m."""
    return dx, dy, dz


@measurement("range", arity=2, components=("distance",))
def range_(dx: Any, dy: Any, dz: Any, m: Any = np) -> tuple[Any, ...]:
    """Distance between two points: m."""
    return polar.spherical(dx, dy, dz, m)[:1]


@measurement("azimuth", arity=2, components=("angle",))
def azimuth(dx: Any, dy: Any, dz: Any, m: Any = np) -> tuple[Any, ...]:
    """Angle of the second point as the first sees it, atan2(dy, dx) in the world frame: rad."""
    return polar.spherical(dx, dy, dz, m)[1:2]


@measurement("inclination", arity=2, components=("angle",))
def inclination(dx: Any, dy: Any, dz: Any, m: Any = np) -> tuple[Any, ...]:
    """Angle from +z of the second point as the first sees it: rad."""
    return polar.spherical(dx, dy, dz, m)[2:]


@measurement("spherical", arity=2, components=("distance", "angle", "angle"))
def spherical(dx: Any, dy: Any, dz: Any, m: Any = np) -> tuple[Any, ...]:
    """Range, azimuth and inclination of the second point as the first sees it: m, rad, rad."""
    return polar.spherical(dx, dy, dz, m)

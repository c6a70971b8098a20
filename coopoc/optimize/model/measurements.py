"""Measurements by name: one formula on components for each, which NumPy, torch and CasADi run, and their registry.

Fixes, odometry, ranges and angles of points and of poses are registered here; other distributions add theirs.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from ...arrays import Bools, Floats, instance, one_of, whole
from ...errors import InputError
from ...plugins import find, in_file, names
from ...world.links import spherical as to_spherical
from .space import Space

Component = Literal["coordinate", "distance", "angle", "turn"]
Frame = Literal["world", "body", "relative", "nodes"]
Formula = Callable[..., Sequence[Any]]


@dataclass(frozen=True, eq=False)
class Measurement:
    """A sensor's measurement of one node (arity 1), of a second node from a first (arity 2), or of any number of nodes.

    Args:
        name: kind of the factors that carry it.
        arity: 1 or 2 nodes, of frame "nodes" any number.
        frame: of the formula's vector. "world": the vector x, y, z of the point, or second - first. "body": that vector
            as the first node, a pose, sees it, R_i^T (p_j - p_i). "relative": it and the 3x3 components of R_i^T R_j;
            of one node, its own position and rotation. "nodes": no vector, but each node as (x, y, z, R), R of a point
            the identity, so that unknowns of sensors, such as an offset or an arm, are nodes, too.
        components: nature of each residual: a coordinate, a distance (m, > 0), an angle (rad, residuals wrap) or part
            of a rotation vector (rad).
        formula: (x, y, z, m), (x, y, z, R, m) or (node, ..., m), with the `constants` before m -> one number per
            component; m is a namespace with sqrt, atan2 and where.
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

    def width(self, dimension: int = 3) -> int:
        """Numbers z per measurement."""
        return Space(dimension, has_rotation=True).ambient if self.compares_poses else self.size(dimension)

    def angles(self, dimension: int = 3) -> Bools:
        """(size,) True where a component is an angle."""
        return np.array([self.components[k] == "angle" for k in self.kept(dimension)])

    def predict(self, vector: Floats, constants: Sequence[float] = ()) -> Floats:
        """(..., size) h of vectors (..., d), for kinds that see no rotation."""
        parts = self.residual([*np.moveaxis(vector, -1, 0)], [0.0] * self.size(vector.shape[-1]), constants, np)
        return np.stack(np.broadcast_arrays(*parts), axis=-1)

    def residual(self, local: Sequence[Any], z: Iterable[Any], constants: Iterable[Any], m: Any) -> list[Any]:
        """h(x) - z in any namespace; angles are not wrapped.

        Args:
            local: x, y[, z] of the vector, then, if the frame is relative, the d^2 components of the rotation; of frame
                "nodes" the numbers of all nodes.
            z: `given` numbers.
            constants: `constants` numbers.
        """
        own = len(local) // self.arity if self.frame == "nodes" else len(local)
        dimension = 2 if own in (2, 6) else 3
        kept, each = self.kept(dimension), [embed(local[k:][:own], dimension) for k in range(0, len(local), own)]
        arguments = [(*node, np.eye(3).tolist())[:4] for node in each] if self.frame == "nodes" else each[0]
        if self.compares_poses:
            return [self.formula(*arguments, embed([*z], dimension), m)[k] for k in kept]
        predicted = self.formula(*arguments, *constants, m)
        return [predicted[k] - number for k, number in zip(kept, z, strict=True)]


def embed(numbers: Sequence[Any], dimension: int) -> list[Any]:
    """x, y, z and, if there are more numbers, the 3x3 components of the rotation: a plane is z = 0 in space."""
    d = dimension
    at = [*numbers[:d], *[0.0 * numbers[0]] * (3 - d)]  # of the namespace's own type
    if len(numbers) == d:
        return at
    return [*at, [[numbers[d + d * i + j] if max(i, j) < d else float(i == j) for j in range(3)] for i in range(3)]]


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
        InputError: the name is taken, so that nothing is silently overwritten; an arity that the frame does not have,
            an unknown component or frame, or `linear` without three coordinates of a world vector.

    >>> MEASUREMENTS["range"].predict(np.array([3.0, 4.0, 0.0]))
    array([5.])
    """

    instance("name", name, str, 'Give the kind of its factors, such as "range".')
    one_of("frame", frame, Frame)
    hint = 'The formula gets one vector x, y, z; frame="nodes" gives it up to nine nodes.'
    whole("arity", arity, 1, 9 if frame == "nodes" else 2, hint)
    entries = components if isinstance(components, tuple | list) else ()
    if not entries or not all(isinstance(component, str) and component in get_args(Component) for component in entries):
        hint = "Give one per number that the formula returns."
        raise InputError("components", components, f"must be among {get_args(Component)}", hint)
    constants = whole("constants", constants, hint="How many numbers each one carries.")
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
    if isinstance(kind, str) and kind in MEASUREMENTS:
        return MEASUREMENTS[kind]
    plugins = names("coopoc.measurements")
    if not (isinstance(kind, str) and in_file(kind)):
        one_of("kind", kind, sorted({*MEASUREMENTS, *plugins}))
    formula = find("coopoc.measurements", kind)
    for registered in MEASUREMENTS.values():
        if registered.formula is formula:
            return registered
    raise InputError("kind", repr(kind), "is no measurement", "Decorate the formula: @measurement(name, arity, ...).")


def _edited(before: Formula, after: Formula) -> bool:
    """Whether both come from one file that was loaded again after a change ("mine.py:NAME")."""
    same = before.__code__.co_filename == after.__code__.co_filename
    return same and before.__module__ != after.__module__


VECTOR: tuple[Component, ...] = ("coordinate",) * 3
PLANE = (0, 1)
SEEN: tuple[Component, ...] = ("distance", "angle", "angle")


def vector(x: Any, y: Any, z: Any, m: Any) -> Sequence[Any]:
    """The vector of the frame itself: m."""
    return x, y, z


def spherical_part(first: int, end: int) -> Formula:
    """Of range, azimuth and inclination of the frame's vector those from `first` to before `end`: m, rad."""
    return lambda x, y, z, m: to_spherical(x, y, z, m)[first:end]


for _name, _arity, _frame in (
    ("position", 1, "world"),  # a GNSS fix
    ("displacement", 2, "world"),  # such as odometry dt u
    ("relative_position", 2, "body"),
):
    measurement(_name, _arity, VECTOR, _frame, linear=_frame == "world", plane=PLANE)(vector)  # type: ignore[arg-type]
for _name, _frame, _first, _end in (
    ("range", "world", 0, 1),
    ("azimuth", "world", 1, 2),  # atan2(dy, dx)
    ("inclination", "world", 2, 3),  # from +z
    ("spherical", "world", 0, 3),
    ("bearing", "body", 1, 2),  # from the forward axis, anticlockwise about the up axis
    ("body_spherical", "body", 0, 3),
):
    _flat = PLANE[: min(2, _end) - _first] or None  # without the inclination
    measurement(_name, 2, SEEN[_first:_end], _frame, plane=_flat)(spherical_part(_first, _end))  # type: ignore[arg-type]


@measurement("speed", arity=2, components=("distance",), plane=(0,), constants=1)
def speed(dx: Any, dy: Any, dz: Any, dt: Any, m: Any) -> Sequence[Any]:
    """Mean speed between two positions of a vehicle that are dt apart (the constant, s): m/s."""
    return (to_spherical(dx, dy, dz, m)[0] / dt,)


@measurement("range_offset", arity=3, components=("coordinate",), frame="nodes", plane=(0,))
def range_offset(a: Any, b: Any, offset: Any, m: Any) -> Sequence[Any]:
    """Distance between two nodes and the first coordinate of a third, an offset that ranges share: m."""
    x, y, z = (q - p for p, q in zip(a[:3], b[:3], strict=True))
    return (to_spherical(x, y, z, m)[0] + offset[0],)


@measurement("antenna", arity=2, components=VECTOR, frame="nodes", plane=PLANE)
def antenna(node: Any, arm: Any, m: Any) -> Sequence[Any]:
    """Where the antenna of a node is, p + R l, the arm l (forward, left, up; of a point east, north, up) a node: m."""
    at, turned = node[:3], node[3]
    return [at[i] + sum(turned[i][j] * arm[j] for j in range(3)) for i in range(3)]


def product(a: Any, b: Any) -> list[list[Any]]:
    """Rows of a matrix product in any namespace."""
    return [[sum(p * q for p, q in zip(row, column, strict=True)) for column in zip(*b, strict=True)] for row in a]


PLANES = ((1, 2), (2, 0), (0, 1))
"""Axes about which x, y and z turn."""


def geodesic(x: Any, y: Any, z: Any, R: Any, measured: Any, m: Any) -> Sequence[Any]:
    """Rz^T (t - tz) and Log(Rz^T R), the error of a relative pose (t, R) against a measured (tz, Rz): m, rad."""
    *at, turned = measured
    gap = [x - at[0], y - at[1], z - at[2]]
    [moved], error = product([gap], turned), product(zip(*turned, strict=True), R)
    half = [0.5 * (error[j][i] - error[i][j]) for i, j in PLANES]
    sine = half[0] * half[0] + half[1] * half[1] + half[2] * half[2]
    cosine = 0.5 * (error[0][0] + error[1][1] + error[2][2] - 1.0)
    if isinstance(R[2][2], float):  # in the plane one angle suffices
        return *moved, 0.0, 0.0, m.atan2(half[2], cosine)
    turning = sine > 1e-12
    root = m.sqrt(m.where(turning, sine, 1.0))
    small = m.where(cosine > 0.0, 1.0 + sine / 6.0, np.nan)  # half a turn has no direction
    ratio = m.where(turning, m.atan2(root, cosine) / root, small)
    return *moved, *(ratio * h for h in half)


def logarithm(x: Any, y: Any, z: Any, R: Any, measured: Any, m: Any) -> Sequence[Any]:
    """Log(Tz^-1 T), the twist that takes a measured pose Tz to the relative pose T: GTSAM's BetweenFactor, m and rad.

    Its rotation vector w is that of `geodesic`, its translation u - w x u / 2 + c w x (w x u) with
    c = (1 - (|w| / 2) cot(|w| / 2)) / |w|^2 and u = Rz^T (t - tz).

    References:
        Sola et al., A micro Lie theory, arXiv 1812.01537, equations 146 and 174.
    """
    *u, a, b, c = geodesic(x, y, z, R, measured, m)
    w = (a, b, c)
    once = _cross(w, u)
    twice = _cross(w, once)
    share = _half_cotangent(a * a + b * b + c * c, m)
    return *(u[k] - 0.5 * once[k] + share * twice[k] for k in range(3)), *w


def _cross(a: Sequence[Any], b: Sequence[Any]) -> list[Any]:
    return [a[i] * b[j] - a[j] * b[i] for i, j in PLANES]


def _half_cotangent(square: Any, m: Any) -> Any:
    """(1 - (w / 2) cot(w / 2)) / w^2 of w^2; near zero by its series, whose terms beyond are below rounding."""
    large = square > 1e-2
    w = m.sqrt(m.where(large, square, 1.0))
    exact = (1.0 - 0.5 * w * m.cos(0.5 * w) / m.sin(0.5 * w)) / (w * w)
    series = 1 / 12 + square * (1 / 720 + square * (1 / 30240 + square * (1 / 1209600 + square / 47900160)))
    return m.where(large, exact, series)


def chordal(x: Any, y: Any, z: Any, R: Any, measured: Any, m: Any) -> Sequence[Any]:
    """t - tz and the nine entries of R - Rz: PyFG's objective, quadratic in positions and rotation matrices: m, 1."""
    *at, turned = measured
    return x - at[0], y - at[1], z - at[2], *(R[i][j] - turned[i][j] for i in range(3) for j in range(3))


_TURN = (*VECTOR, "turn", "turn", "turn")
_CHORD = ("coordinate",) * 12
for _name, _arity in (("pose", 1), ("relative_pose", 2)):
    _options = {"arity": _arity, "frame": "relative", "compares_poses": True}
    measurement(_name, components=_TURN, plane=(0, 1, 5), **_options)(geodesic)  # type: ignore[arg-type]
    if _arity == 2:
        measurement(f"{_name}_log", components=_TURN, plane=(0, 1, 5), **_options)(logarithm)  # type: ignore[arg-type]
    measurement(f"{_name}_chordal", components=_CHORD, plane=(0, 1, 3, 4, 6, 7), **_options)(chordal)  # type: ignore[arg-type]


LEAST_RANGE = 1.0
"""m; a noisy range near zero would make the converted angles seem exact."""
LEAST_SINE = 0.05
"""Of the inclination: near the vertical the azimuth carries no information."""


CONVERTED = "spherical"
"""The kind whose measurements become vectors; of the others those that are linear stay, and angles are left out."""


def converted_rows(z: list[Any], m: Any) -> tuple[Any, list[list[Any]]]:
    """Range d and rows of diag(1, 1/(d sin inc), 1/d) [u e_az e_inc]^T in any namespace, from measured values.

    The converted residual is their product with the vector between the nodes, less (d, 0, 0): d u is the measured one.

    Args:
        z: range, azimuth and, in space, inclination.
        m: with sin, cos, fabs, fmax and where.

    >>> import numpy as np
    >>> converted_rows([2.0, 0.0], np)[1]
    [[np.float64(1.0), np.float64(0.0)], [np.float64(-0.0), np.float64(0.5)]]
    """
    d, sa, ca = m.fmax(z[0], LEAST_RANGE), m.sin(z[1]), m.cos(z[1])
    if len(z) == 2:
        return d, [[ca, sa], [-sa / d, ca / d]]
    si, ci = m.sin(z[2]), m.cos(z[2])
    across = d * m.where(si < 0, -1.0, 1.0) * m.fmax(m.fabs(si), LEAST_SINE)
    return d, [[si * ca, si * sa, ci], [-sa / across, ca / across, 0.0 * d], [ci * ca / d, ci * sa / d, -si / d]]

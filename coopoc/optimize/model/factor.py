"""Factor, Loss and Constraint: M measurements of one kind and their noise, robust losses, bounds on formulas; the check
of what users give for them.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import InitVar, dataclass
from functools import cached_property, lru_cache
from typing import Any, TypeVar

import numpy as np
from numpy import isfinite
from numpy.linalg import cholesky, det, eigvalsh, inv, matrix_rank, norm
from numpy.typing import ArrayLike

from ...arrays import (
    TWO_TURNS,
    AnyArray,
    Bools,
    Floats,
    Ints,
    checked,
    frozen,
    instance,
    number,
    one_of,
    refuse,
    remade,
)
from ...errors import InputError
from .measurements import Measurement, lookup


def whitening(kind: str, cov: ArrayLike) -> Floats:
    """W with W^T W = cov^-1 of covariances (..., size, size): the inverse of their Cholesky factor.

    Raises:
        InputError: not square, not finite, not symmetric, not positive definite; it names the first that is bad.

    >>> whitening("range", [[4.0]])
    array([[0.5]])
    """
    array = checked("cov", cov)
    if array.ndim < 2 or array.shape[-1] != array.shape[-2]:
        raise InputError("cov", array.shape, "must be square matrices", "Give variances on the diagonal, m^2 or rad^2.")
    flat = array.reshape(-1, *array.shape[-2:])
    mirrored = np.isclose(flat, flat.mT, rtol=1e-6, atol=1e-300) & isfinite(flat)
    least = np.full(len(flat), np.nan)
    symmetric = np.asarray(mirrored.all(axis=(1, 2)))
    least[symmetric] = eigvalsh(flat[symmetric])[:, 0]
    if not (least > 0).all():
        k = int(np.flatnonzero(~(least > 0))[0])
        why = f"smallest eigenvalue {least[k]:.3g}" if symmetric[k] else "not symmetric or not finite"
        hint = "Give a covariance, not an information matrix, with no exact direction."
        raise InputError(f"cov of {kind}", f"number {k}: {why}", "must be symmetric positive definite", hint)
    return inv(cholesky(array))


@lru_cache(maxsize=256)
def fitting(measurement: Measurement, width: int) -> int | None:
    """The dimension whose z has `width` numbers; None if both have; InputError if none has."""
    widths = {d: measurement.width(d) for d in (2, 3) if d == 3 or measurement.plane is not None}
    fits = [d for d, own in widths.items() if own == width]
    if not fits:
        hint = "Write poses with coopoc.optimize.pose." if measurement.compares_poses else "Give one per component."
        words = f"must have {' or '.join(map(str, sorted({*widths.values()})))}"
        raise InputError(f"z of {measurement.name}", f"{width} numbers per row", words, hint)
    return fits[0] if len(fits) == 1 else None


def check_values(measurement: Measurement, z: ArrayLike, count: int) -> Floats:
    """z as (M, k): finite, distances > 0, angles in radians, rotations that are some."""
    field = f"z of {measurement.name}"
    array = checked(field, z)
    if array.ndim != 2 or len(array) != count:
        shape = f"must have shape ({count}, {measurement.width()}) for {measurement.name}"
        raise InputError("z", array.shape, shape, "One row per row of nodes; a problem for each run.")
    dimension = fitting(measurement, array.shape[-1]) or 3
    hint = "Drop the measurement, or give it std = inf and any finite z."
    refuse(field, array, ~isfinite(array), "must be finite", hint)
    if measurement.compares_poses:
        check_rotations(field, array[:, dimension:].reshape(-1, dimension, dimension))
        return array
    for column, kept in zip(array.T, measurement.kept(dimension), strict=False):
        component = measurement.components[kept]
        if component == "distance":
            hint = "Coincident vehicles have no direction: drop the pair."
            refuse(field, column, column <= 0, "must be a distance > 0 m", hint)
        if component == "angle":
            refuse(field, column, abs(column) > 2 * np.pi, "must be within 2 pi rad", DEGREES)
    return array


def check_rotations(field: str, rotation: Floats) -> None:
    """InputError unless matrices (..., d, d) are rotations."""
    error = abs(rotation @ rotation.mT - np.eye(rotation.shape[-1])).max(axis=(-1, -2))
    if (error > 1e-6).any() or (det(rotation) < 0).any():
        hint = "Make it with coopoc.optimize.pose(position, angle)."
        if (rotation == 0).all(axis=(-2, -1)).any():
            hint = "Zeros are none: points and anchors among poses need a rotation, too: co.pose(anchor, 0)."
        raise InputError(field, f"a rotation off by {error.max():.1g}", "must hold rotation matrices", hint)


def check_std(measurement: Measurement, std: ArrayLike | float, shape: tuple[int, int]) -> Floats:
    """std as (M or 1, size): > 0, angles at most pi."""
    field, size = f"std of {measurement.name}", shape[-1]
    array = checked(field, std)
    wide = np.full((1, size), array) if array.ndim < 2 and array.size in (1, size) else array
    if wide.shape not in ((1, size), shape):
        allowed = f"must have shape ({size},) or {shape}"
        raise InputError("std", array.shape, allowed, "One standard deviation per component.")
    refuse(field, wide, ~(wide > 0), "must be > 0", "Give standard deviations; infinity means no information.")
    kept = measurement.kept(3 if size == len(measurement.components) else 2)
    angles = wide[:, [measurement.components[k] in ("angle", "turn") for k in kept]]
    refuse(field, angles, isfinite(angles) & (angles > np.pi), "must be <= pi rad", "Angles are in radians.")
    return frozen(wide)


def check_root(field: str, root: ArrayLike, shape: tuple[int, int]) -> Floats:
    """cov, or sqrt_information, as (M or 1, size, size), finite."""
    array, size = checked(field, root), shape[-1]
    array = array[None] if array.ndim == 2 else array
    if array.shape not in ((1, size, size), (*shape, size)):
        allowed = f"must have shape ({size}, {size}) or (M, {size}, {size})"
        raise InputError(field, array.shape, allowed, "Give one matrix, or one for each measurement.")
    refuse(field, array, ~isfinite(array), "must be finite", "Invert a positive definite covariance.")
    return frozen(array)


Made = TypeVar("Made")
LOSSES: dict[str, tuple[Callable[[Any, float, Any], Any], Callable[[Floats, float], Floats]]] = {
    "huber": (
        lambda s, c, m: m.where(s > c * c, 2.0 * c * m.sqrt(m.fmax(s, c * c)) - c * c, s),
        lambda s, c: c / np.sqrt(np.maximum(s, c * c)),
    ),
    "cauchy": (lambda s, c, m: c * c * m.log1p(s / (c * c)), lambda s, c: 1.0 / (1.0 + s / (c * c))),
    "geman-mcclure": (lambda s, c, m: s / (1.0 + s / (c * c)), lambda s, c: (1.0 + s / (c * c)) ** -2.0),
    "truncated": (lambda s, c, m: m.where(s > c * c, c * c, s), lambda s, c: (s <= c * c).astype(float)),
}
"""rho(s, c, m) of the squared residual in any namespace m, such as NumPy or CasADi, and rho'(s, c) in NumPy."""

DEGREES = "This looks like degrees: use np.deg2rad."
BY_ROW = "nodes", "z", "std", "sqrt_information", "constants"
"""Arrays of a factor that have an entry for each measurement, or one for all."""
DEPENDENT_VOLUME = 1e-12
"""Volume of the rows of W, as a share of that of rows at right angles, up to which some may be of no rank."""


@dataclass(frozen=True)
class Loss:
    """rho(s) of the squared whitened residual s = |W (h(x) - z)|^2; half of it is what a measurement costs.

    huber: s up to c^2, then 2 c sqrt(s) - c^2. cauchy: c^2 log(1 + s/c^2). geman-mcclure: s / (1 + s/c^2).
    truncated: min(s, c^2). All equal s near zero. A measurement then has the weight rho'(s) (Barron, CVPR 2019;
    Black and Rangarajan, IJCV 1996). Only huber has a single minimum where least squares has.

    Args:
        name: of the four.
        scale: c > 0, in standard deviations.

    >>> float(Loss("huber", 1.0).cost(np.array(9.0))), float(Loss("huber", 1.0).weight(np.array(9.0)).round(3))
    (5.0, 0.333)
    """

    name: str
    scale: float

    def __post_init__(self) -> None:
        one_of("loss", self.name, LOSSES)
        hint, tiny = "It counts standard deviations: 1.5 to 3.", np.finfo(float).tiny
        self.__dict__["scale"] = number("scale", self.scale, tiny, allowed="> 0 and finite", hint=hint)

    @property
    def convex(self) -> bool:
        """True if the loss adds no minima to those of least squares."""
        return self.name == "huber"

    def cost(self, square: ArrayLike) -> Floats:
        """rho(s)."""
        return np.asarray(LOSSES[self.name][0](checked("square", square), self.scale, np))

    def weight(self, square: ArrayLike) -> Floats:
        """rho'(s), in [0, 1]."""
        return LOSSES[self.name][1](checked("square", square), self.scale)


@dataclass(frozen=True, eq=False)
class Factor:
    """M measurements z of one kind; each adds 1/2 rho(|W (h(x) - z)|^2) to the cost, angles wrapped.

    Args:
        kind: a registered measurement.
        nodes: (M, arity); of two, the first observes the second.
        z: (M, k) m, rad; kinds that compare poses have k = d + d^2 (see `pose`).
        std: size, (size,) or (M, size) standard deviations, W = diag(1/std); infinite: no information.
        sqrt_information: instead of std, (size, size) or (M, size, size), W^T W = cov^-1.
        constants: (M, c) or (c,) numbers of the kind, such as dt s of a speed.
        loss: rho, None for least squares.
        twice: the rotations weigh twice what their noise says, as by CORA's kappa = 1 / var_theta in the plane.
        cov: instead of std, covariances shaped as sqrt_information.

    Raises:
        InputError: shapes, a node paired with itself, z that is not finite, a distance <= 0, an angle beyond 2 pi
            (degrees), a rotation that is none, a std that is not positive or an angle's that exceeds pi, a covariance
            that is not positive definite.

    >>> Factor("range", [[0, 1]], [[5.0]], std=0.1)
    Factor(range x 1)
    """

    kind: str
    nodes: Ints
    z: Floats
    std: Floats | None = None
    sqrt_information: Floats | None = None
    constants: Floats | None = None
    loss: Loss | None = None
    twice: bool = False
    cov: InitVar[ArrayLike | None] = None

    __reduce__ = remade

    def __post_init__(self, cov: ArrayLike | None) -> None:
        measurement = _checked(self)
        self.__dict__["z"] = check_values(measurement, self.z, len(self.nodes))
        noise = {"std": self.std, "sqrt_information": self.sqrt_information, "cov": cov}
        stds = [name for name, value in noise.items() if value is not None]
        if len(stds) != 1:
            allowed = "exactly one of std, cov and sqrt_information must be given"
            raise InputError("std", " and ".join(stds) or "nothing", allowed, "Give std=.")
        shape = len(self.nodes), self.size
        if self.std is not None:
            self.__dict__["std"] = check_std(measurement, self.std, shape)
        else:
            root = self.sqrt_information if cov is None else whitening(measurement.name, cov)
            field = f"{stds[0]} of {measurement.name}"
            self.__dict__["sqrt_information"] = check_root(field, root, shape)  # type: ignore[arg-type]
        if self.loss is not None:
            instance("loss", self.loss, Loss, 'Give Loss("huber", 2.0), or None.')

    @property
    def measurement(self) -> Measurement:
        """The measurement of the factor."""
        return lookup(self.kind)

    @cached_property
    def dimension(self) -> int | None:
        """2 or 3, or None if the kind's z looks the same in both."""
        return fitting(self.measurement, self.z.shape[-1])

    @cached_property
    def size(self) -> int:
        """Residuals per measurement."""
        return self.measurement.size(self.dimension or 3)

    @property
    def informative(self) -> Bools:
        """(M,) True where the measurement carries information."""
        return np.asarray((self.root != 0).any(axis=(1, 2)))

    @cached_property
    def measured(self) -> Ints:
        """(M,) numbers that carry information: the rank of W."""
        if self.std is not None:
            return np.full(len(self.nodes), isfinite(self.std).sum(1))
        root, rank = self.root, np.full(len(self.nodes), self.size)
        flat = ~(abs(det(root)) > DEPENDENT_VOLUME * norm(root, axis=2).prod(axis=1))
        if flat.any():  # the rank takes as long as many steps of a solve
            rank[flat] = matrix_rank(root[flat])
        return rank

    @cached_property
    def root(self) -> Floats:
        """W as (M, size, size)."""
        root: Any = self.sqrt_information if self.std is None else np.eye(self.size) / self.std[:, None]
        return np.broadcast_to(root, (len(self.nodes), self.size, self.size))

    def __repr__(self) -> str:
        return f"Factor({self.kind} x {len(self.nodes)})"


def _checked(item: "Factor | Constraint") -> Measurement:
    """The measurement of an item, with its name, nodes and constants checked."""
    measurement, nodes = item.measurement, checked("nodes", item.nodes, dtype=int)
    if nodes.ndim != 2 or nodes.shape[1] != measurement.arity:
        hint = "Give one row per measurement."
        raise InputError("nodes", nodes.shape, f"must have shape (M, {measurement.arity}) for {measurement.name}", hint)
    refuse("nodes", nodes, nodes < 0, "must be an index >= 0", "Problem.add takes names; a Factor takes indices.")
    ordered = np.sort(nodes)
    if (same := (ordered[:, 1:] == ordered[:, :-1]).any(1)).any():
        hint = "A vehicle does not measure itself."
        raise InputError("nodes", nodes[same][0].tolist(), "must be different points", hint)
    constants = checked(f"constants of {measurement.name}", [] if item.constants is None else item.constants)
    count, own = len(nodes), measurement.constants
    if constants.shape not in ((own,), (1, own), (count, own)) or not isfinite(constants).all():
        hint = "Give them as constants=, such as constants=[0.1] for the dt of a speed."
        raise InputError("constants", constants.tolist(), f"must be {own} finite numbers for {measurement.name}", hint)
    item.__dict__.update(kind=measurement.name, nodes=nodes, constants=frozen(np.full((count, own), constants)))
    return measurement


def unchecked(made: Made, **changes: Any) -> Made:
    """A factor, or another dataclass, with changes that come from checked arrays and need not be checked again."""
    kind: Any = type(made)
    changed: Made = object.__new__(kind)
    fields = {name: value for name, value in made.__dict__.items() if name in kind.__match_args__}
    changed.__dict__.update(fields, **changes)
    return changed


def stacked(arrays: Iterable[AnyArray], *width: int) -> AnyArray:
    """Arrays (M, *width) below one another; (0, *width) of whole numbers if there are none.

    >>> stacked([], 2).shape
    (0, 2)
    """
    return np.concatenate([*arrays] or [np.empty((0, *width), int)])


def taken(factor: Factor, rows: Ints) -> Factor:
    """Some measurements of a factor."""
    parts = {
        name: array[rows]
        for name in BY_ROW
        if (array := getattr(factor, name)) is not None and len(array) == len(factor.nodes)
    }
    return unchecked(factor, **parts)


def reweighed(factor: Factor, share: Floats | float) -> Factor:
    """A factor whose W is a `share` of what it was, one number or (M, 1) of them; nothing is an infinite std."""
    if factor.sqrt_information is not None:
        return unchecked(factor, sqrt_information=factor.sqrt_information * np.asarray(share)[..., None])
    with np.errstate(divide="ignore"):
        return unchecked(factor, std=np.asarray(factor.std) / share)


def fused(factors: Sequence[Factor]) -> Sequence[Factor]:
    """A factor per kind, loss and form of its noise; the same if no two go together.

    >>> fused([Factor("position", [[k]], [[0.0, 0, 0]], std=1.0 + k) for k in range(2)])
    (Factor(position x 2),)
    """
    groups = dict[Any, list[Factor]]()
    for factor in factors:
        groups.setdefault((factor.kind, factor.loss, factor.twice, factor.std is None), []).append(factor)
    return factors if len(groups) == len(factors) else tuple(map(_joined, groups.values()))


def _joined(factors: list[Factor]) -> Factor:
    if len(factors) == 1:
        return factors[0]
    changes = {}
    for name in BY_ROW:
        if getattr(factors[0], name) is not None:
            own = ((len(f.nodes), getattr(f, name)) for f in factors)
            changes[name] = np.concatenate([np.broadcast_to(a, (count, *a.shape[1:])) for count, a in own])
    return unchecked(factors[0], **changes)


@dataclass(frozen=True, eq=False)
class Constraint:
    """lower <= h(x) <= upper for M rows of nodes, h the formula of a kind; equal bounds make an equality.

    A bound on a coordinate is one of kind "position"; a lane, a road surface or a top speed are kinds too ("speed", or
    a formula of one's own).

    Args:
        kind: a registered measurement that is no comparison of poses.
        nodes: (M, arity).
        lower: (M, size), (size,) or a number: m, rad, m/s; -inf, inf leave a side open. An angle counts within half a
            turn of the middle of two bounds, so that [3, 3.3] holds -3; with an open side from -pi to pi.
        upper: as `lower`.
        constants: as in Factor.

    Raises:
        InputError: shapes, NaN, lower > upper, all sides open.

    >>> Constraint("speed", [[0, 1]], 0.0, 30.0, constants=[0.1])
    Constraint(0.0 <= speed <= 30.0 x 1)
    """

    kind: str
    nodes: Ints
    lower: Floats
    upper: Floats
    constants: Floats | None = None

    __reduce__ = remade

    def __post_init__(self) -> None:
        measurement = _checked(self)
        if measurement.compares_poses:
            raise InputError("kind", repr(self.kind), "compares poses and cannot bound them", "Hold the node instead.")
        limits = {name: checked(name, getattr(self, name)) for name in ("lower", "upper")}
        size = max([side.shape[-1] for side in limits.values() if side.ndim], default=measurement.size())
        fitting(measurement, size)
        for name, side in limits.items():
            try:
                self.__dict__[name] = frozen(np.broadcast_to(side, (len(self.nodes), size)))
            except ValueError:
                allowed = f"must have shape ({len(self.nodes)}, {size}), ({size},) or ()"
                raise InputError(name, side.shape, allowed, "Give one bound per component.") from None
            beyond = measurement.angles(self.dimension or 3) & isfinite(side) & (abs(side) > TWO_TURNS)
            refuse(f"{name} bound of {self.kind}", self.__dict__[name], beyond, "must be within 4 pi rad", DEGREES)
        wrong = ~(self.lower <= self.upper) | ((self.lower == self.upper) & ~bounded(self))  # of NaN, too
        allowed = "must be at most the upper one, and below infinity: lower <= upper"
        refuse(f"lower bound of {self.kind}", self.lower, wrong, allowed, "No point can satisfy it.")
        if not bounded(self).any():
            raise InputError(f"bounds of {self.kind}", "none", "must bound something", "Leave the constraint out.")

    @property
    def measurement(self) -> Measurement:
        """The measurement that the constraint bounds."""
        return lookup(self.kind)

    @property
    def dimension(self) -> int | None:
        """2 or 3, or None if the kind looks the same in both."""
        return fitting(self.measurement, self.lower.shape[-1])

    @property
    def middle(self) -> Floats:
        """(M, size) that of two bounds of an angle, 0 elsewhere."""
        both = isfinite([self.lower, self.upper]).all(0) & self.measurement.angles(self.dimension or 3)
        return np.asarray(np.where(both, [self.lower, self.upper], 0.0).mean(0))

    def __repr__(self) -> str:
        return f"Constraint({self.lower.min()} <= {self.kind} <= {self.upper.max()} x {len(self.nodes)})"


def as_factor(constraint: Constraint) -> Factor:
    """The factor whose residual is h of a constraint less its middle, angles in [-pi, pi]."""
    made, z = object.__new__(Factor), constraint.middle
    same = {"kind": constraint.kind, "nodes": constraint.nodes, "constants": constraint.constants}
    made.__dict__.update(same, z=z, std=np.ones((1, z.shape[1])), sqrt_information=None, loss=None, twice=False)
    return made


def bounded(constraint: Constraint) -> Bools:
    """(M, size) True where a side is finite."""
    return isfinite(constraint.lower) | isfinite(constraint.upper)


def steerable(constraint: Constraint, movable: Bools) -> Bools:
    """(M, size) True where a side is finite and a node can move, `movable` (n, dof): the rows that a solver gets."""
    return bounded(constraint) & np.asarray(movable[constraint.nodes].any(axis=(1, 2)))[:, None]

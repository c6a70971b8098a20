"""Factor, Loss and Constraint: M measurements of one kind and their noise, robust losses, bounds on formulas."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import InitVar, dataclass, fields
from functools import cache, cached_property
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from ...arrays import AnyArray, Bools, Floats, Ints, checked, frozen, instance, number, one_of, refuse, remade
from ...errors import InputError
from .inputs import (
    check_constants,
    check_nodes,
    check_root,
    check_std,
    check_values,
    fitting,
    whitening,
)
from .measurements import Measurement, lookup

Made = TypeVar("Made")
LOSSES: dict[str, tuple[Callable[[Any, float, Any], Any], Callable[[Floats, float], Floats]]] = {
    "huber": (
        lambda s, c, m: m.where(s > c * c, 2.0 * c * m.sqrt(m.fmax(s, c * c)) - c * c, s),
        lambda s, c: c / np.sqrt(np.maximum(s, c * c)),
    ),
    "cauchy": (lambda s, c, m: c * c * m.log1p(s / (c * c)), lambda s, c: 1.0 / (1.0 + s / (c * c))),
    "geman-mcclure": (lambda s, c, m: s / (1.0 + s / (c * c)), lambda s, c: (1.0 + s / (c * c)) ** -2.0),
    "truncated": (
        lambda s, c, m: m.where(s > c * c, c * c, s),
        lambda s, c: (s <= c * c).astype(np.float64),
    ),
}
"""rho(s, c, m) of the squared residual in any namespace m, such as NumPy or CasADi, and rho'(s, c) in NumPy."""

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

    def cost(self, square: npt.ArrayLike) -> Floats:
        """rho(s)."""
        return np.asarray(LOSSES[self.name][0](checked("square", square), self.scale, np))

    def weight(self, square: npt.ArrayLike) -> Floats:
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
    cov: InitVar[npt.ArrayLike | None] = None

    __reduce__ = remade

    def __post_init__(self, cov: npt.ArrayLike | None) -> None:
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
            root = whitening(measurement.name, cov) if cov is not None else self.sqrt_information
            assert root is not None
            self.__dict__["sqrt_information"] = check_root(measurement, root, shape)
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
            return np.full(len(self.nodes), np.isfinite(self.std).sum(axis=1))
        root, rank = self.root, np.full(len(self.nodes), self.size)
        flat = ~(np.abs(np.linalg.det(root)) > DEPENDENT_VOLUME * np.linalg.norm(root, axis=2).prod(axis=1))
        if flat.any():  # the rank takes as long as many steps of a solve
            rank[flat] = np.linalg.matrix_rank(root[flat])
        return rank

    @property
    def root(self) -> Floats:
        """W as (M, size, size)."""
        root = self.sqrt_information if self.std is None else np.eye(self.size) / self.std[:, None]
        assert root is not None
        return np.broadcast_to(root, (len(self.nodes), self.size, self.size))

    def __repr__(self) -> str:
        return f"Factor({self.kind} x {len(self.nodes)})"


def _checked(item: "Factor | Constraint") -> Measurement:
    """The measurement of an item, with its name, nodes and constants checked."""
    measurement = item.measurement
    nodes = check_nodes(measurement, item.nodes)
    constants = check_constants(measurement, item.constants, len(nodes))
    item.__dict__.update(kind=measurement.name, nodes=nodes, constants=constants)
    return measurement


def unchecked(made: Made, **changes: Any) -> Made:
    """A factor, or another dataclass, with changes that come from checked arrays and need not be checked again."""
    kind: Any = type(made)
    changed: Made = object.__new__(kind)
    kept = made.__dict__
    changed.__dict__.update({name: kept[name] for name in names_of(kind)}, **changes)
    return changed


def stacked(arrays: Iterable[AnyArray], *width: int) -> AnyArray:
    """Arrays (M, *width) below one another; (0, *width) of whole numbers if there are none.

    >>> stacked([], 2).shape
    (0, 2)
    """
    return np.concatenate([*arrays] or [np.empty((0, *width), np.int64)])


@cache
def names_of(kind: Any) -> tuple[str, ...]:
    """Of the fields of a dataclass."""
    return tuple(field.name for field in fields(kind))


def taken(factor: Factor, rows: Ints) -> Factor:
    """Some measurements of a factor."""
    parts = {
        name: array[rows]
        for name in ("z", "std", "sqrt_information", "constants")
        if (array := getattr(factor, name)) is not None and len(array) == len(factor.nodes)
    }
    return unchecked(factor, nodes=factor.nodes[rows], **parts)


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
    changes = {"nodes": np.concatenate([factor.nodes for factor in factors])}
    for name in ("z", "std", "sqrt_information", "constants"):
        arrays = [getattr(factor, name) for factor in factors]
        if arrays[0] is not None:
            wide = [np.broadcast_to(a, (len(f.nodes), *a.shape[1:])) for a, f in zip(arrays, factors, strict=True)]
            changes[name] = np.concatenate(wide)
    return unchecked(factors[0], **changes)


@dataclass(frozen=True, eq=False)
class Constraint:
    """lower <= h(x) <= upper for M rows of nodes, h the formula of a kind; equal bounds make an equality.

    A bound on a coordinate is one of kind "position"; a lane, a road surface or a top speed are kinds too ("speed", or
    a formula of one's own).

    Args:
        kind: a registered measurement that is no comparison of poses.
        nodes: (M, arity).
        lower: (M, size), (size,) or a number: m, rad, m/s; -inf, inf leave a side open.
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
        sizes = [side.shape[-1] for side in limits.values() if side.ndim]
        size = max(sizes, default=measurement.size())
        fitting(measurement, size)
        for name, side in limits.items():
            try:
                self.__dict__[name] = frozen(np.broadcast_to(side, (len(self.nodes), size)))
            except ValueError:
                allowed = f"must have shape ({len(self.nodes)}, {size}), ({size},) or ()"
                raise InputError(name, side.shape, allowed, "Give one bound per component.") from None
        wrong, field = ~(self.lower <= self.upper), f"lower bound of {self.kind}"  # of NaN, too
        refuse(field, self.lower, wrong, "must be at most the upper one: lower <= upper", "No point can satisfy it.")
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

    def __repr__(self) -> str:
        return f"Constraint({self.lower.min()} <= {self.kind} <= {self.upper.max()} x {len(self.nodes)})"


def as_factor(constraint: Constraint) -> Factor:
    """The factor whose residual is h of a constraint, angles in [-pi, pi]."""
    made, shape = object.__new__(Factor), constraint.lower.shape
    made.__dict__.update(kind=constraint.kind, nodes=constraint.nodes, constants=constraint.constants)
    made.__dict__.update(z=np.zeros(shape), std=np.ones((1, shape[1])), sqrt_information=None, loss=None, twice=False)
    return made


def bounded(constraint: Constraint) -> Bools:
    """(M, size) True where a side is finite."""
    return np.isfinite(constraint.lower) | np.isfinite(constraint.upper)


def steerable(constraint: Constraint, movable: Bools) -> Bools:
    """(M, size) True where a side is finite and a node can move, `movable` (n, dof): the rows that a solver gets."""
    moves = np.asarray(movable[constraint.nodes].any(axis=(1, 2)))
    return bounded(constraint) & moves[:, None]

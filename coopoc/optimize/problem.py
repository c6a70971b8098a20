"""Problem: nodes and factors between them; whitened residuals, their exact Jacobian and the cost."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ..arrays import Bools, Floats, Ints, frozen
from ..errors import InputError
from .constraint import Constraint
from .factor import Factor
from .inputs import numbers
from .linear import Linear, jacobian, linearise
from .measurements import lookup
from .space import Space

if TYPE_CHECKING:
    from ..world.recording import Recording
    from .losses import Loss
    from .sights import Noise

Nodes = str | int | Sequence[str | int] | Sequence[Sequence[str | int]]


@dataclass(frozen=True, eq=False)
class Problem:
    """minimise over n nodes 1/2 sum_k rho(|W_k (h_k(x) - z_k)|^2), for one or for B noise realisations at once.

    A node is a point or a pose in 2 or 3 dimensions, a row of x: its position and, in a problem with poses, its
    rotation matrix (see Space).

    Args:
        names: (n,) unique names of the nodes.
        factors: the measurements.
        x0: (n, width) or (B, n, width) where the solver starts. None: the converted measurements' linear solution;
            poses need an x0.
        hub: nodes that the others hang on, such as the ego at each step. What remains without them must fall into
            small groups (the neighbours); they are eliminated last; the last of them is the one a Solution shows.
        dimension: 2 or 3. poses: the nodes that have a rotation.
        held: nodes that stay at x0, such as the first pose of a graph without fixes.
        constraints: what must hold exactly.

    Raises:
        InputError: repeated names, factors or a hub on unknown nodes, kinds that need a pose, shapes that do not agree.

    >>> problem = Problem(("a", "b")).add("position", "a", [0, 0, 0], std=1.0)
    >>> problem = problem.add("displacement", ("a", "b"), [5, 0, 0], std=1.0)
    >>> problem.cost(np.array([[0, 0, 0], [6.0, 0, 0]]))
    0.5
    """

    names: tuple[str, ...]
    factors: tuple[Factor, ...] = ()
    x0: Floats | None = None
    hub: tuple[int, ...] = ()
    dimension: int = 3
    poses: tuple[int, ...] = ()
    held: tuple[int, ...] = ()
    constraints: tuple[Constraint, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", tuple(str(name) for name in self.names))
        if len(self._place) != len(self.names):
            twice = sorted({n for n in self.names if self.names.count(n) > 1})
            raise InputError("names", twice[:3], "must be unique", "Rename the points that share a name.")
        for field in ("hub", "poses", "held"):
            object.__setattr__(self, field, tuple(self.index(node) for node in getattr(self, field)))
        if len(set(self.hub)) < len(self.hub):
            raise InputError("hub", self.hub, "must not name a point twice", "Name each point of the hub once.")
        Space(self.dimension)  # refuses any other than 2 and 3
        items: tuple[Factor | Constraint, ...] = (*self.factors, *self.constraints)
        for item in items:
            _check_item(self, item)
        if self.x0 is not None:
            object.__setattr__(self, "x0", frozen(points(self, "x0", self.x0)))
        if self.held and self.x0 is None:
            raise InputError("held", [self.names[k] for k in self.held[:3]], "needs an x0 to be held at", "Give x0=.")
        sizes = {b for b in (*(f.batch for f in self.factors), self._start_batch) if b is not None and b > 1}
        if len(sizes) > 1:
            mend = "Use the same number of realisations throughout."
            raise InputError("factors", f"{sorted(sizes)} realisations", "must agree", mend)

    @cached_property
    def space(self) -> Space:
        """Where the nodes live."""
        return Space(self.dimension, bool(self.poses))

    @cached_property
    def free(self) -> Bools | None:
        """(n, dof) False where a node cannot move: it is held, or a point that has no rotation. None: all are free."""
        space, n = self.space, len(self.names)
        if not self.held and len(self.poses) in (0, n):
            return None
        free = np.ones((n, space.dof), dtype=bool)
        if space.turning:
            free[np.setdiff1d(np.arange(n), self.poses), space.dimension :] = False
        free[list(self.held)] = False
        return free

    @cached_property
    def _place(self) -> dict[str, int]:
        return {name: k for k, name in enumerate(self.names)}

    @property
    def _start_batch(self) -> int | None:
        return len(self.x0) if self.x0 is not None and self.x0.ndim == 3 else None

    @cached_property
    def batch(self) -> int | None:
        """B noise realisations, or None for a single problem."""
        sizes = [b for b in (*(f.batch for f in self.factors), self._start_batch) if b is not None]
        return max(sizes) if sizes else None

    @cached_property
    def linear(self) -> bool:
        """True if the residuals are linear in x and the cost is quadratic."""
        return all(f.measurement.linear and f.loss is None for f in self.factors)

    def index(self, node: str | int) -> int:
        """Index of a node given by name or index; InputError if there is none."""
        if isinstance(node, str) and node in self._place:
            return self._place[node]
        if isinstance(node, int | np.integer) and 0 <= node < len(self.names):
            return int(node)
        known = ", ".join(self.names[:8]) + (", ..." if len(self.names) > 8 else "")
        raise InputError("node", repr(node), f"must be an index < {len(self.names)} or one of {known}",
                         "Name the point when the Problem is made.")  # fmt: skip

    def add(
        self,
        kind: str,
        nodes: Nodes,
        z: npt.ArrayLike,
        std: npt.ArrayLike | None = None,
        *,
        cov: npt.ArrayLike | None = None,
        sqrt_information: npt.ArrayLike | None = None,
        constants: npt.ArrayLike | None = None,
        loss: Loss | None = None,
    ) -> Problem:
        """The problem with one more measurement, or with M of one kind; the arguments are those of Factor.

        Args:
            nodes: one node ("a"), a pair (("a", "b")), or a list of M nodes or pairs; names or indices.
            z: (size,), a number, or (M, size).
        """
        factor = Factor(kind, *_rows(self, kind, nodes, z), std=std, sqrt_information=sqrt_information,  # type: ignore[arg-type]
                        constants=constants, loss=loss, cov=cov)  # type: ignore[arg-type]  # fmt: skip
        return replace(self, factors=(*self.factors, factor))

    def constrain(
        self,
        kind: str,
        nodes: Nodes,
        lower: npt.ArrayLike = -np.inf,
        upper: npt.ArrayLike = np.inf,
        constants: npt.ArrayLike | None = None,
    ) -> Problem:
        """The problem with lower <= h(x) <= upper for the kind's formula h; the arguments are those of Constraint.

        >>> Problem(("a",)).constrain("position", "a", lower=[0, 0, -np.inf]).constraints
        (Constraint(-inf <= position <= inf x 1),)
        """
        index = _indices(self, kind, nodes)
        size = lookup(kind).size(self.dimension)
        low, high = (np.broadcast_to(numbers(name, v), (len(index), size)) if np.ndim(v) == 0 else numbers(name, v)
                     for name, v in (("lower", lower), ("upper", upper)))  # fmt: skip
        constraint = Constraint(kind, index, low, high, constants)  # type: ignore[arg-type]
        return replace(self, constraints=(*self.constraints, constraint))

    def pick(self, which: Ints | int) -> Problem:
        """The realisations `which` of B; an int gives a single problem."""
        x0 = self.x0 if self._start_batch is None or self.x0 is None else self.x0[which]
        return self.having(factors=tuple(f.pick(which) for f in self.factors), x0=x0)

    def having(self, **changes: Any) -> Problem:
        """The problem with changes that come from checked parts and need not be checked again."""
        changed = object.__new__(Problem)
        for field in fields(Problem):
            object.__setattr__(changed, field.name, changes.get(field.name, getattr(self, field.name)))
        return changed

    def linearise(self, x: Floats) -> Linear:
        """Whitened residuals and derivatives at x (B, n, width)."""
        return linearise(self.space, self.factors, self.free, x, self.batch is not None)

    def whiten(self, x: npt.ArrayLike) -> tuple[Floats, Any]:
        """Residual r (rows,) and sparse Jacobian J (rows, n dof) of a single problem at x (n, width): cost = 1/2 r.r.

        A robust factor's rows carry the root of its weight rho': J^T r is the gradient, but 1/2 r.r is not the cost.
        """
        linear = self.linearise(points(self, "x", x, (2,))[None])
        return np.concatenate([r.ravel() for r in linear.residual]), self.jacobian(linear)

    def jacobian(self, linear: Linear, which: int = 0) -> Any:
        """Sparse Jacobian (rows, n dof) of one of the realisations of `linearise`, CSR."""
        return jacobian(linear, self.factors, (len(self.names), self.space.dof), which)

    def cost(self, x: npt.ArrayLike) -> float:
        """1/2 sum of rho of a single problem at x (n, width)."""
        return float(self.linearise(points(self, "x", x, (2,))[None]).cost[0])

    @classmethod
    def from_snapshot(
        cls, recording: Recording, step: int, ego: int | str, run: int | None = 0, noise: Noise | None = None
    ) -> Problem:
        """The star of one step: fixes of the ego and its linked neighbours, spherical factors between them.

        All messages of the step are taken as received; `CooperativeMAP` obeys the channel instead.

        Args:
            recording: what was measured. step: t. ego: column or id. run: realisation, None for all R at once.
            noise: what is assumed of it, default the recording's sensors.

        Raises:
            InputError: unknown ego, step or run.
        """
        from .sights import window_problem

        return window_problem(recording, step, ego, 1, run, noise)

    @classmethod
    def from_window(
        cls, recording: Recording, step: int, ego: int | str, length: int, run: int | None = 0,
        noise: Noise | None = None,
    ) -> Problem:  # fmt: skip
        """The stars of the last `length` steps, one point per vehicle and step, joined by odometry dt u.

        Arguments and errors as `from_snapshot`; the first step of the window must exist.
        """
        from .sights import window_problem

        return window_problem(recording, step, ego, length, run, noise)

    def __repr__(self) -> str:
        kinds = ", ".join(f"{len(f.nodes)} {f.kind}" for f in self.factors)
        runs = "" if self.batch is None else f", {self.batch} realisations"
        what = "points" if not self.poses else "poses" if len(self.poses) == len(self.names) else "nodes"
        plane = " in the plane" if self.dimension == 2 else ""
        bound = f"; {len(self.constraints)} constraints" if self.constraints else ""
        return f"Problem({len(self.names)} {what}{plane}; {kinds or 'no factors'}{runs}{bound})"


def _indices(problem: Problem, kind: str, nodes: Any) -> Ints:
    """Nodes (M, arity) as indices, from what a user writes."""
    known = lookup(kind)
    flat = [nodes] if isinstance(nodes, str) or not isinstance(nodes, Iterable) else list(nodes)
    flat = [p for row in flat for p in (row if isinstance(row, list | tuple | np.ndarray) else [row])]
    if len(flat) % known.arity or not flat:
        raise InputError("nodes", nodes, f"must name {known.arity} points per {kind}", "Give points by name or index.")
    return np.array([problem.index(p) for p in flat]).reshape(-1, known.arity)


def _rows(problem: Problem, kind: str, nodes: Any, z: npt.ArrayLike) -> tuple[Ints, Floats]:
    index = _indices(problem, kind, nodes)
    values = numbers(f"z of {kind}", z)
    return index, values.reshape(len(index), -1) if values.ndim < 2 and values.size % len(index) == 0 else values


def _check_item(problem: Problem, item: Factor | Constraint) -> None:
    """InputError unless the nodes exist, have a rotation where the kind needs one, and the dimension fits."""
    known, nodes = item.measurement, item.nodes
    bad = (nodes < 0) | (nodes >= len(problem.names))
    if bad.any():
        problem.index(int(nodes[bad][0]))
    if item.dimension not in (None, problem.dimension):
        mend = f"Make it with Problem(names, dimension={item.dimension})." if known.plane else "Leave it out."
        raise InputError(
            f"{item.kind}", f"for {item.dimension} dimensions", f"must fit a problem of {problem.dimension}", mend
        )
    observers = {"world": nodes[:, :0], "body": nodes[:, :1], "relative": nodes}[known.frame]
    lacking = np.setdiff1d(observers, problem.poses)
    if len(lacking):
        raise InputError(f"nodes of {item.kind}", problem.names[lacking[0]], "must be a pose: it is seen from its body",
                         "Name it in Problem(names, poses=[...]).")  # fmt: skip


def points(problem: Problem, field: str, x: npt.ArrayLike, ranks: tuple[int, ...] = (2, 3)) -> Floats:
    """x as an array (n, width) or (B, n, width); InputError if it is not one, or holds rotations that are none."""
    array = numbers(field, x)
    space, n = problem.space, len(problem.names)
    if array.ndim not in ranks or array.shape[-2:] != (n, space.width) or not np.isfinite(array).all():
        shape = f"must be finite with shape ({n}, {space.width})" + (
            f", or (B, n, {space.width})" if 3 in ranks else ""
        )
        given = f"shape {array.shape}" if np.isfinite(array).all() else "not finite"
        mend = "Make it with coopoc.optimize.pose." if space.turning else "Give one row of metres per point."
        raise InputError(field, given, shape, mend)
    turned = space.rotation(array)
    if space.turning and np.abs(turned @ np.swapaxes(turned, -1, -2) - np.eye(space.dimension)).max(initial=0.0) > 1e-6:
        raise InputError(field, "a matrix that is no rotation", "must hold rotations", "Use coopoc.optimize.pose.")
    return array

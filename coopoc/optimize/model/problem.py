"""Problem: nodes and factors between them; whitened residuals, their exact Jacobian and the cost."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ...arrays import Bools, Floats, Ints, checked, frozen, listed, remade, texts
from ...errors import InputError, shown, suggestion
from .derivatives import Linear, linearise
from .factor import Constraint, Factor, Loss, check_rotations, check_std, stacked, unchecked
from .measurements import lookup
from .space import Space
from .window import Noise, window

if TYPE_CHECKING:
    from ...world.recording import Recording

DERIVED = (
    ("_place", {"names"}),
    ("_turning", {"poses"}),
    ("space", {"dimension", "poses"}),
    ("movable", {"names", "dimension", "poses", "fixed"}),
    ("sparse", {"names", "dimension", "poses", "fixed", "factors"}),
)
"""What is found of a problem once, and the fields that it follows from: others may change and it still holds."""

Nodes = str | int | Sequence[str | int] | Sequence[Sequence[str | int]]


class Search(NamedTuple):
    """The search for a start; the Solution's iterations and seconds contain it.

    Attributes:
        start: name of the start, "" if the user gave x0.
        iterations: linear steps from all starts that were tried.
        seconds: to make the starts and to take those steps.
        notes: what is to be said of it, for `Solution.notes`.
        x0: where it led, or a start that is to be the only one: with another x0 of a problem others compete.

    >>> Search("odometry").iterations
    0
    """

    start: str = ""
    iterations: int = 0
    seconds: float = 0.0
    notes: tuple[str, ...] = ()
    x0: Floats | None = None


@dataclass(frozen=True, eq=False)
class Problem:
    """minimise over n nodes 1/2 sum_k rho(|W_k (h_k(x) - z_k)|^2).

    A node is a point or a pose in 2 or 3 dimensions, a row of x: its position and, in a problem with poses, its
    rotation matrix (see Space).

    Args:
        names: (n,) unique names of the nodes.
        factors: the measurements.
        x0: (n, ambient) where the solver starts. None: the converted measurements' linear solution, or what `solve`
            finds.
        shown: the node that a Solution prints, such as the ego at the last step.
        dimension: 2 or 3.
        poses: the nodes that have a rotation.
        fixed: nodes that stay at x0, such as the first pose of a graph without fixes.
        constraints: what must hold exactly.
        search: how x0 was found, such as the start of a graph that won; a Solution counts its work.

    Raises:
        InputError: repeated names, unknown nodes, kinds that need a pose, shapes that do not agree.

    >>> problem = Problem(("a", "b")).add("position", "a", [0, 0, 0], std=1.0)
    >>> problem = problem.add("displacement", ("a", "b"), [5, 0, 0], std=1.0)
    >>> problem.cost(np.array([[0, 0, 0], [6.0, 0, 0]]))
    0.5
    """

    names: tuple[str, ...]
    factors: Sequence[Factor] = ()
    x0: Floats | None = None
    shown: int = 0
    dimension: int = 3
    poses: tuple[int, ...] = ()
    fixed: tuple[int, ...] = ()
    constraints: tuple[Constraint, ...] = ()
    search: Search = Search()

    __reduce__ = remade

    def __post_init__(self) -> None:
        for field in ("names", "factors", "poses", "fixed", "constraints"):
            self.__dict__[field] = tuple(listed(field, getattr(self, field), "Give a tuple, () for none."))
        names = tuple(map(str, self.names))
        if names != tuple(map(str, range(len(names)))):
            texts("names", [*self.names])  # other whole numbers would look like indices
        self.__dict__["names"] = names
        if len(self._place) != len(names):
            twice = sorted({n for n in names if names.count(n) > 1})
            raise InputError("names", twice[:3], "must be unique", "Rename the points that share a name.")
        for field in ("poses", "fixed"):
            self.__dict__[field] = tuple(map(self.index, getattr(self, field)))
        self.__dict__["shown"] = self.index(self.shown) if self.names else 0
        self.__dict__["dimension"] = int(Space(self.dimension).dimension)  # 2 or 3
        for item in (*self.factors, *self.constraints):
            if not isinstance(item, Factor | Constraint):
                hint = "Add measurements with Problem.add, constraints with Problem.constrain."
                raise InputError("factors, constraints", shown(item), "must be Factors and Constraints", hint)
            self._check(item)
        if self.x0 is not None:
            self.__dict__["x0"] = frozen(points(self.space, len(self.names), "x0", self.x0))
        if self.fixed and self.x0 is None:
            raise InputError(
                "fixed", [self.names[k] for k in self.fixed[:3]], "needs an x0 to be fixed at", "Give x0=."
            )

    @cached_property
    def space(self) -> Space:
        """Where the nodes live."""
        return Space(self.dimension, bool(self.poses))

    @cached_property
    def movable(self) -> Bools:
        """(n, dof) False where a node cannot move: it is fixed, or a point that has no rotation."""
        movable = np.ones((len(self.names), self.space.dof), bool)
        if self.poses:
            movable[np.setdiff1d(np.arange(len(movable)), self.poses), self.dimension :] = False
        movable[list(self.fixed)] = False
        return movable

    @cached_property
    def _place(self) -> dict[str, int]:
        return {name: k for k, name in enumerate(self.names)}

    @cached_property
    def _turning(self) -> frozenset[int]:
        return frozenset(self.poses)

    @cached_property
    def linear(self) -> bool:
        """True if residuals and constraints are linear in x and the cost is quadratic."""
        quadratic = all(f.measurement.linear and f.loss is None for f in self.factors)
        return quadratic and all(c.measurement.linear for c in self.constraints)

    def index(self, node: str | int) -> int:
        """Index of a node given by name or index; InputError if there is none."""
        return index_of(node, self._place, self.names)

    def add(
        self,
        kind: str,
        nodes: Nodes,
        z: ArrayLike,
        std: ArrayLike | None = None,
        *,
        cov: ArrayLike | None = None,
        sqrt_information: ArrayLike | None = None,
        constants: ArrayLike | None = None,
        loss: Loss | None = None,
    ) -> "Problem":
        """The problem with one more measurement, or with M of one kind; the arguments are those of Factor.

        Args:
            nodes: one node ("a"), a pair (("a", "b")), or a list of M nodes or pairs; names or indices.
            z: (size,), a number, or (M, size).
        """
        index = indices(self.index, kind, nodes)
        factor = Factor(
            kind,
            index,
            rows(kind, z, len(index)),
            std,  # type: ignore[arg-type]
            sqrt_information,  # type: ignore[arg-type]
            constants,  # type: ignore[arg-type]
            loss,
            cov=cov,
        )
        if cov is not None:
            check_std(factor.measurement, np.sqrt(np.diagonal(cov, 0, -2, -1)), (len(index), factor.size))
        # it alone is checked: what was checked and found before is kept
        self._check(factor)
        return self.replace_unchecked(factors=(*self.factors, factor))

    def constrain(
        self,
        kind: str,
        nodes: Nodes,
        lower: ArrayLike = -np.inf,
        upper: ArrayLike = np.inf,
        constants: ArrayLike | None = None,
    ) -> "Problem":
        """The problem with lower <= h(x) <= upper for the kind's formula h; the arguments are those of Constraint.

        >>> Problem(("a",)).constrain("position", "a", lower=[0, 0, -np.inf]).constraints
        (Constraint(-inf <= position <= inf x 1),)
        """
        index = indices(self.index, kind, nodes)
        shape = len(index), lookup(kind).size(self.dimension)
        limits = checked("lower", lower), checked("upper", upper)
        low, high = (limit if limit.ndim else np.broadcast_to(limit, shape) for limit in limits)
        constraint = Constraint(kind, index, low, high, constants)  # type: ignore[arg-type]
        return replace(self, constraints=(*self.constraints, constraint))

    def _check(self, item: Factor | Constraint) -> None:
        """InputError unless the nodes exist, have a rotation where the kind needs one, and the dimension fits."""
        measurement, nodes = item.measurement, item.nodes
        if len(beyond := nodes[nodes >= len(self.names)]):
            raise no_such_node(int(beyond[0]), self.names)
        if item.dimension not in (None, self.dimension):
            hint = f"Make it with Problem(names, dimension={item.dimension})." if measurement.plane else "Leave it out."
            raise InputError(
                f"{item.kind}", f"for {item.dimension} dimensions", f"must fit a problem of {self.dimension}", hint
            )
        observers = {"body": nodes[:, :1], "relative": nodes}.get(measurement.frame, nodes[:, :0])
        if lacking := sorted(set(observers.ravel().tolist()) - self._turning):
            allowed = "must be a pose: the measurement is in its body frame"
            raise InputError(
                f"nodes of {item.kind}", self.names[lacking[0]], allowed, "Name it in Problem(names, poses=[...])."
            )

    def replace_unchecked(self, **changes: Any) -> "Problem":
        """The problem with changes that come from checked parts and need not be checked again."""
        changed, kept = unchecked(self, **changes), self.__dict__
        for name, inputs in DERIVED:
            if name in kept and inputs.isdisjoint(changes):
                changed.__dict__[name] = kept[name]
        return changed

    def starting_at(self, x0: Floats) -> "Problem":
        """The problem from another x0 (n, ambient), which need not be checked."""
        return self.replace_unchecked(x0=frozen(x0))

    def linearise(self, x: ArrayLike) -> Linear:
        """Whitened residuals and derivatives at x (n, ambient)."""
        return linearise(self.space, self.factors, self._at(x))

    def whiten(self, x: ArrayLike) -> tuple[Floats, Any]:
        """Residual r (rows,) and sparse Jacobian J (rows, n dof) at x (n, ambient): cost = 1/2 r.r.

        A robust factor's rows carry the root of its weight rho': J^T r is the gradient, but 1/2 r.r is not the cost.
        """
        linear, J = linearised(self, self._at(x))
        return stacked(r.ravel() for r in linear.residual), J

    def cost(self, x: ArrayLike) -> float:
        """1/2 sum of rho at x (n, ambient)."""
        return self.linearise(x).cost

    def _at(self, x: ArrayLike) -> Floats:
        return points(self.space, len(self.names), "x", x)

    @classmethod
    def from_snapshot(
        cls, recording: "Recording", step: int, ego: int | str, run: int = 0, noise: Noise | None = None
    ) -> "Problem":
        """The star of one step: fixes of the ego and its linked neighbours, spherical factors between them.

        All messages of the step are taken as received; the methods obey the channel instead. Missing
        measurements are treated as in `from_window`.

        Args:
            recording: of the measurements.
            step: t.
            ego: column or id.
            run: noise realisation.
            noise: noise model, default the recording's sensors.

        Raises:
            InputError: unknown ego, step or run.
        """
        return cls.from_window(recording, step, ego, 1, run, noise)

    @classmethod
    def from_window(
        cls, recording: "Recording", step: int, ego: int | str, length: int, run: int = 0, noise: Noise | None = None
    ) -> "Problem":
        """The stars of the last `length` steps, one point per vehicle and step, joined by odometry dt u.

        A missing fix makes no factor; of a relative measurement its parts make one each where some are missing.
        Arguments and errors as `from_snapshot`; the first step of the window must exist.
        """
        names, factors, newest = window(recording, step, ego, length, run, noise)
        return cls(names, factors, shown=newest)

    def __repr__(self) -> str:
        count: Counter[str] = Counter()
        for factor in self.factors:
            count[factor.kind] += len(factor.nodes)
        what = "points" if not self.poses else "poses" if len(self.poses) == len(self.names) else "nodes"
        plane = " in the plane" * (self.dimension == 2)
        kinds = ", ".join(f"{number} {kind}" for kind, number in count.items()) or "no factors"
        bound = f"; {len(self.constraints)} constraints" * bool(self.constraints)
        return f"Problem({len(self.names)} {what}{plane}; {kinds}{bound})"


def indices(index: Callable[[Any], int], kind: str, nodes: Any) -> Ints:
    """Nodes (M, arity) of a kind from one node, a tuple or rows of them, each found by `index`."""
    arity, rows = lookup(kind).arity, [several(row) for row in several(nodes)]
    if len(rows) == arity > 1 and all(len(row) == 1 for row in rows):  # of one measurement
        rows = [[node for row in rows for node in row]]
    if not rows or any(len(row) != arity for row in rows):
        hint = "Give one row of names or indices for each measurement."
        raise InputError("nodes", shown(nodes), f"must name {arity} points per {kind}", hint)
    return np.array([[index(node) for node in row] for row in rows])


def several(nodes: Any) -> list[Any]:
    """What an iterable holds; a name, a number and an array without an axis are one node.

    >>> several("car"), several(np.array(3)), several(("a", 1))
    (['car'], [array(3)], ['a', 1])
    """
    scalar = isinstance(nodes, np.ndarray) and not nodes.ndim
    return [nodes] if scalar or isinstance(nodes, str) or not isinstance(nodes, Iterable) else list(nodes)


def rows(kind: str, z: ArrayLike, count: int) -> Floats:
    """z (count, size) from a number, a row or rows."""
    values = checked(f"z of {kind}", z)
    return values.reshape(count, -1) if values.ndim < 2 and values.size % count == 0 else values


def index_of(node: Any, index_of_name: Mapping[str, int], names: Sequence[str]) -> int:
    """Index of a node given by name, which has a place, or index; InputError if there is none."""
    index = index_of_name.get(node) if isinstance(node, str) else node
    if isinstance(index, bool) or not isinstance(index, int | np.integer) or not 0 <= index < len(names):
        raise no_such_node(node, names)
    return int(index)


def no_such_node(
    node: Any, names: Sequence[str], hint: str = "Give its index, or name the point when the Problem is made."
) -> InputError:
    """The error for a node that is neither a name nor an index."""
    allowed = f"must be one of {', '.join(names[:8])}{', ...' * (len(names) > 8)}"
    return InputError("node", shown(node), allowed, suggestion(node, names, hint))


def linearised(problem: Problem, x: Floats) -> tuple[Linear, Any]:
    """`Problem.linearise` at x (n, ambient), which need not be checked, and the sparse Jacobian (rows, n dof), CSR, by
    what can move."""
    linear, movable, dof, blocks = linearise(problem.space, problem.factors, x), problem.movable, problem.space.dof, []
    for f, jacobian in zip(problem.factors, linear.jacobian, strict=True):
        own = (dof * f.nodes[:, :, None] + np.arange(dof)).reshape(len(f.nodes), -1)
        blocks.append((jacobian * movable.ravel()[own][:, None], own))
    return linear, row_matrix(blocks, movable.size)


def row_matrix(blocks: Iterable[tuple[Floats, Ints]], width: int) -> Any:
    """Sparse matrix (rows, width), CSR, of blocks: k rows for each measurement, values (M, k, c) in columns (M, c)."""
    from scipy.sparse import csr_array

    data, columns, lengths = [], [], []
    for values, own in blocks:
        data.append(values.ravel())
        columns.append(np.broadcast_to(own[:, None], values.shape).ravel())
        lengths.append(np.full(values[..., 0].size, own.shape[1]))
    starts = np.append(0, np.cumsum(stacked(lengths)))
    return csr_array((stacked(data), stacked(columns), starts), shape=(len(starts) - 1, width))


def points(space: Space, n: int, field: str, x: ArrayLike) -> Floats:
    """x as an array (n, ambient); InputError if it is not one, or holds matrices of no rotation."""
    array = checked(field, x)
    if array.shape != (n, space.ambient) or not np.isfinite(array).all():
        actual = f"shape {array.shape}" if np.isfinite(array).all() else "not finite"
        hint = "Make it with coopoc.optimize.pose." if space.has_rotation else "Give one row of metres per point."
        raise InputError(field, actual, f"must be finite with shape ({n}, {space.ambient})", hint)
    if space.has_rotation:
        check_rotations(field, space.rotation(array))
    return array

"""The cost of a problem by tapes: value, gradient and sparse Hessian at a point, and factors of it."""

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import combinations, combinations_with_replacement
from typing import Any
from weakref import WeakValueDictionary

import numpy as np

from ...arrays import Bools, Floats, Ints
from ..model.derivatives import Kind, Model, Structure, Term, numbers_of, write
from ..model.factor import steerable
from ..model.problem import Problem
from ..model.space import Space
from .cholesky import Cholesky, cholesky_of

LIBRARIES = ("scipy.sparse", "coopoc.kernels.graphs.graph_tape", "coopoc.kernels.graphs.multifrontal")
"""What every solve imports late, so that `import coopoc` stays quick."""
SMALL_UNKNOWNS = 200
"""Unknowns up to which layouts are kept."""


@dataclass(frozen=True, eq=False)
class Entries:
    """Where the upper triangle of a Hessian over what can move has its numbers, CSC.

    Args:
        number: (n, dof) which of the m unknowns a direction of a node is, -1 where it cannot move.
        key: sorted j n + i of the blocks of nodes (i, j), i <= j.
        entry: (blocks, dof, dof) which one each number of a block, -1 below the diagonal and where nothing can move.
        indptr: (m + 1,) and indices: of the CSC matrix.
    """

    number: Ints
    key: Ints
    entry: Ints
    indptr: Ints
    indices: Ints

    @property
    def size(self) -> int:
        """m, numbers that can move."""
        return len(self.indptr) - 1

    @cached_property
    def diagonal(self) -> Ints:
        """(m,) places of the diagonal."""
        return self.indptr[1:] - 1

    @cached_property
    def marginals(self) -> tuple[Bools, Ints, Ints]:
        """The `pairs_of` the directions of each node."""
        return pairs_of(self.number)

    def places(self, first: Ints, last: Ints, row: Ints, column: Ints) -> Ints:
        """(K, M) where products of directions (K,) of pairs of nodes (M,) belong, -1 if nowhere."""
        upper, lower = np.maximum(first, last), np.minimum(first, last)
        block, turned = np.searchsorted(self.key, upper * len(self.number) + lower), first > last
        row, column = row[:, None], column[:, None]
        return self.entry[block, np.where(turned, column, row), np.where(turned, row, column)]


def pairs_of(number: Ints) -> tuple[Bools, Ints, Ints]:
    """(M, k, k) where two of the k directions of each row of `number` can move, and their unknowns."""
    row, column = np.broadcast_arrays(number[:, :, None], number[:, None, :])
    free = (row >= 0) & (column >= 0)
    return free, row[free], column[free]


def entries_of(movable: Bools, measured: Sequence[Ints]) -> Entries:
    """The pattern of a Hessian: a block for every node and every pair that a measurement joins.

    Args:
        movable: (n, dof) False where a node cannot move.
        measured: the nodes (M, arity) of each factor.
    """
    (n, dof), m = movable.shape, int(movable.sum())
    number = np.where(movable, np.cumsum(movable).reshape(n, dof) - 1, -1)
    keys = [np.arange(n) * (n + 1)]
    for nodes in measured:
        keys += [high * n + low for low, high in combinations(np.sort(nodes).T, 2)]
    key = np.unique(np.concatenate(keys))
    j, i = np.divmod(key, n)
    row, column = np.broadcast_arrays(number[i][:, :, None], number[j][:, None, :])
    there = (row >= 0) & (row <= column)
    row, column = row[there], column[there]
    order, index = np.lexsort((row, column)), np.full(there.shape, -1, int)
    index.ravel()[np.flatnonzero(there)[order]] = np.arange(len(order))
    return Entries(number, key, index, np.searchsorted(column[order], np.arange(m + 1)), row[order])


def places_of(entries: Entries, nodes: Ints, written: Ints) -> Any:
    """(outputs, M) int32, where each output of a tape is added: the cost, the gradient, the Hessian, or, last, nowhere.

    Args:
        entries: of the Hessian.
        nodes: (M, arity).
        written: (outputs, 2), see `Written`.
    """
    m, nowhere, dof = entries.size, entries.size + 1 + len(entries.indices), entries.number.shape[1]
    columns = np.concatenate([entries.number[node].T for node in nodes.T])
    goal = np.zeros((len(written), len(nodes)), np.int32)
    i, j = written.T
    gradient = (i >= 0) & (j < 0)
    goal[gradient] = np.where(columns[i[gradient]] < 0, nowhere, 1 + columns[i[gradient]])
    for first, last in combinations_with_replacement(range(nodes.shape[1]), 2):
        which = np.flatnonzero((j >= 0) & (i // dof == first) & (j // dof == last))
        at = entries.places(nodes[:, first], nodes[:, last], i[which] % dof, j[which] % dof)
        goal[which] = np.where(at < 0, nowhere, 1 + m + at)
    return goal


class Layout:
    """What problems of one structure share: the pattern of their Hessians, tapes, and analyses of the factorisation.

    Args:
        structure: of the problems.

    Raises:
        InputError: a formula that has no tape.
    """

    def __init__(self, structure: Structure) -> None:
        from ...kernels.graphs.graph_tape import accumulate

        self.terms, self._accumulate = structure.factors, accumulate
        self.entries: Entries = entries_of(structure.movable, [term.nodes for term in self.terms])
        self._local = threading.local()
        self._tapes: dict[Model, list[tuple[Any, Ints, Ints]]] = {}

    @property
    def cholesky(self) -> Cholesky:
        """Factors of its Hessians; each thread has its own."""
        if not hasattr(self._local, "cholesky"):
            group = np.nonzero(self.entries.number >= 0)[0]
            self._local.cholesky = Cholesky(self.entries.indptr, self.entries.indices, group)
        return self._local.cholesky  # type: ignore[no-any-return]

    def total(self, model: Model, x: Floats, numbers: Sequence[Floats]) -> Floats:
        """The cost, the gradient, the Hessian's values and a last number, which is waste, at x (n, ambient).

        Args:
            model: of the Hessian.
            x: (n, ambient).
            numbers: of each factor, see `numbers_of`.
        """
        if model not in self._tapes:
            written = [(write(term.kind, model), term.nodes) for term in self.terms]
            self._tapes[model] = [(w.tape, nodes, places_of(self.entries, nodes, w.entries)) for w, nodes in written]
        out = np.zeros(2 if model == "cost" else self.entries.size + len(self.entries.indices) + 2)
        for (tape, nodes, goal), own in zip(self._tapes[model], numbers, strict=True):
            self._accumulate(tape, x, nodes, own, goal, out)
        return out


def structure_of(problem: Problem) -> Structure:
    """The structure of a problem."""
    space, movable = problem.space, problem.movable
    factors = (Term(Kind(f.measurement, space, f.std is None, f.loss), f.nodes.tobytes()) for f in problem.factors)
    constraints = (
        Term(Kind(c.measurement, space), c.nodes.tobytes(), steerable(c, movable).tobytes())
        for c in problem.constraints
    )
    return Structure(len(problem.names), space, movable.tobytes(), tuple(factors), tuple(constraints))


_small = lru_cache(maxsize=256)(Layout)
"""Small problems come by the thousand with few structures."""
_LARGE: WeakValueDictionary[Structure, Layout] = WeakValueDictionary()
"""Of large ones the problem that is at hand and those that differ from it in numbers alone."""


def layout_of(structure: Structure) -> Layout:
    """The layout of a structure without its constraints, shared by its problems."""
    structure = structure._replace(constraints=())
    if structure.nodes * structure.space.dof <= SMALL_UNKNOWNS:
        return _small(structure)
    if (layout := _LARGE.get(structure)) is None:
        layout = _LARGE[structure] = Layout(structure)
    return layout


@dataclass(frozen=True, eq=False)
class Sparse:
    """The cost of a problem over its m unknowns; build it with `sparse`. It does not hold the problem, which
    holds it.

    Args:
        space: where the nodes live.
        layout: of its structure.
        numbers: per factor, the inputs of its tape that are no nodes.
    """

    space: Space
    layout: Layout
    numbers: tuple[Floats, ...]

    @cached_property
    def entries(self) -> Entries:
        """Of its Hessians."""
        return self.layout.entries

    @cached_property
    def size(self) -> int:
        """m."""
        return self.entries.size

    @property
    def cholesky(self) -> Cholesky:
        """Factors of its Hessians, whose ordering is kept; each thread has its own."""
        return self.layout.cholesky

    def cost(self, x: Floats) -> float:
        """1/2 sum of rho at x (n, ambient)."""
        return float(self.layout.total("cost", x, self.numbers)[0])

    def quadratic(self, x: Floats, model: Model) -> tuple[float, Floats, Floats]:
        """Cost, gradient (m,) and the values of the Hessian's upper triangle at x: J^T J, or the exact one."""
        m = self.size
        total = self.layout.total(model, x, self.numbers)
        return float(total[0]), total[1 : m + 1], total[m + 1 : -1]

    def settled(self, x: Floats, dof: int) -> Floats:
        """x (n, ambient) after a Gauss-Newton step along the first directions of each node, or as it is where that has
        none."""
        from scipy.sparse import csc_array

        _, gradient, values = self.quadratic(x, "gauss-newton")
        entries, step = self.entries, np.zeros(self.size)
        own, upper = np.nonzero(entries.number >= 0)[1] < dof, csc_array((values, entries.indices, entries.indptr))
        if factored := cholesky_of(upper[own][:, own]):
            step[own] = -factored.solve(gradient[own])
        return self.retract(x, step)

    def retract(self, x: Floats, step: Floats) -> Floats:
        """x after a step (m,)."""
        return self.space.retract(x, np.append(step, 0.0)[self.entries.number])


def sparse(problem: Problem) -> Sparse:
    """The cost of a problem, without its constraints, ready to be evaluated; kept as long as the problem is.

    Raises:
        InputError: a formula that CasADi cannot run.
    """
    kept: Sparse | None = problem.__dict__.get("sparse")
    if kept is None:
        numbers = tuple(map(numbers_of, problem.factors))
        kept = problem.__dict__["sparse"] = Sparse(problem.space, layout_of(structure_of(problem)), numbers)
    return kept

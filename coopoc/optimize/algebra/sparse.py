"""The cost of a single problem by tapes: value, gradient and sparse Hessian at a point, and factors of it."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import combinations_with_replacement
from typing import Any
from weakref import WeakKeyDictionary, WeakValueDictionary

import numpy as np

from ...arrays import Bools, Floats, Ints
from ..model.factor import steerable
from ..model.linear import Linear
from ..model.problem import Problem
from ..model.space import Space
from ..model.symbolic import Kind, Structure, Term, numbers_of
from ..model.tape import Model, write
from .cholesky import Cholesky, DenseCholesky

DENSE = 200
"""Unknowns up to which one dense matrix is as fast."""
AT_ONCE = 100_000
"""Places that are found at a time: many at once take memory."""


@dataclass(frozen=True, eq=False)
class Entries:
    """Where the upper triangle of a Hessian over what can move has its numbers, CSC.

    Args:
        number: (n, dof) which of the m unknowns a direction of a node is, -1 where it cannot move.
        start: (n,) first of a node's entries in its first column.
        height: (n,) rows above a node's own block.
        block: sorted keys j n + i of the blocks (i, j), i <= j, and the row of each within column j.
        indptr: (m + 1,) and indices: of the CSC matrix.
    """

    number: Ints
    start: Ints
    height: Ints
    block: tuple[Ints, Ints]
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

    def pair(self, first: Ints, last: Ints) -> tuple[Ints, Ints, Ints]:
        """(M,) which of two nodes has the columns of their block, which the rows, and where its rows begin."""
        upper, lower = np.maximum(first, last), np.minimum(first, last)
        key, offset = self.block
        return upper, lower, offset[np.searchsorted(key, upper * len(self.number) + lower)]

    def places(self, pair: tuple[Ints, Ints, Ints], unknown: Ints, another: Ints) -> Ints:
        """(..., M) where products of two unknowns of a pair's nodes belong, -1 where unknown is -1."""
        upper, lower, offset = pair
        low, high = np.minimum(unknown, another), np.maximum(unknown, another)
        within = high - self.first[upper]
        at = self.start[upper] + within * self.height[upper] + within * (within + 1) // 2
        return np.where(low < 0, -1, at + offset + low - self.first[lower])

    @cached_property
    def own(self) -> tuple[Bools, Ints, Ints]:
        """(n, dof, dof) where both directions of a node can move, and their unknowns."""
        row, column = np.broadcast_arrays(self.number[:, :, None], self.number[:, None, :])
        free = (row >= 0) & (column >= 0)
        return free, row[free], column[free]

    @cached_property
    def first(self) -> Ints:
        """(n,) first unknown of each node."""
        counts = (self.number >= 0).sum(axis=1)
        return np.asarray(np.cumsum(counts) - counts)


def entries_of(movable: Bools, measured: Sequence[Ints]) -> Entries:
    """The pattern of a Hessian: a block for every node and every pair that a measurement joins.

    Args:
        movable: (n, dof) False where a node cannot move.
        measured: the nodes (M, arity) of each factor.
    """
    n, dof = movable.shape
    number = np.where(movable, np.cumsum(movable).reshape(n, dof) - 1, -1)
    count = movable.sum(axis=1)
    keys = [np.arange(n) * (n + 1)]
    keys += [nodes.max(axis=1) * n + nodes.min(axis=1) for nodes in measured if nodes.shape[1] == 2]
    key = np.unique(np.concatenate(keys))
    j, i = np.divmod(key, n)
    width = count[i]
    before = np.cumsum(width) - width
    head = before[np.searchsorted(key, np.arange(n) * n)]
    offset = before - head[j]
    height = np.bincount(j, width * (i != j), n).astype(np.int64)
    per_node = count * height + count * (count + 1) // 2
    start = np.cumsum(per_node) - per_node
    length = np.repeat(height, count) + _within(count) + 1
    indptr = np.concatenate([[0], np.cumsum(length)]).astype(np.int64)
    indices = _rows(number, count, (key, offset), height, start, n)
    return Entries(number, start, height, (key, offset), indptr, indices)


def _within(count: Ints) -> Ints:
    """0, 1, ..., c - 1 for each c of `count`."""
    total = np.cumsum(count)
    return np.asarray(np.arange(total[-1] if len(total) else 0) - np.repeat(total - count, count))


def _rows(number: Ints, count: Ints, block: tuple[Ints, Ints], height: Ints, start: Ints, n: int) -> Ints:
    """Row indices of the CSC matrix, block by block and direction by direction."""
    key, offset = block
    j, i = np.divmod(key, n)
    first = np.cumsum(count) - count
    indices = np.empty(int((count * height + count * (count + 1) // 2).sum()), dtype=np.int64)
    for c in range(int(count.max(initial=0))):
        for r in range(int(count.max(initial=0))):
            here = (c < count[j]) & (r < count[i]) & ((i != j) | (r <= c))
            at = start[j] + c * height[j] + c * (c + 1) // 2 + offset + r
            indices[at[here]] = (first[i] + r)[here]
    return indices


def places_of(entries: Entries, nodes: Ints, written: Ints) -> Any:
    """(outputs, M) int32, where each output of a tape is added: the cost, the gradient, the Hessian, or, last, nowhere.

    Args:
        entries: of the Hessian.
        nodes: (M, arity).
        written: (outputs, 2), see `Written`.
    """
    m, nowhere, dof = entries.size, entries.size + 1 + len(entries.indices), entries.number.shape[1]
    columns = np.concatenate([entries.number[node].T for node in nodes.T])
    goal = np.zeros((len(written), len(nodes)), dtype=np.int32)
    i, j = written.T
    gradient = (i >= 0) & (j < 0)
    goal[gradient] = np.where(columns[i[gradient]] < 0, nowhere, 1 + columns[i[gradient]])
    for first, last in combinations_with_replacement(range(nodes.shape[1]), 2):
        which = np.flatnonzero((j >= 0) & (i // dof == first) & (j // dof == last))
        pair = entries.pair(nodes[:, first], nodes[:, last])
        for some in np.array_split(which, 1 + which.size * len(nodes) // AT_ONCE):
            at = entries.places(pair, columns[i[some]], columns[j[some]])
            goal[some] = np.where(at < 0, nowhere, 1 + m + at)
    return goal


def summed(values: Floats, goal: Ints, size: int) -> Floats:
    """(B, size) sums of values (B, K) by where each belongs (K,)."""
    goal = goal + size * np.arange(len(values))[:, None]
    total = np.bincount(goal.ravel(), values.ravel(), size * len(values))
    return np.asarray(total, np.float64).reshape(len(values), size)


class Layout:
    """What problems of one structure share: the pattern of their Hessians, tapes, and analyses of the factorisation.

    Args:
        structure: of the problems.

    Raises:
        InputError: a formula that has no tape.
    """

    def __init__(self, structure: Structure) -> None:
        self.terms = structure.factors
        self.entries: Entries = entries_of(structure.movable, [term.nodes for term in self.terms])
        self._local = threading.local()
        self._tapes: dict[Model, list[tuple[Any, Ints, Ints]]] = {}

    @property
    def cholesky(self) -> Cholesky | DenseCholesky:
        """Factors of its Hessians; each thread has its own."""
        if not hasattr(self._local, "cholesky"):
            pattern = self.entries.indptr, self.entries.indices
            group = np.nonzero(self.entries.number >= 0)[0]
            small = self.entries.size <= DENSE
            self._local.cholesky = DenseCholesky(*pattern) if small else Cholesky(*pattern, group)
        return self._local.cholesky  # type: ignore[no-any-return]

    @cached_property
    def _products(self) -> Ints:
        """Where the entries of (J, r)^T (J, r) of all measurements belong, see `places_of`."""
        goals = [np.empty(0, np.int32)]
        for term in self.terms:
            r = term.nodes.shape[1] * term.kind.space.dof
            i, j = np.indices((r + 1, r + 1)).reshape(2, -1)
            written = np.where((i <= j) & (i < r), [i, np.where(j < r, j, -1)], -1)
            goals.append(places_of(self.entries, term.nodes, written.T).T.ravel())
        return np.concatenate(goals)

    def normal_equations(self, linear: Linear) -> tuple[Floats, Floats]:
        """The values of the upper triangle of J^T J (B, entries) and J^T r (B, m) of linearised problems."""
        m, squares = self.entries.size, [np.empty((len(linear.x), 0))]
        for residual, jacobians in zip(linear.residual, linear.jacobian, strict=True):
            wide = np.concatenate([*jacobians, residual[..., None]], axis=-1)
            squares.append((wide.swapaxes(-1, -2).copy() @ wide).reshape(len(wide), -1))
        total = summed(np.concatenate(squares, axis=1), self._products, m + len(self.entries.indices) + 2)
        return total[:, m + 1 : -1], total[:, 1 : m + 1]

    def total(self, model: Model, x: Floats, numbers: Sequence[Floats]) -> Floats:
        """The cost, the gradient, the Hessian's values and a last number, which is waste, at x (n, ambient).

        Args:
            model: of the Hessian.
            x: (n, ambient).
            numbers: of each factor, see `numbers_of`.
        """
        from ...kernels.graphs.graph_tape import accumulate

        if model not in self._tapes:
            written = [(write(term.kind, model), term.nodes) for term in self.terms]
            self._tapes[model] = [(w.tape, nodes, places_of(self.entries, nodes, w.entries)) for w, nodes in written]
        out = np.zeros(2 if model == "cost" else self.entries.size + len(self.entries.indices) + 2)
        for (tape, nodes, goal), own in zip(self._tapes[model], numbers, strict=True):
            accumulate(tape, x, nodes, own, goal, out)
        return out


def structure_of(problem: Problem) -> Structure:
    """The structure of a problem."""
    space, movable = problem.space, problem.movable
    factors = (Term(Kind(f.measurement, space, f.std is None, f.loss), f.nodes.tobytes()) for f in problem.factors)
    constraints = (
        Term(Kind(c.measurement, space), c.nodes.tobytes(), steerable(c, movable).tobytes())
        for c in problem.constraints
    )
    still = b"" if movable is None else (~movable).tobytes()
    return Structure(len(problem.names), space, still, tuple(factors), tuple(constraints))


_small = lru_cache(maxsize=256)(Layout)
"""Small problems come by the thousand with few structures."""
_LARGE: WeakValueDictionary[Structure, Layout] = WeakValueDictionary()
"""Of large ones the problem that is at hand and those that differ from it in numbers alone."""


def layout_of(problem: Problem) -> Layout:
    """The layout of a single problem, shared with others of its structure."""
    structure = structure_of(problem.replace_unchecked(constraints=()) if problem.constraints else problem)
    if len(problem.names) * problem.space.dof <= DENSE:
        return _small(structure)
    if (layout := _LARGE.get(structure)) is None:
        layout = _LARGE[structure] = Layout(structure)
    return layout


@dataclass(frozen=True, eq=False)
class Sparse:
    """The cost of a single problem over its m unknowns; build it with `sparse`. It does not hold the problem, which
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
    def cholesky(self) -> Cholesky | DenseCholesky:
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

    def retract(self, x: Floats, step: Floats) -> Floats:
        """x after a step (m,)."""
        number = self.entries.number
        if len(step) == number.size:
            return self.space.retract(x, step.reshape(number.shape))
        return self.space.retract(x, np.append(step, 0.0)[number])


_KEPT: WeakKeyDictionary[Problem, Sparse] = WeakKeyDictionary()


def sparse(problem: Problem) -> Sparse:
    """The cost of a single problem, without its constraints, ready to be evaluated; kept as long as the problem is.

    Raises:
        InputError: a formula that CasADi cannot run.
    """
    if (kept := _KEPT.get(problem)) is None:
        numbers = tuple(numbers_of(factor) for factor in problem.factors)
        kept = _KEPT[problem] = Sparse(problem.space, layout_of(problem), numbers)
    return kept


def keep(former: Problem, problem: Problem) -> Problem:
    """The problem, with what is kept of a former one that differs from it in x0 and its search alone."""
    if former in _KEPT:
        _KEPT[problem] = _KEPT[former]
    return problem

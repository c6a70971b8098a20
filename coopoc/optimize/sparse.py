"""A single large problem by compiled tapes and a kept sparsity pattern: cost, gradient and Hessian at a point."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from ..arrays import Floats, Ints
from .cholesky import Cholesky
from .factor import Factor
from .problem import Problem
from .space import Space
from .tape import Model, NoTape, kind_of, numbers_of, write


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

    def places(self, pair: tuple[Ints, Ints, Ints], one: Ints, other: Ints) -> Ints:
        """(M,) where the product of two unknowns of a pair's nodes belongs, -1 where one is -1."""
        upper, lower, offset = pair
        low, high = np.minimum(one, other), np.maximum(one, other)
        within = high - self.first[upper]
        at = self.start[upper] + within * self.height[upper] + within * (within + 1) // 2
        return np.where(low < 0, -1, at + offset + low - self.first[lower])

    @cached_property
    def first(self) -> Ints:
        """(n,) first unknown of each node."""
        counts = (self.number >= 0).sum(axis=1)
        return np.asarray(np.cumsum(counts) - counts)


def entries_of(problem: Problem) -> Entries:
    """The pattern of a problem's Hessian: a block for every node and every pair that a measurement joins."""
    n, dof = len(problem.names), problem.space.dof
    movable = np.ones((n, dof), dtype=bool) if problem.movable is None else problem.movable
    number = np.where(movable, np.cumsum(movable).reshape(n, dof) - 1, -1)
    count = movable.sum(axis=1)
    keys = [np.arange(n) * (n + 1)]
    for factor in problem.factors:
        if factor.nodes.shape[1] == 2:
            keys.append(factor.nodes.max(axis=1) * n + factor.nodes.min(axis=1))
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


@dataclass(frozen=True, eq=False)
class Sparse:
    """A single problem over its m unknowns; build it with `sparse`. It does not hold the problem, which holds it.

    Args:
        space: where the nodes live.
        factors: of the problem.
        entries: of its Hessians.
        numbers: per factor, the inputs of its tape that are no nodes.
    """

    space: Space
    factors: Sequence[Factor]
    entries: Entries
    numbers: tuple[Floats, ...]

    @property
    def size(self) -> int:
        """m."""
        return self.entries.size

    @property
    def cholesky(self) -> Cholesky:
        """Factors of its Hessians, whose ordering is kept; each thread has its own."""
        if not hasattr(self._local, "cholesky"):
            self._local.cholesky = Cholesky(np.nonzero(self.entries.number >= 0)[0])
        return self._local.cholesky  # type: ignore[no-any-return]

    @cached_property
    def _local(self) -> threading.local:
        return threading.local()

    @cached_property
    def _goals(self) -> dict[tuple[int, Model], Any]:
        return {}

    def cost(self, x: Floats) -> float:
        """1/2 sum of rho at x (n, ambient)."""
        return float(self._sum(x, "cost", 2)[0])

    def quadratic(self, x: Floats, model: Model) -> tuple[float, Floats, Floats]:
        """Cost, gradient (m,) and the values of the Hessian's upper triangle at x: J^T J, or the exact one."""
        m = self.size
        total = self._sum(x, model, m + len(self.entries.indices) + 2)
        return float(total[0]), total[1 : m + 1], total[m + 1 : -1]

    def matrix(self, values: Floats) -> Any:
        """The upper triangle as CSC."""
        from scipy.sparse import csc_matrix

        return csc_matrix((values, self.entries.indices, self.entries.indptr), shape=(self.size, self.size))

    def retract(self, x: Floats, step: Floats) -> Floats:
        """x after a step (m,)."""
        wide = np.append(step, 0.0)[self.entries.number]
        return self.space.retract(x, wide)

    def _sum(self, x: Floats, model: Model, size: int) -> Floats:
        from ..kernels.graph_tape import accumulate

        total = np.zeros(size)
        with np.errstate(all="ignore"):
            for k, factor in enumerate(self.factors):
                tape = write(kind_of(factor, self.space), model).tape
                accumulate(tape, x, factor.nodes, self.numbers[k], self._goal(k, factor, model), total)
        return total

    def _goal(self, k: int, factor: Factor, model: Model) -> Any:
        if (k, model) not in self._goals:
            written = write(kind_of(factor, self.space), model).entries
            self._goals[k, model] = _goal(self.entries, factor.nodes, written, self.space.dof)
        return self._goals[k, model]


def _goal(entries: Entries, nodes: Ints, written: Ints, dof: int) -> Any:
    """(outputs, M) where each output of a tape is added: the cost, the gradient, the Hessian, or, last, nowhere."""
    m, nowhere = entries.size, entries.size + 1 + len(entries.indices)
    columns = [entries.number[node, k] for node in nodes.T for k in range(dof)]
    pairs = {(i, j): entries.pair(nodes[:, i], nodes[:, j]) for j in range(nodes.shape[1]) for i in range(j + 1)}
    goal = np.zeros((len(written), len(nodes)), dtype=np.int32)
    for out, (i, j) in enumerate(written.tolist()):
        if i < 0:
            continue
        at, base = (
            (columns[i], 1) if j < 0 else (entries.places(pairs[i // dof, j // dof], columns[i], columns[j]), 1 + m)
        )
        goal[out] = np.where(at < 0, nowhere, base + at)
    return goal


LARGE = 60
"""Nodes beyond which a problem without a separator is sparse."""
_KEPT: WeakKeyDictionary[Problem, Sparse | None] = WeakKeyDictionary()


def sparse(problem: Problem, least: int = LARGE) -> Sparse | None:
    """A large single problem ready to be evaluated, kept as long as the problem is; None if it is small, has a
    separator or constraints, or a kind that no tape can hold. Small are problems of up to `least` nodes."""
    if problem.batch is not None or problem.separator or problem.constraints or len(problem.names) <= least:
        return None
    if problem not in _KEPT:
        _KEPT[problem] = _made(problem)
    return _KEPT[problem]


def keep(former: Problem, problem: Problem) -> Problem:
    """The problem, with what is kept of a former one that differs from it in x0 and its search alone."""
    if former in _KEPT:
        _KEPT[problem] = _KEPT[former]
    return problem


def _made(problem: Problem) -> Sparse | None:
    try:
        for factor in problem.factors:
            write(kind_of(factor, problem.space), "newton")
    except NoTape:
        return None
    return Sparse(
        problem.space, problem.factors, entries_of(problem), tuple(numbers_of(factor) for factor in problem.factors)
    )

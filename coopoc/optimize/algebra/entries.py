"""The pattern of a Hessian over what can move, and where each number of a measurement is added in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations_with_replacement
from typing import Any

import numpy as np

from ...arrays import Bools, Ints

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

    def places(self, pair: tuple[Ints, Ints, Ints], one: Ints, other: Ints) -> Ints:
        """(..., M) where products of two unknowns of a pair's nodes belong, -1 where one is -1."""
        upper, lower, offset = pair
        low, high = np.minimum(one, other), np.maximum(one, other)
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

"""Linear: a problem around a point, as whitened residuals and their derivatives by the steps of the nodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from ...arrays import Bools, Floats, Ints
from .factor import Factor
from .space import Space
from .symbolic import Kind, numbers_of
from .tape import write


@dataclass(frozen=True, eq=False)
class Linear:
    """A problem around x: per factor, whitened residuals and their derivative by the steps of its nodes.

    A robust factor's residual and derivatives carry the root of its weight rho'.

    Args:
        x: (B, n, ambient).
        residual: per factor (B, M, size).
        jacobian: per factor and node (B, M, size, dof).
        cost: (B,) 1/2 sum of rho.
    """

    x: Floats
    residual: tuple[Floats, ...]
    jacobian: tuple[tuple[Floats, ...], ...]
    cost: Floats

    def pick(self, index: Bools | Ints) -> Linear:
        """The realisations `index` of B."""
        jacobian = tuple(tuple(of_node[index] for of_node in nodes) for nodes in self.jacobian)
        return Linear(self.x[index], tuple(r[index] for r in self.residual), jacobian, self.cost[index])


def linearise(space: Space, factors: Sequence[Factor], movable: Bools | None, x: Floats) -> Linear:
    """Factors around x (B, n, ambient); what is not `movable` (n, dof) has no derivative."""
    residuals, jacobians, cost = [], [], np.zeros(len(x))
    for factor in factors:
        residual, jacobian = _evaluated(space, factor, x)
        square = np.einsum("bmk,bmk->bm", residual, residual)
        if factor.loss is None:
            cost += 0.5 * square.sum(axis=1)
        else:
            root = np.sqrt(factor.loss.weight(square))[..., None]
            residual, jacobian = residual * root, tuple(s * root[..., None] for s in jacobian)
            cost += 0.5 * factor.loss.cost(square).sum(axis=1)
        if movable is not None:
            jacobian = tuple(s * movable[n][:, None] for s, n in zip(jacobian, factor.nodes.T, strict=True))
        residuals.append(residual)
        jacobians.append(jacobian)
    return Linear(x, tuple(residuals), tuple(jacobians), cost)


def _evaluated(space: Space, factor: Factor, x: Floats) -> tuple[Floats, tuple[Floats, ...]]:
    """Whitened residuals and derivatives of a factor at x by the tape of its kind, all realisations in one run."""
    from ...kernels.graphs.graph_tape import accumulate

    (batch, n, _), (count, arity), size, dof = x.shape, factor.nodes.shape, factor.size, space.dof
    kind = Kind(factor.measurement, space, factor.std is None)
    rows = batch * count
    numbers, nodes = numbers_of(factor), factor.nodes
    if batch > 1:
        numbers = np.tile(numbers, batch) if numbers.ndim == 2 else numbers.swapaxes(0, 1)
        nodes = (n * np.arange(batch)[:, None, None] + nodes).reshape(-1, arity)
    numbers = numbers.reshape(-1, rows)
    total = np.zeros((1 + arity * dof) * size * rows)
    accumulate(write(kind, "jacobian").tape, x.reshape(batch * n, -1), nodes, numbers, _goal(kind, rows), total)
    end = size * rows
    jacobians = total[end:].reshape(arity, batch, count, size, dof)
    return total[:end].reshape(batch, count, size), tuple(jacobians)


@lru_cache(maxsize=64)
def _goal(kind: Kind, rows: int) -> Any:
    """(outputs, rows) int32, where a tape's outputs go: residuals (rows, size), Jacobians (arity, rows, size, dof)."""
    size, dof = kind.measurement.size(kind.space.dimension), kind.space.dof
    component, column = write(kind, "jacobian").entries.T
    node, direction = np.divmod(column, dof)
    first = np.where(column < 0, component, size * rows * (1 + node * dof) + component * dof + direction)
    stride = np.where(column < 0, size, size * dof)
    return (first[:, None] + stride[:, None] * np.arange(rows)).astype(np.int32)


def sparse_jacobian(linear: Linear, factors: Sequence[Factor], shape: tuple[int, int], index: int) -> Any:
    """Sparse Jacobian (rows, n dof) of one realisation, CSR; shape is n and dof."""
    from scipy.sparse import csr_array

    (n, dof), top = shape, 0
    data, rows, columns = [np.empty(0)], [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for factor, residual, jacobians in zip(factors, linear.residual, linear.jacobian, strict=True):
        count, size = residual.shape[1:]
        row = top + np.arange(count * size).reshape(count, size, 1)
        for nodes, jacobian in zip(factor.nodes.T, jacobians, strict=True):
            data.append(jacobian[index].ravel())
            rows.append(np.broadcast_to(row, (count, size, dof)).ravel())
            columns.append(np.broadcast_to(dof * nodes[:, None, None] + np.arange(dof), (count, size, dof)).ravel())
        top += count * size
    position = np.concatenate(rows), np.concatenate(columns)
    return csr_array((np.concatenate(data), position), shape=(top, n * dof))

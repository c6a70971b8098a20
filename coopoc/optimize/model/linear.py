"""Linear: a problem around a point, as whitened residuals and their derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...arrays import Bools, Floats, Ints
from .factor import Factor
from .local import chain, local
from .space import Space


@dataclass(frozen=True, eq=False)
class Linear:
    """A problem around x: per factor, whitened residuals and their derivative by the steps of its nodes.

    Of a pair in the world frame only the second node's derivative is kept, the first's is minus it. A robust factor's
    residual and derivatives carry the root of its weight rho'.

    Args:
        x: (B, n, ambient).
        residual: per factor (B, M, size).
        jacobian: per factor and node (B or 1, M or 1, size, dof).
        cost: (B,) 1/2 sum of rho.
    """

    x: Floats
    residual: tuple[Floats, ...]
    jacobian: tuple[tuple[Floats, ...], ...]
    cost: Floats

    def pick(self, which: Bools | Ints) -> Linear:
        """The realisations `which` of B."""
        jacobian = tuple(tuple(s[which] if len(s) > 1 else s for s in nodes) for nodes in self.jacobian)
        return Linear(self.x[which], tuple(r[which] for r in self.residual), jacobian, self.cost[which])

    def by_node(self, factors: Sequence[Factor]) -> list[tuple[Floats, ...]]:
        """Per factor one derivative for each of its nodes."""
        return [
            (-jacobian[0], jacobian[0]) if len(jacobian) < factor.nodes.shape[1] else jacobian
            for factor, jacobian in zip(factors, self.jacobian, strict=True)
        ]


def linearise(space: Space, factors: Sequence[Factor], movable: Bools | None, x: Floats) -> Linear:
    """Factors around x (B, n, ambient); what is not `movable` (n, dof) has no derivative."""
    residuals, jacobians, cost = [], [], np.zeros(len(x))
    for factor in factors:
        residual, jacobian = _factor(space, factor, x)
        if factor.loss is None:
            cost += 0.5 * np.einsum("bmk,bmk->b", residual, residual)
        else:
            square = np.einsum("bmk,bmk->bm", residual, residual)
            root = np.sqrt(factor.loss.weight(square))[..., None]
            residual, jacobian = residual * root, tuple(s * root[..., None] for s in jacobian)
            cost += 0.5 * factor.loss.cost(square).sum(axis=1)
        if movable is not None:
            jacobian = _masked(factor, jacobian, movable)
        residuals.append(residual)
        jacobians.append(jacobian)
    return Linear(x, tuple(residuals), tuple(jacobians), cost)


def _factor(space: Space, factor: Factor, x: Floats) -> tuple[Floats, tuple[Floats, ...]]:
    known = factor.measurement
    assert factor.constants is not None
    seen = local(space, known, x, factor.nodes)
    gap: Floats
    jacobian: Floats
    if known.linear:
        gap, jacobian = seen[0] - factor.z, factor.root
    else:
        gap, jacobian = known.differentiate(*seen, factor.z, factor.constants)
        jacobian = factor.whiten_jacobian(jacobian)
    jacobian = jacobian.reshape(*(1,) * (4 - jacobian.ndim), *jacobian.shape)
    return factor.whiten(gap), chain(space, known, x, factor.nodes, seen, jacobian)


def opposite(factor: Factor, movable: Bools | None) -> bool:
    """Whether the two nodes of the factor's measurements have derivatives that differ in sign only."""
    pair = factor.measurement.frame == "world" and factor.nodes.shape[1] == 2
    return pair and (movable is None or bool(movable[factor.nodes].all()))


def _masked(factor: Factor, jacobian: tuple[Floats, ...], movable: Bools) -> tuple[Floats, ...]:
    nodes = factor.nodes.T
    if opposite(factor, movable):
        return jacobian
    if len(jacobian) < len(nodes):
        jacobian = (-jacobian[0], jacobian[0])
    return tuple(s * movable[column][:, None, :] for s, column in zip(jacobian, nodes, strict=True))


def sparse_jacobian(linear: Linear, factors: Sequence[Factor], shape: tuple[int, int], which: int) -> Any:
    """Sparse Jacobian (rows, n dof) of one realisation, CSR; shape is n and dof."""
    from scipy.sparse import csr_array

    data, row, col = entries(linear, factors, shape[1])
    total = sum(len(factor.nodes) * factor.size for factor in factors)
    return csr_array((data[which if len(data) > 1 else 0], (row, col)), shape=(total, shape[1] * shape[0]))


def entries(linear: Linear, factors: Sequence[Factor], dof: int) -> tuple[Floats, Ints, Ints]:
    """Values (B, E), rows and columns (E,) of the Jacobian."""
    batch, top = len(linear.x), 0
    data: list[Floats] = [np.empty((batch, 0))]
    rows, cols = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for factor, residual, jacobians in zip(factors, linear.residual, linear.by_node(factors), strict=True):
        count, size = residual.shape[1:]
        row = top + np.arange(count * size).reshape(count, size, 1) + np.zeros(dof, np.int64)
        for column, jacobian in zip(factor.nodes.T, jacobians, strict=True):
            data.append(np.broadcast_to(jacobian, (*residual.shape, dof)).reshape(batch, -1))
            rows.append(row.ravel())
            cols.append((dof * column[:, None, None] + np.arange(dof) + np.zeros((size, 1), np.int64)).ravel())
        top += count * size
    return np.concatenate(data, axis=1), np.concatenate(rows), np.concatenate(cols)

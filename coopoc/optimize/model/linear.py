"""Linear: a problem around a point, as whitened residuals and their derivatives by the steps of the nodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...arrays import Bools, Floats, Ints
from .factor import Factor
from .measurements import Measurement
from .space import Space, cross


@dataclass(frozen=True, eq=False)
class Linear:
    """A problem around x: per factor, whitened residuals and their derivative by the steps of its nodes.

    A robust factor's residual and derivatives carry the root of its weight rho'.

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
            jacobian = tuple(s * movable[n][:, None] for s, n in zip(jacobian, factor.nodes.T, strict=True))
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


def sparse_jacobian(linear: Linear, factors: Sequence[Factor], shape: tuple[int, int], index: int) -> Any:
    """Sparse Jacobian (rows, n dof) of one realisation, CSR; shape is n and dof."""
    from scipy.sparse import csr_array

    (n, dof), top = shape, 0
    data, rows, columns = [np.empty(0)], [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for factor, residual, jacobians in zip(factors, linear.residual, linear.jacobian, strict=True):
        count, size = residual.shape[1:]
        row = top + np.arange(count * size).reshape(count, size, 1)
        for nodes, jacobian in zip(factor.nodes.T, jacobians, strict=True):
            own = jacobian[index if len(jacobian) > 1 else 0]
            column = dof * nodes[:, None, None] + np.arange(dof)
            for into, part in ((data, own), (rows, row), (columns, column)):
                into.append(np.broadcast_to(part, (count, size, dof)).ravel())
        top += count * size
    place = np.concatenate(rows), np.concatenate(columns)
    return csr_array((np.concatenate(data), place), shape=(top, n * dof))


def local(space: Space, known: Measurement, x: Floats, nodes: Ints) -> tuple[Floats, Floats | None]:
    """Vector (B, M, d) and rotation (B, M, d, d), or None, that the formula of a kind gets at x (B, n, ambient)."""
    p = space.position(x)
    here = p[:, nodes[:, -1]]
    vector = here if known.arity == 1 else here - p[:, nodes[:, 0]]
    if known.frame == "world":
        return vector, None
    turned = space.rotation(x)
    if known.arity == 1:
        return vector, turned[:, nodes[:, 0]]
    back = np.swapaxes(turned[:, nodes[:, 0]], -1, -2)
    vector = (back @ vector[..., None])[..., 0]
    return vector, back @ turned[:, nodes[:, 1]] if known.frame == "relative" else None


def chain(
    space: Space, known: Measurement, x: Floats, nodes: Ints, seen: tuple[Floats, Floats | None], jacobian: Floats
) -> tuple[Floats, ...]:
    """Derivatives (B, M, size, dof) by the steps of the nodes, from those by what is seen.

    Args:
        seen: of `local`.
        jacobian: (B, M, size, d), or (B, M, size, dof) if the frame is relative.
    """
    if known.frame == "world":
        last = _wide(space, jacobian)
        return (last,) if known.arity == 1 else (-last, last)
    if known.arity == 1:
        return (jacobian,)
    vector, rotation = seen
    d = space.dimension
    back = np.swapaxes(space.rotation(x)[:, nodes[:, 0]], -1, -2)
    moved = jacobian[..., :d] @ back
    turning = jacobian[..., :d] @ _swing(vector)
    if rotation is None:
        return np.concatenate([-moved, turning], axis=-1), _wide(space, moved)
    own = jacobian[..., d:]
    turning -= own @ (np.swapaxes(rotation, -1, -2) if d == 3 else np.ones((1, 1)))
    return np.concatenate([-moved, turning], axis=-1), np.concatenate([moved, own], axis=-1)


def _swing(vector: Floats) -> Floats:
    """d(Exp(-w) v)/dw = [v]x at w = 0: (..., 3, 3), or (..., 2, 1) in the plane."""
    if vector.shape[-1] == 3:
        return cross(vector)
    return np.stack([vector[..., 1], -vector[..., 0]], axis=-1)[..., None]


def _wide(space: Space, jacobian: Floats) -> Floats:
    if space.angles == 0:
        return jacobian
    return np.concatenate([jacobian, np.zeros((*jacobian.shape[:-1], space.angles))], axis=-1)

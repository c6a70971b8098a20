"""Whether a stationary point is a minimum: the curvature that Gauss-Newton leaves out."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..arrays import Floats
from .arrowhead import structure
from .factor import Factor
from .normal import Pattern, assemble, squares
from .problem import Problem, vector

STEP = 1e-4
"""Of the vector's length: the second derivative is a central difference of the exact first."""
SLACK = 1e-6
"""Share of the diagonal by which the curvature may be negative: a flat minimum is one, whatever the rounding."""


def is_minimum(problem: Problem, x: Floats) -> bool:
    """True unless the cost of a single problem curves downwards at x (n, 3) m, where its gradient vanishes.

    The Hessian is J^T J + sum_k r_k d2 r_k / dx2. J^T J alone is positive definite at a saddle too, such as an ego on
    the line between two others whose ranges are longer than the line.
    """
    if all(factor.measurement.linear for factor in problem.factors):
        return True
    linear = problem.linearise(x[None])
    parts = squares(linear)
    bent = [part if factor.measurement.linear else part + _bend(factor, vector(x[None], factor.nodes), residual)
            for factor, part, residual in zip(problem.factors, parts, linear.residual, strict=True)]  # fmt: skip
    scheme, _ = structure(problem)
    flat, true = (assemble(scheme, p)[0] for p in (parts, bent))
    own = scheme.pairs[:, 0] == scheme.pairs[:, 1]
    true[own] += SLACK * flat[own] * np.eye(3)
    return _positive(scheme, true)


def _bend(factor: Factor, v: Floats, residual: Floats) -> Floats:
    """(1, M, 3, 3) sum over components of whitened residual times second derivative by the vector v (1, M, 3)."""
    reach = np.maximum(STEP * np.linalg.norm(v, axis=-1, keepdims=True), 1e-9)
    shift = reach * np.eye(3)[:, None, None]
    with np.errstate(all="ignore"):
        rise = factor.measurement.differentiate(v + shift)[1] - factor.measurement.differentiate(v - shift)[1]
        second = factor.whiten(residual, rise / (2.0 * reach[..., None]))[1]
    assert second is not None
    bend: Floats = np.einsum("kbmcj,bmc->bmkj", second, residual)
    return 0.5 * (bend + np.swapaxes(bend, -1, -2))


def _positive(scheme: Pattern, blocks: Floats) -> bool:
    """Whether the symmetric matrix of the blocks (P, 3, 3) is positive definite: all pivots of L D L^T are."""
    from scipy.sparse.linalg import splu

    if not np.isfinite(blocks).all():
        return False
    try:
        factored = splu(_matrix(scheme, blocks), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0,
                        options={"SymmetricMode": True})  # fmt: skip
    except RuntimeError:  # a pivot of exactly zero
        return False
    symmetric = np.array_equal(factored.perm_r, factored.perm_c)
    return bool(symmetric and (factored.U.diagonal() > 0).all())


def _matrix(scheme: Pattern, blocks: Floats) -> Any:
    from scipy.sparse import csc_array

    off = scheme.pairs[:, 0] != scheme.pairs[:, 1]
    i, j = np.concatenate([scheme.pairs, scheme.pairs[off, ::-1]]).T[:, :, None, None]
    values = np.concatenate([blocks, blocks[off]])
    row, col = np.broadcast_arrays(3 * i + np.arange(3)[:, None], 3 * j + np.arange(3))
    return csc_array((values.ravel(), (row.ravel(), col.ravel())), shape=(3 * scheme.points, 3 * scheme.points))

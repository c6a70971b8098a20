"""Marginal covariances by GTSAM: its Bayes tree of the rows of a Jacobian."""

from typing import Any

import numpy as np
from numpy import zeros

from coopoc.arrays import Bools, Floats


def bayes_tree_marginals(J: Any, still: Bools | None, n: int, dof: int) -> Floats:
    """(n, dof, dof) diagonal blocks of (J^T J)^-1 from the Bayes tree of J's rows.

    Args:
        J: (rows, n dof) sparse, every row of at most a few nodes.
        still: (n, dof) what cannot move: its variance is 1.

    Raises:
        numpy.linalg.LinAlgError: the system is singular.
    """
    import gtsam

    graph, nothing = gtsam.GaussianFactorGraph(), gtsam.VectorValues()
    model, zero = gtsam.noiseModel.Unit.Create(1), zeros(1)
    for nodes, blocks in _groups(J, dof):
        if nodes.shape[1] == 1:
            for i, a in zip(nodes[:, 0].tolist(), blocks[:, 0], strict=True):
                graph.add(i, a, zero, model)
        else:
            for (i, j), (a, b) in zip(nodes.tolist(), blocks, strict=True):
                graph.add(i, a, j, b, zero, model)
    if still is not None:
        model = gtsam.noiseModel.Unit.Create(dof)
        for i in np.flatnonzero(still.any(1)).tolist():
            graph.add(i, np.diag(still[i].astype(float)), zeros(dof), model)
    for i in range(n):
        nothing.insert(i, zeros(dof))
    try:
        tree = gtsam.Marginals(graph, nothing)
        return np.stack([tree.marginalCovariance(i) for i in range(n)])
    except RuntimeError as singular:
        raise np.linalg.LinAlgError("gtsam: indeterminate linear system") from singular


def _groups(J: Any, dof: int) -> list[tuple[Any, Floats]]:
    """Rows of J as factors: (nodes (M, arity), blocks (M, arity, 1, dof)), one row each."""
    matrix = J.tocsr()
    matrix.sort_indices()
    node = matrix.indices // dof
    first = np.append(True, (node[1:] != node[:-1])) & (len(node) > 0)
    first[matrix.indptr[:-1][matrix.indptr[:-1] < len(node)]] = True
    row = np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))
    arity = np.bincount(row[first], minlength=matrix.shape[0])
    where = np.cumsum(first) - 1
    blocks = zeros((int(first.sum()), dof))
    blocks[where, matrix.indices % dof] = matrix.data
    nodes, owner = node[first], row[first]
    factors = []
    for count in (1, 2):
        picked = arity[owner] == count
        if picked.any():
            factors.append((nodes[picked].reshape(-1, count), blocks[picked].reshape(-1, count, 1, dof)))
    return factors

"""Small single problems as one dense matrix: a few calls of BLAS in place of sums over blocks and Schur complements,
whose many small NumPy calls take several times as long."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ...arrays import Floats, Ints
from ..model.linear import Linear
from ..model.problem import Problem
from .arrowhead import eliminate, structure
from .normal import normal_equations

NUMBERS = 60
"""Numbers of x up to which one matrix is faster."""


def is_small(problem: Problem) -> bool:
    """True of a single problem that is to be taken as one matrix."""
    return problem.batch is None and len(problem.names) * problem.space.dof <= NUMBERS


def normal_matrix(problem: Problem, linear: Linear) -> tuple[Floats, Floats]:
    """J^T J (n dof, n dof), with 1 added for what cannot move, and J^T r (n dof,) of a single problem."""
    factors = tuple((f.nodes.shape[1], f.nodes.tobytes(), f.size) for f in problem.factors)
    numbers, places = len(problem.names) * problem.space.dof, _places(len(problem.names), problem.space.dof, factors)
    residual = np.concatenate([r.ravel() for r in linear.residual])
    J = np.zeros((len(residual), numbers))
    entries = J.ravel()  # a view
    for jacobians, nodes in zip(linear.by_node(problem.factors), places, strict=True):
        for jacobian, at in zip(jacobians, nodes, strict=True):
            entries[at] = jacobian[0]
    matrix = J.T @ J
    if problem.movable is not None:
        matrix.flat[:: numbers + 1] += ~problem.movable.ravel()
    return matrix, residual @ J


def damped_step(problem: Problem, linear: Linear, damping: Floats) -> Floats:
    """dx (B, n, dof) of (J^T J + diag(damping)) dx = -J^T r: by one matrix, or by blocks for all realisations at once.

    Raises:
        numpy.linalg.LinAlgError: it is singular.
    """
    if not is_small(problem):
        scheme, frame = structure(problem)
        return eliminate(frame, *normal_equations(scheme, linear, [f.nodes for f in problem.factors]), damping)
    matrix, gradient = normal_matrix(problem, linear)
    matrix.flat[:: len(matrix) + 1] += damping.ravel()
    return np.asarray(np.linalg.solve(matrix, -gradient)).reshape(damping.shape)


def diagonal_blocks(matrix: Floats, n: int) -> tuple[Floats, Floats]:
    """(n, dof, dof) diagonal blocks of the inverse, and the inverse; LinAlgError if the matrix is singular."""
    inverse: Floats = np.linalg.inv(matrix)
    dof = len(matrix) // n
    own = inverse.reshape(n, dof, n, dof)
    return own[np.arange(n), :, np.arange(n)], inverse


@lru_cache(maxsize=256)
def _places(n: int, dof: int, factors: tuple[tuple[int, bytes, int], ...]) -> list[list[Ints]]:
    """Per factor and node where its derivative (M, size, dof) is in J, row by row; factors by arity, nodes and size."""
    top, found = 0, []
    for arity, raw, size in factors:
        nodes = np.frombuffer(raw, np.int64).reshape(-1, arity)
        row = top + np.arange(len(nodes) * size).reshape(-1, size, 1)
        found.append([n * dof * row + dof * column[:, None, None] + np.arange(dof) for column in nodes.T])
        top += row.size
    return found

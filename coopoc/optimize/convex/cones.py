"""The semidefinite programme of relaxation.py in Clarabel's own form, built once per shape.

Clarabel solves min 1/2 x'Px + q'x, A x + s = b, s in a cone. Its matrices keep their pattern, so that a new problem is
an update of b: for ten ranges 3.3 ms, against 4.4 ms through CVXPY with a parameter for C; for three
0.3 and 1.4 ms (one core).
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np

from ...arrays import Floats, Ints
from ...errors import MissingLibraryError

PRECISION = 1e-9
"""Relative gap and feasibility that Clarabel is asked for."""


@lru_cache(maxsize=64)
def semidefinite(
    stiefel: tuple[int, int], sphere: tuple[int, int]
) -> Callable[[Floats], tuple[Floats, Floats, Floats]]:
    """Solver of max 1/2 tr L over block-diagonal L with C - L >= 0, the dual of min 1/2 <C, Z>.

    It takes C (bound, bound) and returns L on Stiefel blocks (n, k, k) and on spheres (m,), and Z (bound, bound).

    Args:
        stiefel: shapes (n, k) and (m, q) of the blocks, which follow each other.
        sphere: as `stiefel`.
    """
    clarabel = _clarabel()
    from scipy.sparse import csc_matrix

    (n, k), (m, q) = stiefel, sphere
    size, pairs = n * k + m * q, k * (k + 1) // 2
    i, j = _triangle(size)
    low, high = _triangle(k)
    place = np.zeros((size, size), dtype=np.int64)
    place[i, j] = np.arange(len(i))
    blocks = place[np.arange(n)[:, None] * k + low, np.arange(n)[:, None] * k + high]
    diagonal = place.diagonal()[n * k :]
    column = np.concatenate([np.arange(n * pairs), n * pairs + np.repeat(np.arange(m), q)])
    stretch = np.where(i == j, 1.0, np.sqrt(2.0))
    row = np.concatenate([blocks.ravel(), diagonal])
    A = csc_matrix((stretch[row], (row, column)), shape=(len(i), n * pairs + m))
    goal = np.concatenate([np.tile((low == high).astype(float), n), np.ones(m)])
    solver = clarabel.DefaultSolver(
        csc_matrix((len(goal),) * 2), -goal, A, np.zeros(len(i)), [clarabel.PSDTriangleConeT(size)], _settings()
    )

    def run(C: Floats) -> tuple[Floats, Floats, Floats]:
        scale = max(float(np.trace(C)) / size, 1e-300)
        solver.update(b=stretch * C[i, j] / scale)
        answer = solver.solve()
        value, half = scale * np.array(answer.x), np.zeros((size, size))
        half[i, j] = np.array(answer.z) / stretch
        block = np.zeros((n, k, k))
        block[:, low, high] = block[:, high, low] = value[: n * pairs].reshape(n, pairs)
        return block, value[n * pairs :], half + np.triu(half, 1).T

    return run


def _triangle(size: int) -> tuple[Ints, Ints]:
    """Rows and columns of an upper triangle, column by column."""
    col, row = np.tril_indices(size)
    return row, col


def _settings() -> Any:
    settings = _clarabel().DefaultSettings()
    settings.verbose, settings.max_threads = False, 1
    settings.presolve_enable = settings.chordal_decomposition_enable = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = PRECISION
    return settings


def _clarabel() -> Any:
    try:
        return importlib.import_module("clarabel")
    except ImportError as absent:
        raise MissingLibraryError("clarabel", "a convex relaxation", "clarabel") from absent

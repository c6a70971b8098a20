"""Selected inversion: the entries of a sparse symmetric inverse where its factor has entries, in one backward sweep."""

from __future__ import annotations

import numpy as np

from ...arrays import Floats
from ..compiling.compile import compiled
from .graph_cholesky import locate, shape
from .graph_fronts import Fronts

PANEL = 32
"""Rows that are inverted at a time."""


@compiled
def triangular_inverse(block: Floats) -> Floats:
    """U^-1 (c, c) of the upper triangle U that a block (c, m) begins with, PANEL rows at a time from below."""
    c = len(block)
    root = np.zeros((c, c))
    for first in range((c - 1) // PANEL * PANEL, -1, -PANEL):
        last = min(first + PANEL, c)
        for i in range(last - 1, first - 1, -1):
            root[i, i] = 1.0 / block[i, i]
            for j in range(i + 1, last):
                total = 0.0
                for k in range(i + 1, j + 1):
                    total += block[i, k] * root[k, j]
                root[i, j] = -total * root[i, i]
        if last < c:
            below = np.dot(np.ascontiguousarray(block[first:last, last:c]), np.ascontiguousarray(root[last:, last:]))
            root[first:last, last:] = -np.dot(np.ascontiguousarray(root[first:last, first:last]), below)
    return root


@compiled
def selected_inverse(fronts: Fronts, factor: Floats) -> Floats:
    """Z = A^-1 of A = L L^T where L has numbers, in the same places.

    From the last supernode to the first, with S the rows below its columns J, V = L_JJ^-T and W = V L_SJ^T:
    Z_JS = -W Z_SS, Z_JJ = V V^T - Z_JS W^T. All of Z_SS is there, since what couples two rows of a column fills in.

    Args:
        fronts: of A's pattern.
        factor: of `factorise`.

    References:
        Takahashi, Fagan, Chen, Formation of a sparse bus impedance matrix, 1973; Erisman and Tinney, CACM 1975.
    """
    inverse, where = np.empty(len(factor)), np.empty(len(fronts.order), np.int64)
    for s in range(len(fronts.first) - 2, -1, -1):
        _, c, m = shape(fronts, s)
        own, rows = fronts.start[s], fronts.rows[fronts.row[s] : fronts.row[s + 1]]
        block = factor[own : own + c * m].reshape(c, m)
        goal = inverse[own : own + c * m].reshape(c, m)
        root = triangular_inverse(block)
        goal[:, :c] = np.dot(root, root.T)
        if m == c:
            continue
        among, first = np.empty((m - c, m - c)), 0
        while first < m - c:
            t = fronts.owner[rows[first]]
            b, wide, high = shape(fronts, t)
            locate(fronts, t, where)
            last = first
            while last < m - c and rows[last] < b + wide:
                line = fronts.start[t] + (rows[last] - b) * high
                for i in range(last, m - c):
                    among[last, i] = inverse[line + where[rows[i]]]
                last += 1
            first = last
        for i in range(m - c):
            for j in range(i):
                among[i, j] = among[j, i]
        weight = np.dot(root, np.ascontiguousarray(block[:, c:]))
        beside = np.dot(weight, among)
        goal[:, c:] = -beside
        goal[:, :c] += np.dot(beside, weight.T)
    return inverse

"""Selected inversion: the entries of a sparse symmetric inverse where its factor has entries, in one backward sweep."""

from __future__ import annotations

import numpy as np

from ..arrays import Floats, Ints
from .compile import compiled


@compiled
def selected_inverse(indptr: Ints, indices: Ints, lower: Floats, diagonal: Floats) -> tuple[Floats, Floats]:
    """Z = A^-1 of A = (I + L) D (I + L)^T at the entries of L, and on the diagonal.

    From the last column to the first, with S the rows of column j of L: Z_Sj = -Z_SS L_Sj, Z_jj = 1/d_j - L_Sj^T Z_Sj;
    all of Z_SS has been found, since what couples two rows of a column fills in.

    Args:
        indptr: (m + 1,) of L, CSC with sorted rows; unit diagonal left out.
        indices: (nnz,) rows.
        lower: (nnz,) values.
        diagonal: (m,) D.

    Returns:
        Z at the entries of L (nnz,) and its diagonal (m,).

    References:
        Takahashi, Fagan, Chen, Formation of a sparse bus impedance matrix, 1973; Erisman and Tinney, CACM 1975.
    """
    m = len(diagonal)
    inverse, own = np.empty(len(lower)), np.empty(m)
    weight, found = np.zeros(m), np.zeros(m)
    for j in range(m - 1, -1, -1):
        first, last = indptr[j], indptr[j + 1]
        for e in range(first, last):
            weight[indices[e]] = lower[e]
            found[indices[e]] = 0.0  # other rows hold what earlier columns left there
        for e in range(first, last):
            k = indices[e]
            l_kj, total = lower[e], own[k] * lower[e]
            for f in range(indptr[k], indptr[k + 1]):
                i = indices[f]
                total += inverse[f] * weight[i]
                found[i] += inverse[f] * l_kj
            found[k] += total
        variance = 1.0 / diagonal[j]
        for e in range(first, last):
            inverse[e] = -found[indices[e]]
            variance -= lower[e] * inverse[e]
        own[j] = variance
        for e in range(first, last):
            weight[indices[e]] = 0.0
    return inverse, own

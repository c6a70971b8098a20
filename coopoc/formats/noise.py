"""Symmetric matrices as files write them: the upper triangle by rows, of the covariance or of its inverse."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..arrays import Floats
from ..errors import InputError

Place = Callable[[int], str]
LEAST = 1e-100
"""Least entry of a diagonal, and one over the largest: products of what is beyond them leave the range of numbers."""


def symmetric(upper: Floats, size: int) -> Floats:
    """(M, size, size) matrices of (M, size (size + 1) / 2) upper triangles by rows.

    >>> symmetric(np.array([[1.0, 2, 3]]), 2).tolist()
    [[[1.0, 2.0], [2.0, 3.0]]]
    """
    i, j = np.triu_indices(size)
    out = np.empty((len(upper), size, size))
    out[:, i, j] = out[:, j, i] = upper
    return out


def upper_triangle(matrices: Floats) -> Floats:
    """(M, size (size + 1) / 2), the inverse of `symmetric`."""
    i, j = np.triu_indices(matrices.shape[-1])
    triangle: Floats = matrices[:, i, j]
    return triangle


def inverse(matrices: Floats, place: Place, what: str) -> Floats:
    """Inverses of M symmetric positive definite matrices, information <-> covariance.

    Rows and columns are first scaled by powers of two, which is exact, so that metres beside radians cost no digits.

    Args:
        matrices: (M, size, size).
        place: row -> where it stands, for the message.
        what: "information" or "covariance", for the message.

    Raises:
        InputError: a matrix that is singular or not positive, at its place.

    >>> inverse(np.array([[[4.0, 0], [0, 1e8]]]), "line {}".format, "information").tolist()
    [[[0.25, 0.0], [0.0, 1e-08]]]
    """
    diagonal = np.diagonal(matrices, axis1=-2, axis2=-1)
    positive = (diagonal > LEAST) & (diagonal < 1 / LEAST)
    scale = np.exp2(np.rint(-0.5 * np.log2(np.where(positive, diagonal, 1))))
    both = scale[:, :, None] * scale[:, None, :]
    scaled = matrices * both
    bad = np.flatnonzero(~positive.all(axis=-1) | (np.linalg.eigvalsh(scaled)[:, :1] < 1e-13).any(axis=-1))
    if len(bad):
        row = int(bad[0])
        raise InputError(
            place(row),
            f"{what} {upper_triangle(matrices[row : row + 1])[0].tolist()}",
            "must be positive definite: a singular one has no inverse",
            f"Give every component some {what}, or leave the measurement out.",
        )
    found = np.linalg.inv(scaled) * both
    return np.asarray(0.5 * (found + found.swapaxes(-1, -2)))

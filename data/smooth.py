"""Smoothing of simulated paths, so that velocity is the derivative of position."""

from __future__ import annotations

import numpy as np

from coopoc.arrays import Floats


def smooth(position: Floats, dt: float, cutoff: float) -> Floats:
    """Penalised least squares on jerk: argmin_s |s - x|^2 + lam |D^3 s|^2, with lam = (2 pi cutoff dt)^-6.

    The gain is 1 below the cutoff, 1/2 at it, and falls with the sixth power of the frequency above it; straight
    lines and constant accelerations pass unchanged, and so do both ends of the drive.

    Args:
        position: (T, ...) m, no NaN.
        dt: s.
        cutoff: Hz.

    Source: Whittaker, Proc. Edinburgh Math. Soc. 41, 1923; Eilers, Analytical Chemistry 75(14), 2003.

    >>> bool(np.allclose(smooth(np.arange(9.0) ** 2, 0.1, 0.5), np.arange(9.0) ** 2))
    True
    """
    from scipy.linalg import cho_solve_banded, cholesky_banded

    steps = len(position)
    if steps < 4:
        return np.array(position, dtype=float)
    third = np.diff(np.eye(4), n=3, axis=0)[0]
    bands = np.zeros((4, steps))
    for i in range(4):
        for j in range(i, 4):
            bands[3 - (j - i), j : steps - 3 + j] += third[i] * third[j]
    bands *= (2 * np.pi * cutoff * dt) ** -6
    bands[3] += 1
    flat = np.asarray(position, dtype=float).reshape(steps, -1)
    return np.asarray(cho_solve_banded((cholesky_banded(bands), False), flat)).reshape(np.shape(position))

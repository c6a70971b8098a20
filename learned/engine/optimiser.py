"""Compiled optimiser step of many models: penalties, clipping and AdamW in two passes over the weights of each."""

from __future__ import annotations

from typing import Any

import numpy as np

from coopoc.arrays import Floats
from coopoc.kernels.compiling.compile import compiled, summing
from coopoc.learned.engine.arguments import Found, Moments, Update

from .arithmetic import Index, borrowed, part


@compiled
def advance(moments: Moments, found: Found, update: Update) -> None:
    """`schedule.advance`: change weights and moments (S, P) of the rows (R,) in place by their gradients (R, P).

    Where loss or gradient is not finite, `found.finite` becomes false and nothing is changed.
    """
    for r in range(len(update.rows)):
        advance_row(moments, found, update, r)


@part
def advance_row(moments: Moments, found: Found, update: Update, r: Index) -> None:
    """`advance` of row r.

    References:
        Loshchilov and Hutter, ICLR 2019, algorithm 2.
    """
    at, gradient = update.rows[r], borrowed(found.gradient[r])
    theta, began = borrowed(moments.theta[at]), borrowed(moments.began[at])
    first, second = borrowed(moments.first[at]), borrowed(moments.second[at])
    real = theta.dtype.type
    l2, proximal = real(2.0 * update.l2), real(update.proximal)
    square = _square(theta, gradient, began, l2, proximal)
    found.finite[r] = np.isfinite(found.losses[r]) and not np.isnan(square)
    if not found.finite[r]:
        return
    scale = min(real(update.limit) / (np.sqrt(square) + real(1e-6)), real(1.0))
    keep = real(1.0 - update.rates[r] * update.decay)
    rate, size = real(-update.rates[r] / (1.0 - 0.9**update.step)), real(1.0 / (1.0 - 0.999**update.step))
    for i in range(len(theta)):
        g = scale * _penalised(theta, gradient, began, l2, proximal, i)
        first[i] += real(0.1) * (g - first[i])
        second[i] += real(0.001) * (g * g - second[i])
        theta[i] = keep * theta[i] + rate * first[i] / (np.sqrt(size * second[i]) + real(1e-8))


@part
def _penalised(theta: Floats, gradient: Floats, began: Floats, l2: Any, proximal: Any, i: Index) -> Any:
    """Gradient of loss and penalties with respect to weight i."""
    return gradient[i] + l2 * theta[i] + proximal * (theta[i] - began[i])


@summing
def _square(theta: Floats, gradient: Floats, began: Floats, l2: Any, proximal: Any) -> Any:
    """Squared norm of the gradient with penalties, NaN if the gradient is not finite."""
    real = theta.dtype.type
    square = poisoned = real(0.0)
    for i in range(len(theta)):
        g = _penalised(theta, gradient, began, l2, proximal, i)
        square += g * g
        poisoned += gradient[i] * real(0.0)  # NaN of NaN and of infinity
    return square + poisoned

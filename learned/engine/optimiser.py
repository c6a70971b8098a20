"""Compiled optimiser step of many models: penalties, clipping and AdamW in two passes over the weights of each."""

from __future__ import annotations

from typing import Any

import numpy as np

from coopoc.arrays import Bools, Floats, Ints
from coopoc.kernels.compile import compiled, part, summing

from .arithmetic import Index, lent


@compiled
def advance(
    theta: Floats, gradient: Floats, began: Floats, first: Floats, second: Floats, losses: Floats, rows: Ints,
    step: Index, rates: Floats, decay: float, l2: float, proximal: float, limit: float, finite: Bools,
) -> None:  # fmt: skip
    """`schedule.advance`: change theta and moments (S, P) of `rows` (R,) in place by their gradients (R, P).

    Where loss or gradient is not finite, `finite` (R,) becomes false and nothing is changed.
    """
    for r in range(len(rows)):
        at = rows[r]
        finite[r] = advanced(lent(theta[at]), lent(gradient[r]), lent(began[at]), lent(first[at]), lent(second[at]),
                             losses[r], step, rates[r], decay, l2, proximal, limit)  # fmt: skip


@part
def advanced(
    theta: Floats, gradient: Floats, began: Floats, first: Floats, second: Floats, loss: float, step: Index,
    rate: float, decay: float, l2: float, proximal: float, limit: float,
) -> bool:  # fmt: skip
    """`advance` of one row (P,)."""
    real = theta.dtype.type
    penalty = real(2.0 * l2), real(proximal)
    square = _square(theta, gradient, began, penalty)
    if not np.isfinite(loss) or np.isnan(square):
        return False
    scale = min(real(limit) / (np.sqrt(square) + real(1e-6)), real(1.0))
    size, pace = 1.0 / (1.0 - 0.999**step), -rate / (1.0 - 0.9**step)
    _adamw(theta, gradient, began, penalty, first, second, scale, real(1.0 - rate * decay), real(pace), real(size))
    return True


@part
def _pull(theta: Floats, gradient: Floats, began: Floats, penalty: Any, i: Index) -> Any:
    """Gradient of loss and penalties with respect to weight i."""
    return gradient[i] + penalty[0] * theta[i] + penalty[1] * (theta[i] - began[i])


@summing
def _square(theta: Floats, gradient: Floats, began: Floats, penalty: Any) -> Any:
    """Squared norm of the gradient with penalties, NaN if the gradient was not finite."""
    real = theta.dtype.type
    square = spoilt = real(0.0)
    for i in range(len(theta)):
        pull = _pull(theta, gradient, began, penalty, i)
        square += pull * pull
        spoilt += gradient[i] * real(0.0)  # NaN of NaN and of infinity
    return square + spoilt


@part
def _adamw(
    theta: Floats, gradient: Floats, began: Floats, penalty: Any, first: Floats, second: Floats, scale: Any, keep: Any,
    pace: Any, size: Any,
) -> None:  # fmt: skip
    """theta <- keep theta + pace m / (sqrt(size v) + 1e-8), where m and v move towards scale g and its square."""
    real = theta.dtype.type
    for i in range(len(theta)):
        g = scale * _pull(theta, gradient, began, penalty, i)
        first[i] += real(0.1) * (g - first[i])
        second[i] += real(0.001) * (g * g - second[i])
        theta[i] = keep * theta[i] + pace * first[i] / (np.sqrt(size * second[i]) + real(1e-8))

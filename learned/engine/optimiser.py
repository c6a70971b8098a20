"""Compiled optimiser step of many models: clipping and AdamW in two passes over the weights of each."""

from typing import Any, NamedTuple

import numpy as np

from coopoc.arrays import Bools, Floats, Ints
from coopoc.kernels.compiling.compile import compiled, part, summing


class Moments(NamedTuple):
    """Weights, mean gradient and mean squared gradient, each (S, P)."""

    theta: Floats
    first: Floats
    second: Floats


class Update(NamedTuple):
    """An optimiser step of the models `rows` (R,): its number, learning rates (R,), decoupled decay, clip.

    Step 0 computes losses and gradients only.
    """

    rows: Ints
    step: int
    rates: Floats
    decay: float
    limit: float


class Outcome(NamedTuple):
    """Outputs of a step: gradients (R, P), losses (R,), whether both are finite (R,)."""

    gradient: Floats
    losses: Floats
    finite: Bools


@compiled
def advance(moments: Moments, outcome: Outcome, update: Update) -> None:
    """Change weights and moments (S, P) of the rows (R,) in place by their gradients (R, P): clipped, then AdamW.

    Where loss or gradient is not finite, `outcome.finite` becomes false and nothing is changed.
    """
    for r in range(len(update.rows)):
        advance_row(moments, outcome, update, r)


@part
def advance_row(moments: Moments, outcome: Outcome, update: Update, r: int) -> None:
    """`advance` of row r.

    References:
        Loshchilov and Hutter, ICLR 2019, algorithm 2.
    """
    at, gradient = update.rows[r], outcome.gradient[r]
    theta, first, second = moments.theta[at], moments.first[at], moments.second[at]
    real = theta.dtype.type
    square = squared_norm(gradient)
    outcome.finite[r] = np.isfinite(outcome.losses[r]) and not np.isnan(square)
    if not outcome.finite[r]:
        return
    scale = min(real(update.limit) / (np.sqrt(square) + real(1e-6)), real(1.0))
    keep = real(1.0 - update.rates[r] * update.decay)
    rate, size = real(-update.rates[r] / (1.0 - 0.9**update.step)), real(1.0 / (1.0 - 0.999**update.step))
    for i in range(len(theta)):
        g = scale * gradient[i]
        first[i] += real(0.1) * (g - first[i])
        second[i] += real(0.001) * (g * g - second[i])
        theta[i] = keep * theta[i] + rate * first[i] / (np.sqrt(size * second[i]) + real(1e-8))


@summing
def squared_norm(gradient: Floats) -> Any:
    """Squared norm of a gradient, NaN if it is not finite."""
    real = gradient.dtype.type
    square = poisoned = real(0.0)
    for i in range(len(gradient)):
        square += gradient[i] * gradient[i]
        poisoned += gradient[i] * real(0.0)  # NaN of NaN and of infinity
    return square + poisoned

"""Surrogates of robust losses: convex at first, the loss itself at last, as weights of least squares."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ...arrays import Bools, Floats, number
from ...errors import InputError
from ...plugins import one_of

RATE = 1.4
"""By which mu changes from round to round."""
SETTLED = 1e-6
"""Largest change of a weight that is none."""
EASY = 1e-6
"""Below this mu is not inverted: all candidates are far within their thresholds."""


@dataclass(frozen=True)
class Surrogate:
    """A robust loss made convex by mu, as weights of the ratio s = r^2 / c^2.

    Args:
        first: mu from the largest ratio.
        weight: w(s, mu) = d rho_mu / d r^2.
        later: the next mu.
        done: whether the weights (B, G) have settled, from the new ones, those before and mu (B,).
        last: mu at which rho_mu is rho, or near enough.
    """

    first: Callable[[Floats], Floats]
    weight: Callable[[Floats, Floats], Floats]
    later: Callable[[Floats], Floats]
    done: Callable[[Floats, Floats, Floats], Bools]
    last: float


SURROGATES = {
    "truncated": Surrogate(
        lambda worst: 1.0 / np.maximum(2.0 * worst - 1.0, EASY),
        lambda s, mu: np.clip(np.sqrt(mu * (mu + 1.0) / np.maximum(s, 1e-30)) - mu, 0.0, 1.0),
        lambda mu: mu * RATE,
        lambda new, old, mu: np.asarray(((new == old) & ((new == 0.0) | (new == 1.0))).all(axis=1)),
        1e6,
    ),
    "geman-mcclure": Surrogate(
        lambda worst: np.maximum(2.0 * worst, 1.0),
        lambda s, mu: np.square(mu / (s + mu)),
        lambda mu: np.maximum(mu / RATE, 1.0),
        lambda new, old, mu: np.asarray((mu == 1.0) & (np.abs(new - old) <= SETTLED).all(axis=1)),
        1.0,
    ),
}
"""Of Yang et al.: min(r^2, c^2) as mu grows from c^2 / (2 r_max^2 - c^2), r^2 / (1 + r^2/c^2) as it falls to 1."""


def surrogate_of(loss: str, threshold: float) -> Surrogate:
    """The surrogate of a loss; InputError if there is none, or if the threshold is no probability in (0, 1)."""
    one_of("loss", loss, SURROGATES)
    if not 0 < number("threshold", threshold, allowed="a probability in (0, 1)") < 1:
        hint = "Use 0.99, or scipy.stats.chi2.cdf(c ** 2, size)."
        raise InputError("threshold", threshold, "must be a probability in (0, 1)", hint)
    return SURROGATES[loss]

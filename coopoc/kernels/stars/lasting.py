"""Errors of the ego's fixes that last: no state, but part of what its answer is uncertain by.

An error is what the filter sees of it, a fix less the estimate after the step. Those of white noise are uncorrelated;
the covariance c of one with those of the second before is the variance of what lasts, the estimate's own error among
it. Where c is more than its standard error s, the answer's covariance, axes together, is c - s^2 / c at least; what is
added is shared as the variance of a fix is. What the estimate follows, and what all receivers share, nothing shows.

References:
    Mehra, On the identification of variances and adaptive Kalman filtering, IEEE TAC 15(2), 1970 (correlated
    innovations); James, Stein, Estimation with quadratic loss, 1961 (c - s^2 / c).
"""

import math

from ...arrays import Floats
from ..compiling.compile import part
from .cooperative_state import CLOCK, COVARIANCE, DT, ERRORS, FIX, FIX_VARIANCE, OUT, UNSAID, WHOLE, Filter, Model
from .gaussian import COMMON, ERROR, has
from .messages import vector_at

RECENT, _, _, WEIGHT, WAITED, PAIRS, PRODUCTS, PRODUCTS2 = range(ERRORS, ERRORS + 8)
"""Of the ego's fixes: sums of their errors m on each axis and of 1, fading; s since the last one; and number, sum and
sum of squares of products m^2 of an error and the mean of those before it."""
SECOND, MEMORY = 1.0, 100.0
"""s, in which an error fades, and in which products do."""


@part
def remember_error(f: Filter, own: Floats) -> None:
    """Count the error of a fix that was believed, as the filter sees it, times those before it."""
    ego, g, product = f.ego, f.g, 0.0
    ego[WAITED] += own[DT]
    for i in range(PAIRS, PRODUCTS2 + 1):
        ego[i] *= math.exp(-own[DT] / MEMORY)
    if not f.member[0, OUT + 3] >= 1.0:
        return
    keep = math.exp(-min(ego[WAITED] / SECOND, 1.0))
    for c in range(3):
        error = own[FIX + c] - g.x[c]
        for kind in (ERROR, COMMON):
            error -= g.x[3 * g.block[0, kind] + c] if has(g, 0, kind) else 0.0
        product += error * ego[RECENT + c]
        ego[RECENT + c] = keep * ego[RECENT + c] + error
    if ego[WEIGHT] > 0.0:
        ego[PAIRS] += 1.0
        product /= ego[WEIGHT]
        ego[PRODUCTS] += product
        ego[PRODUCTS2] += product**2
    ego[WEIGHT], ego[WAITED] = keep * ego[WEIGHT] + 1.0, 0.0


@part
def add_lasting(f: Filter, model: Model, own: Floats) -> None:
    """Add to the answer's covariance what it is more uncertain by, as levels were otherwise, and the variance of errors
    of fixes that last; pairs within two seconds count as one."""
    for i in range(9):
        f.ego[COVARIANCE + i] *= 1.0 + f.ego[UNSAID] / max(f.ego[WHOLE], 1e-300)
    n, seconds = max(f.ego[PAIRS], 1.0), min(max(f.ego[CLOCK], SECOND), MEMORY)
    c, error = f.ego[PRODUCTS] / n, f.ego[PRODUCTS2] / n * max(2.0 * SECOND / seconds, 1.0 / n)
    if model.forget == 0.0 or c <= 0.0 or c * c <= error:
        return
    stated = f.ego[COVARIANCE] + f.ego[COVARIANCE + 4] + f.ego[COVARIANCE + 8]
    more = max(c - error / c - stated, 0.0) / sum(vector_at(own, FIX_VARIANCE // 3))
    for i in range(3):
        f.ego[COVARIANCE + 4 * i] += more * own[FIX_VARIANCE + i]

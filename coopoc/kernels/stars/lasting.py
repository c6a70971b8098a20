"""Errors of fixes that last and that no sensor states: no state, but part of what the ego's answer is uncertain by.

The filter observes an error as a fix less the estimate after the step. Errors of white noise are uncorrelated, so the
covariance c of an error with those of the second before is the variance of lasting errors, the estimate's own among
them. Where c exceeds its standard error s, the answer's covariance, summed over the axes, is at least c - s^2 / c; the
increase is divided among the axes as the variance of a fix is. Errors that the estimate follows, or that all receivers
share, cannot be observed.

In a star the errors of the others show how far a sound receiver errs: at least half of them have another one within
that distance. A minority of spoofed receivers, alike or not, and a wrong position of the ego, which all
these errors have in common, hardly change it.

Where at most one receiver of the star is trusted, the ego's included, it is unknown which one errs: if it is that one,
the answer errs by what the others seem to err by, e. So its covariance increases by half the sum of e e^T.

References:
    Mehra, On the identification of variances and adaptive Kalman filtering, IEEE TAC 15(2), 1970 (correlated
    innovations); James, Stein, Estimation with quadratic loss, 1961 (c - s^2 / c).
"""

import math

from ...arrays import Floats
from ..compiling.compile import part
from ..compiling.small import block_at, inner_product, store, subtract, trace, vector_at
from ..geometry import submatrix
from .cooperative_state import (
    CLOCK,
    COUNT,
    COVARIANCE,
    DT,
    ERRORS,
    FIX,
    FIX_VARIANCE,
    MEAN,
    NOISE,
    OUT,
    TRUSTED,
    UNSAID,
    VEHICLE,
    WHOLE,
    Filter,
    Model,
    has_fixes,
    heard,
)
from .gaussian import ABSENT, COMMON, ERROR, has

RECENT, _, _, WEIGHT, WAITED, PAIRS, PRODUCTS, PRODUCTS2 = range(ERRORS, ERRORS + 8)
"""Of the ego's fixes: sums of their errors m on each axis and of 1, fading; s since the last one; and number, sum and
sum of squares of products m^2 of an error and the mean of those before it."""
ERROR_MEMORY_S, PRODUCT_MEMORY_S = 1.0, 100.0
"""s, in which an error fades, and in which products do."""
MIN_VEHICLES = 3
"""Vehicles whose errors show what is usual, and fixes in the mean of one that is trusted."""
OF_ERROR, NEAREST = 3, 4
"""Behind an error in its row of `few`: its variance m^2, axes together, and, in order and not its own, the variance m^2
that the nearest of the others shows."""


@part
def usual_error(f: Filter, but: int) -> float:
    """Variance m^2 of an error of fixes that is usual in the star, without member `but`; 0 where too few show it."""
    g, few, n = f.g, f.few, 0
    for k in range(len(f.who)):
        j = f.who[k, VEHICLE]
        if k == but or not has_fixes(f, k):
            continue
        status, b = f.status[j], g.block[k, ERROR]
        if status[TRUSTED] == 0.0:
            store(few[n], 0, vector_at(g.x, b))
            few[n, OF_ERROR] = trace(submatrix(g.p, 3 * b, 3 * b))
        elif status[COUNT] >= MIN_VEHICLES:
            store(few[n], 0, vector_at(status, MEAN // 3))
            few[n, OF_ERROR] = status[NOISE] / status[COUNT]
        else:
            continue
        n += 1
    for i in range(n):
        least, at = math.inf, i
        for j in range(n):
            gap = subtract(vector_at(few[i], 0), vector_at(few[j], 0))
            square = inner_product(gap, gap) - few[i, OF_ERROR] - few[j, OF_ERROR]
            least = min(least, max(square, 0.0) / 3.0) if j != i else least
        while at > 0 and few[at - 1, NEAREST] > least:
            few[at, NEAREST] = few[at - 1, NEAREST]
            at -= 1
        few[at, NEAREST] = least
    return float(few[(n - 1) // 2, NEAREST]) if n >= MIN_VEHICLES else 0.0


@part
def remember_error(f: Filter, own: Floats) -> None:
    """Count the error of a fix that was believed, as the filter sees it, times those before it."""
    ego, g, product = f.ego, f.g, 0.0
    ego[WAITED] += own[DT]
    for i in range(PAIRS, PRODUCTS2 + 1):
        ego[i] *= math.exp(-own[DT] / PRODUCT_MEMORY_S)
    if not f.member[0, OUT + 3] >= 1.0:
        return
    keep = math.exp(-min(ego[WAITED] / ERROR_MEMORY_S, 1.0))
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
    of fixes that last: those of the ego, where pairs within two seconds count as one, or the mean of the star's; and
    those of all that are not trusted, where at most one is."""
    ego, neighbours = f.ego, heard(f, True)
    for i in range(9):
        ego[COVARIANCE + i] *= 1.0 + ego[UNSAID] / max(ego[WHOLE], 1e-300)
    n, seconds = max(ego[PAIRS], 1.0), min(max(ego[CLOCK], ERROR_MEMORY_S), PRODUCT_MEMORY_S)
    c, error = ego[PRODUCTS] / n, ego[PRODUCTS2] / n * max(2.0 * ERROR_MEMORY_S / seconds, 1.0 / n)
    if model.forget == 0.0:
        return
    stated = trace(block_at(ego, COVARIANCE // 9))
    shown = c - error / c - stated if c > 0.0 and c * c > error else 0.0
    more = max(shown, 3.0 * usual_error(f, ABSENT) / (1.0 + neighbours)) / sum(vector_at(own, FIX_VARIANCE // 3))
    for i in range(3):
        ego[COVARIANCE + 4 * i] += more * own[FIX_VARIANCE + i]
    trusted = neighbours + f.status[f.who[0, VEHICLE], TRUSTED]
    for k in range(len(f.who) if trusted < 2.0 else 0):
        j = f.who[k, VEHICLE]
        if j >= 0 and f.status[j, TRUSTED] == 0.0:
            e = 3 * f.g.block[k, ERROR]
            for i in range(9):
                ego[COVARIANCE + i] += 0.5 * f.g.x[e + i // 3] * f.g.x[e + i % 3]

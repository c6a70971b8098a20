"""One ego's filter with a pseudo-fix from each neighbour, LANES runs side by side: `coopoc.methods.msmv`."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...arrays import Floats
from ..compiling.compile import as_written, inside
from ..compiling.small import (
    add,
    add_diagonal,
    apply,
    from_upper,
    inverse,
    load,
    scale,
    square,
    store,
    subtract,
    times,
    zeros,
)
from ..compiling.vectors import LANES
from .messages import (
    MOVED,
    NEW,
    NONE,
    POSITION,
    PROCESS,
    RELATIVE,
    ROW,
    VARIANCE,
    Assumptions,
    Measurements,
    Star,
    gather,
    largest,
    position_or_nan,
    star_within,
)
from .relative import completed, converted_cov, vector


@as_written
def follow(seen: Measurements, known: Assumptions) -> tuple[Floats, Floats, Floats]:
    """x (R, T, 3) m, covariance (R, T, 3, 3) m^2, and the neighbours' own estimates (R, M, 3) m, NaN for none.

    Args:
        seen: `broadcast` holds every vehicle's own estimate.
        known: `broadcast` its variance m^2.
    """
    runs, steps = seen.gnss.shape[:2]
    x, cov, theirs = (
        np.empty((runs, steps, 3)),
        np.empty((runs, steps, 3, 3)),
        np.empty((runs, seen.relative.shape[1], 3)),
    )
    most, state = largest(seen.start), np.zeros((12, LANES))
    for first in range(0, runs, LANES):
        star, old, last = star_within(most), NONE, min(first + LANES, runs) - 1
        for t in range(steps):
            n = gather(star, seen, known, (first, last), t, old)
            fuse(star, known, state, n, old)
            for lane in range(last - first + 1):
                for i in range(3):
                    x[first + lane, t, i] = state[i, lane]
                    for j in range(3):
                        cov[first + lane, t, i, j] = state[3 + 3 * i + j, lane]
                    for k in range(1, n):
                        theirs[first + lane, seen.start[t] + k - 1, i] = position_or_nan(star, k, i, lane)
            old = n
    return x, cov, theirs


@inside
def fuse(star: Star, known: Assumptions, state: Floats, n: int, old: int) -> None:
    """P^-1 + C_p^-1 + sum_j C_j^-1, and the weighted mean that belongs to it; `state` is x and P."""
    fix = load(star.motion, POSITION, ROW)
    if old == 0:
        at, p = fix, zeros(fix[0], square(ROW))
        flat = 0.0 * fix[0] + known.flat
        p = add_diagonal(p, (flat, flat, flat))
    else:
        at, p = add(load(state, 0, ROW), load(star.motion, MOVED, ROW)), load3(state)
        p = add_diagonal(p, load(star.motion, PROCESS, ROW))
    weight, variance = load(star.status, NEW, (0.0,))[0], load(star.motion, VARIANCE, ROW)
    own = weight / variance[0], weight / variance[1], weight / variance[2]
    information, eta = add_diagonal(inverse(p), own), times(subtract(fix, at), own)
    for k in range(1, n):
        one, variance = pseudo_fix(star, known, k, at)
        new = load(star.status, 5 * k + NEW, (0.0,))[0]
        weight_k = scale(inverse(variance), new)
        information, eta = add(information, weight_k), add(eta, apply(weight_k, subtract(one, at)))
    p = inverse(information)
    store(state, 0, add(at, apply(p, eta)))
    store(state, 1, (p[0], p[1], p[2]))
    store(state, 2, (p[3], p[4], p[5]))
    store(state, 3, (p[6], p[7], p[8]))


@inside
def load3(state: Floats) -> Any:
    """The covariance behind a position."""
    (a, b, c), (d, e, f), (g, h, i) = load(state, 1, ROW), load(state, 2, ROW), load(state, 3, ROW)
    return a, b, c, d, e, f, g, h, i


@inside
def pseudo_fix(star: Star, known: Assumptions, k: int, at: Any) -> Any:
    """Position of the ego by member k's estimate and the measurement of it, and its covariance."""
    theirs, relative = load(star.motion, 4 * k + POSITION, ROW), load(star.relative, k, RELATIVE)
    seen = completed(relative, subtract(theirs, at))
    one, o = 0.0 * at[0] + 1.0, 0.0 * at[0]
    cov = from_upper((one, o, o, one, o, one))
    if len(known.relative_std):
        cov = from_upper(converted_cov(seen, (relative[5], relative[6], relative[7]), known.min_range))
        cov = add_diagonal(cov, load(star.motion, 4 * k + VARIANCE, ROW))
    return subtract(theirs, vector(seen)), cov

"""Kalman filter of an ego with a pseudo-fix from each neighbour (MSMV-R): `coopoc.methods.baselines.MSMV`."""

from __future__ import annotations

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
from .joint_filter import Estimates
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
    star_within,
    write_ego,
)
from .relative import Numbers, completed, converted_cov, vector


@as_written
def run_filter(seen: Measurements, known: Assumptions) -> Estimates:
    """x (R, T, 3) m, covariance (R, T, 3, 3) m^2, and the neighbours' own estimates (R, M, 3) m, NaN for none.

    Args:
        seen: `broadcast` holds every vehicle's own estimate.
        known: `broadcast` its variance m^2.
    """
    runs, steps = seen.gnss.shape[:2]
    out = np.empty((runs, steps, 3)), np.empty((runs, steps, 3, 3)), np.empty((runs, seen.relative.shape[1], 3))
    most, x, cov = largest(seen.start), np.zeros((3, LANES)), np.zeros((9, LANES))
    for first in range(0, runs, LANES):
        star, old, last = star_within(most), NONE, min(first + LANES, runs) - 1
        for t in range(steps):
            n = gather(star, seen, known, first, last, t, old)
            step(star, known, x, cov, n, old)
            write_ego(out, star, x, cov, first, last, t, seen.start[t], n)
            old = n
    return out


@inside
def step(star: Star, known: Assumptions, x: Floats, cov: Floats, n: int, old: int) -> None:
    """P^-1 + C_p^-1 + sum_j C_j^-1, and the weighted mean that belongs to it, in place of x and P."""
    fix = load(star.motion, POSITION, ROW)
    if old == 0:
        at, p = fix, zeros(fix[0], square(ROW))
        flat = 0.0 * fix[0] + known.flat
        p = add_diagonal(p, (flat, flat, flat))
    else:
        at = add(load(x, 0, ROW), load(star.motion, MOVED, ROW))
        p = add_diagonal(load(cov, 0, square(ROW)), load(star.motion, PROCESS, ROW))
    weight, variance = load(star.status, NEW, (0.0,))[0], load(star.motion, VARIANCE, ROW)
    own = weight / variance[0], weight / variance[1], weight / variance[2]
    information, eta = add_diagonal(inverse(p), own), times(subtract(fix, at), own)
    for k in range(1, n):
        position, variance = pseudo_fix(star, known, k, at)
        new = load(star.status, 5 * k + NEW, (0.0,))[0]
        weight_k = scale(inverse(variance), new)
        information, eta = add(information, weight_k), add(eta, apply(weight_k, subtract(position, at)))
    p = inverse(information)
    store(x, 0, add(at, apply(p, eta)))
    store(cov, 0, p)


@inside
def pseudo_fix(star: Star, known: Assumptions, k: int, at: Numbers) -> tuple[Numbers, Numbers]:
    """Position of the ego by member k's estimate and the measurement of it, and its covariance."""
    theirs, relative = load(star.motion, 4 * k + POSITION, ROW), load(star.relative, k, RELATIVE)
    seen = completed(relative, subtract(theirs, at))
    one, o = 0.0 * at[0] + 1.0, 0.0 * at[0]
    cov = from_upper((one, o, o, one, o, one))
    if len(known.relative_std):
        cov = from_upper(converted_cov(seen, (relative[5], relative[6], relative[7]), known.min_range))
        cov = add_diagonal(cov, load(star.motion, 4 * k + VARIANCE, ROW))
    return subtract(theirs, vector(seen)), cov

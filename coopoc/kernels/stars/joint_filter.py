"""The joint filter of one ego's star, over a whole drive or one step at a time.

A step adds process noise to the information block by block, then fixes and relative measurements; no matrix is ever
inverted as a whole. The state of a member is its position or, of six numbers, its position and its receiver's drift.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ...arrays import Floats
from ..compiling.compile import as_written, inner
from ..compiling.small import first3, load, negate, square, store, subtract, with_first3
from ..compiling.vectors import LANES
from .drift import Drift, add_common, add_drifting_fixes, begin_common, decay, drift_noise, drift_prior
from .elimination import predict
from .joint import (
    Joint,
    add_fix,
    add_relative,
    block_of,
    copy,
    exact_information,
    joint_within,
    move,
    place,
    predict_state,
    rearrange,
    relative_information,
    solve,
)
from .messages import (
    NEW,
    NONE,
    POSITION,
    ROW,
    VARIANCE,
    Assumptions,
    Measurements,
    Star,
    clear,
    gather,
    largest,
    star_within,
)


@as_written
def follow(
    seen: Measurements, known: Assumptions, refine: bool, drift: Drift | None, row: Any
) -> tuple[Floats, Floats, Floats]:
    """x (R, T, 3) m, covariance (R, T, 3, 3) m^2, neighbours (R, M, 3) m.

    Args:
        refine: one Gauss-Newton step on range and angles.
        row: as many zeros as a state has numbers.
    """
    runs, steps = seen.gnss.shape[:2]
    out = np.empty((runs, steps, 3)), np.empty((runs, steps, 3, 3)), np.empty((runs, seen.relative.shape[1], 3))
    most = largest(seen.start) + 1
    for first in range(0, runs, LANES):
        last, old = min(first + LANES, runs) - 1, NONE
        star, joint = star_within(most), joint_within(most, row)
        for t in range(steps):
            n = gather(star, seen, known, (first, last), t, old)
            step(star, joint, known, refine, drift, (n, old), row)
            write(out, joint, (first, last, t, seen.start[t]), n, row)
            old = n
    return out


@inner
def write(out: Any, joint: Joint, at: Any, n: int, row: Any) -> None:
    """Copy what a step found in runs first to last."""
    (x, cov, others), (first, last, t, link), d = out, at, len(row)
    for lane in range(last - first + 1):
        for i in range(3):
            x[first + lane, t, i] = joint.state[i, lane]
            for j in range(3):
                cov[first + lane, t, i, j] = joint.scratch[d * min(i, j) + max(i, j), lane]
            for k in range(1, n):
                others[first + lane, link + k - 1, i] = joint.state[d * k + i, lane]


@inner
def step(star: Star, joint: Joint, known: Assumptions, refine: bool, drift: Drift | None, sizes: Any, row: Any) -> None:
    """Predict and update the state; the ego's covariance is then in `scratch`.

    Args:
        sizes: members now and before.
    """
    n, old = sizes
    members = n
    prior = with_first3(row, (1.0 / known.flat, 1.0 / known.flat, 1.0 / known.flat))
    if drift is not None:
        prior = drift_prior(known.flat, drift)
        n, blocks = add_common(star, drift, n, old)
        decay(joint, drift, old, blocks)
        old = blocks
    predict_state(star, joint, n, old, row)
    if drift is not None:
        drift_noise(star, joint, drift, members, n, old)
    predict(joint.information, old, joint.stride, joint.process, joint.scratch, square(row), row)
    rearrange(star, joint, n, old, prior, row)
    clear(joint.eta)
    if drift is not None:
        if n > members and old == 0:
            begin_common(joint, drift, n)
        add_drifting_fixes(star, joint, drift, members, n)
    else:
        add_fixes(star, joint, n, row)
    update(star, joint, known, refine, members, n, row)


@inner
def add_fixes(star: Star, joint: Joint, n: int, row: Any) -> None:
    """Add every member's position as broadcast."""
    for k in range(n):
        if k > 0 and star.previous[k] >= 0:
            place(star, joint, k, row)
        new = load(star.status, 5 * k + NEW, (0.0,))[0]
        p, q, r = load(star.motion, 4 * k + VARIANCE, ROW)
        gap = subtract(load(star.motion, 4 * k + POSITION, ROW), first3(load(joint.state, k, row)))
        add_fix(joint, block_of(k, n), (new / p, new / q, new / r), gap, row)


@inner
def update(star: Star, joint: Joint, known: Assumptions, refine: bool, members: int, n: int, row: Any) -> None:
    """Add the relative measurements, converted at the predicted geometry, and solve; to refine, solve a copy and add
    them once more, exact, linear at that solution."""
    last = 1 if refine and members > 1 else 0
    clear(joint.move)
    for stage in range(last + 1):
        a, eta = joint.information, joint.eta
        if stage < last:
            a, eta = joint.factor, joint.move
            copy(joint.information, a, n, joint.stride, square(row))
            for i in range(n):
                store(eta, i, load(joint.eta, i, row))
        for k in range(1, members):
            if stage == 1:
                edge = exact_information(star, joint, k, n, known.min_range, row)
            else:
                edge = relative_information(star, joint, k, known.relative_std, known.min_range, row)
            add_relative(a, eta, joint.stride, (k, n), edge, row)
        cov = solve(a, joint, eta, n, row)
        store(joint.scratch, 0, negate(cov))
    move(joint, n, row)

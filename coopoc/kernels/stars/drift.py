"""The joint filter of a star whose fixes have time-correlated errors: z = x + drift + common + white noise.

A state is (position, drift), six numbers. The error that all fixes have in common is the position of one more block
behind the members'; its drift is zero. Both errors are Gauss-Markov: e_t = keep e_{t-1} + w, in steady state.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from ..compiling.compile import as_written, inner, inside
from ..compiling.small import add, add_diagonal, first3, load, square, store, subtract, times, zeros
from ..compiling.vectors import LANES, unrolled
from .elimination import predict, rescale
from .joint import Joint, block_of, joint_within, place_on_broadcast, predict_state, rearrange
from .joint_filter import update, write
from .messages import (
    MOVED,
    NEW,
    NONE,
    POSITION,
    PROCESS,
    ROW,
    VARIANCE,
    Assumptions,
    Estimates,
    Measurements,
    Star,
    clear,
    gather,
    largest,
    new_estimates,
    star_within,
)
from .relative import Numbers

NOTHING = 1e-18
"""m^2, variance of an error that there is not."""
STATE = (0.0,) * 6


class Drift(NamedTuple):
    """Variances m^2 of a receiver's own and of the common error, 0 for none; correlation from one step to the next."""

    own: float
    common: float
    keep: float


@as_written
def run_filter(seen: Measurements, known: Assumptions, refine: bool, drift: Drift) -> Estimates:
    """x (R, T, 3) m, covariance (R, T, 3, 3) m^2, neighbours (R, M, 3) m."""
    runs, steps = seen.gnss.shape[:2]
    out = new_estimates(seen)
    most = largest(seen.start) + 1
    for first in range(0, runs, LANES):
        last, old = min(first + LANES, runs) - 1, NONE
        star, joint = star_within(most), joint_within(most, STATE)
        for t in range(steps):
            n = gather(star, seen, known, first, last, t, old)
            step(star, joint, known, refine, drift, n, old)
            write(out, joint, first, last, t, seen.start[t], n, STATE)
            old = n
    return out


@inner
def step(star: Star, joint: Joint, known: Assumptions, refine: bool, drift: Drift, members: int, old: int) -> None:
    """Predict and update; the common error is one more member, which does not move and is never measured."""
    o, flat, fades = 0.0 * load(star.motion, 0, ROW)[0], 1.0 / known.flat, 1.0 - drift.keep * drift.keep
    n, before = members + 1, old + 1 if old > 0 else 0
    star.previous[members] = before - 1
    store(star.motion, 4 * members + MOVED, (o, o, o))
    noise = o + drift.common * fades
    store(star.motion, 4 * members + PROCESS, (noise, noise, noise))
    for row in range(8):
        store(star.relative, 8 * members + row, (o,))
    decay(joint, drift, old, before)
    predict_state(star, joint, n, before, STATE)
    own = o + 1.0 / max(drift.own * fades, NOTHING * NOTHING)
    for k in range(n):
        if star.previous[k] >= 0:
            at = block_of(star.previous[k], before)
            process = own if k < members else o + 1.0 / (NOTHING * NOTHING)
            store(joint.process, at, joined(first3(load(joint.process, at, STATE)), (process, process, process)))
    predict(joint.information, before, joint.stride, joint.process, joint.scratch, square(STATE), STATE)
    prior = 1.0 / max(drift.own, NOTHING)
    rearrange(star, joint, n, before, (flat, flat, flat, prior, prior, prior), STATE)
    if old == 0:
        common, nothing = o + 1.0 / max(drift.common, NOTHING), o + 1.0 / NOTHING
        variance = (common, common, common, nothing, nothing, nothing)
        at = (n - 2) * joint.stride + n - 2
        store(joint.information, at, add_diagonal(zeros(o, square(STATE)), variance))
        store(joint.state, n - 1, zeros(o, STATE))
    place_on_broadcast(star, joint, members, STATE)
    clear(joint.eta)
    add_fixes(star, joint, members, n)
    update(star, joint, known, refine, members, n, STATE)


@inner
def decay(joint: Joint, drift: Drift, members: int, blocks: int) -> None:
    """Multiply the errors of the last star by `keep`, in state and information."""
    for k in range(blocks):
        state = load(joint.state, k, STATE)
        one, keep = 0.0 * state[0] + 1.0, 0.0 * state[0] + drift.keep
        position, error = (one, keep) if k < members else (keep, one)
        factors = (position, position, position, error, error, error)
        p, e = 1.0 / position, 1.0 / error
        store(joint.state, k, times(state, factors))
        store(joint.move, block_of(k, blocks), (p, p, p, e, e, e))
    rescale(joint.information, blocks, joint.stride, joint.move, square(STATE), STATE)


@inner
def add_fixes(star: Star, joint: Joint, members: int, n: int) -> None:
    """Add every member's position as broadcast: information about its position, its drift and the common error."""
    common = n - 2
    for k in range(members):
        new = load(star.status, 5 * k + NEW, (0.0,))[0]
        p, q, r = load(star.motion, 4 * k + VARIANCE, ROW)
        weight, state = (new / p, new / q, new / r), load(joint.state, k, STATE)
        expected = add(add(first3(state), last3(state)), first3(load(joint.state, members, STATE)))
        eta = times(weight, subtract(load(star.motion, 4 * k + POSITION, ROW), expected))
        information, i = both(weight), block_of(k, n)
        add_at(joint, i, i, information)
        add_at(joint, common, common, information)
        add_at(joint, min(i, common), max(i, common), information)
        for at in (i, common):
            store(joint.eta, at, add(load(joint.eta, at, STATE), joined(eta, eta)))


@inside
def add_at(joint: Joint, i: int, j: int, information: Numbers) -> None:
    """Add to block (i, j)."""
    at = i * joint.stride + j
    store(joint.information, at, add(load(joint.information, at, square(STATE)), information))


@unrolled
def joined(a: Any, b: Any) -> Any:
    """Both tuples in one."""
    return [*a, *b]


@unrolled
def both(w: Any) -> Any:
    """H^T diag(w) H with H = [I I], as a fix sees position and drift."""
    return [w[i % 3] if i % 3 == j % 3 else w[0] * 0.0 for i in range(6) for j in range(6)]


@unrolled
def last3(v: Any) -> Any:
    """The last three numbers."""
    return v[3:]

"""Fixes with time-correlated errors, in the blocks of the joint filter: z = x + drift + common + white noise.

A state is (position, drift), six numbers. The error that all fixes have in common is the position of one more block
behind the members'; its drift is zero. Both errors are Gauss-Markov: e_t = keep e_{t-1} + w, in steady state.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from ..compiling.compile import inner, inside
from ..compiling.small import add, add_diagonal, first3, load, store, subtract, times, zeros
from ..compiling.vectors import unrolled
from .elimination import rescale
from .joint import Joint, block_of, place
from .messages import MOVED, NEW, POSITION, PROCESS, ROW, VARIANCE, Star

NOTHING = 1e-18
"""m^2, variance of an error that there is not."""


class Drift(NamedTuple):
    """Variances m^2 of a receiver's own and of the common error, 0 for none; correlation from one step to the next."""

    own: float
    common: float
    keep: float


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


@inside
def three(number: float) -> Any:
    """The same number three times."""
    return number, number, number


@inner
def add_common(star: Star, drift: Drift, n: int, old: int) -> Any:
    """Put the common error behind the members, as one that does not move; numbers of blocks now and before."""
    if drift.common == 0.0:
        return n, old
    before = old + 1 if old > 0 else 0
    star.previous[n] = before - 1
    zero = three(0.0 * load(star.motion, 0, ROW)[0])
    store(star.motion, 4 * n + MOVED, zero)
    noise = drift.common * (1.0 - drift.keep * drift.keep)
    store(star.motion, 4 * n + PROCESS, (zero[0] + noise, zero[1] + noise, zero[2] + noise))
    for row in range(8):
        store(star.relative, 8 * n + row, (0.0,))
    return n + 1, before


@inner
def decay(joint: Joint, drift: Drift, members: int, old: int) -> None:
    """Multiply the errors of the last star by `keep`, in state and information."""
    for k in range(old):
        state = load(joint.state, k, (0.0,) * 6)
        one, keep = three(0.0 * state[0] + 1.0), three(0.0 * state[0] + drift.keep)
        factors, inverse = joined(one, keep), three(1.0 / keep[0])
        divided = joined(one, inverse)
        if k == members:
            factors, divided = joined(keep, one), joined(inverse, one)
        store(joint.state, k, times(state, factors))
        store(joint.move, block_of(k, old), divided)
    rescale(joint.information, old, joint.stride, joint.move, (0.0,) * 36, (0.0,) * 6)


@inner
def drift_noise(star: Star, joint: Joint, drift: Drift, members: int, n: int, old: int) -> None:
    """Inverse process noise of the drifts of the members that stay; the common error has none."""
    least = NOTHING * NOTHING
    for k in range(n):
        process = 1.0 / max(drift.own * (1.0 - drift.keep * drift.keep), least) if k < members else 1.0 / least
        if star.previous[k] >= 0:
            at = block_of(star.previous[k], old)
            position = first3(load(joint.process, at, (0.0,) * 6))
            store(joint.process, at, joined(position, three(0.0 * position[0] + process)))


@inside
def drift_prior(flat: float, drift: Drift) -> Any:
    """Information of a member that joins."""
    return joined(three(1.0 / flat), three(1.0 / max(drift.own, NOTHING)))


@inner
def begin_common(joint: Joint, drift: Drift, n: int) -> None:
    """Zero and the prior variance for the common error, the block before the ego's."""
    at = (n - 2) * joint.stride + n - 2
    o = 0.0 * load(joint.information, 0, ROW)[0]
    variance = joined(three(o + 1.0 / drift.common), three(o + 1.0 / NOTHING))
    store(joint.information, at, add_diagonal(zeros(o, (0.0,) * 36), variance))
    store(joint.state, n - 1, zeros(o, (0.0,) * 6))


@inner
def add_drifting_fixes(star: Star, joint: Joint, drift: Drift, members: int, n: int) -> None:
    """Add every member's position as broadcast: information about its position, its drift and the common error."""
    row, common = (0.0,) * 6, n - 2
    for k in range(members):
        if k > 0 and star.previous[k] >= 0:
            place(star, joint, k, row)
        new = load(star.status, 5 * k + NEW, (0.0,))[0]
        p, q, r = load(star.motion, 4 * k + VARIANCE, ROW)
        weight, state = (new / p, new / q, new / r), load(joint.state, k, row)
        gap = subtract(subtract(load(star.motion, 4 * k + POSITION, ROW), first3(state)), last3(state))
        if n > members:
            gap = subtract(gap, first3(load(joint.state, members, row)))
        eta, information, i = times(weight, gap), both(weight), block_of(k, n)
        add_at(joint, i, i, information)
        store(joint.eta, i, add(load(joint.eta, i, row), joined(eta, eta)))
        if n > members:
            add_at(joint, common, common, information)
            add_at(joint, min(i, common), max(i, common), information)
            store(joint.eta, common, add(load(joint.eta, common, row), joined(eta, eta)))


@inside
def add_at(joint: Joint, i: int, j: int, information: Any) -> None:
    """Add to block (i, j)."""
    at = i * joint.stride + j
    store(joint.information, at, add(load(joint.information, at, (0.0,) * 36), information))

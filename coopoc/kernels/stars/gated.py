"""Gates of a star: which numbers of a step weigh less, before they become information.

A filter in information form knows no innovation's covariance. So each member carries a bound of the covariance of its
vector from the ego, which the member's own relative measurements and both motions give, and the ego its covariance:
a gate is never tighter than that of the exact innovation.
"""

from math import inf, sqrt
from typing import NamedTuple

import numpy as np

from ...arrays import Floats
from ..compiling.compile import inner, inside, storage
from ..compiling.small import (
    add,
    add_diagonal,
    choose_each,
    diagonal,
    inner_product,
    load,
    scale,
    store,
    subtract,
    times,
    trace,
    vector_at,
    zeros,
)
from ..compiling.vectors import LANES, Lanes, choose, take
from ..gate import (
    ANEW,
    BACK,
    FIX_GATE,
    INITIAL_LOCKOUT,
    LEAK,
    NO_FIX_M2,
    NOT_REMEMBERED_M2,
    distance,
    gain_of,
    gated_update,
    inflation,
    remember,
    vote,
)
from ..geometry import Numbers, axes, direction, incomplete, metres, residuals, vector, whole
from .messages import ROW, VARIANCE, Star, moved_of, position_of, process_of, relative_of, variance_of

STATE, BEFORE, VOTES = (0.0,) * 13, (0.0,) * 14, (0.0,) * 9


class Gates(NamedTuple):
    """What the gates of a star remember; arrays are (., LANES).

    Attributes:
        state: (13 most,) of each member 9 m^2, the bound of the covariance of its vector from the ego (of the ego, its
            covariance), and the hits of range, azimuth, inclination and position.
        last: of the last star.
        before: (14,) where the ego was before fixes contradicted it m, covariance m^2, and the evidence and time of
            `gate.remember`.
        votes: (9,) of `gate.vote`.
    """

    state: Floats
    last: Floats
    before: Floats
    votes: Floats


@storage
def gates_within(most: int) -> Gates:
    """Room for `most` members."""
    before = np.zeros((len(BEFORE), LANES))
    before[3:12:4] = NOT_REMEMBERED_M2
    state = np.zeros((2, 13 * most, LANES))
    return Gates(state[0], state[1], before, np.zeros((len(VOTES), LANES)))


@inner
def carry(star: Star, gates: Gates, flat: float, n: int, old: int) -> None:
    """Bring what is remembered forward to this star; `flat` m^2 is the variance of a member that joins, and the ego
    begins at its fix."""
    for k in range(old):
        store(gates.last, k, load(gates.state, k, STATE))
    own, memory = process_of(star, 0), load(gates.before, 0, BEFORE)
    there, spread = add(memory[:3], moved_of(star, 0)), add_diagonal(memory[3:12], own)
    store(gates.before, 0, (*there, *spread, *memory[12:]))
    for k in range(n):
        previous, process = star.previous[k], process_of(star, k)
        if previous < 0:
            store(gates.state, k, fresh(star, k, flat))
            continue
        before = load(gates.last, previous, STATE)
        process = add(process, own) if k > 0 else process
        store(gates.state, k, (*add_diagonal(before[:9], process), *before[9:]))


@inside
def fresh(star: Star, k: int, flat: float) -> Numbers:
    """What is remembered of a member that joins, or of an ego at its fix."""
    o = 0.0 * variance_of(star, 0)[0]
    f, y = o + flat, o + INITIAL_LOCKOUT
    variance = (f, f, f) if k > 0 else variance_of(star, 0)
    return (*diagonal(variance), y, y, y, o)


@inner
def supporters(star: Star, n: int, at: Numbers, variance: Numbers) -> float:
    """How many neighbours, measured whole, are where their messages say if the ego is at a position."""
    agree = o = 0.0 * at[0]
    noise = add(add(variance, variance_of(star, 0)), (o + 1.0, o + 1.0, o + 1.0))
    for k in range(1, n):
        polar = relative_of(star, k)
        gap, sent = subtract(position_of(star, k), add(at, vector(polar))), variance_of(star, k)
        q = distance(gap, diagonal(add(noise, sent)))
        agree = agree + choose(o + FIX_GATE - q, choose(o + NO_FIX_M2 - sent[0], whole(polar), o), o)
    return agree


@inner
def go_back(star: Star, gates: Gates, state: Floats, n: int) -> Lanes:
    """BACK where the ego goes back to where it was before fixes contradicted it: its state and covariance are; ANEW
    where fixes outvote its start, and neighbours do not speak for that; else 0."""
    at, ego, memory = vector_at(state, 0), load(gates.state, 0, STATE), load(gates.before, 0, BEFORE)
    fix, variance, there, spread = position_of(star, 0), variance_of(star, 0), memory[:3], memory[3:12]
    votes, left = vote(load(gates.votes, 0, VOTES), moved_of(star, 0), process_of(star, 0), fix, variance)
    store(gates.votes, 0, votes)
    q = distance(subtract(fix, at), add_diagonal(ego[:9], variance))
    o = 0.0 * q
    if not left <= o:
        more = supporters(star, n, at, (ego[0], ego[4], ego[8])) - supporters(star, n, fix, zeros(o, ROW))
        left = choose(more, o, left)
    if q <= o + FIX_GATE and o + NOT_REMEMBERED_M2 <= spread[0] and left <= o:
        return o
    gap, other = subtract(there, at), distance(subtract(fix, there), add_diagonal(spread, variance))
    apart, wide, gain = inner_product(gap, gap), trace(spread), gain_of(ego[:9], variance)
    what, evidence, since = remember(q, other, FIX_GATE, gain, apart, wide, memory[12], memory[13])
    begins, back, flat = what - 0.5, what - 1.5, o + NOT_REMEMBERED_M2
    nothing = diagonal((flat, flat, flat))
    kept = choose_each(back, nothing, choose_each(begins, ego[:9], choose_each(what + 0.5, spread, nothing)))
    store(gates.before, 0, (*choose_each(begins, at, there), *kept, evidence, since))
    store(gates.state, 0, (*choose_each(back, spread, ego[:9]), *ego[9:12], choose(back, o, ego[12])))
    store(state, 0, choose_each(back, there, at))
    return choose(left, o + ANEW, choose(back, o + BACK, o))


@inner
def gate_star(star: Star, gates: Gates, state: Floats, placed: Floats, least: float, n: int) -> None:
    """Inflate the deviations of relative measurements and the variances of positions that are beyond their gates.

    Where the ego's own fix is beyond, the neighbours' speak for or against it: if most of them are beyond as well, it
    is the ego's position that is wrong, and in the end all count again. Otherwise many neighbours beyond the gate are
    many wrong messages.

    Args:
        star: of this step.
        gates: brought forward.
        state: (3 n, LANES) m, predicted positions.
        placed: (n, LANES) 1 where something is known of where a member is, else 0.
        least: m.
    """
    origin, ego = vector_at(state, 0), load(gates.state, 0, STATE)
    o, hits = 0.0 * ego[12], ego[12]
    total = own = gate_position(star, 0, origin, ego[:9], hits)
    for k in range(1, n):
        at, polar, memory = vector_at(state, k), relative_of(star, k), load(gates.state, k, STATE)
        std = polar[5:]
        if incomplete(polar):
            far = o + inf
            std = choose_each(take(placed, k) - 0.5, std, (far, far, far))
        cov, moved, factor, three = gate_components(subtract(at, origin), memory[:9], polar, std, memory[9:12], least)
        store(gates.state, k, (*cov, *three, o))
        store(star.relative, k, inflated(polar, factor))
        total = total + gate_position(star, k, add(at, moved), add(ego[:9], cov), hits)
    store(gates.state, 0, (*ego[:12], choose(own, max(hits + total, o), max(hits + LEAK * own, o))))


@inside
def inflated(measured: Numbers, factor: Numbers) -> Numbers:
    """A measurement, its standard deviations times three factors."""
    a, b, c = factor
    return (*measured[:5], a * measured[5], b * measured[6], c * measured[7])


@inner
def gate_position(star: Star, k: int, at: Numbers, cov: Numbers, hits: float) -> Lanes:
    """Inflate the variance of a member's position; the gain that it would have had, less than 0 within the gate."""
    variance = variance_of(star, k)
    q = distance(subtract(position_of(star, k), at), add_diagonal(cov, variance))
    store(star.motion, 4 * k + VARIANCE, scale(variance, inflation(q, FIX_GATE, hits)))
    gain: float = gain_of(cov, variance)
    return choose(q - FIX_GATE, gain, -gain)


@inner
def gate_components(
    gap: Numbers, cov: Numbers, measured: Numbers, std: Numbers, hits: Numbers, least: float
) -> tuple[Numbers, Numbers, Numbers, Numbers]:
    """Update a vector by range, azimuth and inclination, one after the other, gated.

    Args:
        gap: m, the predicted vector.
        cov: (9,) m^2, of it.
        measured: `geometry.five`.
        std: m, rad, rad; infinite for what was not measured.
        hits: (3,) of these components.
        least: m, least distance at which an angle's error counts.

    Returns:
        Covariance, move m, factors of the standard deviations, and hits.
    """
    polar = direction(gap)
    ray, side, up = axes(polar)
    lengths = metres(polar, (1.0, 1.0, 1.0), least)
    longer, turned, raised = times(residuals(measured, polar), lengths)
    a, b, c = times(std, lengths)
    cov, moved, f, first = gated_update(cov, zeros(a, ROW), ray, longer, a * a, hits[0])
    cov, moved, g, second = gated_update(cov, moved, side, turned, b * b, hits[1])
    cov, moved, h, third = gated_update(cov, moved, up, raised, c * c, hits[2])
    return cov, moved, (sqrt(f), sqrt(g), sqrt(h)), (first, second, third)

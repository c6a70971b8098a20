"""Filters of an ego that fuse a pseudo-fix from each neighbour: MSMV-R, and (split) covariance intersection.

In covariance intersection each source, the ego's own estimate and the pseudo-fixes of its neighbours, has a dependent
and an independent covariance D and I. With s = w for the ego and 1 - w for all others its information is

    L(s) = (D / s + I)^-1 = s K,  K = (D + s I)^-1,  L' = K D K,  L'' = -2 sym(K I L'),

and w makes the trace of P = (F + sum of L)^-1 least, F the information that depends on nothing: the only minimum of a
convex function, by Newton's method within brackets from the weight of the step before. LANES runs side by side.
"""

from math import nan
from typing import NamedTuple

import numpy as np

from ...arrays import Floats
from ..compiling.compile import as_written, inner, inside
from ..compiling.small import (
    add,
    add_diagonal,
    apply,
    block_at,
    choose_each,
    diagonal,
    inner_product,
    inverse,
    load,
    minus_product,
    negate,
    scale,
    store,
    subtract,
    trace,
    transpose,
    vector_at,
    zeros,
)
from ..compiling.vectors import LANES, Lanes, choose, take
from ..gate import BACK, FIX_GATE, distance, gate_fix, inflation
from ..geometry import Numbers, completed, direction, metres, spread, vector
from .gated import STATE, Gates, carry, gate_components, gates_within, go_back, inflated
from .joint_filter import write
from .messages import (
    BLOCK,
    HELD,
    NEW,
    NONE,
    NOWHERE,
    Assumptions,
    Estimates,
    Measurements,
    Star,
    gather,
    moved_of,
    new_estimates,
    position_of,
    process_of,
    relative_of,
    star_within,
    variance_of,
)

NEWTON_STEPS, BISECT_AFTER, STEP_TOLERANCE = 60, 20, 1e-8
"""Of Newton's method; after BISECT_AFTER rounds a step out of the bracket halves it."""
MIN_OWN_WEIGHT = 1e-9
"""Least weight of the ego's own estimate: at zero nothing might be left to invert."""
MAX_WEIGHT = 1.0 - 1e-6
"""Greatest weight but for 1: nearer to 1 the derivatives of what lacks a component, whose I is 1e8 m^2, bend within
D / I = 1e-8, and Newton's steps there are shorter than STEP_TOLERANCE without a minimum."""


class Fusion(NamedTuple):
    """The estimate of the ego and what is fused with it at a step.

    Attributes:
        x: (3 most, LANES) m of the ego, and behind it its neighbours' own, NaN for none.
        dependent: (9 most, LANES) m^2 of each source, the ego's first.
        independent: (9 most, LANES) m^2.
        gap: (3 most, LANES) m, from the ego to their pseudo-fixes.
        used: (most, LANES) 1, or 0 for one without a message.
        weight: (1, LANES) w.
        split: keep independent errors apart.
        robust: gate fixes and pseudo-fixes.
        naive: take all errors as independent, measurements at the measured geometry, and each message once: MSMV.
    """

    x: Floats
    dependent: Floats
    independent: Floats
    gap: Floats
    used: Floats
    weight: Floats
    split: bool
    robust: bool
    naive: bool


@as_written
def run_intersection(
    measurements: Measurements, model: Assumptions, split: bool, robust: bool, naive: bool
) -> Estimates:
    """x (R, T, 3) m, covariance (R, T, 3, 3) m^2, and the neighbours' own estimates (R, M, 3) m, NaN for none.

    Args:
        measurements: `broadcast` holds every vehicle's own estimate.
        model: `broadcast` its variance m^2.
        split: keep independent errors apart.
        robust: gate fixes and pseudo-fixes.
        naive: MSMV, as of `Fusion`.
    """
    runs, steps = measurements.gnss.shape[:2]
    out = new_estimates(measurements)
    most = measurements.most
    vectors, matrices = np.zeros((2, 3 * most, LANES)), np.zeros((2, 9 * most, LANES))
    sources = vectors[0], matrices[0], matrices[1], vectors[1], np.ones((most, LANES)), np.zeros((1, LANES))
    fusion = Fusion(*sources, split, robust, naive)
    for first in range(0, runs, LANES):
        star, before, old, last = star_within(most), star_within(most), NONE, min(first + LANES, runs) - 1
        gates = gates_within(1)
        for t in range(steps):
            star, before = before, star
            n = gather(star, before, measurements, model, first, last, t, old)
            intersect(star, model, fusion, gates, n, old)
            write(out, fusion.x, gates.state, first, last, t, measurements.start[t], n)
            old = n
    return out


@inner
def intersect(star: Star, model: Assumptions, fusion: Fusion, gates: Gates, n: int, old: int) -> None:
    """Predict, go back or begin anew as the joint filter does, and fuse."""
    fix, variance = position_of(star, 0), variance_of(star, 0)
    o, new = 0.0 * fix[0], take(star.status, NEW)
    nothing, flat, hits = zeros(o, BLOCK), o + model.flat, o
    if old == 0:
        x, w, new = fix, o + 0.5, new if fusion.naive else o
        dependent, independent = nothing, diagonal((flat, flat, flat) if fusion.naive else variance)
    else:
        x, w = add(vector_at(fusion.x, 0), moved_of(star, 0)), take(fusion.weight, 0)
        dependent = block_at(fusion.dependent, 0)
        independent = add_diagonal(block_at(fusion.independent, 0), process_of(star, 0))
    if fusion.robust:
        store(fusion.x, 0, x)
        carry(star, gates, model.flat, 1, min(old, 1))
        back = go_back(star, gates, fusion.x, n)
        anew, memory = back - BACK, load(gates.state, 0, STATE)
        x, new = choose_each(anew, fix, vector_at(fusion.x, 0)), choose(anew, o, new)
        dependent = choose_each(back, choose_each(anew, diagonal(variance), memory[:9]), dependent)
        independent = choose_each(back, nothing, independent)
        own = add(dependent, independent)
        share, hits = gate_fix(subtract(fix, x), own, variance, FIX_GATE, choose(anew, o, memory[12]))
        variance = scale(variance, share)
    add_source(fusion, 0, dependent, independent)
    fixed = diagonal((new / variance[0], new / variance[1], new / variance[2]))
    add_neighbours(star, model, fusion, x, n)
    alone = inverse(add(fixed, source(fusion, 0, o + 1.0)[0]))
    w = o + 0.5 if fusion.naive else best_weight(fusion, fixed, n, w)
    for _ in range(2):
        total, eta, dependent = fixed, apply(fixed, subtract(fix, x)), nothing
        for k in range(n):
            s = w if k == 0 else 1.0 - w
            information, derivative, _ = source(fusion, k, s)
            total, dependent = add(total, information), add(dependent, scale(derivative, s))
            eta = add(eta, apply(information, vector_at(fusion.gap, k)))
        cov = inverse(total)
        # A weight that is worse than none was lost to rounding, where without a fix all information is small.
        worse = choose(trace(cov), trace(cov) - (1.0 + 1e-9) * trace(alone), o + 1.0)
        if worse <= o:
            break
        w = choose(worse, o + 1.0, w)
    dependent = product(product(cov, dependent), cov)
    store(fusion.x, 0, add(x, apply(cov, eta)))
    store(gates.state, 0, (*cov, o, o, o, hits))
    store(fusion.dependent, 0, dependent)
    store(fusion.independent, 0, subtract(cov, dependent))
    store(fusion.weight, 0, (w,))


@inner
def add_neighbours(star: Star, model: Assumptions, fusion: Fusion, x: Numbers, n: int) -> None:
    """Pseudo-fixes of the neighbours of which a position is held, at the geometry of the ego's predicted position."""
    o = 0.0 * x[0]
    unit, nowhere = o + 1.0, (o + nan, o + nan, o + nan)
    for k in range(1, n):
        gap = subtract(position_of(star, k), x)
        relative, variance = relative_of(star, k), variance_of(star, k)
        polar, noise, theirs, f = direction(gap), diagonal((unit, unit, unit)), diagonal(variance), unit
        if fusion.robust:
            ahead = add(add(block_at(fusion.dependent, 0), block_at(fusion.independent, 0)), theirs)
            _, _, factor, _ = gate_components(gap, ahead, relative, relative[5:], (o, o, o), model.min_range)
            relative = inflated(relative, factor)
        complete = completed(relative, polar)
        if len(model.relative_std):
            noise = cov_of(complete if fusion.naive else polar, relative, model.min_range)
        elif fusion.naive:
            theirs = scale(theirs, 0.0)
        has_position, held = o + NOWHERE - variance[0], take(star.status, 5 * k + HELD)
        store(fusion.x, k, choose_each(choose(has_position, held, o), position_of(star, k), nowhere))
        held = take(star.status, 5 * k + NEW) if fusion.naive else held
        gap = subtract(gap, vector(complete))
        if fusion.robust:
            f = inflation(distance(gap, add(ahead, noise)), FIX_GATE, o)
        counts = choose(o + 1e300 - f, held, o)
        f = choose(counts, f, unit)
        store(fusion.used, k, (choose(has_position, counts, o),))
        store(fusion.gap, k, gap)
        add_source(fusion, k, scale(theirs, f), scale(noise, f))


@inside
def add_source(fusion: Fusion, k: int, dependent: Numbers, independent: Numbers) -> None:
    """Set a source; plain covariance intersection takes all of its error as dependent, MSMV none."""
    if fusion.naive:
        dependent, independent = scale(dependent, 0.0), add(dependent, independent)
    elif not fusion.split:
        dependent, independent = add(dependent, independent), scale(independent, 0.0)
    store(fusion.dependent, k, dependent)
    store(fusion.independent, k, independent)


@inner
def source(fusion: Fusion, k: int, s: float) -> tuple[Numbers, Numbers, Numbers]:
    """L, L' and K I L' of a source at its s; 0 for one that is not used.

    K I is (1 - K D) / s, which keeps its digits beside an I of 1e8 m^2; if not split it is 0.
    """
    d, i = block_at(fusion.dependent, k), block_at(fusion.independent, k)
    root = scale(inverse(add(d, scale(i, s))), take(fusion.used, k))
    share = product(root, d)
    derivative = product(share, root)
    d2p_dw2 = scale(derivative, 0.0)
    if fusion.split:
        d2p_dw2 = scale(subtract(derivative, product(share, derivative)), 1.0 / max(s, 0.0 * s + 1e-12))
    return scale(root, s), derivative, d2p_dw2


@inner
def best_weight(fusion: Fusion, fixed: Numbers, n: int, w: float) -> Lanes:
    """w of least trace in [MIN_OWN_WEIGHT, MAX_WEIGHT], or 1."""
    low, high, going = 0.0 * w + MIN_OWN_WEIGHT, 0.0 * w + MAX_WEIGHT, 0.0 * w + 1.0
    w = choose(w - MAX_WEIGHT, high, w)
    for round_ in range(NEWTON_STEPS):
        total, dp_dw, d2p_dw2 = fixed, scale(fixed, 0.0), scale(fixed, 0.0)
        for k in range(n):
            information, derivative, curvature = source(fusion, k, w if k == 0 else 1.0 - w)
            total, d2p_dw2 = add(total, information), add(d2p_dw2, curvature)
            dp_dw = add(dp_dw, derivative) if k == 0 else subtract(dp_dw, derivative)
        p = inverse(total)
        twice, bent = product(p, p), add(product(product(dp_dw, p), dp_dw), d2p_dw2)
        first, second = -inner_product(twice, dp_dw), 2.0 * inner_product(twice, transpose(bent))  # of tr P by w
        low, high = choose(first, low, w), choose(-first, high, w)
        newton = choose(second, w - first / second, w)
        inside_low, inside_high = newton - low, high - newton
        middle = 0.5 * (low + high)
        below, above = (low, high) if round_ < BISECT_AFTER else (middle, middle)
        before, w = w, choose(going, choose(inside_low, choose(inside_high, newton, above), below), w)
        going = choose(abs(w - before) - STEP_TOLERANCE, going, 0.0 * w)
        if going <= 0.0 * w:
            break
    return choose(w - MAX_WEIGHT + STEP_TOLERANCE, 0.0 * w + 1.0, w)


@inside
def product(a: Numbers, b: Numbers) -> Lanes:
    """A B."""
    return negate(minus_product(a, b))


@inside
def cov_of(polar: Numbers, measured: Numbers, least: float) -> Lanes:
    """Covariance m^2 of a converted measurement at a geometry; standard deviations count as 1e3 at most, so that a
    missing component has a variance beyond any other."""
    std = -max(-measured[5], -1e3), -max(-measured[6], -1e3), -max(-measured[7], -1e3)
    a, b, c = metres(polar, std, least)
    return spread(polar, a * a, b * b, c * c)

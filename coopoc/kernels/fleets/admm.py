"""Consensus ADMM of a whole fleet over a drive, one run after the other.

Each vehicle holds a copy of itself and of those in contact: copy e is that of edges.head[e], held by edges.tail[e].
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...arrays import Floats
from ..compiling.compile import compiled, part
from ..compiling.small import (
    add,
    add_diagonal,
    apply,
    inverse,
    load,
    minus_apply,
    minus_product,
    scale,
    store,
    subtract,
)
from .graph import MATRIX, VECTOR, Assumed, Edges, Measured, Pairs, advance, copy, linearise


class Consensus(NamedTuple):
    """Variables of one step, flat: of N vehicles, or of E copies of others.

    Attributes:
        z: (3 N) m, agreed positions less the beliefs.
        own: (3 N) m, each vehicle's copy of itself.
        own_dual: (3 N) m.
        outer: (9 N) m^2, inverse of the vehicle's own block once the copies are eliminated.
        holders: (N) copies of a vehicle.
        copy: (3 E) m.
        dual: (3 E) m.
        inner: (9 E) m^2, (W / 2 + rho)^-1 of each edge.
    """

    z: Floats
    own: Floats
    own_dual: Floats
    outer: Floats
    holders: Floats
    copy: Floats
    dual: Floats
    inner: Floats


@compiled
def run_filter(
    measured: Measured, pairs: Pairs, assumed: Assumed, edges: Edges, rounds: int, rho: float
) -> tuple[Floats, Floats]:
    """Positions (R, T, 3 N) m and covariances (R, T, 9 N) m^2 of each vehicle's own filter, NaN m where inactive.

    Args:
        measured: what the fleet measured.
        pairs: those that exchange messages.
        assumed: the noise model.
        edges: memory.
        rounds: iterations a step.
        rho: 1/m^2, the penalty.
    """
    runs, steps, n = measured.active.shape
    x, cov = np.empty((runs, steps, 3 * n)), np.zeros((runs, steps, 9 * n))
    z, own, own_dual, outer = np.zeros(3 * n), np.zeros(3 * n), np.zeros(3 * n), np.zeros(9 * n)
    copies, dual, inner = np.zeros(len(edges.eta)), np.zeros(len(edges.eta)), np.zeros(len(edges.information))
    state, covariance = Consensus(z, own, own_dual, outer, np.zeros(n), copies, dual, inner), np.zeros(9 * n)
    for run in range(runs):
        for t in range(steps):
            advance(run, t, x[run], covariance, measured, assumed)
            count = linearise(run, t, x[run, t], covariance, measured, pairs, assumed, edges)
            prepare(count, edges, covariance, rho, state)
            for _ in range(rounds):
                solve(count, edges, rho, state)
                agree(count, edges, state)
            copy(covariance, cov[run, t], 9 * n)
            for k in range(n):
                store(x[run, t], k, add(load(x[run, t], k, VECTOR), load(state.z, k, VECTOR)))
    return x, cov


@part
def prepare(count: int, edges: Edges, covariance: Floats, rho: float, state: Consensus) -> None:
    """Inverses of the local problems; half of what a pair measured belongs to each of its vehicles."""
    state.z[:], state.own_dual[:], state.dual[:], state.holders[:] = 0.0, 0.0, 0.0, 1.0
    for n in range(len(state.holders)):
        if covariance[9 * n] > 0.0:
            information = inverse(load(covariance, n, MATRIX))
            store(state.outer, n, add_diagonal(information, (rho, rho, rho)))
    for e in range(count):
        holder, half = edges.tail[e], scale(load(edges.information, e, MATRIX), 0.5)
        inner = inverse(add_diagonal(half, (rho, rho, rho)))
        store(edges.information, e, half)
        store(edges.eta, e, scale(load(edges.eta, e, VECTOR), 0.5))
        store(state.inner, e, inner)
        block = load(state.outer, holder, MATRIX)
        store(state.outer, holder, subtract(block, scale(minus_product(inner, half), rho)))
        state.holders[holder] += 1.0
    for n in range(len(state.holders)):
        store(state.outer, n, inverse(load(state.outer, n, MATRIX)))


@part
def solve(count: int, edges: Edges, rho: float, state: Consensus) -> None:
    """Each vehicle's copies y = argmin f_i(y) + rho / 2 sum_k |y_k - a_k|^2, with a_k = z_k - u_k."""
    for n in range(len(state.holders)):
        store(state.own, n, subtract(load(state.z, n, VECTOR), load(state.own_dual, n, VECTOR)))
    for e in range(count):
        holder = edges.tail[e]
        target = subtract(load(state.z, edges.head[e], VECTOR), load(state.dual, e, VECTOR))
        store(state.copy, e, target)
        pair_eta = subtract(apply(load(edges.information, e, MATRIX), target), load(edges.eta, e, VECTOR))
        moved = apply(load(state.inner, e, MATRIX), pair_eta)
        store(state.own, holder, add(load(state.own, holder, VECTOR), moved))
    for n in range(len(state.holders)):
        store(state.own, n, scale(apply(load(state.outer, n, MATRIX), load(state.own, n, VECTOR)), rho))
    for e in range(count):
        eta = add(load(edges.eta, e, VECTOR), scale(load(state.copy, e, VECTOR), rho))
        measured = minus_apply(load(edges.information, e, MATRIX), load(state.own, edges.tail[e], VECTOR))
        store(state.copy, e, apply(load(state.inner, e, MATRIX), subtract(eta, measured)))


@part
def agree(count: int, edges: Edges, state: Consensus) -> None:
    """z = mean over the holders of y + u, then u += y - z."""
    for n in range(len(state.holders)):
        store(state.z, n, add(load(state.own, n, VECTOR), load(state.own_dual, n, VECTOR)))
    for e in range(count):
        n, both = edges.head[e], add(load(state.copy, e, VECTOR), load(state.dual, e, VECTOR))
        store(state.z, n, add(load(state.z, n, VECTOR), both))
    for n in range(len(state.holders)):
        z = scale(load(state.z, n, VECTOR), 1.0 / state.holders[n])
        store(state.z, n, z)
        store(state.own_dual, n, subtract(add(load(state.own_dual, n, VECTOR), load(state.own, n, VECTOR)), z))
    for e in range(count):
        rest = subtract(load(state.copy, e, VECTOR), load(state.z, edges.head[e], VECTOR))
        store(state.dual, e, add(load(state.dual, e, VECTOR), rest))

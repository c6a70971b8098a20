"""Consensus ADMM of a whole fleet over a drive, one run after the other.

Each vehicle holds a copy of itself and of those in contact. Copies of pair k are number 2k, of the second held by the
first, and 2k + 1, of the first held by the second.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...arrays import AnyArray, Floats
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
from .belief_propagation import linearise
from .fleet_graph import MATRIX, VECTOR, Assumed, Measured, Pairs, advance, copy, most_pairs


class Consensus(NamedTuple):
    """Variables of one step, flat: of N vehicles, or of up to 2 P copies.

    Attributes:
        z: (3 N) m, agreed positions less the beliefs.
        own: (3 N) m, each vehicle's copy of itself.
        own_dual: (3 N) m.
        outer: (9 N) m^2, inverse of the vehicle's own block once the copies are eliminated.
        holders: (N) copies of a vehicle.
        copy: (6 P) m.
        dual: (6 P) m.
        inner: (9 P) m^2, (W / 2 + rho)^-1 of each pair.
    """

    z: AnyArray
    own: AnyArray
    own_dual: AnyArray
    outer: AnyArray
    holders: AnyArray
    copy: AnyArray
    dual: AnyArray
    inner: AnyArray


@compiled
def follow(measured: Measured, pairs: Pairs, assumed: Assumed, rounds: int, rho: float) -> tuple[Floats, Floats]:
    """Positions (R, T, 3 N) m and covariances (R, T, 9 N) m^2 of each vehicle's own filter, NaN m where inactive.

    Args:
        measured: what the fleet measured.
        pairs: those that exchange messages.
        assumed: the noise model.
        rounds: iterations a step.
        rho: 1/m^2, the penalty.
    """
    runs, steps, n = measured.active.shape
    x, cov = np.empty((runs, steps, 3 * n)), np.zeros((runs, steps, 9 * n))
    most = most_pairs(pairs)
    graph, own = (np.zeros(9 * most), np.zeros(3 * most)), np.zeros(9 * n)
    state = Consensus(
        np.zeros(3 * n),
        np.zeros(3 * n),
        np.zeros(3 * n),
        np.zeros(9 * n),
        np.zeros(n),
        np.zeros(6 * most),
        np.zeros(6 * most),
        np.zeros(9 * most),
    )
    for run in range(runs):
        for t in range(steps):
            advance(run, t, x[run], own, measured, assumed)
            linearise(run, t, x[run, t], own, measured.relative[run], pairs, assumed, graph)
            prepare(run, t, own, pairs, graph, rho, state)
            for _ in range(rounds):
                solve(run, t, pairs, graph, rho, state)
                agree(run, t, pairs, state)
            copy(own, cov[run, t], 9 * n)
            for k in range(n):
                store(x[run, t], k, add(load(x[run, t], k, VECTOR), load(state.z, k, VECTOR)))
    return x, cov


@part
def prepare(
    run: int, t: int, own: AnyArray, pairs: Pairs, graph: tuple[AnyArray, AnyArray], rho: float, state: Consensus
) -> None:
    """Inverses of the local problems; half of what a pair measured belongs to each of its vehicles."""
    state.z[:], state.own_dual[:], state.dual[:], state.holders[:] = 0.0, 0.0, 0.0, 1.0
    for n in range(len(state.holders)):
        if own[9 * n] > 0.0:
            information = inverse(load(own, n, MATRIX))
            store(state.outer, n, add_diagonal(information, (rho, rho, rho)))
    for k in range(pairs.start[t], pairs.start[t + 1]):
        if pairs.alive[run, k]:
            place = k - pairs.start[t]
            half = scale(load(graph[0], place, MATRIX), 0.5)
            inner = inverse(add_diagonal(half, (rho, rho, rho)))
            store(graph[0], place, half)
            store(graph[1], place, scale(load(graph[1], place, VECTOR), 0.5))
            store(state.inner, place, inner)
            for n in (pairs.first[k], pairs.second[k]):
                store(state.outer, n, subtract(load(state.outer, n, MATRIX), scale(minus_product(inner, half), rho)))
                state.holders[n] += 1.0
    for n in range(len(state.holders)):
        store(state.outer, n, inverse(load(state.outer, n, MATRIX)))


@part
def solve(run: int, t: int, pairs: Pairs, graph: tuple[AnyArray, AnyArray], rho: float, state: Consensus) -> None:
    """Each vehicle's copies y = argmin f_i(y) + rho / 2 sum_k |y_k - a_k|^2, with a_k = z_k - u_k."""
    for n in range(len(state.holders)):
        store(state.own, n, subtract(load(state.z, n, VECTOR), load(state.own_dual, n, VECTOR)))
    for k in range(pairs.start[t], pairs.start[t + 1]):
        if pairs.alive[run, k]:
            place, i, j = k - pairs.start[t], pairs.first[k], pairs.second[k]
            half, inner = load(graph[0], place, MATRIX), load(state.inner, place, MATRIX)
            for m, holder, of, sign in ((2 * place, i, j, 1.0), (2 * place + 1, j, i, -1.0)):
                wish = subtract(load(state.z, of, VECTOR), load(state.dual, m, VECTOR))
                eta = scale(load(graph[1], place, VECTOR), sign)
                more = apply(inner, subtract(apply(half, wish), eta))
                store(state.own, holder, add(load(state.own, holder, VECTOR), more))
    for n in range(len(state.holders)):
        store(state.own, n, scale(apply(load(state.outer, n, MATRIX), load(state.own, n, VECTOR)), rho))
    for k in range(pairs.start[t], pairs.start[t + 1]):
        if pairs.alive[run, k]:
            place, i, j = k - pairs.start[t], pairs.first[k], pairs.second[k]
            half, inner = load(graph[0], place, MATRIX), load(state.inner, place, MATRIX)
            for m, holder, of, sign in ((2 * place, i, j, 1.0), (2 * place + 1, j, i, -1.0)):
                wish = subtract(load(state.z, of, VECTOR), load(state.dual, m, VECTOR))
                eta = add(scale(load(graph[1], place, VECTOR), sign), scale(wish, rho))
                eta = subtract(eta, minus_apply(half, load(state.own, holder, VECTOR)))
                store(state.copy, m, apply(inner, eta))


@part
def agree(run: int, t: int, pairs: Pairs, state: Consensus) -> None:
    """z = mean over the holders of y + u, then u += y - z."""
    for n in range(len(state.holders)):
        store(state.z, n, add(load(state.own, n, VECTOR), load(state.own_dual, n, VECTOR)))
    for k in range(pairs.start[t], pairs.start[t + 1]):
        if pairs.alive[run, k]:
            place = k - pairs.start[t]
            for m, of in ((2 * place, pairs.second[k]), (2 * place + 1, pairs.first[k])):
                both = add(load(state.copy, m, VECTOR), load(state.dual, m, VECTOR))
                store(state.z, of, add(load(state.z, of, VECTOR), both))
    for n in range(len(state.holders)):
        z = scale(load(state.z, n, VECTOR), 1.0 / state.holders[n])
        store(state.z, n, z)
        dual = subtract(add(load(state.own_dual, n, VECTOR), load(state.own, n, VECTOR)), z)
        store(state.own_dual, n, dual)
    for k in range(pairs.start[t], pairs.start[t + 1]):
        if pairs.alive[run, k]:
            place = k - pairs.start[t]
            for m, of in ((2 * place, pairs.second[k]), (2 * place + 1, pairs.first[k])):
                rest = subtract(load(state.copy, m, VECTOR), load(state.z, of, VECTOR))
                store(state.dual, m, add(load(state.dual, m, VECTOR), rest))

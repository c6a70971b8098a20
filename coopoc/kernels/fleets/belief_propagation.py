"""Gaussian belief propagation of a whole fleet over a drive, one run after the other.

Messages of pair k are number 2k, to its first vehicle, and 2k + 1, to its second.
"""

from __future__ import annotations

import numpy as np

from ...arrays import AnyArray, Floats
from ..compiling.compile import compiled, part
from ..compiling.small import add, apply, inverse, load, minus_apply, minus_product, scale, store, subtract, transpose
from .fleet_graph import MATRIX, VECTOR, Assumed, Measured, Pairs, advance, copy, most_pairs, pair_at_agreement


@compiled
def follow(
    measured: Measured, pairs: Pairs, assumed: Assumed, rounds: int, damping: float, carry_belief: bool
) -> tuple[Floats, Floats]:
    """Positions (R, T, 3 N) m and covariances (R, T, 9 N) m^2 of all vehicles, NaN m where inactive.

    Args:
        measured: what the fleet measured.
        pairs: those that exchange messages.
        assumed: the noise model.
        rounds: of messages a step.
        damping: share of the old message in the new one.
        carry_belief: whether the belief's covariance goes on to the next step, or that of the vehicle's own filter.
    """
    runs, steps, vehicles = measured.active.shape
    x, cov = np.empty((runs, steps, 3 * vehicles)), np.zeros((runs, steps, 9 * vehicles))
    most, own, prior = most_pairs(pairs), np.zeros(9 * vehicles), np.zeros(9 * vehicles)
    graph = np.zeros(9 * most), np.zeros(3 * most)
    messages, beliefs = (np.zeros(18 * most), np.zeros(6 * most)), (np.zeros(9 * vehicles), np.zeros(3 * vehicles))
    for run in range(runs):
        for t in range(steps):
            advance(run, t, x[run], own, measured, assumed)
            linearise(run, t, x[run, t], own, measured.relative[run], pairs, assumed, graph)
            for n in range(vehicles):
                if measured.active[run, t, n]:
                    store(prior, n, inverse(load(own, n, MATRIX)))
            messages[0][:], messages[1][:] = 0.0, 0.0
            for _ in range(rounds):
                gather(run, t, prior, pairs, messages, beliefs)
                pass_messages(run, t, pairs, graph, damping, messages, beliefs)
            gather(run, t, prior, pairs, messages, beliefs)
            for n in range(vehicles):
                if measured.active[run, t, n]:
                    posterior = inverse(load(beliefs[0], n, MATRIX))
                    store(cov[run, t], n, posterior)
                    moved = add(load(x[run, t], n, VECTOR), apply(posterior, load(beliefs[1], n, VECTOR)))
                    store(x[run, t], n, moved)
            if carry_belief:
                copy(cov[run, t], own, len(own))
    return x, cov


@part
def linearise(
    run: int,
    t: int,
    x: AnyArray,
    own: AnyArray,
    relative: AnyArray,
    pairs: Pairs,
    assumed: Assumed,
    graph: tuple[AnyArray, AnyArray],
) -> None:
    """Information and information vectors of the step's pairs about x_second - x_first, at the beliefs."""
    for k in range(pairs.start[t], pairs.start[t + 1]):
        if pairs.alive[run, k]:
            i, j, place = pairs.first[k], pairs.second[k], k - pairs.start[t]
            vector = subtract(load(x, j, VECTOR), load(x, i, VECTOR))
            cov = add(load(own, i, MATRIX), load(own, j, MATRIX))
            information, eta = pair_at_agreement(vector, cov, k, pairs, relative, assumed)
            store(graph[0], place, information)
            store(graph[1], place, eta)


@part
def gather(
    run: int,
    t: int,
    prior: AnyArray,
    pairs: Pairs,
    messages: tuple[AnyArray, AnyArray],
    beliefs: tuple[AnyArray, AnyArray],
) -> None:
    """Prior and messages of each vehicle, summed."""
    copy(prior, beliefs[0], len(prior))
    beliefs[1][:] = 0.0
    for k in range(pairs.start[t], pairs.start[t + 1]):
        if pairs.alive[run, k]:
            place = 2 * (k - pairs.start[t])
            for n, m in ((pairs.first[k], place), (pairs.second[k], place + 1)):
                store(beliefs[0], n, add(load(beliefs[0], n, MATRIX), load(messages[0], m, MATRIX)))
                store(beliefs[1], n, add(load(beliefs[1], n, VECTOR), load(messages[1], m, VECTOR)))


@part
def pass_messages(
    run: int,
    t: int,
    pairs: Pairs,
    graph: tuple[AnyArray, AnyArray],
    damping: float,
    messages: tuple[AnyArray, AnyArray],
    beliefs: tuple[AnyArray, AnyArray],
) -> None:
    """Lambda_m = W (W + Lambda)^-1 Lambda and eta_m = W (W + Lambda)^-1 (eta - w) + w, with (eta, Lambda) the sender's
    belief less the receiver's last message."""
    for k in range(pairs.start[t], pairs.start[t + 1]):
        if pairs.alive[run, k]:
            place = k - pairs.start[t]
            w, e = load(graph[0], place, MATRIX), load(graph[1], place, VECTOR)
            old, old_eta = load(messages[0], 2 * place, MATRIX), load(messages[1], 2 * place, VECTOR)
            back, back_eta = load(messages[0], 2 * place + 1, MATRIX), load(messages[1], 2 * place + 1, VECTOR)
            for m, n, sign in ((2 * place, pairs.second[k], -1.0), (2 * place + 1, pairs.first[k], 1.0)):
                cavity, eta = (
                    subtract(load(beliefs[0], n, MATRIX), back),
                    subtract(load(beliefs[1], n, VECTOR), back_eta),
                )
                gain, one = inverse(add(w, cavity)), scale(e, sign)
                new = minus_product(w, minus_product(gain, cavity))
                new = scale(add(new, transpose(new)), 0.5 * (1.0 - damping))
                new_eta = add(minus_apply(w, minus_apply(gain, subtract(eta, one))), one)
                store(messages[0], m, add(scale(old, damping), new))
                store(messages[1], m, add(scale(old_eta, damping), scale(new_eta, 1.0 - damping)))
                old, old_eta, back, back_eta = back, back_eta, old, old_eta

"""Gaussian belief propagation of a whole fleet over a drive, one run after the other."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...arrays import Floats
from ..compiling.compile import compiled, part
from ..compiling.small import add, apply, inverse, load, minus_apply, minus_product, scale, store, subtract, transpose
from .graph import MATRIX, VECTOR, Assumed, Edges, Measured, Pairs, advance, copy, linearise


class Gaussians(NamedTuple):
    """Gaussians in information form, of vehicles or of edges.

    Attributes:
        matrix: (9 M) 1/m^2.
        vector: (3 M) 1/m.
    """

    matrix: Floats
    vector: Floats


@compiled
def run_filter(
    measured: Measured, pairs: Pairs, assumed: Assumed, edges: Edges, rounds: int, damping: float
) -> tuple[Floats, Floats]:
    """Positions (R, T, 3 N) m and covariances (R, T, 9 N) m^2 of all vehicles, NaN m where inactive.

    The covariance of the vehicle's own filter goes on to the next step.

    Args:
        measured: what the fleet measured.
        pairs: those that exchange messages.
        assumed: the noise model.
        edges: memory.
        rounds: of messages a step.
        damping: share of the old message in the new one.
    """
    runs, steps, vehicles = measured.active.shape
    x, cov = np.empty((runs, steps, 3 * vehicles)), np.zeros((runs, steps, 9 * vehicles))
    own, prior = np.zeros(9 * vehicles), np.zeros(9 * vehicles)
    messages = Gaussians(np.zeros(len(edges.information)), np.zeros(len(edges.eta)))
    beliefs = Gaussians(np.zeros(9 * vehicles), np.zeros(3 * vehicles))
    for run in range(runs):
        for t in range(steps):
            advance(run, t, x[run], own, measured, assumed)
            count = linearise(run, t, x[run, t], own, measured, pairs, assumed, edges)
            for n in range(vehicles):
                if measured.active[run, t, n]:
                    store(prior, n, inverse(load(own, n, MATRIX)))
            messages.matrix[:], messages.vector[:] = 0.0, 0.0
            for _ in range(rounds):
                sum_messages(count, edges, prior, messages, beliefs)
                pass_messages(count, edges, damping, messages, beliefs)
            sum_messages(count, edges, prior, messages, beliefs)
            for n in range(vehicles):
                if measured.active[run, t, n]:
                    posterior = inverse(load(beliefs.matrix, n, MATRIX))
                    store(cov[run, t], n, posterior)
                    moved = apply(posterior, load(beliefs.vector, n, VECTOR))
                    store(x[run, t], n, add(load(x[run, t], n, VECTOR), moved))
    return x, cov


@part
def sum_messages(count: int, edges: Edges, prior: Floats, messages: Gaussians, beliefs: Gaussians) -> None:
    """Belief of each vehicle: its prior and the messages to it, summed."""
    copy(prior, beliefs.matrix, len(prior))
    beliefs.vector[:] = 0.0
    for e in range(count):
        n = edges.head[e]
        store(beliefs.matrix, n, add(load(beliefs.matrix, n, MATRIX), load(messages.matrix, e, MATRIX)))
        store(beliefs.vector, n, add(load(beliefs.vector, n, VECTOR), load(messages.vector, e, VECTOR)))


@part
def pass_messages(count: int, edges: Edges, damping: float, messages: Gaussians, beliefs: Gaussians) -> None:
    """Lambda_m = W (W + Lambda)^-1 Lambda and eta_m = W (W + Lambda)^-1 (eta - w) + w, with (eta, Lambda) the sender's
    belief less the receiver's last message."""
    for e in range(0, count, 2):
        old, old_eta = load(messages.matrix, e, MATRIX), load(messages.vector, e, VECTOR)
        back, back_eta = load(messages.matrix, e + 1, MATRIX), load(messages.vector, e + 1, VECTOR)
        for m in (e, e + 1):
            w, pair_eta, sender = load(edges.information, m, MATRIX), load(edges.eta, m, VECTOR), edges.tail[m]
            cavity = subtract(load(beliefs.matrix, sender, MATRIX), back)
            eta = subtract(load(beliefs.vector, sender, VECTOR), back_eta)
            gain = inverse(add(w, cavity))
            new = minus_product(w, minus_product(gain, cavity))
            new = scale(add(new, transpose(new)), 0.5 * (1.0 - damping))
            new_eta = add(minus_apply(w, minus_apply(gain, subtract(eta, pair_eta))), pair_eta)
            store(messages.matrix, m, add(scale(old, damping), new))
            store(messages.vector, m, add(scale(old_eta, damping), scale(new_eta, 1.0 - damping)))
            old, old_eta, back, back_eta = back, back_eta, old, old_eta

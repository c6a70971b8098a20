"""Compiled training step of many GainNets: rollout, loss, its gradient and AdamW, a model after the other."""

from __future__ import annotations

import numpy as np

from coopoc.arrays import AnyArray, Bools, Floats, Ints
from coopoc.kernels.compile import compiled, part

from . import backward, forward
from .arithmetic import Index, aligned, lent
from .optimiser import advanced
from .tape import Net, Tape


@compiled
def descend(
    theta: Floats, rows: Ints, layers: Ints, places: AnyArray, gnss: Floats, velocity: Floats, truth: Floats,
    x0: Floats, dt: Floats, fields: Ints, delta_fields: Ints, sizes: tuple[int, int, int, int], slots: Index,
    gradient: Floats, losses: Floats, began: Floats, first: Floats, second: Floats, step: Index, rates: Floats,
    decay: float, l2: float, proximal: float, limit: float, finite: Bools, begin: Index, end: Index,
) -> None:  # fmt: skip
    """Losses (R,) m^2 and gradients (R, P) of the models `rows` of theta (S, P), and with step > 0 one of AdamW.

    A model is done with before the next one begins, so that its tape stays in the cache.

    Args:
        rows: (R,). gnss, velocity, truth: (T, R, B, 3) m, m/s, m. x0: (R, B, 3) m. dt: (T,) s. layers, places, fields,
            delta_fields, slots: as in `backward`. sizes: of the matrices, of the tape's memory that is kept and that is
            not, of the deltas'. began, first, second, rates, decay, l2, proximal, limit, finite: as in
            `optimiser.advance`. begin, end: of the rows to do.
    """
    lanes, turned, now = gnss.shape[2], layers[:, 2] > 0, np.zeros(2, np.int64)
    padded, kept = aligned(sizes[0], theta), aligned(sizes[1], theta)
    passing, waiting = aligned(sizes[2], theta), aligned(sizes[3], theta)
    ahead, behind = forward.scratch(lanes, theta), backward.scratch(lanes, sizes[0], theta)
    x = np.empty_like(gnss)
    for r in range(begin, end):
        at = rows[r]
        net = Net(lent(theta[at]), lent(padded), lent(layers), lent(turned), lent(places[0]))
        tape = Tape(lent(passing), lent(kept), lent(fields), lent(now), lanes)
        deltas = Tape(lent(waiting), lent(waiting), lent(delta_fields), lent(now), lanes)
        forward.follow(net, tape, gnss, velocity, x0, dt, x, r, 1, ahead)
        losses[r] = _scored(x, truth, r)
        backward.back(net, tape, deltas, gnss, x, r, slots, behind, places, gradient[r])
        if step > 0:
            finite[r] = advanced(net.theta, lent(gradient[r]), lent(began[at]), lent(first[at]), lent(second[at]),
                                 losses[r], step, rates[r], decay, l2, proximal, limit)  # fmt: skip


@part
def _scored(x: Floats, truth: Floats, r: Index) -> float:
    """Squared error m^2 of x[:, r], mean over time and lanes, sum over components; x becomes the gradient in x.

    Added in one order, so that a number does not depend on who is beside it.
    """
    share, total = 1.0 / (x.shape[0] * x.shape[2]), 0.0
    scale = x.dtype.type(2.0 * share)
    for t in range(x.shape[0]):
        for b in range(x.shape[2]):
            for i in range(3):
                error = x[t, r, b, i] - truth[t, r, b, i]
                x[t, r, b, i] = scale * error
                total += error * error
    return float(total * share)

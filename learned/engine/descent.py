"""Compiled training step of many GainNets: rollout, loss, its gradient and AdamW, one model after the other."""

from __future__ import annotations

import numpy as np

from coopoc.arrays import Floats
from coopoc.kernels.compiling.compile import compiled
from coopoc.learned.engine.arguments import Drives, Found, Matrices, Memory, Moments, Update

from . import backward, forward
from .arithmetic import ONE, ZERO, Index, aligned, borrowed, part
from .optimiser import advance_row
from .tape import Tape, net_of


@compiled
def descend(
    moments: Moments,
    matrices: Matrices,
    drives: Drives,
    target: Floats,
    memory: Memory,
    found: Found,
    update: Update,
    span: tuple[int, int],
) -> None:
    """Losses (R,) m^2 and gradients (R, P) of the models `update.rows`, and with step > 0 one step of AdamW.

    A model is finished before the next one begins, so that its tape stays in the cache.

    Args:
        moments: (S, P) weights and moments.
        matrices: layout of the nets.
        drives: of the R models.
        target: (T, R, B, 3) true positions m; with step -1 the gradient with respect to the estimates.
        memory: sizes of the memory.
        found: outputs.
        update: the optimiser step.
        span: first and last + 1 of the rows to compute.
    """
    theta, lanes, now = moments.theta, drives.gnss.shape[2], np.zeros(2, np.int64)
    padded, kept = aligned(memory.padded, theta), aligned(memory.kept, theta)
    passing, waiting = aligned(memory.passing, theta), aligned(memory.waiting, theta)
    ahead, behind = forward.scratch(lanes, theta), backward.scratch(lanes, memory.padded, theta)
    x = np.empty_like(drives.gnss)
    for r in range(span[0], span[1]):
        net = net_of(theta[update.rows[r]], padded, matrices, ZERO)
        tape = Tape(borrowed(passing), borrowed(kept), borrowed(memory.fields), borrowed(now), lanes)
        deltas = Tape(borrowed(waiting), borrowed(waiting), borrowed(memory.delta_fields), borrowed(now), lanes)
        forward.follow(net, tape, drives, x, r, ONE, ahead)
        if update.step < 0:
            _copy(x, target, r)
        else:
            found.losses[r] = _score(x, target, r)
        nets = backward.nets(net, matrices, behind, found.gradient[r])
        backward.back(nets, tape, deltas, drives.gnss, x, r, memory.slots, behind)
        if update.step > 0:
            advance_row(moments, found, update, r)


@part
def _copy(x: Floats, target: Floats, r: Index) -> None:
    """x[:, r] = target[:, r]; an assignment of slices would compile the text of its errors."""
    for t in range(x.shape[0]):
        for b in range(x.shape[2]):
            for i in range(3):
                x[t, r, b, i] = target[t, r, b, i]


@part
def _score(x: Floats, truth: Floats, r: Index) -> float:
    """Squared error m^2 of x[:, r], mean over the steps with a truth, then over lanes, sum over components; x becomes
    its gradient in x, 0 where the truth is not known (NaN).

    Summed in one order, so that a result does not depend on the other models.
    """
    total = 0.0
    for b in range(x.shape[2]):
        known, squares = 0, 0.0
        for t in range(x.shape[0]):
            known += not np.isnan(truth[t, r, b, 0])
        share = 1.0 / (max(known, 1) * x.shape[2])
        scale = x.dtype.type(2.0 * share)
        for t in range(x.shape[0]):
            for i in range(3):
                error = x[t, r, b, i] - truth[t, r, b, i]
                if np.isnan(truth[t, r, b, i]):
                    error = x.dtype.type(0.0)
                x[t, r, b, i] = scale * error
                squares += error * error
        total += share * squares
    return float(total)

"""Compiled training step of GainNets: rollout, loss, backpropagation through time; AdamW, which serves any nets."""

from typing import Any, NamedTuple

import numpy as np

from coopoc.arrays import Bools, Floats, Ints
from coopoc.kernels.compiling.compile import compiled, part, summing

from .forward import Drives, State, follow, missing, new_state
from .layers import (
    CELLS,
    FROM_H,
    FROM_X,
    GATES,
    PAD,
    SHORTEST_LENGTH,
    Net,
    Plan,
    aligned,
    backward_layer,
    collect,
    new_net,
    pack,
    unpack,
)
from .tile import Index, Indices, apart


class Moments(NamedTuple):
    """Weights, mean gradient and mean squared gradient, each (S, P)."""

    theta: Floats
    first: Floats
    second: Floats


class Update(NamedTuple):
    """An optimiser step of the models `rows` (R,): its number, learning rates (R,), decoupled decay, clip.

    Step 0 computes losses and gradients only.
    """

    rows: Ints
    step: int
    rates: Floats
    decay: float
    limit: float


class Outcome(NamedTuple):
    """Outputs of a step: gradients (R, P), losses (R,), whether both are finite (R,)."""

    gradient: Floats
    losses: Floats
    finite: Bools


@compiled
def advance(moments: Moments, outcome: Outcome, update: Update) -> None:
    """Change weights and moments (S, P) of the rows (R,) in place by their gradients (R, P): clipped, then AdamW.

    Where loss or gradient is not finite, `outcome.finite` becomes false and nothing is changed.
    """
    for r in range(len(update.rows)):
        advance_row(moments, outcome, update, r)


@part
def advance_row(moments: Moments, outcome: Outcome, update: Update, r: int) -> None:
    """`advance` of row r.

    References:
        Loshchilov and Hutter, ICLR 2019, algorithm 2.
    """
    at, gradient = update.rows[r], outcome.gradient[r]
    theta, first, second = moments.theta[at], moments.first[at], moments.second[at]
    real = theta.dtype.type
    square = squared_norm(gradient)
    outcome.finite[r] = np.isfinite(outcome.losses[r]) and not np.isnan(square)
    if not outcome.finite[r]:
        return
    scale = min(real(update.limit) / (np.sqrt(square) + real(1e-6)), real(1.0))
    keep = real(1.0 - update.rates[r] * update.decay)
    rate, size = real(-update.rates[r] / (1.0 - 0.9**update.step)), real(1.0 / (1.0 - 0.999**update.step))
    for i in range(len(theta)):
        g = scale * gradient[i]
        first[i] += real(0.1) * (g - first[i])
        second[i] += real(0.001) * (g * g - second[i])
        theta[i] = keep * theta[i] + rate * first[i] / (np.sqrt(size * second[i]) + real(1e-8))


@summing
def squared_norm(gradient: Floats) -> Any:
    """Squared norm of a gradient, NaN if it is not finite."""
    real = gradient.dtype.type
    square = poisoned = real(0.0)
    for i in range(len(gradient)):
        square += gradient[i] * gradient[i]
        poisoned += gradient[i] * real(0.0)  # NaN of NaN and of infinity
    return square + poisoned


DRIVES_AT_ONCE = 4
"""Drives of which one tape holds all steps: so few that the second cache holds it."""
PRODUCT = 64
"""Rows of the tape whose gradients are added to those of the weights at once: so few that the cache holds them."""


@compiled
def descend(moments: Moments, plan: Plan, drives: Drives, truth: Floats, outcome: Outcome, update: Update) -> None:
    """Losses (R,) m^2 and gradients (R, P) of the models `update.rows`, and with step > 0 one step of AdamW.

    Args:
        moments: (S, P) weights and moments.
        plan: layers and tape of the nets.
        drives: of the R models.
        truth: (T, R, B, 3) positions m.
        outcome: losses and gradients, written here.
        update: the optimiser step.
    """
    theta, (steps, _, lanes, _) = moments.theta, drives.gnss.shape
    net, total, one = new_net(plan, theta), new_net(plan, theta), np.ones(1, theta.dtype)
    most = min(DRIVES_AT_ONCE, lanes)
    together = min(steps, max(1, PRODUCT // most))
    tape = aligned(steps * most, plan.width, theta)
    gradient = aligned(together * most, plan.width, theta)
    x, state, adjoint = np.empty_like(drives.gnss), new_state(most, theta), new_state(most, theta)
    for r in range(len(update.rows)):
        unpack(theta[update.rows[r]], net)
        total.matrices[:] = 0.0
        loss = 0.0
        for first in range(0, lanes, most):
            rows = (r, first, min(most, lanes - first))
            follow(net, tape, drives, x, rows, state, 1)
            for lane in range(first, first + rows[2]):
                loss += score(x, truth, r, lane)
            for field in adjoint:
                field[:] = 0.0
            for end in range(steps, 0, -together):
                begin = max(0, end - together)
                part_of_tape = tape[begin * rows[2] : end * rows[2]]
                back(net, part_of_tape, gradient, drives.gnss[:end], x, begin, rows, adjoint)
                collect(total, part_of_tape, gradient, one)
        pack(total, outcome.gradient[r])
        outcome.losses[r] = loss
        if update.step > 0:
            advance_row(moments, outcome, update, r)


@part
def score(x: Floats, truth: Floats, r: Index, lane: Index) -> float:
    """Squared error m^2 of a drive, sum over components, mean over the steps with a truth, over the number of drives; x
    becomes its gradient in x, 0 where there is no truth (NaN)."""
    measured, squares, zero = 0, 0.0, x.dtype.type(0.0)
    for t in range(x.shape[0]):
        measured += not np.isnan(truth[t, r, lane, 0])
    share = 1.0 / (max(measured, 1) * x.shape[2])
    scale = x.dtype.type(2.0 * share)
    for t in range(x.shape[0]):
        for i in range(3):
            error = zero if np.isnan(truth[t, r, lane, i]) else x[t, r, lane, i] - truth[t, r, lane, i]
            x[t, r, lane, i] = scale * error
            squares += float(error * error)
    return float(share * squares)


@part
def back(
    net: Net,
    tape: Floats,
    gradient: Floats,
    gnss: Floats,
    adjoints: Floats,
    begin: Index,
    rows: Indices,
    adjoint: State,
) -> None:
    """The gradient of the tape, zero before, from that of the estimates (T, S, B, 3); `rows` as in `forward.follow`.

    Tape and gradient hold the steps from `begin` to the last of gnss; `adjoint` is the gradient in the state after
    that, and becomes that before `begin`.
    """
    s, first, lanes = rows
    for t in range(len(gnss) - 1, begin - 1, -1):
        row = (t - begin) * lanes
        for lane in range(lanes):
            for i in range(3):
                adjoint.x[lane, i] += adjoints[t, s, first + lane, i]
            gone = missing(gnss, (t, s, first + lane))
            correct_back(net, tape[row + lane], gradient[row + lane], adjoint, lane, gone)
        infer_back(net, tape, gradient, row, lanes)
        for lane in range(lanes):
            if missing(gnss, (t, s, first + lane)):
                for i in range(3):
                    adjoint.x[lane, i] += adjoint.x_before[lane, i]
                    adjoint.x_before[lane, i] = 0.0
            else:
                features_back(net, tape[row + lane], gradient[row + lane], adjoint, lane)


@part
def correct_back(net: Net, tape: Floats, gradient: Floats, adjoint: State, lane: Index, gone: bool) -> None:
    """`forward.correct` backwards: the gradient of gain, innovation and new states; without a fix it is zero."""
    columns, zero = net.columns, tape.dtype.type(0.0)
    gain, residual = columns.gain, columns.residual
    process, innovation, posterior = columns.process, columns.innovation, columns.posterior
    for j in range(3):
        gradient[residual + j] = zero
        for i in range(3):
            along = zero if gone else adjoint.x[lane, i]
            gradient[gain + 3 * i + j] = along * tape[residual + j]
            gradient[residual + j] += along * tape[gain + 3 * i + j]
    gradient[columns.evolved : columns.prior_old] = zero
    for j in range(CELLS):
        gradient[process + j] = zero if gone else adjoint.process[lane, j]
        gradient[innovation + j] = zero if gone else adjoint.innovation[lane, j]
        gradient[posterior + j] = zero if gone else adjoint.prior[lane, j]


@part
def infer_back(net: Net, tape: Floats, gradient: Floats, row: Index, lanes: Index) -> None:
    """`forward.infer` backwards: from the gradient of gain, posterior and states to that of changes and old states."""
    columns, last = net.columns, len(net.layers) - 1
    for layer in range(last, -1, -1):
        old, new = net.layers[layer, 9], net.layers[layer, 10]
        if new > 0:
            for lane in range(row, row + lanes):
                unit = gradient[lane, old : old + GATES]
                blend_back(tape[lane, old : old + 8 * PAD], gradient[lane, new : new + CELLS], unit)
        backward_layer(net, layer, tape, gradient, row, lanes)
        if layer == last:
            for lane in range(row, row + lanes):
                for j in range(CELLS):
                    gradient[lane, columns.prior + j] = gradient[lane, columns.prior_copy + j]


@part
def blend_back(unit: Floats, after: Floats, gradient: Floats) -> None:
    """`forward.blend` backwards, with the gradient of the new state."""
    apart()
    one = unit.dtype.type(1.0)
    for j in range(CELLS):
        reset, keep, fresh = unit[GATES + j], unit[GATES + PAD + j], unit[GATES + 2 * PAD + j]
        candidate = after[j] * (one - keep) * (one - fresh * fresh)
        opened = candidate * unit[FROM_H + 2 * CELLS + j] * reset * (one - reset)
        kept = after[j] * (unit[j] - fresh) * keep * (one - keep)
        gradient[j] = after[j] * keep
        gradient[FROM_X + j] = gradient[FROM_H + j] = opened
        gradient[FROM_X + CELLS + j] = gradient[FROM_H + CELLS + j] = kept
        gradient[FROM_X + 2 * CELLS + j], gradient[FROM_H + 2 * CELLS + j] = candidate, candidate * reset


@part
def features_back(net: Net, tape: Floats, gradient: Floats, adjoint: State, lane: Index) -> None:
    """`forward.features` backwards, and `adjoint` of the state of a lane before the step."""
    real, at, columns = tape.dtype.type, net.columns.changes, net.columns
    residual, lengths = columns.residual, columns.lengths
    for change in range(1, 4):
        c = at + 3 * change
        u, v, w, p, q, r = tape[c], tape[c + 1], tape[c + 2], gradient[c], gradient[c + 1], gradient[c + 2]
        length, along = tape[lengths + change], u * p + v * q + w * r
        scale = real(0.0) if length <= real(SHORTEST_LENGTH) else real(1.0) / length
        gradient[c], gradient[c + 1], gradient[c + 2] = (
            (p - u * along) * scale,
            (q - v * along) * scale,
            (r - w * along) * scale,
        )
    for i in range(3):
        evolved, updated = gradient[at + 6 + i], gradient[at + 9 + i]
        in_residual = gradient[residual + i] + gradient[at + 3 + i]
        adjoint.x[lane, i] += adjoint.prior_before[lane, i] + adjoint.x_before[lane, i]
        adjoint.x[lane, i] += evolved + updated - in_residual
        adjoint.x_before[lane, i], adjoint.prior_before[lane, i] = -evolved, -updated
    process, prior, innovation = columns.process_old, columns.prior_old, columns.innovation_old
    for j in range(CELLS):
        adjoint.process[lane, j], adjoint.prior[lane, j] = gradient[process + j], gradient[prior + j]
        adjoint.innovation[lane, j] = gradient[innovation + j]

"""Compiled training step of GainNets: rollout, loss, backpropagation through time and AdamW."""

from __future__ import annotations

import numpy as np

from coopoc.arrays import Floats
from coopoc.kernels.compiling.compile import compiled, part, storage
from coopoc.learned.engine import layers as on
from coopoc.learned.engine.forward import Drives, State, follow, missing, new_state
from coopoc.learned.engine.layers import (
    CELLS,
    LANES,
    PAD,
    SHORTEST,
    Index,
    Net,
    Plan,
    backward_layer,
    columns_of,
    unpack,
)
from coopoc.learned.engine.optimiser import Found, Moments, Update, advance_row


@compiled
def descend(moments: Moments, plan: Plan, drives: Drives, target: Floats, found: Found, update: Update) -> None:
    """Losses (R,) m^2 and gradients (R, P) of the models `update.rows`, and with step > 0 one step of AdamW.

    Args:
        moments: (S, P) weights and moments.
        plan: layers and tape of the nets.
        drives: of the R models.
        target: (T, R, B, 3) true positions m; with step -1 the gradient with respect to the estimates.
        found: outputs.
        update: the optimiser step.
    """
    theta, (steps, _, lanes, _) = moments.theta, drives.gnss.shape
    net = Net(np.empty(plan.parameters, theta.dtype), plan.layers, plan.columns)
    most = min(LANES, lanes)
    tape, gradient = (
        np.zeros((steps * most, plan.width), theta.dtype),
        np.zeros((steps * most, plan.width), theta.dtype),
    )
    x, state, adjoint = np.empty_like(drives.gnss), new_state(theta), new_state(theta)
    for r in range(len(update.rows)):
        unpack(theta[update.rows[r]], net)
        found.gradient[r] = 0.0
        loss = 0.0
        for first in range(0, lanes, LANES):
            rows = (r, first, min(LANES, lanes - first))
            follow(net, tape, drives, x, rows, state, 1)
            for lane in range(first, first + rows[2]):
                if update.step < 0:
                    for t in range(steps):
                        for i in range(3):
                            x[t, r, lane, i] = target[t, r, lane, i]
                else:
                    loss += score(x, target, r, lane)
            gradient[:] = 0.0
            back(net, tape, gradient, drives.gnss, x, rows, adjoint)
            collect(net, tape[: steps * rows[2]], gradient, found.gradient[r])
        found.losses[r] = loss
        if update.step > 0:
            advance_row(moments, found, update, r)


@part
def score(x: Floats, truth: Floats, r: Index, lane: Index) -> float:
    """Squared error m^2 of a drive, sum over components, mean over the steps with a truth, over the number of drives; x
    becomes its gradient in x, 0 where the truth is not known (NaN)."""
    known, squares, zero = 0, 0.0, x.dtype.type(0.0)
    for t in range(x.shape[0]):
        known += not np.isnan(truth[t, r, lane, 0])
    share = 1.0 / (max(known, 1) * x.shape[2])
    scale = x.dtype.type(2.0 * share)
    for t in range(x.shape[0]):
        for i in range(3):
            error = zero if np.isnan(truth[t, r, lane, i]) else x[t, r, lane, i] - truth[t, r, lane, i]
            x[t, r, lane, i] = scale * error
            squares += float(error * error)
    return float(share * squares)


@storage
def collect(net: Net, tape: Floats, gradient: Floats, total: Floats) -> None:
    """Add to the gradient (P,) of the weights that of every layer: dW = dy^T x and db = dy, summed over the steps."""
    steps = len(tape)
    for layer in range(len(net.layers)):
        weight, bias, outputs, inputs, _, source, to, _ = columns_of(net, layer)
        dy, x = np.empty((steps, outputs), tape.dtype), np.empty((steps, inputs), tape.dtype)
        copy(gradient, to, dy)
        copy(tape, source, x)
        accumulate(np.dot(dy.T, x).reshape(-1), total[weight : weight + outputs * inputs])
        for t in range(steps):
            accumulate(dy[t], total[bias : bias + outputs])


@part
def copy(source: Floats, first: Index, target: Floats) -> None:
    """Columns (T, n) of an array from `first` on."""
    for t in range(len(target)):
        row, into = source[t, first : first + target.shape[1]], target[t]
        for j in range(len(into)):
            into[j] = row[j]


@part
def accumulate(values: Floats, total: Floats) -> None:
    """total (n,) += values (n,)."""
    for i in range(len(total)):
        total[i] += values[i]


@part
def back(
    net: Net,
    tape: Floats,
    gradient: Floats,
    gnss: Floats,
    adjoints: Floats,
    rows: tuple[Index, Index, Index],
    adjoint: State,
) -> None:
    """The gradient of the tape, zero before, from that of the estimates (T, S, B, 3); `rows` as in `forward.follow`.

    `adjoint` is memory for the gradient with respect to the state after a step.
    """
    s, first, lanes = rows
    for lane in range(lanes):
        for j in range(CELLS):
            adjoint.process[lane, j] = adjoint.prior[lane, j] = adjoint.innovation[lane, j] = 0.0
        for i in range(3):
            adjoint.x[lane, i] = adjoint.x_before[lane, i] = adjoint.prior_before[lane, i] = 0.0
    for t in range(len(gnss) - 1, -1, -1):
        row = t * lanes
        for lane in range(lanes):
            for i in range(3):
                adjoint.x[lane, i] += adjoints[t, s, first + lane, i]
            if not missing(gnss, (t, s, first + lane)):
                move_back(net, tape[row + lane], gradient[row + lane], adjoint, lane)
        think_back(net, tape, gradient, row, lanes)
        for lane in range(lanes):
            if missing(gnss, (t, s, first + lane)):
                for i in range(3):
                    adjoint.x[lane, i] += adjoint.x_before[lane, i]
                    adjoint.x_before[lane, i] = 0.0
            else:
                look_back(net, tape[row + lane], gradient[row + lane], adjoint, lane)


@part
def move_back(net: Net, tape: Floats, gradient: Floats, adjoint: State, lane: Index) -> None:
    """`forward.move` backwards: the gradient of gain, innovation and new states of a lane."""
    columns = net.columns
    gain, residual = columns[on.GAIN], columns[on.RESIDUAL]
    process, innovation, posterior = columns[on.PROCESS], columns[on.INNOVATION], columns[on.POSTERIOR]
    for i in range(3):
        for j in range(3):
            gradient[gain + 3 * i + j] = adjoint.x[lane, i] * tape[residual + j]
            gradient[residual + j] += adjoint.x[lane, i] * tape[gain + 3 * i + j]
    for j in range(CELLS):
        gradient[process + j], gradient[innovation + j] = adjoint.process[lane, j], adjoint.innovation[lane, j]
        gradient[posterior + j] = adjoint.prior[lane, j]


@part
def think_back(net: Net, tape: Floats, gradient: Floats, row: Index, lanes: Index) -> None:
    """`forward.think` backwards: from the gradient of gain, posterior and states to that of changes and old states."""
    prior, copy = net.columns[on.PRIOR], net.columns[on.PRIOR_COPY]
    backward_layer(net, on.L_POSTERIOR, tape, gradient, row, lanes)
    for lane in range(row, row + lanes):
        for j in range(CELLS):
            gradient[lane, prior + j] = gradient[lane, copy + j]
    backward_layer(net, on.L_BACK, tape, gradient, row, lanes)
    backward_layer(net, on.L_GAIN, tape, gradient, row, lanes)
    backward_layer(net, on.L_HIDDEN, tape, gradient, row, lanes)
    gru_back(net, on.L_INNOVATION_X, on.INNOVATION_OLD, on.INNOVATION, tape, gradient, row, lanes)
    backward_layer(net, on.L_OBSERVATION, tape, gradient, row, lanes)
    backward_layer(net, on.L_EXPECTED, tape, gradient, row, lanes)
    gru_back(net, on.L_PRIOR_X, on.PRIOR_OLD, on.PRIOR, tape, gradient, row, lanes)
    backward_layer(net, on.L_EVOLUTION, tape, gradient, row, lanes)
    gru_back(net, on.L_PROCESS_X, on.PROCESS_OLD, on.PROCESS, tape, gradient, row, lanes)
    backward_layer(net, on.L_UPDATE, tape, gradient, row, lanes)


@part
def gru_back(
    net: Net, layer: Index, field: Index, to: Index, tape: Floats, gradient: Floats, row: Index, lanes: Index
) -> None:
    """`forward.gru` backwards."""
    old, x, h = net.columns[field], net.columns[field + 1], net.columns[field + 2]
    gates, new, one = net.columns[field + 3], net.columns[to], tape.dtype.type(1.0)
    for lane in range(row, row + lanes):
        gate, after = tape[lane, gates : gates + 3 * PAD], gradient[lane, new : new + CELLS]
        before, kept = tape[lane, old : old + CELLS], tape[lane, h + 2 * CELLS : h + 3 * CELLS]
        in_x, in_h = gradient[lane, x : x + 3 * CELLS], gradient[lane, h : h + 3 * CELLS]
        in_old = gradient[lane, old : old + CELLS]
        for j in range(CELLS):
            reset, keep, fresh = gate[j], gate[PAD + j], gate[2 * PAD + j]
            candidate = after[j] * (one - keep) * (one - fresh * fresh)
            in_x[j] = in_h[j] = candidate * kept[j] * reset * (one - reset)
            in_x[CELLS + j] = in_h[CELLS + j] = after[j] * (before[j] - fresh) * keep * (one - keep)
            in_x[2 * CELLS + j], in_h[2 * CELLS + j] = candidate, candidate * reset
            in_old[j] = after[j] * keep
    backward_layer(net, layer, tape, gradient, row, lanes)
    backward_layer(net, layer + 1, tape, gradient, row, lanes)


@part
def look_back(net: Net, tape: Floats, gradient: Floats, adjoint: State, lane: Index) -> None:
    """`forward.look` backwards, and `adjoint` of the state of a lane before the step."""
    real, at, columns = tape.dtype.type, net.columns[on.CHANGES], net.columns
    residual, lengths = columns[on.RESIDUAL], columns[on.LENGTHS]
    for change in range(1, 4):
        c = at + 3 * change
        u, v, w, p, q, r = tape[c], tape[c + 1], tape[c + 2], gradient[c], gradient[c + 1], gradient[c + 2]
        length, along = tape[lengths + change], u * p + v * q + w * r
        scale = real(0.0) if length <= real(SHORTEST) else real(1.0) / length
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
    process, prior, innovation = columns[on.PROCESS_OLD], columns[on.PRIOR_OLD], columns[on.INNOVATION_OLD]
    for j in range(CELLS):
        adjoint.process[lane, j], adjoint.prior[lane, j] = gradient[process + j], gradient[prior + j]
        adjoint.innovation[lane, j] = gradient[innovation + j]

"""Compiled backpropagation through time of GainNets, from the tape that `kernel_forward` leaves."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from coopoc.arrays import Floats, Ints

from .arithmetic import Net, Tape, add_product, bias, compiled, rows, span, weight
from .forward import (
    BACK,
    EPS,
    EVOLUTION,
    EXPECTED,
    FLOOR,
    GAIN,
    HIDDEN,
    INNOVATION_GATES,
    INNOVATION_X,
    LENGTHS,
    OBSERVATION,
    POSTERIOR,
    POSTERIOR_OUT,
    PRIOR_GATES,
    PRIOR_X,
    PROCESS_GATES,
    PROCESS_X,
    SURPRISE,
    UPDATE,
    missing,
)  # fmt: skip


class Pull(NamedTuple):
    """Gradient with respect to the state after a step (`State` of the forward pass), changed in place."""

    process: Floats
    prior: Floats
    innovation: Floats
    x: Floats
    x_before: Floats
    prior_before: Floats


@compiled
def backward(
    theta: Floats, layers: Ints, gnss: Floats, pulls: Floats, memory: Floats, fields: Ints, deltas: Floats,
    delta_fields: Ints, gradient: Floats, first: int, last: int,
) -> None:  # fmt: skip
    """Gradient (S, P) of the models first..last - 1 from that of their estimates, `pulls` (T, S, B, 3).

    The gradients of the layers' outputs wait in `deltas` (S, size), a tape with room for a few steps; when it is full,
    the gradient of each weight grows by one product over all its rows.

    Args:
        theta: (S, P). layers: as in `Net`. gnss: (T, S, B, 3). memory, fields: the tape, as in `Tape`.
    """
    room = delta_fields[0, 2]
    for s in range(first, last):
        net, made = Net(theta[s], theta[s], layers), Net(gradient[s], gradient[s], layers)
        tape, waiting = Tape(memory[s], fields, gnss.shape[2]), Tape(deltas[s], delta_fields, gnss.shape[2])
        work = np.empty(3 * gnss.shape[2] * layers[:, 3].max(), theta.dtype)
        pull, gradient[s] = _nothing(gnss.shape[2], theta), 0.0
        for t in range(len(pulls) - 1, -1, -1):
            pull.x[:] += pulls[t, s]
            _step(net, gnss[t, s], pull, tape, waiting, t, work)
            if t % room == 0:
                _collect(made, tape, waiting, t, min(room, len(pulls) - t))


@compiled
def _nothing(lanes: int, like: Floats) -> Pull:
    """No gradient yet."""
    grus, positions = np.zeros((3, lanes, 9), like.dtype), np.zeros((3, lanes, 3), like.dtype)
    return Pull(grus[0], grus[1], grus[2], positions[0], positions[1], positions[2])


@compiled
def _collect(gradient: Net, tape: Tape, deltas: Tape, t: int, count: int) -> None:
    """Add what the steps t..t + count - 1 contribute to the gradient of every weight and bias."""
    for name in range(len(gradient.layers)):
        delta = span(deltas, name, 0, count)
        add_product(delta.T, span(tape, name, t, count), weight(gradient, name))
        constant = bias(gradient, name)
        for row in range(delta.shape[0]):
            for j in range(delta.shape[1]):
                constant[j] += delta[row, j]


@compiled
def _step(net: Net, gnss: Floats, pull: Pull, tape: Tape, deltas: Tape, t: int, work: Floats) -> None:
    """Back over step t: `pull` becomes the gradient with respect to the state before it."""
    surprise, back_in, posterior_in = rows(tape, SURPRISE, t), rows(tape, BACK, t), rows(tape, POSTERIOR, t)
    seen, moved = rows(tape, INNOVATION_X, t), rows(tape, PRIOR_X, t)
    lanes, gain = tape.lanes, rows(deltas, GAIN, t)
    grus, in_surprise = np.zeros((4, lanes, 9), work.dtype), np.zeros((lanes, 3), work.dtype)
    process, prior, innovation, posterior = grus[0], grus[1], grus[2], grus[3]
    for b in range(lanes):
        gone = missing(gnss, b)
        for j in range(9):
            gain[b, j] = 0.0 if gone else pull.x[b, j // 3] * surprise[b, j % 3]
        if not gone:
            for j in range(9):
                process[b, j], posterior[b, j] = pull.process[b, j], pull.prior[b, j]
                innovation[b, j] = pull.innovation[b, j]
                in_surprise[b, j % 3] += back_in[b, 9 + j] * pull.x[b, j // 3]

    _active(posterior, 0, rows(tape, POSTERIOR_OUT, t), 0, rows(deltas, POSTERIOR, t))
    both = _through(net, POSTERIOR, deltas, t, work)
    _add(both, 0, prior)
    _active(both, 9, posterior_in, 9, rows(deltas, BACK, t))
    both = _through(net, BACK, deltas, t, work)
    _add(both, 0, innovation)
    _add(both, 9, gain)
    _active(_through(net, GAIN, deltas, t, work), 0, rows(tape, GAIN, t), 0, rows(deltas, HIDDEN, t))
    both = _through(net, HIDDEN, deltas, t, work)
    _add(both, 0, prior)
    _add(both, 9, innovation)

    given = _gru(net, INNOVATION_X, INNOVATION_GATES, innovation, tape, deltas, t, work)
    _active(given, 0, seen, 0, rows(deltas, EXPECTED, t))
    _active(given, 9, seen, 9, rows(deltas, OBSERVATION, t))
    _add(_through(net, EXPECTED, deltas, t, work), 0, prior)
    given = _gru(net, PRIOR_X, PRIOR_GATES, prior, tape, deltas, t, work)
    _add(given, 0, process)
    _active(given, 9, moved, 9, rows(deltas, EVOLUTION, t))
    given = _gru(net, PROCESS_X, PROCESS_GATES, process, tape, deltas, t, work)
    _active(given, 0, rows(tape, PROCESS_X, t), 0, rows(deltas, UPDATE, t))

    observed, evolved, updated = rows(tape, OBSERVATION, t), rows(tape, EVOLUTION, t), rows(tape, UPDATE, t)
    lengths = rows(tape, LENGTHS, t)
    out = _through(net, OBSERVATION, deltas, t, work)
    _turn(out, 3, observed, lengths, 1, 7)
    for b in range(lanes):
        for i in range(3):
            in_surprise[b, i] += out[b, 3 + i]
    in_evolution = _through(net, EVOLUTION, deltas, t, work)
    _turn(in_evolution, 0, evolved, lengths, 2, 3)
    in_update = _through(net, UPDATE, deltas, t, work[in_evolution.size :])
    _turn(in_update, 0, updated, lengths, 3, 3)
    for b in range(lanes):
        gone = missing(gnss, b)
        for i in range(3):
            if gone:
                pull.x[b, i] += pull.x_before[b, i]
                pull.x_before[b, i] = 0.0
            else:
                pull.x[b, i] += (
                    pull.prior_before[b, i] - in_surprise[b, i] + pull.x_before[b, i]
                    + in_evolution[b, i] + in_update[b, i]
                )
                pull.x_before[b, i], pull.prior_before[b, i] = -in_evolution[b, i], -in_update[b, i]
        if not gone:
            for j in range(9):
                pull.process[b, j], pull.prior[b, j] = process[b, j], prior[b, j]
                pull.innovation[b, j] = innovation[b, j]


@compiled
def _through(net: Net, name: int, deltas: Tape, t: int, work: Floats) -> Floats:
    """Gradient (B, inputs) of what a layer reads, in the memory `work`."""
    weights = weight(net, name)
    out = work[: deltas.lanes * weights.shape[1]].reshape(deltas.lanes, weights.shape[1])
    out[:] = 0.0
    add_product(rows(deltas, name, t), weights, out)
    return out


@compiled
def _active(values: Floats, at: int, reached: Floats, column: int, out: Floats) -> None:
    """out (B, n) = the columns of values from `at` on where those of `reached` from `column` on are positive, or 0."""
    zero = values.dtype.type(0.0)
    for b in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[b, j] = values[b, at + j] if reached[b, column + j] > zero else zero


@compiled
def _add(values: Floats, at: int, out: Floats) -> None:
    """out (B, n) += the columns of values from `at` on."""
    for b in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[b, j] += values[b, at + j]


@compiled
def _gru(
    net: Net, name: int, gates_name: int, after: Floats, tape: Tape, deltas: Tape, t: int, work: Floats
) -> Floats:
    """Gradient of a GRU's input, in `work`; `after` (B, 9), that of its new state, becomes that of its old one."""
    one = work.dtype.type(1.0)
    before, gates = rows(tape, name + 1, t), rows(tape, gates_name, t)
    given, kept = rows(deltas, name, t), rows(deltas, name + 1, t)
    for b in range(tape.lanes):
        for j in range(9):
            reset, keep, fresh = gates[b, j], gates[b, 9 + j], gates[b, 18 + j]
            in_fresh = after[b, j] * (one - keep) * (one - fresh * fresh)
            given[b, j] = kept[b, j] = in_fresh * gates[b, 27 + j] * reset * (one - reset)
            given[b, 9 + j] = kept[b, 9 + j] = after[b, j] * (before[b, j] - fresh) * keep * (one - keep)
            given[b, 18 + j], kept[b, 18 + j] = in_fresh, in_fresh * reset
            after[b, j] *= keep
    _add(_through(net, name + 1, deltas, t, work), 0, after)
    return _through(net, name, deltas, t, work)


@compiled
def _turn(values: Floats, at: int, features: Floats, lengths: Floats, which: int, log: int) -> None:
    """Gradient of a direction in values[:, at : at + 3], and of its length's logarithm, into that of the vector."""
    real = values.dtype.type
    for b in range(values.shape[0]):
        length, along = lengths[b, which], real(0.0)
        for i in range(3):
            along += features[b, at + i] * values[b, at + i]
        scale = real(0.0) if length <= real(EPS) else real(1.0) / length
        in_length = values[b, log] / (length + real(FLOOR)) if values.shape[1] > log else real(0.0)
        for i in range(3):
            unit = features[b, at + i]
            values[b, at + i] = (values[b, at + i] - unit * along) * scale + unit * in_length

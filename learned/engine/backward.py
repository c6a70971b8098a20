"""Compiled backpropagation through time of GainNets, from the tape of `forward.follow`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from coopoc.arrays import Floats
from coopoc.learned.engine.arguments import Matrices

from . import places as on
from .arithmetic import ONE, PAD, THREE, TWO, ZERO, Index, aligned, borrowed, carry, inside, part, window
from .forward import blend, layer, missing
from .places import LOG_FLOOR, SHORTEST
from .product import add_outer, add_product, dots, gated_product
from .tape import Net, Nets, Tape, bias, matrix, net_of, pack, rows, span, unpack


class Adjoint(NamedTuple):
    """Gradient with respect to the state after a step (`State` of the forward pass), changed in place."""

    process: Floats
    prior: Floats
    innovation: Floats
    x: Floats
    x_before: Floats
    prior_before: Floats


class Inner(NamedTuple):
    """Gradients within a step: new GRU states (B, PAD), innovation, inputs of the first layers; and a GRU's gates."""

    process: Floats
    prior: Floats
    innovation: Floats
    residual: Floats
    observed: Floats
    evolved: Floats
    updated: Floats
    gates: Floats


class Scratch(NamedTuple):
    """Memory of a backward pass: untransposed matrices, all gradients, those within a step, those of positions."""

    straight: Floats
    grown: Floats
    inner: Floats
    positions: Floats


@part
def scratch(lanes: Index, size: Index, like: Floats) -> Scratch:
    """Memory for B lanes and matrices of this size."""
    return Scratch(
        aligned(size, like), aligned(size, like), aligned(lanes * 14 * PAD, like), np.empty(3 * lanes * 3, like.dtype)
    )


@inside
def nets(ahead: Net, matrices: Matrices, room: Scratch, gradient: Floats) -> Nets:
    """The three forms of a net whose gradient (P,) is wanted."""
    straight = net_of(ahead.theta, room.straight, matrices, ONE)
    return Nets(ahead, straight, net_of(gradient, room.grown, matrices, TWO))


@part
def back(
    nets: Nets, tape: Tape, deltas: Tape, gnss: Floats, adjoints: Floats, s: Index, slots: Index, room: Scratch
) -> None:
    """The gradient of one model from that of its estimates, from its tape and its matrices as `follow` left them.

    The wide layers are computed again, which is faster than to fetch them from memory. They and the gradients of the
    layers' outputs wait in fields with room for a few steps; when these are full, the gradient of each weight grows by
    one product over all their rows.

    Args:
        nets: the model, and its gradient.
        tape: of the forward pass.
        deltas: gradients of the layers' outputs.
        gnss: (T, S, B, 3) m.
        adjoints: (T, S, B, 3) gradient of the loss with respect to the estimates.
        s: index of the model.
        slots: steps for which the fields have room.
        room: memory.
    """
    ahead, net, made = nets
    unpack(net)
    made.padded[:] = 0.0
    lanes, recompute, steps = tape.lanes, tape.fields[on.CORRECTED, 2] == 0, len(gnss)
    fixes, flat, stride = gnss.reshape(-1), adjoints.reshape(-1), gnss.shape[1] * tape.lanes * 3
    adjoint, inner = _nothing(lanes, room.inner, room.positions)
    for t in range(steps - 1, -1, -1):
        tape.now[0], tape.now[1], at = t % slots, t, s * lanes * 3 + t * stride
        given = window(flat, at, lanes, THREE)
        for b in range(lanes):
            for i in range(3):
                adjoint.x[b, i] += given[b, i]
        if recompute:
            _again(ahead, tape)
        _step(net, ahead, window(fixes, at, lanes, THREE), adjoint, tape, deltas, inner)
        if t % slots == 0:
            _collect(made, tape, deltas, min(slots, steps - t))
    pack(made)


@part
def _nothing(lanes: Index, work: Floats, positions: Floats) -> tuple[Adjoint, Inner]:
    """No gradient yet, in this memory, and room for those within a step."""
    wide, size, step = np.int64(PAD), lanes * PAD, lanes * THREE
    work[:], positions[:] = 0.0, 0.0
    adjoint = Adjoint(
        window(work, ZERO, lanes, wide),
        window(work, size, lanes, wide),
        window(work, 2 * size, lanes, wide),
        window(positions, ZERO, lanes, THREE),
        window(positions, step, lanes, THREE),
        window(positions, 2 * step, lanes, THREE),
    )
    inner = Inner(
        window(work, 3 * size, lanes, wide),
        window(work, 4 * size, lanes, wide),
        window(work, 5 * size, lanes, wide),
        window(work, 6 * size, lanes, wide),
        window(work, 7 * size, lanes, wide),
        window(work, 8 * size, lanes, wide),
        window(work, 9 * size, lanes, wide),
        window(work, 10 * size, lanes, 4 * wide),
    )
    return adjoint, inner


@inside
def _again(net: Net, tape: Tape) -> None:
    """The outputs of the wide layers at the present step, and what stands beside them."""
    moved, seen, wide = rows(tape, on.PRIOR_IN), rows(tape, on.INNOVATION_IN), net.layers[on.UPDATE, 2]
    layer(net, on.UPDATE, tape, rows(tape, on.CORRECTED), on.FIRST)
    layer(net, on.EVOLUTION, tape, moved, on.FIRST)
    layer(net, on.OBSERVATION, tape, seen, on.FIRST)
    layer(net, on.HIDDEN, tape, rows(tape, on.HIDDEN_OUT), on.FIRST)
    layer(net, on.EXPECTED, tape, seen, 2 * wide)
    blend(tape, on.PROCESS_OLD, moved, wide)


@part
def _collect(gradient: Net, tape: Tape, deltas: Tape, count: Index) -> None:
    """Add what `count` steps from the present one on contribute to the gradient of every weight and bias.

    The matrix of a layer with more outputs than inputs is transposed: the longer axis runs along the vectors.
    """
    one = np.ones((count * tape.lanes, 1), gradient.padded.dtype)
    for name in range(len(gradient.layers)):
        outputs, inputs = gradient.layers[name, 2], gradient.layers[name, 3]
        given, at = span(tape, gradient.layers[name, 7], count), gradient.layers[name, 8]
        delta, column = span(deltas, gradient.layers[name, 9], count), gradient.layers[name, 10]
        if gradient.transposed[name]:
            add_outer(given, at, inputs, delta, column, matrix(gradient, name))
        else:
            add_outer(delta, column, outputs, given, at, matrix(gradient, name))
        add_outer(borrowed(one), ZERO, ONE, delta, column, bias(gradient, name))


@inside
def _step(net: Net, ahead: Net, gnss: Floats, adjoint: Adjoint, tape: Tape, deltas: Tape, inner: Inner) -> None:
    """Back over a step: `adjoint` becomes the gradient with respect to the state before it."""
    gain = _room(net, on.GAIN, deltas)
    _begin(gnss, adjoint, tape, inner, gain, _room(net, on.POSTERIOR, deltas))
    _gate(net, on.POSTERIOR, tape, on.CORE, on.BACK, deltas)
    _add(net, on.POSTERIOR, deltas, on.SECOND, inner.prior)
    _add(net, on.BACK, deltas, on.FIRST, inner.innovation)
    _add(net, on.BACK, deltas, on.SECOND, gain)
    _gate(net, on.GAIN, tape, on.HIDDEN_OUT, on.HIDDEN, deltas)
    _add(net, on.HIDDEN, deltas, on.FIRST, inner.prior)
    _add(net, on.HIDDEN, deltas, on.SECOND, inner.innovation)

    _gru(net, on.INNOVATION_X, inner.innovation, inner.gates, tape, deltas)
    _gate(net, on.INNOVATION_X, tape, on.INNOVATION_IN, on.OBSERVATION, deltas)
    _add(net, on.EXPECTED, deltas, on.FIRST, inner.prior)
    _gru(net, on.PRIOR_X, inner.prior, inner.gates, tape, deltas)
    _gate(net, on.PRIOR_X, tape, on.PRIOR_IN, on.EVOLUTION, deltas)
    _add(net, on.PRIOR_X, deltas, net.layers[on.UPDATE, 2], inner.process)
    _gru(net, on.PROCESS_X, inner.process, inner.gates, tape, deltas)
    _gate(net, on.PROCESS_X, tape, on.CORRECTED, on.UPDATE, deltas)
    _end(net, ahead, gnss, adjoint, tape, deltas, inner)


@inside
def _begin(gnss: Floats, adjoint: Adjoint, tape: Tape, inner: Inner, gain: Floats, posterior: Floats) -> None:
    """Gradients of what a step gives: new states, K and innovation by x = x_prior + K (z - x_prior), posterior.

    None of them where there is no fix, so that all further ones of that lane are zero.
    """
    core, lengths, posterior_out = rows(tape, on.CORE), rows(tape, on.LENGTHS), rows(tape, on.POSTERIOR_OUT)
    zero = core.dtype.type(0.0)
    for b in range(tape.lanes):
        gone = missing(gnss, b)
        for i in range(3):
            along = zero
            for j in range(3):
                gain[b, 3 * i + j] = zero if gone else adjoint.x[b, i] * lengths[b, on.RESIDUAL + j]
                along += core[b, on.CORE_GAIN + 3 * j + i] * adjoint.x[b, j]
            inner.residual[b, i] = zero if gone else along
        for j in range(PAD):
            inner.process[b, j] = zero if gone else adjoint.process[b, j]
            inner.innovation[b, j] = zero if gone else adjoint.innovation[b, j]
            inner.prior[b, j] = zero
        for j in range(PAD):
            posterior[b, j] = zero if gone or posterior_out[b, j] <= zero else adjoint.prior[b, j]


@inside
def _end(net: Net, ahead: Net, gnss: Floats, adjoint: Adjoint, tape: Tape, deltas: Tape, inner: Inner) -> None:
    """Gradients of the four changes, and `adjoint` before the step; without a fix only x and x_before were moved on."""
    wide = net.layers[on.UPDATE, 2]
    dots(_room(net, on.OBSERVATION, deltas), 2 * wide, matrix(ahead, on.OBSERVATION), THREE, inner.observed)
    dots(_room(net, on.EVOLUTION, deltas), wide, matrix(ahead, on.EVOLUTION), ZERO, inner.evolved)
    dots(_room(net, on.UPDATE, deltas), wide, matrix(ahead, on.UPDATE), ZERO, inner.updated)
    features, lengths = rows(tape, on.FEATURES), rows(tape, on.LENGTHS)
    for b in range(tape.lanes):
        _turn(features, lengths, b, ONE, inner.observed)
        _turn(features, lengths, b, TWO, inner.evolved)
        _turn(features, lengths, b, THREE, inner.updated)
        if missing(gnss, b):
            for i in range(3):
                adjoint.x[b, i] += adjoint.x_before[b, i]
                adjoint.x_before[b, i] = 0.0
            continue
        for i in range(3):
            evolved, updated = inner.evolved[b, i], inner.updated[b, i]
            in_residual = inner.residual[b, i] + inner.observed[b, i]
            adjoint.x[b, i] += adjoint.prior_before[b, i] + adjoint.x_before[b, i] - in_residual + evolved + updated
            adjoint.x_before[b, i], adjoint.prior_before[b, i] = -evolved, -updated
        for j in range(9):
            adjoint.process[b, j], adjoint.prior[b, j] = inner.process[b, j], inner.prior[b, j]
            adjoint.innovation[b, j] = inner.innovation[b, j]


@inside
def _turn(features: Floats, lengths: Floats, b: Index, which: Index, values: Floats) -> None:
    """Gradient of a change, in place, from that of its direction and of the logarithm of its length."""
    real, at = values.dtype.type, on.CHANGES[which, 0]
    u, v, w = features[b, at], features[b, at + 1], features[b, at + 2]
    p, q, r = values[b, 0], values[b, 1], values[b, 2]
    length, along = lengths[b, which], u * p + v * q + w * r
    scale = real(0.0) if length <= real(SHORTEST) else real(1.0) / length
    in_length = values[b, 3] / (length + real(LOG_FLOOR)) - along * scale
    values[b, 0], values[b, 1] = p * scale + u * in_length, q * scale + v * in_length
    values[b, 2] = r * scale + w * in_length


@inside
def _room(net: Net, name: Index, deltas: Tape) -> Floats:
    """The field where the gradient of a layer's outputs stands."""
    return rows(deltas, net.layers[name, 9])


@inside
def _add(net: Net, name: Index, deltas: Tape, at: Index, out: Floats) -> None:
    """Add to out (B, PAD) the gradient of a layer's inputs from input `at` on."""
    add_product(_room(net, name, deltas), net.layers[name, 10], net.layers[name, 2], matrix(net, name), at, out)


@inside
def _gate(net: Net, name: Index, tape: Tape, reached: Index, below: Index, deltas: Tape) -> None:
    """The gradient of a layer's inputs, where these are positive, as that of the outputs of the layer below."""
    gated_product(
        _room(net, name, deltas),
        net.layers[name, 10],
        net.layers[name, 2],
        matrix(net, name),
        rows(tape, reached),
        _room(net, below, deltas),
    )


@inside
def _gru(net: Net, name: Index, after: Floats, work: Floats, tape: Tape, deltas: Tape) -> None:
    """Gradients of a GRU's X and H; `after` (B, PAD), that of its new state, becomes its part in the old one's."""
    old, one = net.layers[name + 1, 7], after.dtype.type(1.0)
    before, gates = rows(tape, old), rows(tape, old + on.GATES_FROM_OLD)
    given, kept = _room(net, name, deltas), _room(net, name + 1, deltas)
    for b in range(tape.lanes):
        for j in range(PAD):
            reset, keep, fresh = gates[b, j], gates[b, on.KEEP + j], gates[b, on.FRESH + j]
            in_fresh = after[b, j] * (one - keep) * (one - fresh * fresh)
            work[b, j] = in_fresh * gates[b, on.KEPT + j] * reset * (one - reset)
            work[b, on.KEEP + j] = after[b, j] * (before[b, j] - fresh) * keep * (one - keep)
            work[b, on.FRESH + j], work[b, on.KEPT + j] = in_fresh, in_fresh * reset
            after[b, j] *= keep
        for third in range(3):
            carry(work, third * PAD, given, third * 9, b)
            carry(work, (third + third // 2) * PAD, kept, third * 9, b)
    _add(net, name + 1, deltas, on.FIRST, after)

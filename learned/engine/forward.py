"""Compiled rollout of GainNets: the arithmetic of `GainNet.step` for B lanes, and the tape that backward reads."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from coopoc.arrays import AnyArray, Floats, Ints
from coopoc.kernels.compile import compiled, part

from ..nets.gain_net import LOG_FLOOR, SHORTEST
from . import places as on
from .arithmetic import PAD, THREE, ZERO, Index, aligned, carry, inside, lent, sigmoid, tanh, window
from .product import affine, spread
from .tape import Net, Tape, bias, matrix, rows, unpack


class State(NamedTuple):
    """`net.Memory` for the B lanes of one model, changed in place; the GRU states have PAD columns."""

    process: Floats
    prior: Floats
    innovation: Floats
    x: Floats
    x_before: Floats
    prior_before: Floats
    gnss_before: Floats


class Seen(NamedTuple):
    """A step's fixes (B, 3) m, velocities (B, 3) m/s and dt s."""

    gnss: Floats
    velocity: Floats
    dt: float


class Scratch(NamedTuple):
    """Memory of a rollout: of a GRU's two halves, of the GRU states, of the positions."""

    gates: Floats
    grus: Floats
    positions: Floats


@compiled
def forward(
    theta: Floats, padded: Floats, layers: Ints, places: AnyArray, gnss: Floats, velocity: Floats, x0: Floats,
    dt: Floats, kept: Floats, fields: Ints, size: Index, keep: Index, x: Floats, first: Index, last: Index,
) -> None:  # fmt: skip
    """Estimates x (T, S, B, 3) m of the models first..last - 1, and what backward needs of their tape.

    Args:
        theta: (S, P). padded: (S, .) for the matrices. layers: as in `Net`. places: as in `Plan`. gnss, velocity:
            (T, S, B, 3) m, m/s. x0: (S, B, 3) m. dt: (T,) s. kept: (S, .) of the tape. fields: as in `Tape`. size: of
            its memory that is not kept. keep: 1 keeps all steps, 0 the last.
    """
    lanes, turned, now = gnss.shape[2], layers[:, 2] > 0, np.zeros(2, np.int64)
    passing, room = aligned(size, x), scratch(lanes, x)
    for s in range(first, last):
        net = Net(lent(theta[s]), lent(padded[s]), lent(layers), lent(turned), lent(places[0]))
        tape = Tape(lent(passing), lent(kept[s]), lent(fields), lent(now), lanes)
        follow(net, tape, gnss, velocity, x0, dt, x, s, keep, room)


@part
def scratch(lanes: Index, like: Floats) -> Scratch:
    """Memory for B lanes."""
    return Scratch(aligned(2 * lanes * on.GATES, like), aligned(3 * lanes * PAD, like),
                   np.empty(4 * lanes * 3, like.dtype))  # fmt: skip


@part
def follow(
    net: Net, tape: Tape, gnss: Floats, velocity: Floats, x0: Floats, dt: Floats, x: Floats, s: Index, keep: Index,
    room: Scratch,
) -> None:  # fmt: skip
    """Estimates x[:, s] of one model, and its matrices."""
    unpack(net)
    lanes, wide, logs, work = tape.lanes, net.layers[on.UPDATE, 2], net.layers[on.UPDATE, 3] > 3, lent(room.gates)
    fixes, speeds, made, at = gnss.reshape(-1), velocity.reshape(-1), x.reshape(-1), s * lanes * 3
    state = _start(window(x0.reshape(-1), at, lanes, THREE), room.grus, room.positions)
    for t in range(len(dt)):
        tape.now[0], tape.now[1] = 0, t * keep
        seen = Seen(window(fixes, at, lanes, THREE), window(speeds, at, lanes, THREE), dt[t])
        _look(seen, state, tape, logs)
        _think(net, state, tape, work)
        _move(seen, state, tape, wide, window(made, at, lanes, THREE))
        at += gnss.shape[1] * lanes * 3


@part
def _start(x0: Floats, grus: Floats, positions: Floats) -> State:
    """The state before the first step, in this memory: GRU states I, 0, I, all positions x0 (B, 3) m."""
    lanes, wide = len(x0), np.int64(PAD)
    grus[:] = 0.0
    size, step = lanes * wide, lanes * THREE
    state = State(
        window(grus, ZERO, lanes, wide), window(grus, size, lanes, wide), window(grus, 2 * size, lanes, wide),
        window(positions, ZERO, lanes, THREE), window(positions, step, lanes, THREE),
        window(positions, 2 * step, lanes, THREE), window(positions, 3 * step, lanes, THREE),
    )  # fmt: skip
    for b in range(lanes):
        for i in range(3):
            state.process[b, 4 * i] = state.innovation[b, 4 * i] = 1.0
            state.x[b, i] = state.x_before[b, i] = state.prior_before[b, i] = state.gnss_before[b, i] = x0[b, i]
    return state


@inside
def missing(gnss: Floats, b: Index) -> bool:
    """Whether lane b of gnss (B, 3) has no fix."""
    return bool(np.isnan(gnss[b, 0]) and np.isnan(gnss[b, 1]) and np.isnan(gnss[b, 2]))


@inside
def _look(seen: Seen, state: State, tape: Tape, logs: bool) -> None:
    """The four changes as the layers read them, their lengths, and the innovation; a missing fix repeats the last."""
    real, features, lengths = state.x.dtype.type, rows(tape, on.FEATURES), rows(tape, on.LENGTHS)
    for b in range(tape.lanes):
        gone = missing(seen.gnss, b)
        for i in range(3):
            fix = state.gnss_before[b, i] if gone else seen.gnss[b, i]
            features[b, i] = fix - state.gnss_before[b, i]
            features[b, 3 + i] = fix - (state.x[b, i] + seen.dt * seen.velocity[b, i])
            features[b, 8 + i] = state.x[b, i] - state.x_before[b, i]
            features[b, 12 + i] = state.x[b, i] - state.prior_before[b, i]
            lengths[b, on.SURPRISE + i] = features[b, 3 + i]
        for which in range(4):
            at, log = on.CHANGES[which]
            u, v, w = features[b, at], features[b, at + 1], features[b, at + 2]
            length = np.sqrt(u * u + v * v + w * w)
            scale = real(0.0) if length <= real(SHORTEST) else real(1.0) / length
            features[b, at], features[b, at + 1], features[b, at + 2] = u * scale, v * scale, w * scale
            features[b, log] = np.log(length + real(LOG_FLOOR)) if logs else real(0.0)
            lengths[b, which] = length


@inside
def _think(net: Net, state: State, tape: Tape, work: Floats) -> None:
    """The net itself, from features to gain and posterior, all on the tape."""
    wide, core, back = net.layers[on.UPDATE, 2], rows(tape, on.CORE), window(work, ZERO, tape.lanes, np.int64(PAD))
    moved, seen = rows(tape, on.PRIOR_IN), rows(tape, on.INNOVATION_IN)
    layer(net, on.UPDATE, tape, rows(tape, on.CORRECTED), on.FIRST)
    layer(net, on.EVOLUTION, tape, moved, on.FIRST)
    layer(net, on.OBSERVATION, tape, seen, on.FIRST)
    _gru(net, on.PROCESS_X, on.PROCESS_OLD, on.PROCESS_GATES, state.process, tape, work, moved, wide)
    _gru(net, on.PRIOR_X, on.PRIOR_OLD, on.PRIOR_GATES, state.prior, tape, work, core, on.CORE_PRIOR)
    layer(net, on.EXPECTED, tape, seen, 2 * wide)
    _gru(net, on.INNOVATION_X, on.INNOVATION_OLD, on.INNOVATION_GATES, state.innovation, tape, work, core,
         on.CORE_INNOVATION)  # fmt: skip
    layer(net, on.HIDDEN, tape, rows(tape, on.HIDDEN_OUT), on.FIRST)
    layer(net, on.GAIN, tape, core, on.CORE_GAIN)
    layer(net, on.BACK, tape, back, on.FIRST)
    for b in range(tape.lanes):
        for j in range(9):
            core[b, j] = back[b, j]
    layer(net, on.POSTERIOR, tape, rows(tape, on.POSTERIOR_OUT), on.FIRST)


@inside
def layer(net: Net, name: Index, tape: Tape, out: Floats, at: Index) -> None:
    """What a layer makes of its window of the tape, into out (B, n) from column `at` on, with padding."""
    inputs, relu, field, column = net.layers[name, 3], net.layers[name, 6], net.layers[name, 7], net.layers[name, 8]
    affine(rows(tape, field), column, inputs, matrix(net, name), bias(net, name), relu > 0, out, at)


@inside
def _gru(
    net: Net, name: Index, old: Index, gates_name: Index, state: Floats, tape: Tape, work: Floats, out: Floats,
    at: Index,
) -> None:  # fmt: skip
    """r, z = sigmoid(W x + U h), n = tanh(W x + r (U h)), h <- n + z (h - n), biases in W and U; h from column `at` on.

    Loops run over PAD columns, more than the nine that count, because loops of such a length vectorise.
    """
    real, before, gates = work.dtype.type, rows(tape, old), rows(tape, gates_name)
    given, kept = window(work, ZERO, tape.lanes, on.GATES), window(work, tape.lanes * on.GATES, tape.lanes, on.GATES)
    for b in range(tape.lanes):
        carry(state, ZERO, before, ZERO, b)
    layer(net, name, tape, given, on.FIRST)
    layer(net, name + 1, tape, kept, on.FIRST)
    spread(given)
    spread(kept)
    for b in range(tape.lanes):
        for j in range(PAD):
            reset = sigmoid(given[b, j] + kept[b, j], real)
            keep = sigmoid(given[b, on.KEEP + j] + kept[b, on.KEEP + j], real)
            fresh = tanh(given[b, on.FRESH + j] + reset * kept[b, on.FRESH + j], real)
            gates[b, j], gates[b, on.KEEP + j] = reset, keep
            gates[b, on.FRESH + j], gates[b, on.KEPT + j] = fresh, kept[b, on.FRESH + j]
    blend(tape, old, gates_name, out, at)


@inside
def blend(tape: Tape, old: Index, gates_name: Index, out: Floats, at: Index) -> None:
    """h <- n + z (h - n), the new state of a GRU, into out from column `at` on."""
    before, gates = rows(tape, old), rows(tape, gates_name)
    for b in range(tape.lanes):
        for j in range(PAD):
            fresh = gates[b, on.FRESH + j]
            out[b, at + j] = fresh + gates[b, on.KEEP + j] * (before[b, j] - fresh)


@inside
def _move(seen: Seen, state: State, tape: Tape, wide: Index, x: Floats) -> None:
    """x <- x_prior + K (z - x_prior) and the states of the GRUs; without a fix x <- x_prior and nothing else."""
    lengths, core, moved = rows(tape, on.LENGTHS), rows(tape, on.CORE), rows(tape, on.PRIOR_IN)
    posterior = rows(tape, on.POSTERIOR_OUT)
    for b in range(tape.lanes):
        gone = missing(seen.gnss, b)
        for i in range(3):
            state.x_before[b, i] = state.x[b, i]
            state.x[b, i] += seen.dt * seen.velocity[b, i]
            if not gone:
                state.prior_before[b, i], state.gnss_before[b, i] = state.x[b, i], seen.gnss[b, i]
                row = on.CORE_GAIN + 3 * i
                state.x[b, i] += (core[b, row] * lengths[b, on.SURPRISE]
                                  + core[b, row + 1] * lengths[b, on.SURPRISE + 1]
                                  + core[b, row + 2] * lengths[b, on.SURPRISE + 2])  # fmt: skip
            x[b, i] = state.x[b, i]
        if not gone:
            for j in range(9):
                state.process[b, j], state.prior[b, j] = moved[b, wide + j], posterior[b, j]
                state.innovation[b, j] = core[b, on.CORE_INNOVATION + j]

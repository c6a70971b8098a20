"""Compiled rollout of GainNets: the arithmetic of `GainNet.step` for B lanes, and the tape that backward reads."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from coopoc.arrays import Floats
from coopoc.kernels.compiling.compile import compiled
from coopoc.learned.engine.arguments import Drives, Matrices, Memory

from . import places as on
from .arithmetic import PAD, THREE, ZERO, Index, aligned, borrowed, carry, inside, part, sigmoid, tanh, window
from .places import LOG_FLOOR, SHORTEST
from .product import affine, align_gates
from .tape import Net, Tape, bias, matrix, net_of, rows, unpack


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
    theta: Floats, matrices: Matrices, drives: Drives, memory: Memory, x: Floats, span: tuple[int, int]
) -> None:
    """Estimates x (T, S, B, 3) m of the models of theta (S, P) in `span`; the tape holds one step only."""
    lanes, now, room = drives.gnss.shape[2], np.zeros(2, np.int64), scratch(drives.gnss.shape[2], x)
    padded, kept, passing = aligned(memory.padded, x), aligned(memory.kept, x), aligned(memory.passing, x)
    for s in range(span[0], span[1]):
        net = net_of(theta[s], padded, matrices, ZERO)
        tape = Tape(borrowed(passing), borrowed(kept), borrowed(memory.fields), borrowed(now), lanes)
        follow(net, tape, drives, x, s, ZERO, room)


@part
def scratch(lanes: Index, like: Floats) -> Scratch:
    """Memory for B lanes."""
    return Scratch(
        aligned(2 * lanes * on.GATES, like), aligned(3 * lanes * PAD, like), np.empty(4 * lanes * 3, like.dtype)
    )


@part
def follow(net: Net, tape: Tape, drives: Drives, x: Floats, s: Index, keep: Index, room: Scratch) -> None:
    """Estimates x[:, s] of one model, and its matrices; keep: 1 keeps all steps on the tape, 0 the last."""
    unpack(net)
    lanes, wide, logs, work = tape.lanes, net.layers[on.UPDATE, 2], net.layers[on.UPDATE, 3] > 3, borrowed(room.gates)
    fixes, speeds, made, at = drives.gnss.reshape(-1), drives.velocity.reshape(-1), x.reshape(-1), s * lanes * 3
    state = _start(window(drives.x0.reshape(-1), at, lanes, THREE), room.grus, room.positions)
    for t in range(len(drives.dt)):
        tape.now[0], tape.now[1] = 0, t * keep
        seen = Seen(window(fixes, at, lanes, THREE), window(speeds, at, lanes, THREE), drives.dt[t])
        _look(seen, state, tape, logs)
        _think(net, state, tape, work)
        _move(seen, state, tape, wide, window(made, at, lanes, THREE))
        at += drives.gnss.shape[1] * lanes * 3


@part
def _start(x0: Floats, grus: Floats, positions: Floats) -> State:
    """The state before the first step, in this memory: GRU states I, 0, I, all positions x0 (B, 3) m."""
    lanes, wide = len(x0), np.int64(PAD)
    grus[:] = 0.0
    size, step = lanes * wide, lanes * THREE
    state = State(
        window(grus, ZERO, lanes, wide),
        window(grus, size, lanes, wide),
        window(grus, 2 * size, lanes, wide),
        window(positions, ZERO, lanes, THREE),
        window(positions, step, lanes, THREE),
        window(positions, 2 * step, lanes, THREE),
        window(positions, 3 * step, lanes, THREE),
    )
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
            lengths[b, on.RESIDUAL + i] = features[b, 3 + i]
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
    _gru(net, on.PROCESS_X, state.process, tape, work, moved, wide)
    _gru(net, on.PRIOR_X, state.prior, tape, work, core, on.CORE_PRIOR)
    layer(net, on.EXPECTED, tape, seen, 2 * wide)
    _gru(net, on.INNOVATION_X, state.innovation, tape, work, core, on.CORE_INNOVATION)
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
def _gru(net: Net, name: Index, state: Floats, tape: Tape, work: Floats, out: Floats, at: Index) -> None:
    """r, z = sigmoid(W x + U h), n = tanh(W x + r (U h)), h <- n + z (h - n), biases in W and U; h from column `at` on.

    Loops run over PAD columns, more than the nine that count, because loops of such a length vectorise.
    """
    old = net.layers[name + 1, 7]
    real, before, gates = work.dtype.type, rows(tape, old), rows(tape, old + on.GATES_FROM_OLD)
    given, kept = window(work, ZERO, tape.lanes, on.GATES), window(work, tape.lanes * on.GATES, tape.lanes, on.GATES)
    for b in range(tape.lanes):
        carry(state, ZERO, before, ZERO, b)
    layer(net, name, tape, given, on.FIRST)
    layer(net, name + 1, tape, kept, on.FIRST)
    align_gates(given)
    align_gates(kept)
    for b in range(tape.lanes):
        for j in range(PAD):
            reset = sigmoid(given[b, j] + kept[b, j], real)
            keep = sigmoid(given[b, on.KEEP + j] + kept[b, on.KEEP + j], real)
            fresh = tanh(given[b, on.FRESH + j] + reset * kept[b, on.FRESH + j], real)
            gates[b, j], gates[b, on.KEEP + j] = reset, keep
            gates[b, on.FRESH + j], gates[b, on.KEPT + j] = fresh, kept[b, on.FRESH + j]
    blend(tape, old, out, at)


@inside
def blend(tape: Tape, old: Index, out: Floats, at: Index) -> None:
    """h <- n + z (h - n), the new state of a GRU, into out from column `at` on."""
    before, gates = rows(tape, old), rows(tape, old + on.GATES_FROM_OLD)
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
                state.x[b, i] += (
                    core[b, row] * lengths[b, on.RESIDUAL]
                    + core[b, row + 1] * lengths[b, on.RESIDUAL + 1]
                    + core[b, row + 2] * lengths[b, on.RESIDUAL + 2]
                )
            x[b, i] = state.x[b, i]
        if not gone:
            for j in range(9):
                state.process[b, j], state.prior[b, j] = moved[b, wide + j], posterior[b, j]
                state.innovation[b, j] = core[b, on.CORE_INNOVATION + j]

"""Compiled rollout of GainNets: the arithmetic of `GainNet.step` for B lanes, and the tape that backward reads."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from coopoc.arrays import Floats, Ints

from .arithmetic import Net, Tape, add_product, bias, compiled, opened, rows, sigmoid, tanh, turned

UPDATE, EVOLUTION, OBSERVATION, PROCESS_X, PROCESS_H, PRIOR_X, PRIOR_H, EXPECTED, INNOVATION_X, INNOVATION_H = range(10)
HIDDEN, GAIN, BACK, POSTERIOR = range(10, 14)
"""The layers (of a GRU, X reads its input and H its state), and the fields of the tape with what they read."""
POSTERIOR_OUT, PROCESS_GATES, PRIOR_GATES, INNOVATION_GATES, LENGTHS, SURPRISE = range(14, 20)
"""The other fields of the tape; gates are r, z, n and the part of n that r scales."""
EPS = 1e-12
"""Least length that has a direction, m."""
FLOOR = 0.01
"""Added to a length before its logarithm is taken, m."""


class State(NamedTuple):
    """`net.Memory` for the B lanes of one model, changed in place."""

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


@compiled
def forward(
    theta: Floats, layers: Ints, gnss: Floats, velocity: Floats, x0: Floats, dt: Floats, memory: Floats, fields: Ints,
    x: Floats, first: int, last: int,
) -> None:  # fmt: skip
    """Estimates x (T, S, B, 3) m of the models first..last - 1, and their tape.

    Args:
        theta: (S, P). layers: as in `Net`. gnss, velocity: (T, S, B, 3). x0: (S, B, 3) m. dt: (T,) s.
        memory: (S, size) of the tape. fields: as in `Tape`.
    """
    for s in range(first, last):
        net, tape, state = opened(theta[s], layers), Tape(memory[s], fields, x0.shape[1]), _start(x0[s])
        work = np.empty(2 * x0.shape[1] * layers[:, 2].max(), x.dtype)
        for t in range(len(x)):
            seen = Seen(gnss[t, s], velocity[t, s], dt[t])
            _look(seen, state, tape, t)
            _think(net, state, tape, t, work)
            _move(seen, state, tape, t)
            x[t, s] = state.x


@compiled
def _start(x0: Floats) -> State:
    """The state before the first step: GRU states I, 0, I, all positions x0 (B, 3) m."""
    grus = np.zeros((3, len(x0), 9), x0.dtype)
    for axis in range(3):
        grus[::2, :, 4 * axis] = 1.0
    return State(grus[0], grus[1], grus[2], x0.copy(), x0.copy(), x0.copy(), x0.copy())


@compiled
def missing(gnss: Floats, b: int) -> bool:
    """Whether lane b of gnss (B, 3) has no fix."""
    return bool(np.isnan(gnss[b, 0]) and np.isnan(gnss[b, 1]) and np.isnan(gnss[b, 2]))


@compiled
def _look(seen: Seen, state: State, tape: Tape, t: int) -> None:
    """The four changes as the layers read them, their lengths, and the innovation; a missing fix repeats the last."""
    real = state.x.dtype.type
    updated, evolved, observed = rows(tape, UPDATE, t), rows(tape, EVOLUTION, t), rows(tape, OBSERVATION, t)
    lengths, surprise = rows(tape, LENGTHS, t), rows(tape, SURPRISE, t)
    for b in range(tape.lanes):
        gone = missing(seen.gnss, b)
        for i in range(3):
            fix = state.gnss_before[b, i] if gone else seen.gnss[b, i]
            surprise[b, i] = fix - (state.x[b, i] + seen.dt * seen.velocity[b, i])
            observed[b, i] = fix - state.gnss_before[b, i]
            observed[b, 3 + i] = surprise[b, i]
            evolved[b, i] = state.x[b, i] - state.x_before[b, i]
            updated[b, i] = state.x[b, i] - state.prior_before[b, i]
        lengths[b, 0], lengths[b, 1] = _unit(observed, b, 0), _unit(observed, b, 3)
        lengths[b, 2], lengths[b, 3] = _unit(evolved, b, 0), _unit(updated, b, 0)
        if updated.shape[1] > 3:
            observed[b, 6] = np.log(lengths[b, 0] + real(FLOOR))
            observed[b, 7] = np.log(lengths[b, 1] + real(FLOOR))
            evolved[b, 3] = np.log(lengths[b, 2] + real(FLOOR))
            updated[b, 3] = np.log(lengths[b, 3] + real(FLOOR))


@compiled
def _unit(v: Floats, b: int, at: int) -> float:
    """Divide the vector v[b, at : at + 3] by its length and give the length; what has no direction becomes zero."""
    real = v.dtype.type
    length = np.sqrt(v[b, at] * v[b, at] + v[b, at + 1] * v[b, at + 1] + v[b, at + 2] * v[b, at + 2])
    scale = real(0.0) if length <= real(EPS) else real(1.0) / length
    for i in range(at, at + 3):
        v[b, i] *= scale
    return length  # type: ignore[no-any-return]


@compiled
def _think(net: Net, state: State, tape: Tape, t: int, work: Floats) -> None:
    """The net itself, from features to gain and posterior, all on the tape."""
    moved, seen, prior = rows(tape, PRIOR_X, t), rows(tape, INNOVATION_X, t), rows(tape, EXPECTED, t)
    pair, back_in, posterior_in = rows(tape, HIDDEN, t), rows(tape, BACK, t), rows(tape, POSTERIOR, t)
    _relu(_layer(net, UPDATE, tape, t, work), rows(tape, PROCESS_X, t), 0)
    _relu(_layer(net, EVOLUTION, tape, t, work), moved, 9)
    _relu(_layer(net, OBSERVATION, tape, t, work), seen, 9)

    _gru(net, PROCESS_X, PROCESS_GATES, state.process, tape, t, work, moved)
    _gru(net, PRIOR_X, PRIOR_GATES, state.prior, tape, t, work, prior)
    _relu(_layer(net, EXPECTED, tape, t, work), seen, 0)
    _gru(net, INNOVATION_X, INNOVATION_GATES, state.innovation, tape, t, work, back_in)
    for b in range(tape.lanes):
        for j in range(9):
            pair[b, j] = posterior_in[b, j] = prior[b, j]
            pair[b, 9 + j] = back_in[b, j]

    _relu(_layer(net, HIDDEN, tape, t, work), rows(tape, GAIN, t), 0)
    gain = _layer(net, GAIN, tape, t, work)
    for b in range(tape.lanes):
        for j in range(9):
            back_in[b, 9 + j] = gain[b, j]
    _relu(_layer(net, BACK, tape, t, work), posterior_in, 9)
    _relu(_layer(net, POSTERIOR, tape, t, work), rows(tape, POSTERIOR_OUT, t), 0)


@compiled
def _layer(net: Net, name: int, tape: Tape, t: int, work: Floats) -> Floats:
    """(B, outputs) of a layer, in the memory `work`."""
    constant = bias(net, name)
    out = work[: tape.lanes * len(constant)].reshape(tape.lanes, len(constant))
    for b in range(tape.lanes):
        for j in range(len(constant)):
            out[b, j] = constant[j]
    add_product(rows(tape, name, t), turned(net, name), out)
    return out


@compiled
def _relu(values: Floats, out: Floats, at: int) -> None:
    """max(values, 0) into the columns of out from `at` on; NaN stays NaN."""
    zero = values.dtype.type(0.0)
    for b in range(values.shape[0]):
        for j in range(values.shape[1]):
            out[b, at + j] = zero if values[b, j] < zero else values[b, j]


@compiled
def _gru(net: Net, name: int, gates_name: int, state: Floats, tape: Tape, t: int, work: Floats, out: Floats) -> None:
    """r, z = sigmoid(W x + U h), n = tanh(W x + r (U h)), h <- n + z (h - n), biases in W and U; into out[:, :9]."""
    real = work.dtype.type
    before, gates = rows(tape, name + 1, t), rows(tape, gates_name, t)
    for b in range(tape.lanes):
        for j in range(9):
            before[b, j] = state[b, j]
    given = _layer(net, name, tape, t, work)
    kept = _layer(net, name + 1, tape, t, work[given.size :])
    for b in range(tape.lanes):
        for j in range(9):
            reset = sigmoid(given[b, j] + kept[b, j], real)
            keep = sigmoid(given[b, 9 + j] + kept[b, 9 + j], real)
            fresh = tanh(given[b, 18 + j] + reset * kept[b, 18 + j], real)
            gates[b, j], gates[b, 9 + j], gates[b, 18 + j], gates[b, 27 + j] = reset, keep, fresh, kept[b, 18 + j]
            out[b, j] = fresh + keep * (before[b, j] - fresh)


@compiled
def _move(seen: Seen, state: State, tape: Tape, t: int) -> None:
    """x <- x_prior + K (z - x_prior) and the states of the GRUs; without a fix x <- x_prior and nothing else."""
    surprise, back_in, moved = rows(tape, SURPRISE, t), rows(tape, BACK, t), rows(tape, PRIOR_X, t)
    posterior = rows(tape, POSTERIOR_OUT, t)
    for b in range(tape.lanes):
        gone = missing(seen.gnss, b)
        for i in range(3):
            state.x_before[b, i] = state.x[b, i]
            state.x[b, i] += seen.dt * seen.velocity[b, i]
            if not gone:
                state.prior_before[b, i], state.gnss_before[b, i] = state.x[b, i], seen.gnss[b, i]
                state.x[b, i] += (back_in[b, 9 + 3 * i] * surprise[b, 0] + back_in[b, 10 + 3 * i] * surprise[b, 1]
                                  + back_in[b, 11 + 3 * i] * surprise[b, 2])  # fmt: skip
        if not gone:
            for j in range(9):
                state.process[b, j], state.prior[b, j] = moved[b, j], posterior[b, j]
                state.innovation[b, j] = back_in[b, j]

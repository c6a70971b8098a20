"""Compiled rollout of a GainNet along a drive: the arithmetic of `GainNet.step`, and the tape that backward reads."""

from collections import namedtuple
from typing import NamedTuple

import numpy as np

from coopoc.arrays import Floats
from coopoc.kernels.compiling.compile import compiled, part, storage

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
    forward_layer,
    new_net,
    sigmoid,
    tanh,
    unpack,
)
from .tile import Index, Indices, apart

FOLLOWED = 16
"""Drives that are followed together, so that weights are fetched once for them."""


class Drives(NamedTuple):
    """Inputs of a rollout: gnss (T, S, B, 3) m, velocity (T, S, B, 3) m/s, x0 (S, B, 3) m, dt (T,) s."""

    gnss: Floats
    velocity: Floats
    x0: Floats
    dt: Floats


State = namedtuple("State", "process prior innovation x x_before prior_before gnss_before")
"""Memory of a net of L drives, arrays that are changed in place, or tensors: three GRU states (L, 9); estimate (L, 3)
m, the previous one, the last prior, the last fix."""


@storage
def new_state(lanes: Index, like: Floats) -> State:
    """Memory of a state."""
    cells, positions = np.zeros((3, lanes, CELLS), like.dtype), np.zeros((4, lanes, 3), like.dtype)
    return State(cells[0], cells[1], cells[2], positions[0], positions[1], positions[2], positions[3])


@compiled
def forward(theta: Floats, plan: Plan, drives: Drives, x: Floats) -> None:
    """Estimates x (T, S, B, 3) m of the models of theta (S, P); the tape holds one step only."""
    net, lanes = new_net(plan, x), min(FOLLOWED, x.shape[2])
    tape, state = aligned(lanes, plan.width, x), new_state(lanes, x)
    for s in range(len(theta)):
        unpack(theta[s], net)
        for first in range(0, x.shape[2], lanes):
            follow(net, tape, drives, x, (s, first, min(lanes, x.shape[2] - first)), state, 0)


@part
def follow(net: Net, tape: Floats, drives: Drives, x: Floats, rows: Indices, state: State, keep: int) -> None:
    """Estimates x[:, s, first : first + lanes] m of `rows` = s, first, lanes; keep: 1 keeps all steps on the tape, so
    many rows each, 0 the last."""
    s, first, lanes = rows
    start(state, drives.x0, rows)
    for t in range(len(drives.dt)):
        row = keep * t * lanes
        features(drives, state, net, tape, row, t, rows)
        infer(net, tape, row, lanes)
        for lane in range(lanes):
            correct(drives, state, net, tape[row + lane], lane, (t, s, first + lane))
            for i in range(3):
                x[t, s, first + lane, i] = state.x[lane, i]


@part
def start(state: State, x0: Floats, rows: Indices) -> None:
    """The state before the first step: GRU states I, 0, I, all positions x0 m."""
    s, first, lanes = rows
    for lane in range(lanes):
        for j in range(CELLS):
            state.process[lane, j] = state.innovation[lane, j] = 1.0 if j % 4 == 0 else 0.0
            state.prior[lane, j] = 0.0
        for position in state[3:]:
            for i in range(3):
                position[lane, i] = x0[s, first + lane, i]


@part
def missing(gnss: Floats, at: Indices) -> bool:
    """Whether there is no fix at a step of a model's drive."""
    t, s, b = at
    return bool(np.isnan(gnss[t, s, b, 0]) and np.isnan(gnss[t, s, b, 1]) and np.isnan(gnss[t, s, b, 2]))


@part
def features(drives: Drives, state: State, net: Net, tape: Floats, row: Index, t: Index, rows: Indices) -> None:
    """Inputs of a step of GainNet: its old states, directions and lengths of four differences, and the innovation; a
    missing fix repeats the last."""
    real, at = tape.dtype.type, net.columns.changes
    residual, lengths = net.columns.residual, net.columns.lengths
    s, first, lanes = rows
    for lane in range(lanes):
        own, b, x = tape[row + lane], first + lane, state.x[lane]
        gone = missing(drives.gnss, (t, s, b))
        for i in range(3):
            fix = state.gnss_before[lane, i] if gone else drives.gnss[t, s, b, i]
            innovation = fix - (x[i] + drives.dt[t] * drives.velocity[t, s, b, i])
            own[at + i], own[at + 3 + i] = fix - state.gnss_before[lane, i], innovation
            own[at + 6 + i] = x[i] - state.x_before[lane, i]
            own[at + 9 + i] = x[i] - state.prior_before[lane, i]
            own[residual + i] = innovation
        for change in range(4):
            c = at + 3 * change
            u, v, w = own[c], own[c + 1], own[c + 2]
            length = np.sqrt(u * u + v * v + w * w)
            scale = real(0.0) if length <= real(SHORTEST_LENGTH) else real(1.0) / length
            own[c], own[c + 1], own[c + 2] = u * scale, v * scale, w * scale
            own[lengths + change] = length
        for j in range(CELLS):
            own[net.columns.process_old + j], own[net.columns.prior_old + j] = (
                state.process[lane, j],
                state.prior[lane, j],
            )
            own[net.columns.innovation_old + j] = state.innovation[lane, j]


@part
def infer(net: Net, tape: Floats, row: Index, lanes: Index) -> None:
    """Forward pass, from the features and the old states to the gain and the posterior.

    A GRU: r, z = sigmoid(W x + U h), n = tanh(W x + r (U h)), h' = n + z (h - n), biases in W and U. Its fields follow
    each other: old state, W x, U h, gates. Gates are computed over PAD columns, of which nine count, because loops of
    such a length vectorise.
    """
    columns, last = net.columns, len(net.layers) - 1
    for layer in range(last + 1):
        if layer == last:
            for lane in range(row, row + lanes):
                for j in range(CELLS):
                    tape[lane, columns.prior_copy + j] = tape[lane, columns.prior + j]
        forward_layer(net, layer, tape, row, lanes)
        old, new = net.layers[layer, 9], net.layers[layer, 10]
        if new > 0:
            for lane in range(row, row + lanes):
                blend(tape[lane, old : old + 8 * PAD], tape[lane, new : new + CELLS])


@part
def blend(unit: Floats, new: Floats) -> None:
    """Gates and new state of a GRU from its fields."""
    apart()
    real = new.dtype.type
    for j in range(PAD):
        unit[GATES + j] = sigmoid(unit[FROM_X + j] + unit[FROM_H + j], real)
    for j in range(PAD):
        unit[GATES + PAD + j] = sigmoid(unit[FROM_X + CELLS + j] + unit[FROM_H + CELLS + j], real)
    for j in range(PAD):
        fresh = unit[FROM_X + 2 * CELLS + j] + unit[GATES + j] * unit[FROM_H + 2 * CELLS + j]
        unit[GATES + 2 * PAD + j] = tanh(fresh, real)
    for j in range(CELLS):
        fresh = unit[GATES + 2 * PAD + j]
        new[j] = fresh + unit[GATES + PAD + j] * (unit[j] - fresh)


@part
def correct(drives: Drives, state: State, net: Net, tape: Floats, lane: Index, at: Indices) -> None:
    """x <- x_prior + K (z - x_prior) and the new states of a lane; without a fix x <- x_prior and nothing else."""
    t, s, b = at
    gone, gain, residual, x = missing(drives.gnss, at), net.columns.gain, net.columns.residual, state.x[lane]
    for i in range(3):
        state.x_before[lane, i] = x[i]
        x[i] += drives.dt[t] * drives.velocity[t, s, b, i]
        if not gone:
            state.prior_before[lane, i], state.gnss_before[lane, i] = x[i], drives.gnss[t, s, b, i]
            for j in range(3):
                x[i] += tape[gain + 3 * i + j] * tape[residual + j]
    if not gone:
        process, innovation, posterior = net.columns.process, net.columns.innovation, net.columns.posterior
        for j in range(CELLS):
            state.process[lane, j], state.innovation[lane, j] = tape[process + j], tape[innovation + j]
            state.prior[lane, j] = tape[posterior + j]

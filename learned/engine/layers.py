"""Layers of a GainNet for the compiled engine: their numbers in flat weights, their columns on the tape, products.

The tape has a row of numbers per step and drive: inputs and outputs of every layer, side by side, at columns that
`plan_of` gives; the gradient of the tape has the same columns. A layer is y = W x + b, with ReLU where the net has one;
the matrix of a layer with more outputs than inputs is transposed, so that the longer axis always runs along memory.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from coopoc.arrays import Floats, Ints
from coopoc.kernels.compiling.compile import part, storage, summing

SIZE = 3
"""Components of state and measurement, m = n = 3."""
CELLS = SIZE * SIZE
"""Entries of each covariance-like GRU state."""
SHORTEST = 1e-12
"""Length in m up to which a vector has no direction: its feature is zero and has no gradient."""
LANES = 4
"""Drives that one tape holds."""
PAD = 16
"""Columns of a gate of a GRU: more than the nine that count, because loops of such a length vectorise."""
Index: TypeAlias = int | np.integer[Any]
"""A number of a layer, field, row or column: Python's, or NumPy's from a table of them."""
Shapes: TypeAlias = tuple[tuple[str, tuple[int, ...]], ...]
"""Names and shapes of a net's parameters, in the order of theta."""

FIELDS = (
    *("changes", "corrected", "process_old", "process_x", "process_h", "process_gates", "process", "evolved"),
    *("prior_old", "prior_x", "prior_h", "prior_gates", "expected", "observed"),
    *("innovation_old", "innovation_x", "innovation_h", "innovation_gates", "prior", "innovation", "gain"),
    *("hidden", "prior_copy", "back", "posterior", "residual", "lengths"),
)
"""Fields of the tape, in their order: [process, evolved], [expected, observed], [prior, innovation, gain] and
[prior_copy, back] stand side by side, because layers read two of them at once. `changes` holds the directions of the
four changes: of the fix, innovation, evolution, update."""
(
    CHANGES,
    CORRECTED,
    PROCESS_OLD,
    PROCESS_X,
    PROCESS_H,
    PROCESS_GATES,
    PROCESS,
    EVOLVED,
    PRIOR_OLD,
    PRIOR_X,
    PRIOR_H,
    PRIOR_GATES,
    EXPECTED,
    OBSERVED,
    INNOVATION_OLD,
    INNOVATION_X,
    INNOVATION_H,
    INNOVATION_GATES,
    PRIOR,
    INNOVATION,
    GAIN,
    HIDDEN,
    PRIOR_COPY,
    BACK,
    POSTERIOR,
    RESIDUAL,
    LENGTHS,
) = np.arange(len(FIELDS))

LAYERS = (
    ("update.weight", "changes", 9, "corrected", True),
    ("evolution.weight", "changes", 6, "evolved", True),
    ("observation.weight", "changes", 0, "observed", True),
    ("process.weight_ih", "corrected", 0, "process_x", False),
    ("process.weight_hh", "process_old", 0, "process_h", False),
    ("prior.weight_ih", "process", 0, "prior_x", False),
    ("prior.weight_hh", "prior_old", 0, "prior_h", False),
    ("prior_to_innovation.weight", "prior", 0, "expected", True),
    ("innovation.weight_ih", "expected", 0, "innovation_x", False),
    ("innovation.weight_hh", "innovation_old", 0, "innovation_h", False),
    ("gain_hidden.weight", "prior", 0, "hidden", True),
    ("gain.weight", "hidden", 0, "gain", False),
    ("posterior_hidden.weight", "innovation", 0, "back", True),
    ("posterior.weight", "prior_copy", 0, "posterior", True),
)
"""Layers in the order of `L_UPDATE` and the rest: parameter, field and first column of the inputs, field of the
outputs, whether a ReLU follows."""
(
    L_UPDATE,
    L_EVOLUTION,
    L_OBSERVATION,
    L_PROCESS_X,
    L_PROCESS_H,
    L_PRIOR_X,
    L_PRIOR_H,
    L_EXPECTED,
    L_INNOVATION_X,
    L_INNOVATION_H,
    L_HIDDEN,
    L_GAIN,
    L_BACK,
    L_POSTERIOR,
) = np.arange(len(LAYERS))
WEIGHT, BIAS, OUTPUTS, INPUTS, TALL, FROM, TO, RELU = np.arange(8)
"""Columns of `Net.layers`: begin of weight and bias in theta, sizes, whether the matrix is transposed, columns of
inputs and outputs on the tape, whether a ReLU follows."""


class Plan(NamedTuple):
    """For nets of one shape: layers (14, 8), first column of each field, columns of the tape, shape of `Net.matrices`,
    number of parameters."""

    layers: Ints
    columns: Ints
    width: int
    size: tuple[int, int, int]
    parameters: int


class Net(NamedTuple):
    """Matrices of one net with padded rows, all its weights (P,), and what `Plan` says of them."""

    matrices: Floats
    weights: Floats
    layers: Ints
    columns: Ints


@cache
def plan_of(shapes: Shapes) -> Plan:
    """The plan of nets with parameters of these names and shapes."""
    sizes, begin, at = dict(shapes), {}, 0
    for name, shape in shapes:
        begin[name] = at
        at += math.prod(shape)
    widths = {target: sizes[name][0] for name, _, _, target, _ in LAYERS}
    widths |= {name: 3 * PAD for name in FIELDS if name.endswith("gates")} | {
        "changes": 12,
        "residual": 3,
        "lengths": 4,
    }
    ends = np.cumsum([widths.get(name, CELLS) for name in FIELDS])
    columns = dict(zip(FIELDS, [0, *ends[:-1].tolist()], strict=True))
    rows = []
    for name, source, first, target, relu in LAYERS:
        outputs, inputs = sizes[name]
        starts = begin[name], begin[name.replace("weight", "bias")]
        rows.append([*starts, outputs, inputs, outputs > inputs, columns[source] + first, columns[target], relu])
    longest = (max(max(sizes[name]) for name, *_ in LAYERS) // PAD + 2) * PAD
    size = len(LAYERS), max(min(sizes[name]) for name, *_ in LAYERS) + CELLS, longest
    return Plan(np.array(rows), np.array(list(columns.values())), int(ends[-1]) // PAD * PAD + 3 * PAD, size, at)


@storage
def new_net(plan: Plan, like: Floats) -> Net:
    """Memory of the weights of one net."""
    return Net(np.zeros(plan.size, like.dtype), np.zeros(plan.parameters, like.dtype), plan.layers, plan.columns)


@part
def unpack(theta: Floats, net: Net) -> None:
    """Copy flat weights (P,), with the matrices of tall layers transposed."""
    for i in range(len(theta)):
        net.weights[i] = theta[i]
    for layer in range(len(net.layers)):
        matrix, (at, _, outputs, inputs, tall, _, _, _) = net.matrices[layer], columns_of(net, layer)
        for o in range(outputs):
            for i in range(inputs):
                if tall:
                    matrix[i, o] = theta[at + o * inputs + i]
                else:
                    matrix[o, i] = theta[at + o * inputs + i]


@part
def whole(rows: Index) -> Index:
    """Rows of a matrix with those of zeros behind it."""
    return (rows + CELLS - 1) // CELLS * CELLS


@part
def columns_of(net: Net, name: Index) -> tuple[Any, ...]:
    """A row of `Net.layers`."""
    row = net.layers[name]
    return row[0], row[1], row[2], row[3], row[4], row[5], row[6], row[7]


@part
def forward_layer(net: Net, name: Index, tape: Floats, row: Index, lanes: Index) -> None:
    """y = W x + b of a layer at so many rows of the tape."""
    _, bias, outputs, inputs, tall, source, to, relu = columns_of(net, name)
    start, matrix, zero = net.weights[bias : bias + outputs], net.matrices[name], tape.dtype.type(0.0)
    for lane in range(row, row + lanes):
        y = tape[lane, to : to + outputs]
        for o in range(outputs):
            y[o] = start[o]
    if tall:
        add_rows(tape, to, tape, source, matrix[: whole(inputs)], outputs, row, lanes)
    else:
        add_dots(tape, to, tape, source, matrix[: whole(outputs)], inputs, row, lanes)
    if relu:
        for lane in range(row, row + lanes):
            y = tape[lane, to : to + outputs]
            for o in range(outputs):
                y[o] = zero if y[o] < zero else y[o]


@part
def backward_layer(net: Net, name: Index, tape: Floats, gradient: Floats, row: Index, lanes: Index) -> None:
    """Add W^T dy to dx of a layer at so many rows; where its ReLU is shut dy becomes zero."""
    _, _, outputs, inputs, tall, source, to, relu = columns_of(net, name)
    matrix, zero = net.matrices[name], tape.dtype.type(0.0)
    if relu:
        for lane in range(row, row + lanes):
            y, dy = tape[lane, to : to + outputs], gradient[lane, to : to + outputs]
            for o in range(outputs):
                dy[o] = dy[o] if y[o] > zero else zero
    if tall:
        add_dots(gradient, source, gradient, to, matrix[: whole(inputs)], outputs, row, lanes)
    else:
        add_rows(gradient, source, gradient, to, matrix[: whole(outputs)], inputs, row, lanes)


@summing
def add_rows(
    target: Floats, to: Index, given: Floats, source: Index, matrix: Floats, n: Index, row: Index, lanes: Index
) -> None:
    """y (n,) += x (m,) M (m, n) in rows of two arrays; nine rows of M at a time, which all lanes share.

    The zeros behind a matrix let whole blocks of nine rows and PAD columns count.
    """
    m, n = len(matrix), (n + PAD - 1) // PAD * PAD
    for p in range(0, m, 9):
        w = matrix[p : p + 9]
        for lane in range(row, row + lanes):
            x, y = given[lane, source + p : source + p + 9], target[lane, to : to + n]
            x0, x1, x2, x3, x4, x5, x6, x7, x8 = x[0], x[1], x[2], x[3], x[4], x[5], x[6], x[7], x[8]
            for j in range(n):
                s = x0 * w[0, j] + x1 * w[1, j] + x2 * w[2, j]
                t = x3 * w[3, j] + x4 * w[4, j] + x5 * w[5, j]
                y[j] += s + t + (x6 * w[6, j] + x7 * w[7, j] + x8 * w[8, j])


@summing
def add_dots(
    target: Floats, to: Index, given: Floats, source: Index, matrix: Floats, n: Index, row: Index, lanes: Index
) -> None:
    """y (m,) += M (m, n) x (n,), as `add_rows`."""
    m, n = len(matrix), (n + PAD - 1) // PAD * PAD
    for p in range(0, m, 9):
        w = matrix[p : p + 9]
        for lane in range(row, row + lanes):
            x, y = given[lane, source : source + n], target[lane, to + p : to + p + 9]
            s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = s8 = target.dtype.type(0.0)
            for j in range(n):
                s0, s1, s2 = s0 + w[0, j] * x[j], s1 + w[1, j] * x[j], s2 + w[2, j] * x[j]
                s3, s4, s5 = s3 + w[3, j] * x[j], s4 + w[4, j] * x[j], s5 + w[5, j] * x[j]
                s6, s7, s8 = s6 + w[6, j] * x[j], s7 + w[7, j] * x[j], s8 + w[8, j] * x[j]
            y[0], y[1], y[2] = y[0] + s0, y[1] + s1, y[2] + s2
            y[3], y[4], y[5] = y[3] + s3, y[4] + s4, y[5] + s5
            y[6], y[7], y[8] = y[6] + s6, y[7] + s7, y[8] + s8


@part
def tanh(v: Any, real: Any) -> Any:
    """tanh from [7/6] of its continued fraction at v/4 and two doublings, tanh 2y = 2 tanh y / (1 + tanh^2 y).

    No table and no branch, so that a loop over it vectorises; NaN stays NaN. Error 2e-7 in float32, 3e-13 in float64.
    """
    v = real(15.0) if v > real(15.0) else v
    v = real(-15.0) if v < real(-15.0) else v
    y = v * real(0.25)
    s = y * y
    p = ((s * real(1 / 135135) + real(378 / 135135)) * s + real(17325 / 135135)) * s + real(1.0)
    q = ((s * real(28 / 135135) + real(3150 / 135135)) * s + real(62370 / 135135)) * s + real(1.0)
    p = y * p
    p, q = (p + p) * q, p * p + q * q
    return (p + p) * q / (p * p + q * q)


@part
def sigmoid(v: Any, real: Any) -> Any:
    """1 / (1 + exp(-v))."""
    return real(0.5) + real(0.5) * tanh(real(0.5) * v, real)

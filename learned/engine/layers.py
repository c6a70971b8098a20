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
from coopoc.kernels.compiling.compile import part, summing

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
    """For nets of one shape: layers (14, 8), first column of each field, columns of the tape, number of parameters."""

    layers: Ints
    columns: Ints
    width: int
    parameters: int


class Net(NamedTuple):
    """Weights (P,) of one net as its layers read them, and what `Plan` says of them."""

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
    return Plan(np.array(rows), np.array(list(columns.values())), int(ends[-1]) + PAD, at)


@part
def unpack(theta: Floats, net: Net) -> None:
    """Copy flat weights (P,), with the matrices of tall layers transposed."""
    weights, layers = net.weights, net.layers
    for i in range(len(theta)):
        weights[i] = theta[i]
    for layer in range(len(layers)):
        if layers[layer, TALL]:
            at, outputs, inputs = layers[layer, WEIGHT], layers[layer, OUTPUTS], layers[layer, INPUTS]
            for o in range(outputs):
                for i in range(inputs):
                    weights[at + i * outputs + o] = theta[at + o * inputs + i]


@part
def columns_of(net: Net, name: Index) -> tuple[Any, ...]:
    """A row of `Net.layers`."""
    row = net.layers[name]
    return row[0], row[1], row[2], row[3], row[4], row[5], row[6], row[7]


@part
def forward_layer(net: Net, name: Index, tape: Floats, row: Index, lanes: Index) -> None:
    """y = W x + b of a layer at so many rows of the tape."""
    weight, bias, outputs, inputs, tall, source, to, relu = columns_of(net, name)
    start, matrix = net.weights[bias : bias + outputs], net.weights[weight : weight + outputs * inputs]
    zero = tape.dtype.type(0.0)
    for lane in range(row, row + lanes):
        y = tape[lane, to : to + outputs]
        for o in range(outputs):
            y[o] = start[o]
    if tall:
        add_rows(tape, to, tape, source, matrix.reshape(inputs, outputs), row, lanes)
    else:
        add_dots(tape, to, tape, source, matrix.reshape(outputs, inputs), row, lanes)
    if relu:
        for lane in range(row, row + lanes):
            y = tape[lane, to : to + outputs]
            for o in range(outputs):
                y[o] = zero if y[o] < zero else y[o]


@part
def backward_layer(net: Net, name: Index, tape: Floats, gradient: Floats, row: Index, lanes: Index) -> None:
    """Add W^T dy to dx of a layer at so many rows; where its ReLU is shut dy becomes zero."""
    weight, _, outputs, inputs, tall, source, to, relu = columns_of(net, name)
    matrix, zero = net.weights[weight : weight + outputs * inputs], tape.dtype.type(0.0)
    if relu:
        for lane in range(row, row + lanes):
            y, dy = tape[lane, to : to + outputs], gradient[lane, to : to + outputs]
            for o in range(outputs):
                dy[o] = dy[o] if y[o] > zero else zero
    if tall:
        add_dots(gradient, source, gradient, to, matrix.reshape(inputs, outputs), row, lanes)
    else:
        add_rows(gradient, source, gradient, to, matrix.reshape(outputs, inputs), row, lanes)


@summing
def add_rows(target: Floats, to: Index, given: Floats, source: Index, matrix: Floats, row: Index, lanes: Index) -> None:
    """y (n,) += x (m,) M (m, n) in rows of two arrays; four rows of M at a time, which all lanes share."""
    m, n = matrix.shape
    whole = m - m % 4
    for p in range(0, whole, 4):
        for lane in range(row, row + lanes):
            x, y = given[lane, source + p : source + p + 4], target[lane, to : to + n]
            x0, x1, x2, x3 = x[0], x[1], x[2], x[3]
            for j in range(n):
                y[j] += (x0 * matrix[p, j] + x1 * matrix[p + 1, j]) + (x2 * matrix[p + 2, j] + x3 * matrix[p + 3, j])
    for p in range(whole, m):
        for lane in range(row, row + lanes):
            x0, y = given[lane, source + p], target[lane, to : to + n]
            for j in range(n):
                y[j] += x0 * matrix[p, j]


@summing
def add_dots(target: Floats, to: Index, given: Floats, source: Index, matrix: Floats, row: Index, lanes: Index) -> None:
    """y (m,) += M (m, n) x (n,), as `add_rows`; three rows of M at a time, since m is always a multiple of three."""
    m, n = matrix.shape
    for p in range(0, m, 3):
        for lane in range(row, row + lanes):
            x, y = given[lane, source : source + n], target[lane, to + p : to + p + 3]
            s = t = u = target.dtype.type(0.0)
            for j in range(n):
                s += matrix[p, j] * x[j]
                t += matrix[p + 1, j] * x[j]
                u += matrix[p + 2, j] * x[j]
            y[0], y[1], y[2] = y[0] + s, y[1] + t, y[2] + u


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

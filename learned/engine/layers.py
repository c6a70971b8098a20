"""Layers of a GainNet for the compiled engine: their numbers in flat weights, their columns on the tape, products.

The tape has a row of numbers per step and drive: inputs and outputs of every layer, side by side, at columns that
`plan_of` gives; the gradient of the tape has the same columns. A layer is y = W x + b, with ReLU where the net has one.
Products write whole vectors, so that a field is followed by room or by what is written later.
"""

import math
from collections import namedtuple
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from coopoc.arrays import Floats, Ints
from coopoc.kernels.compiling.compile import inside, part, storage

from .tile import Index, apart, product

STATE_SIZE = 3
"""Components of state and measurement, m = n = 3."""
CELLS = STATE_SIZE * STATE_SIZE
"""Entries of each covariance-like GRU state."""
SHORTEST_LENGTH = 1e-12
"""Length in m up to which a vector has no direction: its feature is zero and has no gradient."""
PAD = 16
"""Columns of a gate of a GRU: more than the nine that count, because loops of such a length vectorise."""
FROM_X, FROM_H, GATES = PAD, 3 * PAD, 5 * PAD
"""Columns of W x, U h and the gates of a GRU from that of its old state."""
ZEROS = 512
"""Zeros at the end of the matrices, as many as the longest row has entries."""
Shapes = tuple[tuple[str, tuple[int, ...]], ...]
"""Names and shapes of a net's parameters, in the order of theta."""


Columns = namedtuple(
    "Columns",
    "changes corrected process_old process_x process_h process_gates process evolved prior_old prior_x prior_h "
    "prior_gates expected observed innovation_old innovation_x innovation_h innovation_gates prior innovation gain "
    "hidden prior_copy back posterior residual lengths",
)
"""First column of each field of the tape, in their order: [process, evolved], [expected, observed], [prior, innovation,
gain] and [prior_copy, back] stand side by side, because layers read two of them at once. `changes` holds the directions
of the four changes: of the fix, innovation, evolution, update."""
ADJACENT_FIELDS = ("process", "expected", "prior", "innovation", "prior_copy")
"""Fields that end where the next one begins; the others have room for the last vector of what is written there."""
_ROWS = (
    "update.weight changes 9 corrected 1 1",
    "process.weight_ih corrected 0 process_x 0 1",
    "process.weight_hh process_old 0 process_h 0 0",
    "evolution.weight changes 6 evolved 1 1",
    "prior.weight_ih process 0 prior_x 0 0",
    "prior.weight_hh prior_old 0 prior_h 0 0",
    "prior_to_innovation.weight prior 0 expected 1 0",
    "observation.weight changes 0 observed 1 1",  # after `expected`, whose last vector reaches into it
    "innovation.weight_ih expected 0 innovation_x 0 1",
    "innovation.weight_hh innovation_old 0 innovation_h 0 0",
    "gain_hidden.weight prior 0 hidden 1 0",
    "gain.weight hidden 0 gain 0 1",
    "posterior_hidden.weight innovation 0 back 1 0",
    "posterior.weight prior_copy 0 posterior 1 1",
)
LAYERS = [row.split() for row in _ROWS]
"""Layers in the order of forward: parameter, field and first column of the inputs, field of the outputs, 1 where a ReLU
follows, 1 where backward finds no gradient at the inputs yet."""


class Plan(NamedTuple):
    """For nets of one shape: layers (14, 11), first column of each field, columns of the tape, length of
    `Net.matrices`, and places (3, P) there of each parameter: for forward, for backward, and of its gradient."""

    layers: Ints
    columns: Columns
    width: int
    size: int
    places: Ints


class Net(NamedTuple):
    """All matrices of one net with rows of whole vectors, and what `Plan` says of them.

    Of each layer stand one after the other W^T, which forward reads, W, which backward reads, and b.
    """

    matrices: Floats
    layers: Ints
    columns: Columns
    places: Ints


@cache
def plan_of(shapes: Shapes) -> Plan:
    """The plan of nets with parameters of these names and shapes."""
    sizes, begin, at = dict(shapes), {}, 0
    for name, shape in shapes:
        begin[name] = at
        at += math.prod(shape)
    widths = {target: sizes[name][0] for name, _, _, target, _, _ in LAYERS}
    widths |= {name: 3 * PAD for name in Columns._fields if name.endswith("gates")} | {"changes": 9 + PAD}
    columns, end = {}, 0
    for name in Columns._fields:
        columns[name], width = end, widths.get(name, CELLS)
        end += width if name in ADJACENT_FIELDS else whole(end + whole(width)) - end
    rows, size, places = [], 0, np.empty((3, at), np.int64)
    for name, source, first, target, relu, begins in LAYERS:
        outputs, inputs = sizes[name]
        back = size + inputs * whole(outputs)
        bias = back + outputs * whole(inputs)
        o, i = np.indices((outputs, inputs)).reshape(2, -1)
        ahead, behind = size + i * whole(outputs) + o, back + o * whole(inputs) + i
        places[:, begin[name] : begin[name] + outputs * inputs] = ahead, behind, ahead if outputs > inputs else behind
        first_bias = begin[name.replace("weight", "bias")]
        places[:, first_bias : first_bias + outputs] = bias + np.arange(outputs)
        gru = name.partition(".weight_hh")
        unit = (columns[f"{gru[0]}_old"], columns[gru[0]]) if gru[1] else (0, 0)
        ends = columns[source] + int(first), columns[target]
        rows.append([outputs, inputs, size, back, bias, *ends, int(relu), int(begins), *unit])
        size = bias + whole(outputs)
    return Plan(np.array(rows), Columns(**columns), end, size, places)


def whole(columns: int) -> int:
    """Columns rounded up to whole vectors."""
    return -(-columns // PAD) * PAD


@storage
def aligned(rows: Index, columns: Index, like: Floats) -> Floats:
    """Zeros that begin where a vector may begin: one that crosses a line of the cache takes twice as long.

    What stands in new memory may be denormal, with which every operation takes a hundred times as long.
    """
    memory = np.zeros(rows * columns + PAD, like.dtype)
    first = -(memory.ctypes.data // memory.itemsize) % PAD
    return memory[first : first + rows * columns].reshape(rows, columns)


@storage
def new_net(plan: Plan, like: Floats) -> Net:
    """Memory of the weights of one net."""
    return Net(aligned(1, plan.size + ZEROS, like)[0], plan.layers, plan.columns, plan.places)


@part
def unpack(theta: Floats, net: Net) -> None:
    """Copy flat weights (P,) into the matrices."""
    for p in range(len(theta)):
        net.matrices[net.places[0, p]] = net.matrices[net.places[1, p]] = theta[p]


@inside
def columns_of(net: Net, name: Index) -> tuple[Any, ...]:
    """A row of `Net.layers` but for its last two: old and new state of the GRU that the layer completes, or 0."""
    row = net.layers[name]
    return row[0], row[1], row[2], row[3], row[4], row[5], row[6], row[7], row[8]


@inside
def forward_layer(net: Net, name: Index, tape: Floats, row: Index, lanes: Index) -> None:
    """y = W x + b of a layer at so many rows of the tape."""
    outputs, inputs, ahead, _, start, source, to, relu, _ = columns_of(net, name)
    width, m, real = tape.shape[1], net.matrices, tape.dtype.type
    x, y = (tape, row * width + source, width), (tape, row * width + to, width)
    floor = real(0.0) if relu else real(-np.inf)
    product(y, x, 1, (m, ahead, outputs + -outputs % PAD), (m, start, 0), (lanes, outputs, inputs), floor)


@part
def backward_layer(net: Net, name: Index, tape: Floats, gradient: Floats, row: Index, lanes: Index) -> None:
    """Add W^T dy to dx of a layer at so many rows, or write it if no gradient stands there yet; where the ReLU of the
    layer is shut dy becomes zero."""
    outputs, inputs, _, back, _, source, to, relu, begins = columns_of(net, name)
    width = tape.shape[1]
    if relu:
        for lane in range(row, row + lanes):
            shut(tape[lane, to : to + outputs], gradient[lane, to : to + outputs])
    dx, dy, w = (gradient, row * width + source, width), (gradient, row * width + to, width), net.matrices
    b, size, floor = (w, back, inputs + -inputs % PAD), (lanes, inputs, outputs), tape.dtype.type(-np.inf)
    if begins:
        product(dx, dy, 1, b, (w, len(w) - ZEROS, 0), size, floor)
    else:
        product(dx, dy, 1, b, dx, size, floor)


@part
def shut(y: Floats, dy: Floats) -> None:
    """dy = 0 where y is not positive."""
    apart()
    for o in range(len(dy)):
        dy[o] = dy[o] if y[o] > 0.0 else dy.dtype.type(0.0)


@part
def collect(total: Net, tape: Floats, gradient: Floats, one: Floats) -> None:
    """Add to the gradient of the weights that of every layer: dW = dy^T x and db = dy, summed over the rows.

    dW^T stands in place of W^T where it has the longer rows, else dW in place of W.
    """
    steps, width = tape.shape
    m, floor = total.matrices, tape.dtype.type(-np.inf)
    for layer in range(len(total.layers)):
        outputs, inputs, ahead, back, start, source, to, _, _ = columns_of(total, layer)
        x, dy = (tape, source, 1), (gradient, to, 1)
        if outputs > inputs:
            out = (m, ahead, outputs + -outputs % PAD)
            product(out, x, width, (gradient, to, width), out, (inputs, outputs, steps), floor)
        else:
            out = (m, back, inputs + -inputs % PAD)
            product(out, dy, width, (tape, source, width), out, (outputs, inputs, steps), floor)
        out = (m, start, 0)
        product(out, (one, 0, 0), 0, (gradient, to, width), out, (1, outputs, steps), floor)


@part
def pack(total: Net, gradient: Floats) -> None:
    """Copy what `collect` has added to the gradient (P,) of the flat weights."""
    for p in range(len(gradient)):
        gradient[p] = total.matrices[total.places[2, p]]


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

"""Where the compiled kernels find weights and what a step leaves behind: matrices with padded columns, and a tape."""

from __future__ import annotations

from typing import NamedTuple

from numba.extending import register_jitable

from coopoc.arrays import AnyArray, Bools, Ints
from coopoc.learned.engine.arguments import Matrices

from .arithmetic import ONE, PAD, Index, borrowed, inside, part, whole, window


class Net(NamedTuple):
    """Flat weights (P,) of one model, or their gradient, and memory for the same as matrices with padded columns.

    `layers` (layers, 11) holds of each where its weight and its bias begin in theta, its outputs, its inputs, where it
    begins in `padded`; how many of its inputs, the first ones, come last on the tape; whether it ends in a ReLU; the
    field of the tape with its inputs and their first column; the field of the deltas with the gradient of its outputs
    and their first column. `transposed` (layers,): whether the matrix is (inputs, outputs). `places` (P,): where
    each number of theta is in `padded`.
    """

    theta: AnyArray
    padded: AnyArray
    layers: Ints
    transposed: Bools
    places: AnyArray


class Nets(NamedTuple):
    """A net with transposed matrices, as the forward pass reads it, with untransposed ones, and its gradient."""

    ahead: Net
    straight: Net
    gradient: Net


class Tape(NamedTuple):
    """What the steps of one model leave behind, in memory that is kept for backward and in memory that is not.

    `fields` (fields, 3) holds of each where it begins, its width, and whether it is kept (1, else 0). `now` (2,) holds
    the slot of the present step in the memory that is not kept, which has few and uses them in turn, and in the other.
    """

    passing: AnyArray
    kept: AnyArray
    fields: Ints
    now: Ints
    lanes: Index


@inside
def net_of(theta: AnyArray, padded: AnyArray, matrices: Matrices, which: Index) -> Net:
    """The net of flat weights with its matrices transposed as row `which` of `Matrices` has it."""
    places, transposed = matrices.places[which], matrices.transposed[which]
    return Net(borrowed(theta), borrowed(padded), borrowed(matrices.layers), borrowed(transposed), borrowed(places))


@register_jitable
def room(outputs: Index, inputs: Index) -> Index:
    """Padded memory of a layer: its weight, transposed or not, and its bias."""
    return max(inputs * whole(outputs), outputs * whole(inputs + PAD - 9)) + whole(outputs)


@inside
def matrix(net: Net, layer: Index) -> AnyArray:
    """Weight (outputs, inputs) of a layer, or transposed (inputs, outputs), a view; inputs stand as on the tape.

    Untransposed rows are so long that PAD columns may be read from the last nine inputs on.
    """
    outputs, inputs, at = net.layers[layer, 2], net.layers[layer, 3], net.layers[layer, 4]
    rows, columns = (inputs, whole(outputs)) if net.transposed[layer] else (outputs, whole(inputs + PAD - 9))
    return window(net.padded, at, rows, columns)


@inside
def bias(net: Net, layer: Index) -> AnyArray:
    """Bias (1, outputs) of a layer with padded columns, a view."""
    outputs, inputs = net.layers[layer, 2], net.layers[layer, 3]
    end = net.layers[layer, 4] + room(outputs, inputs)
    return window(net.padded, end - whole(outputs), ONE, whole(outputs))


@part
def unpack(net: Net) -> None:
    """Every layer's weight and bias from theta into its matrix, with zeros as padding."""
    net.padded[:] = 0.0
    for i in range(len(net.theta)):
        net.padded[net.places[i]] = net.theta[i]


@part
def pack(net: Net) -> None:
    """Every layer's weight and bias from its matrix into theta."""
    for i in range(len(net.theta)):
        net.theta[i] = net.padded[net.places[i]]


@inside
def rows(tape: Tape, name: Index) -> AnyArray:
    """(B, width) of a field at the present step, a view."""
    return span(tape, name, ONE)


@inside
def span(tape: Tape, name: Index, count: Index) -> AnyArray:
    """(count B, width) of a field at `count` steps from the present one on, a view."""
    width, kept = tape.fields[name, 1], tape.fields[name, 2]
    at = tape.fields[name, 0] + tape.now[kept] * tape.lanes * width
    if kept:
        return window(tape.kept, at, count * tape.lanes, width)
    return window(tape.passing, at, count * tape.lanes, width)

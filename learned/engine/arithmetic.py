"""Arithmetic of the compiled kernels: products, tanh and sigmoid that vectorise, and views into flat memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar, cast

import numba
import numpy as np

from coopoc.arrays import AnyArray, Ints

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """Compiled at the first call and cached on disk, without the interpreter's lock.

    A product and a sum may become one instruction; nothing is reordered.
    """
    made = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
    return cast(Function, made(function))


@compiled
def tanh(v: Any, real: Any) -> Any:
    """tanh from [9/8] of its continued fraction at v/4 and two doublings, tanh 2y = 2 tanh y / (1 + tanh^2 y).

    No table and no branch, so that a loop over it vectorises; NaN stays NaN. Error 2e-7 in float32, 2e-13 in float64.
    """
    v = real(15.0) if v > real(15.0) else v
    v = real(-15.0) if v < real(-15.0) else v
    y = v * real(0.25)
    s = y * y
    p = s * real(1 / 34459425) + real(990 / 34459425)
    p = y * (((p * s + real(135135 / 34459425)) * s + real(4729725 / 34459425)) * s + real(1.0))
    q = s * real(45 / 34459425) + real(13860 / 34459425)
    q = ((q * s + real(945945 / 34459425)) * s + real(16216200 / 34459425)) * s + real(1.0)
    p, q = (p + p) * q, p * p + q * q
    return (p + p) * q / (p * p + q * q)


@compiled
def sigmoid(v: Any, real: Any) -> Any:
    """1 / (1 + exp(-v))."""
    return real(0.5) + real(0.5) * tanh(real(0.5) * v, real)


@compiled
def add_product(a: AnyArray, b: AnyArray, out: AnyArray) -> None:
    """out (m, n) += a (m, k) b (k, n)."""
    for i in range(a.shape[0]):
        for k in range(a.shape[1]):
            factor = a[i, k]
            for j in range(out.shape[1]):
                out[i, j] += factor * b[k, j]


class Net(NamedTuple):
    """Flat weights (P,) of one model, its transposed weights at the same places, and where its layers lie.

    `layers` (layers, 4): where a weight and its bias begin, outputs, inputs.
    """

    theta: AnyArray
    turned: AnyArray
    layers: Ints


class Tape(NamedTuple):
    """What the steps of one model leave behind: `fields` (fields, 3) says where each begins, its width, its slots.

    A field with fewer slots than there are steps is overwritten in turn: one slot keeps nothing.
    """

    memory: AnyArray
    fields: Ints
    lanes: int


@compiled
def weight(net: Net, layer: int) -> AnyArray:
    """Weight (outputs, inputs) of a layer, a view."""
    at, outputs, inputs = net.layers[layer, 0], net.layers[layer, 2], net.layers[layer, 3]
    return net.theta[at : at + outputs * inputs].reshape(outputs, inputs)


@compiled
def turned(net: Net, layer: int) -> AnyArray:
    """Transposed weight (inputs, outputs) of a layer, a view: products run along its last axis."""
    at, outputs, inputs = net.layers[layer, 0], net.layers[layer, 2], net.layers[layer, 3]
    return net.turned[at : at + outputs * inputs].reshape(inputs, outputs)


@compiled
def bias(net: Net, layer: int) -> AnyArray:
    """Bias (outputs,) of a layer, a view."""
    return net.theta[net.layers[layer, 1] : net.layers[layer, 1] + net.layers[layer, 2]]


@compiled
def opened(theta: AnyArray, layers: Ints) -> Net:
    """A model's flat weights with their transposes."""
    net = Net(theta, np.empty_like(theta), layers)
    for layer in range(len(layers)):
        source, target = weight(net, layer), turned(net, layer)
        for i in range(target.shape[0]):
            for j in range(target.shape[1]):
                target[i, j] = source[j, i]
    return net


@compiled
def rows(tape: Tape, name: int, step: int) -> AnyArray:
    """(B, width) of a field at a step, a view."""
    return span(tape, name, step % tape.fields[name, 2], 1)


@compiled
def span(tape: Tape, name: int, slot: int, count: int) -> AnyArray:
    """(count B, width) of `count` slots of a field from `slot` on, a view."""
    at, width = tape.fields[name, 0], tape.fields[name, 1]
    size = tape.lanes * width
    return tape.memory[at + slot * size : at + (slot + count) * size].reshape(count * tape.lanes, width)

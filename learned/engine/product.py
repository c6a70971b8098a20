"""Matrix products for compiled kernels, of tiles whose sums stay in registers.

NumPy's product inside numba is a call into BLAS, which for one trajectory takes longer than the product itself; a loop
in Python's syntax keeps its sums in memory. These tiles are as fast as BLAS for many rows and half as fast for one.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import types

from coopoc.arrays import AnyArray
from coopoc.kernels.compile import summing

from .arithmetic import ONE, PAD, ZERO, Index, apart, inside, instructions
from .tile import ADD, BYTES, GATE, RELU, shapes, stays

TALL = 6
"""Most rows of a tile: 6 x 2 sums, two vectors of b and a factor fit the 16 registers of AVX2."""
WIDEST = {1: 2, 2: 4} | dict.fromkeys(range(3, TALL + 1), 2)
"""Most vectors of a tile by its rows: one with few rows is wide, so that no sum waits for itself."""
one_row, few_rows = shapes({1: 8}), shapes(WIDEST)


@inside
def affine(
    a: AnyArray, at: Index, depth: Index, b: AnyArray, start: AnyArray, relu: bool, out: AnyArray, column: Index
) -> None:
    """out[:, column:] (m, n) = a[:, at:] (m, depth) b (depth, n) + start (1, n), if `relu` zero where that is negative.

    In all products n is a multiple of PAD. NaN stays NaN.
    """
    size, end, real = out.itemsize, b.strides[0], out.dtype.type
    left, into = _at(a) + at * size, _at(out) + column * size
    if a.shape[0] > 1:
        _tiles(left, a.strides[0], size, _at(b), end, _at(start), ZERO, _at(start), ZERO, into, out.strides[0],
               a.shape[0], depth, end, ADD + RELU if relu else ADD, real)  # fmt: skip
    elif relu:
        _row_relu(left, size, _at(b), end, _at(start), into, end, depth, real)
    else:
        _row_sum(left, size, _at(b), end, _at(start), into, end, depth, real)


@inside
def gated_product(a: AnyArray, at: Index, depth: Index, b: AnyArray, gate: AnyArray, out: AnyArray) -> None:
    """out (m, n) = a[:, at:] (m, depth) b (depth, n) where gate (m, n) is positive, else zero."""
    size, end, real = out.itemsize, out.strides[0], out.dtype.type
    if a.shape[0] > 1:
        _tiles(_at(a) + at * size, a.strides[0], size, _at(b), b.strides[0], _at(out), ZERO, _at(gate), gate.strides[0],
               _at(out), end, a.shape[0], depth, end, GATE, real)  # fmt: skip
    else:
        _row_gated(_at(a) + at * size, size, _at(b), b.strides[0], _at(gate), _at(out), end, depth, real)


@inside
def add_product(a: AnyArray, at: Index, depth: Index, b: AnyArray, column: Index, out: AnyArray) -> None:
    """out (m, n) += a[:, at:] (m, depth) b[:, column:] (depth, n)."""
    size, end, real = out.itemsize, out.strides[0], out.dtype.type
    left, right = _at(a) + at * size, _at(b) + column * size
    if a.shape[0] > 1:
        _tiles(left, a.strides[0], size, right, b.strides[0], _at(out), end, _at(out), ZERO, _at(out), end, a.shape[0],
               depth, end, ADD, real)  # fmt: skip
    else:
        _row_sum(left, size, right, b.strides[0], _at(out), _at(out), end, depth, real)


@inside
def add_outer(a: AnyArray, at: Index, count: Index, b: AnyArray, column: Index, out: AnyArray) -> None:
    """out (count, n) += a[:, at:] (k, count)^T b[:, column:] (k, n).

    What lies behind rows of b that are shorter is read; the columns of out beyond them then mean nothing.
    """
    size, end, real = out.itemsize, out.strides[0], out.dtype.type
    left, right = _at(a) + at * size, _at(b) + column * size
    if count > 1:
        _tiles(left, size, a.strides[0], right, b.strides[0], _at(out), end, _at(out), ZERO, _at(out), end, count,
               a.shape[0], end, ADD, real)  # fmt: skip
    else:
        _row_sum(left, a.strides[0], right, b.strides[0], _at(out), _at(out), end, a.shape[0], real)


@summing
def dots(a: AnyArray, depth: Index, b: AnyArray, first: Index, out: AnyArray) -> None:
    """out (m, 4): products of rows of a, `depth` long, with three rows of b from `first` on, and with b's last if b has
    rows for logarithms, else zero."""
    last, logs, zero = b.shape[0] - 1, b.shape[0] % 4 == 0, a.dtype.type(0.0)
    for i in range(a.shape[0]):
        s = t = u = v = zero
        for k in range(depth):
            s += a[i, k] * b[first, k]
            t += a[i, k] * b[first + 1, k]
            u += a[i, k] * b[first + 2, k]
            v += a[i, k] * b[last, k]
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = s, t, u, v if logs else zero


@inside
def _tiles(
    a: Index, a_row: Index, a_column: Index, b: Index, b_row: Index, start: Index, start_row: Index, gate: Index,
    gate_row: Index, out: Index, out_row: Index, rows: Index, depth: Index, end: Index, how: Index, real: Any,
) -> None:  # fmt: skip
    """A product from addresses, strides and the length of a row of the result, all in bytes."""
    wide, j = 4 if rows == 2 else 2, 0
    while j < end:
        while wide * BYTES > end - j:
            wide //= 2
        for i in range(0, rows, TALL):
            tall = min(rows - i, TALL)
            _tile(a + i * a_row, a_row, a_column, b + j, b_row, start + i * start_row + j, start_row,
                  gate + i * gate_row + j, gate_row, out + i * out_row + j, out_row, tall, wide, depth, how, real)
        j += wide * BYTES


@apart
def _tile(
    a: Index, a_row: Index, a_column: Index, b: Index, b_row: Index, start: Index, start_row: Index, gate: Index,
    gate_row: Index, out: Index, out_row: Index, tall: Index, wide: Index, depth: Index, how: Index, real: Any,
) -> None:  # fmt: skip
    """A tile of so many rows and vectors at these addresses, in a function of its own: within the loops of `_tiles` the
    compiler would work out the addresses of every shape before it takes one."""
    stays()
    few_rows(a, a_row, a_column, b, b_row, start, start_row, gate, gate_row, out, out_row, tall, wide, depth, how, real)


@apart
def _row_sum(
    a: Index, a_column: Index, b: Index, b_row: Index, start: Index, out: Index, end: Index, depth: Index, real: Any
) -> None:
    """One row of a product with ADD."""
    stays()
    _row(a, a_column, b, b_row, start, start, out, end, depth, ADD, real)


@apart
def _row_relu(
    a: Index, a_column: Index, b: Index, b_row: Index, start: Index, out: Index, end: Index, depth: Index, real: Any
) -> None:
    """One row with ADD and RELU."""
    stays()
    _row(a, a_column, b, b_row, start, start, out, end, depth, ADD + RELU, real)


@apart
def _row_gated(
    a: Index, a_column: Index, b: Index, b_row: Index, gate: Index, out: Index, end: Index, depth: Index, real: Any
) -> None:
    """One row with GATE."""
    stays()
    _row(a, a_column, b, b_row, gate, gate, out, end, depth, GATE, real)


@inside
def _row(
    a: Index, a_column: Index, b: Index, b_row: Index, start: Index, gate: Index, out: Index, end: Index, depth: Index,
    how: Index, real: Any,
) -> None:  # fmt: skip
    """One row of a product, as `_tiles`."""
    wide, j = 8, 0
    while j < end:
        while wide * BYTES > end - j:
            wide //= 2
        one_row(a, ZERO, a_column, b + j, b_row, start + j, ZERO, gate + j, ZERO, out + j, ZERO, ONE, wide, depth, how,
             real)  # fmt: skip
        j += wide * BYTES


@instructions
def _at(typing: Any, array: Any) -> Any:
    """Address of an array's first number."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        struct = context.make_array(signature.args[0])(context, builder, values[0])
        return builder.ptrtoint(struct.data, context.get_value_type(types.intp))

    return types.intp(array), generate


@inside
def spread(gates: AnyArray) -> None:
    """Of every row of gates (m, 3 PAD), the three nines at 0, 9, 18 to 0, PAD, 2 PAD, where vectors begin.

    A vector that is read across two that were just written would wait until these have reached the cache.
    """
    for row in range(gates.shape[0]):
        _spread(gates, row)


@instructions
def _spread(typing: Any, gates: Any, row: Any) -> Any:
    """`spread` of one row."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        struct = context.make_array(signature.args[0])(context, builder, values[0])
        number, lane = context.get_value_type(gates.dtype), ir.IntType(32)
        first = builder.gep(struct.data, [builder.mul(values[1], values[1].type(3 * PAD))])
        both = ir.VectorType(number, 2 * PAD)
        given = builder.load(builder.bitcast(first, ir.PointerType(both)), align=4)
        for half in (1, 2):
            mask = [min(9 * half + i, 2 * PAD - 1) for i in range(PAD)]
            taken = ir.Constant(ir.VectorType(lane, PAD), mask)
            moved = builder.shuffle_vector(given, ir.Constant(both, ir.Undefined), taken)
            place = builder.gep(first, [values[1].type(PAD * half)])
            builder.store(moved, builder.bitcast(place, ir.PointerType(moved.type)), align=4)
        return context.get_dummy_value()

    return types.void(gates, types.intp), generate

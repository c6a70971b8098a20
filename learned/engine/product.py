"""Matrix products for compiled kernels, of tiles whose sums stay in registers.

NumPy's product inside numba is a call into BLAS, which for one trajectory takes longer than the product itself; a loop
in Python's syntax keeps its sums in memory. These tiles are as fast as BLAS for many rows and half as fast for one.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import types

from coopoc.arrays import AnyArray
from coopoc.kernels.compiling.compile import summing

from .arithmetic import ONE, PAD, ZERO, Index, apart, inside, instructions
from .tile import ADD, BYTES, GATE, RELU, Tile, shapes, stays

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
    size, end, real, rows = out.itemsize, b.strides[0], out.dtype.type, a.shape[0]
    left, row, into, first = _at(a) + at * size, a.strides[0], _at(out) + column * size, _at(start)
    how = ADD + RELU if relu else ADD
    given = Tile(left, row, size, _at(b), end, first, ZERO, first, ZERO, into, out.strides[0], rows, end, depth, how)
    if rows > 1:
        _tiles(given, real)
    elif relu:
        _row_relu(given, real)
    else:
        _row_sum(given, real)


@inside
def gated_product(a: AnyArray, at: Index, depth: Index, b: AnyArray, gate: AnyArray, out: AnyArray) -> None:
    """out (m, n) = a[:, at:] (m, depth) b (depth, n) where gate (m, n) is positive, else zero."""
    size, end, real, rows, into = out.itemsize, out.strides[0], out.dtype.type, a.shape[0], _at(out)
    left, row, down, shut = _at(a) + at * size, a.strides[0], b.strides[0], _at(gate)
    given = Tile(left, row, size, _at(b), down, into, ZERO, shut, gate.strides[0], into, end, rows, end, depth, GATE)
    if rows > 1:
        _tiles(given, real)
    else:
        _row_gated(given, real)


@inside
def add_product(a: AnyArray, at: Index, depth: Index, b: AnyArray, column: Index, out: AnyArray) -> None:
    """out (m, n) += a[:, at:] (m, depth) b[:, column:] (depth, n)."""
    _add(_at(a) + at * out.itemsize, a.strides[0], out.itemsize, a.shape[0], depth, b, column, out)


@inside
def add_outer(a: AnyArray, at: Index, count: Index, b: AnyArray, column: Index, out: AnyArray) -> None:
    """out (count, n) += a[:, at:] (k, count)^T b[:, column:] (k, n).

    Rows of b that are shorter are read beyond their end; the columns of out beyond them then mean nothing.
    """
    _add(_at(a) + at * out.itemsize, out.itemsize, a.strides[0], count, a.shape[0], b, column, out)


@inside
def _add(
    left: Index, row: Index, step: Index, rows: Index, depth: Index, b: AnyArray, column: Index, out: AnyArray
) -> None:
    """out += a b[:, column:], with a from its address and strides in bytes."""
    end, real, into, right = out.strides[0], out.dtype.type, _at(out), _at(b) + column * out.itemsize
    given = Tile(left, row, step, right, b.strides[0], into, end, into, ZERO, into, end, rows, end, depth, ADD)
    if rows > 1:
        _tiles(given, real)
    else:
        _row_sum(given, real)


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
def _tiles(p: Tile, real: Any) -> None:
    """A product by tiles."""
    wide, j = 4 if p.tall == 2 else 2, 0
    while j < p.wide:
        while wide * BYTES > p.wide - j:
            wide //= 2
        for i in range(0, p.tall, TALL):
            a, b, tall = p.a + i * p.a_row, p.b + j, min(p.tall - i, TALL)
            start, gate, out = p.start + i * p.start_row + j, p.gate + i * p.gate_row + j, p.out + i * p.out_row + j
            rows = p.start_row, p.gate_row, p.out_row
            tile = Tile(
                a,
                p.a_row,
                p.a_column,
                b,
                p.b_row,
                start,
                rows[0],
                gate,
                rows[1],
                out,
                rows[2],
                tall,
                wide,
                p.depth,
                p.how,
            )
            _tile(tile, real)
        j += wide * BYTES


@apart
def _tile(tile: Tile, real: Any) -> None:
    """One tile, in a function of its own: within the loops of `_tiles` the compiler would compute the addresses of
    every shape before it takes one."""
    stays()
    few_rows(tile, real)


@apart
def _row_sum(p: Tile, real: Any) -> None:
    """One row of a product with ADD."""
    stays()
    _row(p, ADD, real)


@apart
def _row_relu(p: Tile, real: Any) -> None:
    """One row with ADD and RELU."""
    stays()
    _row(p, ADD + RELU, real)


@apart
def _row_gated(p: Tile, real: Any) -> None:
    """One row with GATE."""
    stays()
    _row(p, GATE, real)


@inside
def _row(p: Tile, how: Index, real: Any) -> None:
    """One row of a product, as `_tiles`."""
    wide, j = 8, 0
    while j < p.wide:
        while wide * BYTES > p.wide - j:
            wide //= 2
        b, start, gate, out = p.b + j, p.start + j, p.gate + j, p.out + j
        one_row(
            Tile(p.a, ZERO, p.a_column, b, p.b_row, start, ZERO, gate, ZERO, out, ZERO, ONE, wide, p.depth, how), real
        )
        j += wide * BYTES


@instructions
def _at(typing: Any, array: Any) -> Any:
    """Address of an array's first number."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        struct = context.make_array(signature.args[0])(context, builder, values[0])
        return builder.ptrtoint(struct.data, context.get_value_type(types.intp))

    return types.intp(array), generate


@inside
def align_gates(gates: AnyArray) -> None:
    """Of every row of gates (m, 3 PAD), the three nines at 0, 9, 18 to 0, PAD, 2 PAD, where vectors begin.

    A vector that is read across two that were just written would wait until these have reached the cache.
    """
    for row in range(gates.shape[0]):
        _align_row(gates, row)


@instructions
def _align_row(typing: Any, gates: Any, row: Any) -> Any:
    """`align_gates` of one row."""

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

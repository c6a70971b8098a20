"""Matrix products for compiled kernels: tiles whose sums stay in registers, written in LLVM's vectors.

NumPy's product inside numba is a call into BLAS, which for one trajectory takes longer than the product itself; a loop
in Python's syntax keeps its sums in memory. These tiles are as fast as BLAS for many rows and half as fast for one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, cast

import numpy as np
from llvmlite import binding, ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from coopoc.arrays import AnyArray
from coopoc.kernels.compile import part, summing

from .arithmetic import PAD, ZERO, Index

BYTES = 64 if binding.get_host_cpu_features().get("avx512f") else 32
"""Of a vector register."""
TALL = 6
"""Most rows of a tile: 6 x 2 sums, two vectors of b and a factor fit the 16 registers of AVX2."""
WIDEST = {1: 8, 2: 4}
"""Most vectors of a tile by its rows, 2 for more rows: one with few rows is wide, so that no sum waits for itself."""
ADD, RELU, GATE = np.array([1, 2, 4])
"""What a product does besides: begin from numbers, not zero; end with zero where it, or a gate, is not positive."""

instructions = cast(Callable[[Callable[..., Any]], Callable[..., Any]], intrinsic)
"""`intrinsic` with a type."""


@part
def affine(
    a: AnyArray, at: Index, depth: Index, b: AnyArray, start: AnyArray, relu: bool, out: AnyArray, column: Index
) -> None:
    """out[:, column:] (m, n) = a[:, at:] (m, depth) b (depth, n) + start (1, n), if `relu` zero where that is negative.

    In all products n is a multiple of PAD. NaN stays NaN.
    """
    size = out.itemsize
    _tiles(_at(a) + at * size, a.strides[0], size, _at(b), b.strides[0], _at(start), ZERO, _at(start), ZERO,
           _at(out) + column * size, out.strides[0], a.shape[0], depth, b.strides[0], ADD + RELU if relu else ADD,
           out.dtype.type)  # fmt: skip


@part
def gated_product(a: AnyArray, at: Index, depth: Index, b: AnyArray, gate: AnyArray, out: AnyArray) -> None:
    """out (m, n) = a[:, at:] (m, depth) b (depth, n) where gate (m, n) is positive, else zero."""
    size = out.itemsize
    _tiles(_at(a) + at * size, a.strides[0], size, _at(b), b.strides[0], _at(out), ZERO, _at(gate), gate.strides[0],
           _at(out), out.strides[0], a.shape[0], depth, out.strides[0], GATE, out.dtype.type)  # fmt: skip


@part
def add_product(a: AnyArray, at: Index, depth: Index, b: AnyArray, column: Index, out: AnyArray) -> None:
    """out (m, n) += a[:, at:] (m, depth) b[:, column:] (depth, n)."""
    size = out.itemsize
    _tiles(_at(a) + at * size, a.strides[0], size, _at(b) + column * size, b.strides[0], _at(out), out.strides[0],
           _at(out), ZERO, _at(out), out.strides[0], a.shape[0], depth, out.strides[0], ADD,
           out.dtype.type)  # fmt: skip


@part
def add_outer(a: AnyArray, at: Index, count: Index, b: AnyArray, column: Index, out: AnyArray) -> None:
    """out (count, n) += a[:, at:] (k, count)^T b[:, column:] (k, n).

    What lies behind rows of b that are shorter is read; the columns of out beyond them then mean nothing.
    """
    size = out.itemsize
    _tiles(_at(a) + at * size, size, a.strides[0], _at(b) + column * size, b.strides[0], _at(out), out.strides[0],
           _at(out), ZERO, _at(out), out.strides[0], count, a.shape[0], out.strides[0], ADD,
           out.dtype.type)  # fmt: skip


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


@part
def _tiles(
    a: Index, a_row: Index, a_column: Index, b: Index, b_row: Index, start: Index, start_row: Index, gate: Index,
    gate_row: Index, out: Index, out_row: Index, rows: Index, depth: Index, end: Index, how: Index, real: Any,
) -> None:  # fmt: skip
    """A product from addresses, strides and the length of a row of the result, all in bytes."""
    wide, j = 8 if rows == 1 else 4 if rows == 2 else 2, 0
    while j < end:
        while wide * BYTES > end - j:
            wide //= 2
        for i in range(0, rows, TALL):
            tall = min(rows - i, TALL)
            _tile(a + i * a_row, a_row, a_column, b + j, b_row, start + i * start_row + j, start_row,
                  gate + i * gate_row + j, gate_row, out + i * out_row + j, out_row, tall, wide, depth, how, real)
        j += wide * BYTES


@instructions
def _at(typing: Any, array: Any) -> Any:
    """Address of an array's first number."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        struct = context.make_array(signature.args[0])(context, builder, values[0])
        return builder.ptrtoint(struct.data, context.get_value_type(types.intp))

    return types.intp(array), generate


@part
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


class _Tile(NamedTuple):
    """Arguments of `_tile` as LLVM's values, in its order."""

    a: Any
    a_row: Any
    a_column: Any
    b: Any
    b_row: Any
    start: Any
    start_row: Any
    gate: Any
    gate_row: Any
    out: Any
    out_row: Any
    tall: Any
    wide: Any
    depth: Any
    how: Any


@instructions
def _tile(
    typing: Any, a: Any, a_row: Any, a_column: Any, b: Any, b_row: Any, start: Any, start_row: Any, gate: Any,
    gate_row: Any, out: Any, out_row: Any, tall: Any, wide: Any, depth: Any, how: Any, real: Any,
) -> Any:  # fmt: skip
    """A tile of so many rows and vectors at these addresses."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        builder.function.attributes.add("noinline")
        given, number = _Tile(*values[:-1]), context.get_value_type(real.instance_type)
        vector, word = ir.VectorType(number, BYTES * 8 // real.instance_type.bitwidth), given.a.type
        end = builder.append_basic_block("end")
        which = builder.switch(builder.add(builder.mul(given.tall, word(16)), given.wide), end)
        for shape in ((r, v) for r in range(1, TALL + 1) for v in (1, 2, 4, 8) if v <= WIDEST.get(r, 2)):
            here = builder.append_basic_block("tile")
            which.add_case(word(16 * shape[0] + shape[1]), here)
            builder.position_at_end(here)
            _emit(builder, vector, shape, given)
            builder.branch(end)
        builder.position_at_end(end)
        return context.get_dummy_value()

    words = (types.intp,) * len(_Tile._fields)
    return types.void(*words, real), generate


def _emit(builder: Any, vector: Any, shape: tuple[int, int], given: _Tile) -> None:
    """The instructions of one tile; with few sums, several terms of each are added at once."""
    word, (tall, wide), cells = given.a.type, shape, [(r, v) for r in range(shape[0]) for v in range(shape[1])]
    terms, nothing = max(1, 8 // (tall * wide)), ir.Constant(vector, None)
    begins, relu, gated = (builder.icmp_signed("!=", builder.and_(given.how, word(int(flag))), word(0))
                           for flag in (ADD, RELU, GATE))  # fmt: skip
    always = _splat(builder, builder.not_(builder.or_(relu, gated)), ir.VectorType(ir.IntType(1), vector.count))

    def place(base: Any, kind: Any, *steps: tuple[Any, int]) -> Any:
        for stride, count in steps:
            base = builder.add(base, builder.mul(stride, word(count)))
        return builder.inttoptr(base, ir.PointerType(kind))

    def load(base: Any, *steps: tuple[Any, int]) -> Any:
        return builder.load(place(base, vector, *steps), align=4)

    starts = [builder.select(begins, load(given.start, (given.start_row, r), (word(BYTES), v)), nothing)
              for r, v in cells]  # fmt: skip
    sums = {(u, *cell): cast(Any, cgutils).alloca_once_value(builder, nothing if u else start)
            for u in range(terms) for cell, start in zip(cells, starts, strict=True)}  # fmt: skip

    def add(k: Any, u: int) -> None:
        row = builder.add(given.b, builder.mul(k, given.b_row))
        loaded = [load(row, (word(BYTES), v)) for v in range(wide)]
        for r in range(tall):
            left = place(builder.add(given.a, builder.mul(k, given.a_column)), vector.element, (given.a_row, r))
            factor = _splat(builder, builder.load(left), vector)
            for v in range(wide):
                term = builder.fmul(factor, loaded[v], flags=("contract",))
                builder.store(builder.fadd(builder.load(sums[u, r, v]), term, flags=("contract",)), sums[u, r, v])

    full = builder.sub(given.depth, builder.urem(given.depth, word(terms)))
    with cgutils.for_range_slice(builder, word(0), full, word(terms), inc=True) as (k, _):
        for u in range(terms):
            add(builder.add(k, word(u)), u)
    with cgutils.for_range_slice(builder, full, given.depth, word(1), inc=True) as (k, _):
        add(k, 0)
    for r, v in cells:
        parts = [builder.load(sums[u, r, v]) for u in range(terms)]
        while len(parts) > 1:
            parts = [builder.fadd(one, other) for one, other in zip(parts[::2], parts[1::2], strict=True)]
        gate = builder.select(relu, parts[0], load(given.gate, (given.gate_row, r), (word(BYTES), v)))
        keep = builder.or_(builder.fcmp_unordered(">", gate, nothing), always)
        result = builder.select(keep, parts[0], nothing)
        builder.store(result, place(given.out, vector, (given.out_row, r), (word(BYTES), v)), align=4)


def _splat(builder: Any, number: Any, vector: Any) -> Any:
    """A vector of one number."""
    lane, nothing = ir.IntType(32), ir.Constant(vector, ir.Undefined)
    first = builder.insert_element(nothing, number, lane(0))
    return builder.shuffle_vector(first, nothing, ir.Constant(ir.VectorType(lane, vector.count), [0] * vector.count))

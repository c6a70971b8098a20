"""Tiles of matrix products, their sums in registers, written in LLVM's vectors."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, cast

import numpy as np
from llvmlite import binding, ir
from numba.core import cgutils, types

from .arithmetic import instructions

BYTES = 64 if binding.get_host_cpu_features().get("avx512f") else 32
"""Of a vector register."""
ADD, RELU, GATE = np.array([1, 2, 4])
"""What a product does besides: begin from numbers, not zero; end with zero where it, or a gate, is not positive."""


@instructions
def stays(typing: Any) -> Any:
    """The calling function is never copied into its callers."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        builder.function.attributes.add("noinline")
        return context.get_dummy_value()

    return types.void(), generate


class Tile(NamedTuple):
    """A product out = start + a b, gated: addresses, strides and `wide` of a whole product in bytes, other sizes in
    numbers; `wide` of one tile in vectors."""

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


def shapes(widest: dict[int, int]) -> Callable[[Tile, Any], None]:
    """A function of compiled code that computes a tile, its rows a key of `widest`, its vectors at most as many."""

    def tile(typing: Any, given: Any, real: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            given, number = Tile(*cgutils.unpack_tuple(builder, values[0])), context.get_value_type(real.instance_type)
            vector, word = ir.VectorType(number, BYTES * 8 // real.instance_type.bitwidth), given.a.type
            end = builder.append_basic_block("end")
            which = builder.switch(builder.add(builder.mul(given.tall, word(16)), given.wide), end)
            for shape in ((r, v) for r, most in widest.items() for v in (1, 2, 4, 8) if v <= most):
                here = builder.append_basic_block("tile")
                which.add_case(word(16 * shape[0] + shape[1]), here)
                builder.position_at_end(here)
                _emit(builder, vector, shape, given)
                builder.branch(end)
            builder.position_at_end(end)
            return context.get_dummy_value()

        return types.void(given, real), generate

    return instructions(tile)


def _emit(builder: Any, vector: Any, shape: tuple[int, int], given: Tile) -> None:
    """The instructions of one tile; with few sums, several terms of each are added at once."""
    word, (tall, wide), cells = given.a.type, shape, [(r, v) for r in range(shape[0]) for v in range(shape[1])]
    terms, nothing = max(1, 8 // (tall * wide)), ir.Constant(vector, None)
    begins, relu, gated = (
        builder.icmp_signed("!=", builder.and_(given.how, word(int(flag))), word(0)) for flag in (ADD, RELU, GATE)
    )
    always = _splat(builder, builder.not_(builder.or_(relu, gated)), ir.VectorType(ir.IntType(1), vector.count))

    def place(base: Any, kind: Any, *steps: tuple[Any, int]) -> Any:
        for stride, count in steps:
            base = builder.add(base, builder.mul(stride, word(count)))
        return builder.inttoptr(base, ir.PointerType(kind))

    def load(base: Any, *steps: tuple[Any, int]) -> Any:
        return builder.load(place(base, vector, *steps), align=4)

    starts = [
        builder.select(begins, load(given.start, (given.start_row, r), (word(BYTES), v)), nothing) for r, v in cells
    ]
    sums = {
        (u, *cell): cast(Any, cgutils).alloca_once_value(builder, nothing if u else start)
        for u in range(terms)
        for cell, start in zip(cells, starts, strict=True)
    }

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

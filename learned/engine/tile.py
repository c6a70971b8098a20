"""Matrix products by tiles whose sums stay in vector registers: the only instructions that are written by hand.

A loop in Python's syntax keeps its sums in memory, and to call BLAS takes longer than a product of a few rows: four
rows by 252 x 32 weights take plain numba 8 to 15 multiply-adds per ns, these tiles 25 to 40 (one core with AVX-512).
"""

from typing import Any

import numpy as np
from llvmlite import binding, ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from coopoc.arrays import Floats
from coopoc.kernels.compiling.compile import part

REGISTER_BYTES = 64 if binding.get_host_cpu_features().get("avx512f") else 32
"""Of a vector register."""
SHAPES = [(rows, vectors) for rows in (1, 2, 3, 4) for vectors in (1, 2)]
"""Rows and vectors of a tile: eight sums at most, beside which the 16 registers of AVX2 hold what they are made of."""
Index = int | np.integer[Any]
"""A number of a layer, field, row or column: Python's, or NumPy's from a table of them."""
Indices = tuple[Index, Index, Index]
Block = tuple[Floats, Index, Index]
"""A matrix in the memory of an array: the array, place of the first entry, distance of two rows, which may be 0."""


@part
def product(out: Block, a: Block, across: Index, b: Block, start: Block, size: Indices, floor: Any) -> None:
    """out (m, n) = max(start + a b, floor) of `size` m, n and k, terms of a sum; n is rounded up to whole vectors.

    The entries of a row of a (m, k) are `across` apart, those of the others 1.
    """
    rows, columns, depth = size
    wide = REGISTER_BYTES // 4 if out[0].itemsize == 4 else REGISTER_BYTES // 8
    for j in range(0, columns, 2 * wide):
        vectors = 2 if columns - j > wide else 1
        for i in range(0, rows, 4):
            right, left = (b[0], b[1] + j, b[2]), (a[0], a[1] + i * a[2], a[2])
            into, begin = (out[0], out[1] + i * out[2] + j, out[2]), (start[0], start[1] + i * start[2] + j, start[2])
            tile(into, left, across, right, begin, depth, floor, min(4, rows - i), vectors)


def _tile(
    typing: Any, out: Any, a: Any, across: Any, b: Any, start: Any, depth: Any, floor: Any, rows: Any, vectors: Any
) -> Any:
    """out = max(start + a b, floor) of one of `SHAPES`; NaN stays NaN."""

    def generate(context: Any, build: Any, signature: Any, values: Any) -> Any:
        blocks, (_, _, across, _, _, depth, floor, rows, vectors) = [], values
        for kind, at in ((out, 0), (a, 1), (b, 3), (start, 4)):
            array, first, step = cgutils.unpack_tuple(build, values[at])
            blocks.append((build.gep(context.make_array(kind[0])(context, build, array).data, [first]), step))
        code = build.add(build.mul(rows, rows.type(2)), vectors)
        for shape in SHAPES:
            with build.if_then(build.icmp_signed("==", code, code.type(2 * shape[0] + shape[1]))):
                _emit(build, shape, blocks, across, depth, floor)
        return context.get_dummy_value()

    return types.void(out, a, types.intp, b, start, types.intp, floor, types.intp, types.intp), generate


tile: Any = intrinsic(_tile)


def _emit(build: Any, shape: tuple[int, int], blocks: Any, across: Any, depth: Any, floor: Any) -> None:
    """One tile."""
    cells = [(r, v) for r in range(shape[0]) for v in range(shape[1])]
    count, word = REGISTER_BYTES // (4 if isinstance(floor.type, ir.FloatType) else 8), depth.type
    vector, lane = ir.VectorType(floor.type, count), ir.IntType(32)
    out, a, b, start = blocks

    def place(block: Any, row: Any, column: Any, kind: Any = vector) -> Any:
        return build.bitcast(build.gep(block[0], [build.add(build.mul(row, block[1]), column)]), ir.PointerType(kind))

    def load(block: Any, row: Any, v: int) -> Any:
        return build.load(place(block, row, word(v * count)), align=4)

    def splat(value: Any) -> Any:
        first = build.insert_element(ir.Constant(vector, ir.Undefined), value, lane(0))
        return build.shuffle_vector(first, first, ir.Constant(ir.VectorType(lane, count), [0] * count))

    sums = {cell: cgutils.alloca_once_value(build, load(start, word(cell[0]), cell[1])) for cell in cells}
    with cgutils.for_range_slice(build, word(0), depth, word(1), inc=True) as (k, _):
        loaded = [load(b, k, v) for v in range(shape[1])]
        factors = [splat(build.load(place(a, word(r), build.mul(k, across), floor.type))) for r in range(shape[0])]
        for r, v in cells:
            term = build.fmul(factors[r], loaded[v], flags=("contract",))
            build.store(build.fadd(build.load(sums[r, v]), term, flags=("contract",)), sums[r, v])
    for r, v in cells:
        total = build.load(sums[r, v])
        result = build.select(build.fcmp_ordered("<", total, splat(floor)), splat(floor), total)
        build.store(result, place(out, word(r), word(v * count)), align=4)


def _apart(typing: Any) -> Any:
    """The calling function stays a function of its own, and what it writes overlaps nothing else that it reads."""

    def generate(context: Any, build: Any, signature: Any, values: Any) -> Any:
        build.function.attributes.add("noinline")
        for argument in build.function.args:
            if isinstance(argument.type, ir.PointerType):
                argument.add_attribute("noalias")
        return context.get_dummy_value()

    return types.void(), generate


apart: Any = intrinsic(_apart)

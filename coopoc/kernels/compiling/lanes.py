"""The inner loop of dense block algebra, written as vector instructions: d rows -= (d, d) x d rows.

A loop over a short row costs more to enter than to run when the compiler must first prove that arrays do not overlap;
here it is stated. Matrices are flat arrays whose rows are `stride` numbers apart, a multiple of `LANES`.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from llvmlite import ir
from numba import config
from numba.core import cgutils, types
from numba.extending import intrinsic

LANES = 4
"""Numbers in one vector: 256 bits."""
_INDEX = types.intp
_VECTOR = ir.VectorType(ir.DoubleType(), LANES)


def fused(build: Any, a: Any, b: Any, total: Any) -> Any:
    """a b + total of numbers or vectors, rounded once."""
    kind = total.type
    name = f"llvm.fma.v{kind.count}f64" if isinstance(kind, ir.VectorType) else "llvm.fma.f64"
    function = cgutils.get_or_insert_function(build.module, ir.FunctionType(kind, [kind] * 3), name)
    return build.call(function, [a, b, total])


def check_index(context: Any, build: Any, kind: Any, array: Any, past: Any) -> None:
    """IndexError unless a flat array holds `past` numbers; compiled under NUMBA_BOUNDSCHECK=1 only, as numba's own."""
    if config.BOUNDSCHECK:  # type: ignore[attr-defined]
        beyond = build.icmp_unsigned(">", past, cgutils.create_struct_proxy(kind)(context, build, array).nitems)
        with build.if_then(beyond, likely=False):
            context.call_conv.return_user_exc(build, IndexError, ("vector beyond the end of its array",))


class _Code:
    """Places, vectors and sums in the function that is being built."""

    def __init__(self, context: Any, build: Any, signature: Any, args: Any, arrays: tuple[int, ...]) -> None:
        self.build = build
        self.check = {k: partial(check_index, context, build, signature.args[a], args[a]) for k, a in enumerate(arrays)}
        self.arrays = [cgutils.create_struct_proxy(signature.args[k])(context, build, args[k]).data for k in arrays]

    def index(self, at: Any, *steps: tuple[Any, int]) -> Any:
        """at + sum of count x size."""
        for size, count in steps:
            at = self.build.add(at, self.build.mul(size, ir.Constant(size.type, count)))
        return at

    def vector(self, array: int, at: Any) -> Any:
        """Pointer to LANES numbers."""
        self.check[array](self.build.add(at, ir.Constant(at.type, LANES)))
        return self.build.bitcast(self.build.gep(self.arrays[array], [at]), _VECTOR.as_pointer())

    def minus(self, array: int, at: Any) -> Any:
        """Minus one number, in all lanes."""
        self.check[array](self.build.add(at, ir.Constant(at.type, 1)))
        number = self.build.fneg(self.build.load(self.build.gep(self.arrays[array], [at])))
        none, first = ir.Constant(_VECTOR, ir.Undefined), ir.Constant(ir.IntType(32), 0)
        everywhere = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
        return self.build.shuffle_vector(self.build.insert_element(none, number, first), none, everywhere)

    def plus_product(self, total: Any, a: Any, b: Any) -> Any:
        """total + a b, rounded once."""
        return fused(self.build, a, b, total)


def subtracting(d: int) -> Any:
    """A function for compiled code: `d` rows of a matrix less the transposed (d, d) of `left` times d rows of `right`.

    out[out_at + a stride + j] -= sum_c left[left_at + c stride + a] right[right_at + c stride + j], a, c < d and
    j < LANES tiles.
    """

    def generate(context: Any, build: Any, signature: Any, args: Any) -> Any:
        code = _Code(context, build, signature, args, (0, 2, 4))
        out_at, left_at, right_at, stride, tiles = (args[k] for k in (1, 3, 5, 6, 7))
        one = ir.Constant(stride.type, 1)
        factors = [[code.minus(1, code.index(left_at, (stride, c), (one, a))) for c in range(d)] for a in range(d)]
        with cgutils.for_range(build, tiles) as loop:
            shift = build.mul(loop.index, ir.Constant(stride.type, LANES))
            places = [code.index(build.add(right_at, shift), (stride, c)) for c in range(d)]
            rows = [build.load(code.vector(2, place), align=8) for place in places]
            for a in range(d):
                target = code.vector(0, code.index(build.add(out_at, shift), (stride, a)))
                total = build.load(target, align=8)
                for factor, row in zip(factors[a], rows, strict=True):
                    total = code.plus_product(total, factor, row)
                build.store(total, target, align=8)
        return context.get_dummy_value()

    def typed(
        context: Any, out: Any, out_at: Any, left: Any, left_at: Any, right: Any, right_at: Any, stride: Any, tiles: Any
    ) -> Any:
        n = _INDEX
        return types.void(out, n, left, n, right, n, n, n), generate

    return intrinsic(typed)


subtract: Any = subtracting(3)

"""What the compiled kernels share: tanh and sigmoid that vectorise, aligned memory, views into flat memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias, cast

import numpy as np
from llvmlite import ir
from numba import njit
from numba.core import cgutils, types
from numba.extending import intrinsic, register_jitable

from coopoc.arrays import AnyArray
from coopoc.kernels.compiling.compile import Function

PAD = 16
"""Columns of matrices come in multiples of this: whole vectors in either precision."""
ZERO, ONE, TWO, THREE = np.arange(4)
"""NumPy's integers, because numba compiles a function anew for each constant of Python's."""
Index: TypeAlias = int | np.integer[Any]
"""What kernels count and index with: Python's integers, and NumPy's that come from tables of them."""


def part(function: Function) -> Function:
    """Compiled with the first kernel that calls it, for compiled callers only; it may return views."""
    return _within(function)


def inside(function: Function) -> Function:
    """As `part`, and always copied into its caller: to hand arrays to a small function takes as long as it does."""
    return _within(function, forceinline=True)


def apart(function: Function) -> Function:
    """As `part`, and also so where an `inside` calls it, whose callees are otherwise copied like itself."""
    return _within(function, forceinline=False)


def _within(function: Function, **options: bool) -> Function:
    """Without wrappers for callers from Python, which would be machine code of its own."""
    untyped: Any = njit
    wrappers = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return cast(
        Function, untyped(nogil=True, error_model="numpy", fastmath={"contract"}, **wrappers, **options)(function)
    )


instructions = cast(Callable[[Callable[..., Any]], Callable[..., Any]], intrinsic)
"""`intrinsic` with a type."""


def view(function: Callable[..., Any]) -> Callable[..., AnyArray]:
    """What `function` writes in LLVM's instructions, as a function of compiled code that returns an array."""
    return cast(Callable[..., AnyArray], intrinsic(function))


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


@register_jitable
def whole(columns: Index) -> Index:
    """Columns rounded up to whole vectors."""
    return (columns + PAD - 1) // PAD * PAD


@part
def aligned(size: Index, like: AnyArray) -> AnyArray:
    """Memory (size,) that begins where a vector may begin: one that crosses a line of the cache takes twice as long."""
    memory = np.empty(size + PAD, like.dtype)
    first = -(memory.ctypes.data // memory.itemsize) % PAD
    return memory[first : first + size]


@view
def window(typing: Any, flat: Any, at: Any, rows: Any, columns: Any) -> Any:
    """A view (rows, columns) into flat memory from `at` on that does not count as a reference to it.

    NumPy's views do, and in a time loop of many small steps counting takes as long as the arithmetic. The memory must
    be held by an argument of the calling function.
    """
    shaped = types.Array(flat.dtype, 2, "C")

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        owner = context.make_array(signature.args[0])(context, builder, values[0])
        made, size = context.make_array(shaped)(context, builder), owner.itemsize
        _, at, rows, columns = values
        context.populate_array(
            made,
            data=builder.gep(owner.data, [at]),
            shape=_pair(builder, rows, columns),
            strides=_pair(builder, builder.mul(columns, size), size),
            itemsize=size,
            meminfo=None,
        )
        return made._getvalue()

    return shaped(flat, types.intp, types.intp, types.intp), generate


def _pair(builder: Any, *values: Any) -> Any:
    return cast(Any, cgutils).pack_array(builder, values)


@view
def borrowed(typing: Any, array: Any) -> Any:
    """The same array, not counted as a reference; as for `window`, an argument must hold the memory."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        owner, made = (context.make_array(array)(context, builder, *given) for given in (values, ()))
        context.populate_array(
            made, data=owner.data, shape=owner.shape, strides=owner.strides, itemsize=owner.itemsize, meminfo=None
        )
        return made._getvalue()

    return array(array), generate


@instructions
def carry(typing: Any, source: Any, at: Any, target: Any, to: Any, row: Any) -> Any:
    """target[row, to : to + PAD] = source[row, at : at + PAD] as one vector: of a loop the compiler does not know that
    it does not read what it has just written."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        def place(array: Any, given: Any, column: Any) -> Any:
            struct = context.make_array(array)(context, builder, given)
            first = builder.add(builder.mul(values[4], cgutils.unpack_tuple(builder, struct.shape, 2)[1]), column)
            kind = ir.VectorType(context.get_value_type(array.dtype), int(PAD))
            return builder.bitcast(builder.gep(struct.data, [first]), ir.PointerType(kind))

        number = builder.load(place(source, values[0], values[1]), align=4)
        builder.store(number, place(target, values[2], values[3]), align=4)
        return context.get_dummy_value()

    return types.void(source, types.intp, target, types.intp, types.intp), generate

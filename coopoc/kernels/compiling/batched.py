"""Numbers of four runs side by side: a vector that adds, multiplies and divides as a float does, for compiled code.

What is written for floats serves four runs at the price of one, and each as if it were alone: every lane is rounded as
a float is. A product and a sum are rounded once, and are one instruction, in `plus` and `less` and nowhere else.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic, lower_builtin, models, register_model, type_callable

from .lanes import LANES, check_index, fused

VECTOR = ir.VectorType(ir.DoubleType(), LANES)


class Batched(types.Type):
    """The type of LANES numbers; only what is compiled can hold one."""

    def __init__(self) -> None:
        super().__init__(name="Batched")


@register_model(Batched)
class _Model(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, VECTOR)  # type: ignore[no-untyped-call]


BATCHED = Batched()


def _wide(context: Any, build: Any, value: Any, kind: Any) -> Any:
    """A vector as it is, a number in all lanes."""
    if isinstance(kind, Batched):
        return value
    return wide(build, context.cast(build, value, kind, types.float64))


def wide(build: Any, number: Any) -> Any:
    """The vector of one number in all lanes."""
    first = build.insert_element(ir.Constant(VECTOR, ir.Undefined), number, ir.Constant(ir.IntType(32), 0))
    everywhere = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    return build.shuffle_vector(first, ir.Constant(VECTOR, ir.Undefined), everywhere)


def _operator(function: Any, makes: Callable[[Any, Any, Any], Any]) -> None:
    """Give vectors a binary operator; a float beside one stands for itself in all lanes."""

    @type_callable(function)
    def typed(context: Any) -> Any:
        def typer(a: Any, b: Any) -> Any:
            vectors = [isinstance(k, Batched) for k in (a, b)]
            return BATCHED if any(vectors) and all(isinstance(k, Batched | types.Float) for k in (a, b)) else None

        return typer

    def lowered(context: Any, build: Any, signature: Any, args: Any) -> Any:
        a, b = (_wide(context, build, *pair) for pair in zip(args, signature.args, strict=True))
        return makes(build, a, b)

    for pair in ((Batched, Batched), (Batched, types.Float), (types.Float, Batched)):
        lower_builtin(function, *pair)(lowered)


def _larger(build: Any, a: Any, b: Any) -> Any:
    return build.select(build.fcmp_ordered(">=", a, b), a, b)


_operator(operator.add, lambda build, a, b: build.fadd(a, b))
_operator(operator.sub, lambda build, a, b: build.fsub(a, b))
_operator(operator.mul, lambda build, a, b: build.fmul(a, b))
_operator(operator.truediv, lambda build, a, b: build.fdiv(a, b))
_operator(max, _larger)


def _function(function: Any, name: str) -> None:
    """Give vectors a function of one number, by LLVM's name of it."""

    @type_callable(function)
    def typed(context: Any) -> Any:
        return lambda a: BATCHED if isinstance(a, Batched) else None

    @lower_builtin(function, Batched)  # type: ignore[untyped-decorator]
    def lowered(context: Any, build: Any, signature: Any, args: Any) -> Any:
        kind = ir.FunctionType(VECTOR, [VECTOR])
        return build.call(cgutils.get_or_insert_function(build.module, kind, f"llvm.{name}.v{LANES}f64"), args)


@type_callable(operator.le)
def _all_at_most(context: Any) -> Any:
    return lambda a, b: types.boolean if isinstance(a, Batched) and isinstance(b, Batched) else None


@lower_builtin(operator.le, Batched, Batched)  # type: ignore[untyped-decorator]
def _all_lanes_at_most(context: Any, build: Any, signature: Any, args: Any) -> Any:
    """True if it is so in all lanes, which a NaN is not."""
    each = build.fcmp_ordered("<=", *args)
    bits = ir.IntType(LANES)
    return build.icmp_unsigned("==", build.bitcast(each, bits), ir.Constant(bits, 2**LANES - 1))


_function(math.sqrt, "sqrt")
_function(math.floor, "floor")
_function(abs, "fabs")


@type_callable(operator.neg)
def _negative(context: Any) -> Any:
    return lambda a: BATCHED if isinstance(a, Batched) else None


@lower_builtin(operator.neg, Batched)  # type: ignore[untyped-decorator]
def _negated(context: Any, build: Any, signature: Any, args: Any) -> Any:
    return build.fneg(args[0])


def _place(context: Any, build: Any, kind: Any, array: Any, at: Any) -> Any:
    """Pointer to the vector `at` of a flat array."""
    data = cgutils.create_struct_proxy(kind)(context, build, array).data
    start = build.mul(at, ir.Constant(at.type, LANES))
    check_index(context, build, kind, array, build.add(start, ir.Constant(at.type, LANES)))
    return build.bitcast(build.gep(data, [start]), VECTOR.as_pointer())


def _take(context: Any, array: Any, at: Any) -> Any:
    """Vector number `at` of a flat array."""

    def generate(context: Any, build: Any, signature: Any, args: Any) -> Any:
        return build.load(_place(context, build, signature.args[0], *args), align=8)

    return BATCHED(array, types.uint64), generate


def _put(context: Any, array: Any, at: Any, value: Any) -> Any:
    """Write vector number `at` of a flat array."""

    def generate(context: Any, build: Any, signature: Any, args: Any) -> Any:
        build.store(args[2], _place(context, build, signature.args[0], *args[:2]), align=8)
        return context.get_dummy_value()

    return types.void(array, types.uint64, BATCHED), generate


def _pack(context: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
    """The vector of four numbers."""

    def generate(context: Any, build: Any, signature: Any, args: Any) -> Any:
        whole = ir.Constant(VECTOR, ir.Undefined)
        for k, number in enumerate(args):
            whole = build.insert_element(whole, number, ir.Constant(ir.IntType(32), k))
        return whole

    return BATCHED(*[types.float64] * LANES), generate


def _fused(sign: Callable[[Any, Any], Any]) -> Callable[..., Any]:
    """total + sign(a) b, rounded once, of numbers, of vectors or of both."""

    def typed(context: Any, total: Any, a: Any, b: Any) -> Any:
        kinds = (total, a, b)
        kind = BATCHED if any(isinstance(k, Batched) for k in kinds) else types.float64

        def generate(context: Any, build: Any, signature: Any, args: Any) -> Any:
            if kind is BATCHED:
                args = [_wide(context, build, value, given) for value, given in zip(args, signature.args, strict=True)]
            return fused(build, sign(build, args[1]), args[2], args[0])

        return kind(*(k if isinstance(k, Batched) else types.float64 for k in kinds)), generate

    return typed


def _choose(context: Any, sign: Any, a: Any, b: Any) -> Any:
    """a where the sign is positive, else b; of numbers or of vectors."""

    def generate(context: Any, build: Any, signature: Any, args: Any) -> Any:
        positive = build.fcmp_ordered(">", args[0], ir.Constant(args[0].type, None if vectors else 0.0))
        return build.select(positive, args[1], args[2])

    vectors = isinstance(sign, Batched)
    kind = BATCHED if vectors else types.float64
    return kind(kind, kind, kind), generate


def _lane(context: Any, vector: Any, which: Any) -> Any:
    """One number of a vector."""

    def generate(context: Any, build: Any, signature: Any, args: Any) -> Any:
        return build.extract_element(*args)

    return types.float64(vector, types.int64), generate


take: Any = intrinsic(_take)
put: Any = intrinsic(_put)
pack: Any = intrinsic(_pack)
lane: Any = intrinsic(_lane)
choose: Any = intrinsic(_choose)
plus: Any = intrinsic(_fused(lambda build, a: a))
less: Any = intrinsic(_fused(lambda build, a: build.fneg(a)))

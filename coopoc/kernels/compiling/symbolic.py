"""Symbolic numbers: what Python does to them while a kernel is compiled becomes the kernel's instructions.

`unrolled` makes a function for compiled code of one that is written on them: a formula for matrices of any size is an
ordinary loop, of which nothing is left at run time, and numba has no types to infer for its inside.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from inspect import Parameter, signature
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from .batched import BATCHED, VECTOR, Batched, wide
from .lanes import LANES, check_index, fused


@dataclass(frozen=True, eq=False)
class Number:
    """A number of the kernel that is being compiled; without a builder only its type is known."""

    batched: bool
    build: Any = None
    value: Any = None

    def _with(self, make: Callable[..., Any], *others: Number | float) -> Number:
        numbers = [o if isinstance(o, Number) else Number(False, self.build, _constant(o)) for o in (self, *others)]
        batched = any(n.batched for n in numbers)
        if self.build is None:
            return Number(batched)
        values = [wide(self.build, n.value) if batched and not n.batched else n.value for n in numbers]
        return Number(batched, self.build, make(self.build, *values))

    def __add__(self, other: Number | float) -> Number:
        return self._with(lambda build, a, b: build.fadd(a, b), other)

    def __sub__(self, other: Number | float) -> Number:
        return self._with(lambda build, a, b: build.fsub(a, b), other)

    def __mul__(self, other: Number | float) -> Number:
        return self._with(lambda build, a, b: build.fmul(a, b), other)

    def __neg__(self) -> Number:
        return self._with(lambda build, a: build.fneg(a))

    def choose(self, a: Number, b: Number) -> Number:
        """a where this number is positive, else b."""
        return self._with(lambda build, s, x, y: build.select(build.fcmp_ordered(">", s, _zero(s.type)), x, y), a, b)

    def over(self) -> Number:
        """1 / x."""
        return self._with(lambda build, a: build.fdiv(ir.Constant(a.type, _ones(a.type)), a))


Numbers = Sequence[Number]


def _constant(number: float) -> Any:
    return ir.Constant(ir.DoubleType(), number)


def _zero(kind: Any) -> Any:
    return ir.Constant(kind, [0.0] * LANES if isinstance(kind, ir.VectorType) else 0.0)


def _ones(kind: Any) -> Any:
    return [1.0] * LANES if isinstance(kind, ir.VectorType) else 1.0


def plus(total: Number, a: Number, b: Number) -> Number:
    """total + a b, rounded once."""
    return total._with(lambda build, t, x, y: fused(build, x, y, t), a, b)


def less(total: Number, a: Number, b: Number) -> Number:
    """total - a b, rounded once."""
    return total._with(lambda build, t, x, y: fused(build, build.fneg(x), y, t), a, b)


@dataclass(frozen=True, eq=False)
class _Memory:
    """Numbers of an array one after the other."""

    kind: Any
    context: Any = None
    build: Any = None
    array: Any = None

    @property
    def batched(self) -> bool:
        return bool(self.kind.ndim == 2)

    def places(self, at: Any, length: int) -> list[Any]:
        """Pointers to the numbers of tuple number `at` of those of some length that stand one after the other."""
        build, kind, width = self.build, at.type, LANES if self.batched else 1
        start = build.mul(at, ir.Constant(kind, length * width))
        check_index(self.context, build, self.kind, self.array, build.add(start, ir.Constant(kind, length * width)))
        first = build.gep(cgutils.create_struct_proxy(self.kind)(self.context, build, self.array).data, [start])
        if self.batched:
            first = build.bitcast(first, VECTOR.as_pointer())
        return [build.gep(first, [ir.Constant(kind, i)]) for i in range(length)]

    def read(self, at: Any, length: int) -> list[Number]:
        """That tuple."""
        if self.build is None:
            return [Number(self.batched)] * length
        return [Number(self.batched, self.build, self.build.load(p, align=8)) for p in self.places(at, length)]

    def write(self, at: Any, numbers: Numbers) -> None:
        """Write that tuple."""
        if self.build is not None:
            for number, place in zip(numbers, self.places(at, len(numbers)), strict=True):
                value = wide(self.build, number.value) if self.batched and not number.batched else number.value
                self.build.store(value, place, align=8)


def unrolled(write: Callable[..., Any]) -> Any:
    """A function for compiled code, whose instructions `write` makes from symbolic arguments."""

    def typed(context: Any, *kinds: Any) -> Any:
        kinds = tuple(types.unliteral(kind) for kind in kinds)
        made = write(*(_symbol(None, None, kind, None) for kind in kinds))

        def generate(context: Any, build: Any, signature: Any, args: Any) -> Any:
            found = write(*(_symbol(context, build, *pair) for pair in zip(kinds, args, strict=True)))
            if found is None:
                return context.get_dummy_value()
            if isinstance(found, Number):
                return found.value
            return context.make_tuple(build, signature.return_type, [n.value for n in found])

        return _kind(made)(*kinds), generate

    names = [Parameter(name, Parameter.POSITIONAL_OR_KEYWORD) for name in ("context", *signature(write).parameters)]
    typed.__name__, typed.__signature__ = write.__name__, signature(write).replace(parameters=names)  # type: ignore[attr-defined]
    typed.__doc__ = write.__doc__
    return intrinsic(typed)


def _kind(made: Any) -> Any:
    if made is None:
        return types.void
    if isinstance(made, Number):
        return BATCHED if made.batched else types.float64
    return types.Tuple([_kind(n) for n in made])


def _symbol(context: Any, build: Any, kind: Any, value: Any) -> Any:
    """A Number, a list of them, memory, or the integer as it is."""
    if isinstance(kind, types.BaseTuple):
        kinds: Any = kind
        values = [None] * len(kind) if build is None else cgutils.unpack_tuple(build, value)
        return [_symbol(context, build, k, v) for k, v in zip(kinds, values, strict=True)]
    if isinstance(kind, types.Array):
        return _Memory(kind, context, build, value)
    if isinstance(kind, Batched | types.Float):
        return Number(isinstance(kind, Batched), build, value)
    return value

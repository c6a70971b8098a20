"""Vectors of runs and symbolic numbers: Python writes the instructions of a kernel while it is compiled.

A vector holds the same number of LANES runs; it adds, multiplies and divides as a float does, and every lane is rounded
as a float is. A product and a sum are rounded once, as one instruction, in `plus` and `less` and nowhere else, so that
a run gets the digits that it gets alone.

`unrolled` makes a function for compiled code of one that is written on `Number`s: a formula for matrices of any size is
an ordinary loop, of which nothing is left at run time, and numba infers no types for its inside.
"""

import math
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from inspect import Parameter, signature
from typing import Any, TypeAlias

from llvmlite import ir
from numba import config
from numba.core import cgutils, types
from numba.extending import intrinsic, lower_builtin, models, register_model, type_callable

LANES = 4
"""Runs in one vector: 256 bits."""
VECTOR = ir.VectorType(ir.DoubleType(), LANES)


class Batched(types.Type):
    """The type of LANES numbers; only compiled code can hold one."""

    def __init__(self) -> None:
        super().__init__(name="Batched")


@register_model(Batched)
class _Model(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, VECTOR)  # type: ignore[no-untyped-call]


BATCHED = Batched()


def _instruction(name: str) -> Callable[["Number", "Number | float"], "Number"]:
    """The operator that an LLVM instruction of two numbers is."""
    return lambda a, b: a.apply(lambda build, *values: getattr(build, name)(*values), b)


@dataclass(frozen=True, eq=False)
class Number:
    """A number of the kernel that is being compiled; without a builder only its type is known."""

    kind: Any
    build: Any = None
    value: Any = None

    @property
    def wide(self) -> Any:
        """Its LLVM vector: a float stands in all lanes."""
        if self.kind is BATCHED:
            return self.value
        nothing, first = ir.Constant(VECTOR, ir.Undefined), ir.Constant(ir.IntType(32), 0)
        everywhere = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
        return self.build.shuffle_vector(self.build.insert_element(nothing, self.value, first), nothing, everywhere)

    def apply(self, make: Callable[..., Any], *others: "Number | float", kind: Any = None) -> "Number":
        """What an LLVM instruction makes of this number and others, a vector if one of them is."""
        numbers = [
            n if isinstance(n, Number) else Number(types.float64, self.build, ir.Constant(ir.DoubleType(), n))
            for n in (self, *others)
        ]
        batched = any(n.kind is BATCHED for n in numbers)
        own = kind or (BATCHED if batched else types.float64)
        if self.build is None:
            return Number(own)
        return Number(own, self.build, make(self.build, *(n.wide if batched else n.value for n in numbers)))

    def call(self, name: str, *others: "Number | float") -> "Number":
        """An LLVM intrinsic of numbers, such as fma."""

        def make(build: Any, *values: Any) -> Any:
            kind = values[0].type
            ending = f"v{LANES}f64" if kind == VECTOR else "f64"
            function = ir.FunctionType(kind, [kind] * len(values))
            return build.call(cgutils.get_or_insert_function(build.module, function, f"llvm.{name}.{ending}"), values)

        return self.apply(make, *others)

    __add__, __sub__ = _instruction("fadd"), _instruction("fsub")
    __mul__, __truediv__ = _instruction("fmul"), _instruction("fdiv")

    def __neg__(self) -> "Number":
        return self.apply(lambda build, a: build.fneg(a))

    def over(self) -> "Number":
        """1 / x."""
        return self.apply(lambda build, a, one: build.fdiv(one, a), 1.0)

    def plus(self, a: "Number", b: "Number") -> "Number":
        """self + a b, rounded once."""
        return a.call("fma", b, self)

    def less(self, a: "Number", b: "Number") -> "Number":
        """self - a b, rounded once."""
        return (-a).call("fma", b, self)

    def larger(self, other: "Number | float") -> "Number":
        """self where it is at least the other, else that."""
        return self.apply(lambda build, a, b: build.select(build.fcmp_ordered(">=", a, b), a, b), other)

    def choose(self, a: "Number", b: "Number") -> "Number":
        """a where this number is positive, else b."""

        def make(build: Any, sign: Any, x: Any, y: Any) -> Any:
            return build.select(build.fcmp_ordered(">", sign, ir.Constant(sign.type, None)), x, y)

        return self.apply(make, a, b)

    def at_most(self, other: "Number") -> "Number":
        """Whether self <= other in all lanes, which a NaN is not."""

        def make(build: Any, a: Any, b: Any) -> Any:
            bits = ir.IntType(LANES)
            lanes = build.bitcast(build.fcmp_ordered("<=", a, b), bits)
            return build.icmp_unsigned("==", lanes, ir.Constant(bits, 2**LANES - 1))

        return self.apply(make, other, kind=types.boolean)


Numbers: TypeAlias = Sequence[Number]
Lanes: TypeAlias = Any
"""What compiled code returns: a float, LANES of them side by side, or a tuple of such."""


@dataclass(frozen=True, eq=False)
class Memory:
    """An array of the kernel that is being compiled: flat, or (., LANES) whose rows are vectors."""

    kind: Any
    context: Any = None
    build: Any = None
    array: Any = None

    def _places(self, at: Any, length: int, batched: bool) -> list[Any]:
        """Pointers to the numbers of tuple number `at` of those of some length that stand one after the other."""
        build, width = self.build, length * (LANES if batched else 1)
        header = cgutils.create_struct_proxy(self.kind)(self.context, build, self.array)
        start = build.mul(at, ir.Constant(at.type, width))
        if config.BOUNDSCHECK:  # type: ignore[attr-defined]
            beyond = build.icmp_unsigned(">", build.add(start, ir.Constant(at.type, width)), header.nitems)
            with build.if_then(beyond, likely=False):
                self.context.call_conv.return_user_exc(build, IndexError, ("vector beyond the end of its array",))
        first = build.gep(header.data, [start])
        first = build.bitcast(first, VECTOR.as_pointer()) if batched else first
        return [build.gep(first, [ir.Constant(at.type, i)]) for i in range(length)]

    def read(self, at: Any, length: int = 1, batched: bool = False) -> list[Number]:
        """That tuple."""
        batched = batched or self.kind.ndim == 2
        kind = BATCHED if batched else types.float64
        if self.build is None:
            return [Number(kind)] * length
        return [Number(kind, self.build, self.build.load(p, align=8)) for p in self._places(at, length, batched)]

    def write(self, at: Any, numbers: Numbers, batched: bool = False) -> None:
        """Write that tuple."""
        batched = batched or self.kind.ndim == 2
        if self.build is not None:
            for number, address in zip(numbers, self._places(at, len(numbers), batched), strict=True):
                self.build.store(number.wide if batched else number.value, address, align=8)


def _symbol(kind: Any, context: Any = None, build: Any = None, value: Any = None) -> Any:
    """A Number, a list of them, Memory, or an integer as it is."""
    if isinstance(kind, types.BaseTuple):
        kinds: Any = kind
        values = [None] * len(kind) if build is None else cgutils.unpack_tuple(build, value)
        return [_symbol(k, context, build, v) for k, v in zip(kinds, values, strict=True)]
    if isinstance(kind, types.Array):
        return Memory(kind, context, build, value)
    return Number(kind, build, value) if isinstance(kind, Batched | types.Float) else value


def _typed(write: Callable[..., Any], kinds: Sequence[Any]) -> Any:
    """The signature of a function that is written on symbols."""
    made = write(*map(_symbol, kinds))
    if isinstance(made, list):
        return types.Tuple([n.kind for n in made])(*kinds)
    return (types.void if made is None else made.kind)(*kinds)


def _instructions(write: Callable[..., Any], context: Any, build: Any, kinds: Any, args: Any) -> Any:
    """What the function makes of its arguments, as instructions."""
    made = write(*(_symbol(kind, context, build, value) for kind, value in zip(kinds, args, strict=True)))
    if isinstance(made, list):
        return context.make_tuple(build, types.Tuple([n.kind for n in made]), [n.value for n in made])
    return context.get_dummy_value() if made is None else made.value


def unrolled(write: Callable[..., Any]) -> Any:
    """A function for compiled code, whose instructions `write` makes from symbolic arguments."""

    def typed(context: Any, *kinds: Any) -> Any:
        kinds = tuple(types.unliteral(kind) for kind in kinds)

        def generate(context: Any, build: Any, signature: Any, args: Any) -> Any:
            return _instructions(write, context, build, kinds, args)

        return _typed(write, kinds), generate

    names = [Parameter(name, Parameter.POSITIONAL_OR_KEYWORD) for name in ("context", *signature(write).parameters)]
    typed.__name__, typed.__signature__ = write.__name__, signature(write).replace(parameters=names)  # type: ignore[attr-defined]
    typed.__doc__ = write.__doc__
    return intrinsic(typed)


def _operator(function: Any, write: Callable[..., Number], *patterns: tuple[Any, ...]) -> None:
    """Give vectors an operator or a function of Python; a float beside a vector stands in all lanes."""

    def result(*kinds: Any) -> Any:
        return _typed(write, kinds) if any(all(map(isinstance, kinds, pattern)) for pattern in patterns) else None

    @type_callable(function)
    def typed(context: Any) -> Any:
        return (lambda a: result(a)) if len(patterns[0]) == 1 else lambda a, b: result(a, b)

    def lowered(context: Any, build: Any, signature: Any, args: Any) -> Any:
        return _instructions(write, context, build, signature.args, args)

    for pattern in patterns:
        lower_builtin(function, *pattern)(lowered)


_PAIRS = ((Batched, Batched), (Batched, types.Float), (types.Float, Batched))
for _function, _write in (
    (operator.add, Number.__add__),
    (operator.sub, Number.__sub__),
    (operator.mul, Number.__mul__),
    (operator.truediv, Number.__truediv__),
    (max, Number.larger),
):
    _operator(_function, _write, *_PAIRS)
_operator(operator.le, Number.at_most, (Batched, Batched))
_operator(operator.neg, Number.__neg__, (Batched,))
_operator(math.sqrt, lambda a: a.call("sqrt"), (Batched,))
_operator(math.floor, lambda a: a.call("floor"), (Batched,))
_operator(abs, lambda a: a.call("fabs"), (Batched,))


@unrolled
def take(array: Any, at: Any) -> Any:
    """Vector number `at` of a flat array."""
    return array.read(at, batched=True)[0]


@unrolled
def put(array: Any, at: Any, value: Any) -> Any:
    """Write vector number `at` of a flat array."""
    array.write(at, [value], batched=True)


@unrolled
def pack(a: Any, b: Any, c: Any, d: Any) -> Any:
    """The vector of four numbers."""

    def make(build: Any, *numbers: Any) -> Any:
        whole = ir.Constant(VECTOR, ir.Undefined)
        for k, number in enumerate(numbers):
            whole = build.insert_element(whole, number, ir.Constant(ir.IntType(32), k))
        return whole

    return a.apply(make, b, c, d, kind=BATCHED)


@unrolled
def lane(vector: Any, index: Any) -> Any:
    """One number of a vector."""
    return vector.apply(lambda build, v: build.extract_element(v, index), kind=types.float64)


choose: Any = unrolled(Number.choose)
"""a where the first number is positive, else b."""
plus: Any = unrolled(Number.plus)
"""total + a b, rounded once."""
less: Any = unrolled(Number.less)
"""total - a b, rounded once."""

"""Small matrices of any fixed size as tuples of numbers, unrolled by the compiler.

A vector of d numbers is a tuple of d, a d x d matrix a tuple of d * d, row by row. A number is a float, or LANES runs
side by side (`coopoc.kernels.compiling.vectors`): one text serves both. Memory is a flat array of floats, or an array
(., LANES).

Products and sums are fused where `plus` and `less` stand and nowhere else, so that all runs get the digits of a run
alone.
"""

import math
from typing import Any

from .vectors import Number, Numbers, unrolled


def _entries(rows: int, columns: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(rows) for j in range(columns)]


def _dot(first: Number, a: Numbers, b: Numbers) -> Number:
    """first - a b, product by product."""
    for x, y in zip(a, b, strict=True):
        first = first.less(x, y)
    return first


def _inner(a: Numbers, b: Numbers) -> Number:
    first, *others = (x * y for x, y in zip(a, b, strict=True))
    return sum(others, first)


@unrolled
def load(memory: Any, at: Any, like: Any) -> Any:
    """Tuple number `at` of those, as long as `like`, that stand in memory one after the other."""
    return memory.read(at, len(like))


@unrolled
def vector_at(memory: Any, at: Any) -> Any:
    """Vector number `at` of those of three numbers."""
    return memory.read(at, 3)


@unrolled
def block_at(memory: Any, at: Any) -> Any:
    """Matrix number `at` of those of 3 x 3 numbers."""
    return memory.read(at, 9)


@unrolled
def store(memory: Any, at: Any, values: Any) -> Any:
    """Write tuple number `at`."""
    memory.write(at, values)


@unrolled
def add(a: Any, b: Any) -> Any:
    """a + b."""
    return [x + y for x, y in zip(a, b, strict=True)]


@unrolled
def subtract(a: Any, b: Any) -> Any:
    """a - b."""
    return [x - y for x, y in zip(a, b, strict=True)]


@unrolled
def negate(a: Any) -> Any:
    """-a."""
    return [-x for x in a]


@unrolled
def times(a: Any, b: Any) -> Any:
    """a_i b_i."""
    return [x * y for x, y in zip(a, b, strict=True)]


inner_product: Any = unrolled(_inner)
"""The sum of a_i b_i, every product and sum rounded by itself."""
less_inner_product: Any = unrolled(_dot)
"""first - the sum of a_i b_i."""


@unrolled
def normalised_square(a: Any, variance: Any) -> Any:
    """The sum of a_i^2 / variance_i."""
    first, *others = (x * x / v for x, v in zip(a, variance, strict=True))
    return sum(others, first)


@unrolled
def trace(a: Any) -> Any:
    """Of a matrix."""
    first, *others = a[:: math.isqrt(len(a)) + 1]
    return sum(others, first)


@unrolled
def over(a: Any) -> Any:
    """1 / a_i."""
    return [x.over() for x in a]


@unrolled
def scale(a: Any, number: Any) -> Any:
    """a_i times a number."""
    return [x * number for x in a]


@unrolled
def zeros(number: Any, like: Any) -> Any:
    """As many zeros as `like` has numbers, of the kind of `number`."""
    return [number * 0.0 for _ in like]


@unrolled
def choose_each(sign: Any, a: Any, b: Any) -> Any:
    """a_i where the number `sign` is positive, else b_i."""
    return [sign.choose(x, y) for x, y in zip(a, b, strict=True)]


@unrolled
def transpose(a: Any) -> Any:
    """A^T."""
    d = math.isqrt(len(a))
    return [a[j * d + i] for i, j in _entries(d, d)]


@unrolled
def from_upper(u: Any) -> Any:
    """A symmetric 3 x 3 matrix from its upper triangle, row by row."""
    return [u[k] for k in (0, 1, 2, 1, 3, 4, 2, 4, 5)]


@unrolled
def diagonal(v: Any) -> Any:
    """diag(v)."""
    return [v[i] * float(i == j) for i, j in _entries(len(v), len(v))]


@unrolled
def add_diagonal(a: Any, v: Any) -> Any:
    """A + diag(v)."""
    d = len(v)
    return [a[i * d + j] + v[i] if i == j else a[i * d + j] for i, j in _entries(d, d)]


@unrolled
def minus_product(a: Any, b: Any) -> Any:
    """-A B, B a matrix or a vector."""
    d = math.isqrt(len(a))
    m = len(b) // d
    return [_dot(-(a[i * d] * b[j]), a[i * d + 1 : i * d + d], b[m + j :: m]) for i, j in _entries(d, m)]


@unrolled
def less_transposed_product(t: Any, a: Any, b: Any) -> Any:
    """T - A^T B, B a matrix or a vector."""
    d = math.isqrt(len(a))
    m = len(b) // d
    return [_dot(t[i * m + j], a[i::d], b[j::m]) for i, j in _entries(d, m)]


@unrolled
def apply(a: Any, v: Any) -> Any:
    """A v, every product and sum rounded by itself."""
    d = len(v)
    return [_inner(a[i * d : i * d + d], v) for i in range(d)]


@unrolled
def inverse(m: Any) -> Any:
    """The inverse of a symmetric positive definite 3 x 3 matrix, whose upper triangle counts, by its LDL factors.

    Its adjugate has fewer divisions, but no digits left where an angle is unknown: variances of 1e9 and 0.1 m^2.
    """
    x = m[0].over()
    u, v = m[1] * x, m[2] * x
    y, e = m[4].less(m[1], u).over(), m[5].less(m[1], v)
    w = e * y
    f = m[8].less(m[2], v).less(e, w).over()
    v = (u * w) - v
    d, e, c = y.plus(w * f, w), -(w * f), v * f
    b = c * w
    b = -(b.plus(u, y))
    return [x.plus(u * y, u).plus(c, v), b, c, b, d, e, c, e, f]

"""Dual numbers: the exact derivative of a measurement by running it once, for whole arrays of factors at a time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ...arrays import Floats


@dataclass(frozen=True, eq=False)
class Dual:
    """A value and its derivative by E coordinates (forward-mode differentiation).

    The module that defines it is also the namespace `m` of its functions, as numpy, torch and casadi are of theirs.

    Args:
        value: any shape (...).
        derivative: (E, ...), broadcastable.

    >>> x, y, _ = seeds(np.array([3.0, 4.0, 0.0]))
    >>> sqrt(x * x + y * y).derivative
    array([0.6, 0.8, 0. ])
    """

    value: Floats
    derivative: Floats

    __array_ufunc__ = None  # makes ndarray * Dual call Dual.__rmul__

    def __add__(self, other: Any) -> Dual:
        if isinstance(other, Dual):
            return Dual(self.value + other.value, self.derivative + other.derivative)
        return Dual(self.value + other, self.derivative)

    def __neg__(self) -> Dual:
        return Dual(-self.value, -self.derivative)

    def __sub__(self, other: Any) -> Dual:
        return self.__add__(-other)

    def __rsub__(self, other: Any) -> Dual:
        return self.__neg__().__add__(other)

    def __mul__(self, other: Any) -> Dual:
        if isinstance(other, Dual):
            return Dual(self.value * other.value, self.value * other.derivative + other.value * self.derivative)
        return Dual(self.value * other, self.derivative * other)

    def __truediv__(self, other: Any) -> Dual:
        if isinstance(other, Dual):
            ratio = self.value / other.value
            return Dual(ratio, (self.derivative - ratio * other.derivative) / other.value)
        return Dual(self.value / other, self.derivative / other)

    def __rtruediv__(self, other: Any) -> Dual:
        ratio = other / self.value
        return Dual(ratio, -ratio / self.value * self.derivative)

    def __pow__(self, power: float) -> Dual:
        return Dual(self.value**power, power * self.value ** (power - 1) * self.derivative)

    def __lt__(self, other: Any) -> Any:
        return self.value < other

    def __gt__(self, other: Any) -> Any:
        return self.value > other

    __radd__ = __add__
    __rmul__ = __mul__


def seeds(vector: Floats, coordinates: int | None = None) -> tuple[Dual, ...]:
    """The components of vectors (..., k), each with the derivative 1 by itself among E `coordinates` (default k)."""
    k = vector.shape[-1]
    unit = np.eye(k, coordinates or k).reshape(k, -1, *(1,) * (vector.ndim - 1))
    return tuple(Dual(vector[..., i], unit[i]) for i in range(k))


def sqrt(a: Dual) -> Dual:
    """Square root."""
    root = np.sqrt(a.value)
    return Dual(root, a.derivative * (0.5 / root))


def sin(a: Dual) -> Dual:
    """Sine."""
    return Dual(np.sin(a.value), np.cos(a.value) * a.derivative)


def cos(a: Dual) -> Dual:
    """Cosine."""
    return Dual(np.cos(a.value), -np.sin(a.value) * a.derivative)


def atan2(y: Dual, x: Dual) -> Dual:
    """Angle of (x, y), d atan2 = (x dy - y dx) / (x^2 + y^2)."""
    square = x.value * x.value + y.value * y.value
    return Dual(np.arctan2(y.value, x.value), (x.value / square) * y.derivative - (y.value / square) * x.derivative)


def where(condition: Any, a: Any, b: Any) -> Dual:
    """`a` where the condition holds, else `b`; both are computed, so both must be finite."""
    first, second = (v if isinstance(v, Dual) else Dual(np.asarray(v, dtype=np.float64), np.zeros(1)) for v in (a, b))
    value = np.where(condition, first.value, second.value)
    rank = np.ndim(value)
    sides = (
        s.derivative.reshape(len(s.derivative), *(1,) * (rank + 1 - s.derivative.ndim), *s.derivative.shape[1:])
        for s in (first, second)
    )
    return Dual(value, np.where(condition, *sides))

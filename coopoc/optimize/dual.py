"""Dual numbers: the exact derivative of a measurement by running it once, for whole arrays of factors at a time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arrays import Floats


@dataclass(frozen=True, eq=False)
class Dual:
    """A value and its derivative by the three components of a vector (forward-mode differentiation).

    The module that defines it is also the namespace `m` of its functions, as numpy, torch and casadi are of theirs.

    Args:
        value: any shape (...). slope: (3, ...), broadcastable.

    >>> x, y, _ = seeds(np.array([3.0, 4.0, 0.0]))
    >>> sqrt(x * x + y * y).slope
    array([0.6, 0.8, 0. ])
    """

    value: Floats
    slope: Floats

    __array_ufunc__ = None  # makes ndarray * Dual call Dual.__rmul__

    def __add__(self, other: Any) -> Dual:
        if isinstance(other, Dual):
            return Dual(self.value + other.value, self.slope + other.slope)
        return Dual(self.value + other, self.slope)

    def __neg__(self) -> Dual:
        return Dual(-self.value, -self.slope)

    def __sub__(self, other: Any) -> Dual:
        return self.__add__(-other)

    def __rsub__(self, other: Any) -> Dual:
        return self.__neg__().__add__(other)

    def __mul__(self, other: Any) -> Dual:
        if isinstance(other, Dual):
            return Dual(self.value * other.value, self.value * other.slope + other.value * self.slope)
        return Dual(self.value * other, self.slope * other)

    def __truediv__(self, other: Any) -> Dual:
        if isinstance(other, Dual):
            ratio = self.value / other.value
            return Dual(ratio, (self.slope - ratio * other.slope) / other.value)
        return Dual(self.value / other, self.slope / other)

    def __rtruediv__(self, other: Any) -> Dual:
        ratio = other / self.value
        return Dual(ratio, -ratio / self.value * self.slope)

    def __pow__(self, power: float) -> Dual:
        return Dual(self.value**power, power * self.value ** (power - 1) * self.slope)

    __radd__ = __add__
    __rmul__ = __mul__


def seeds(vector: Floats) -> tuple[Dual, Dual, Dual]:
    """The components of vectors (..., 3), each with the derivative 1 by itself."""
    unit = np.eye(3).reshape(3, 3, *(1,) * (vector.ndim - 1))
    return Dual(vector[..., 0], unit[0]), Dual(vector[..., 1], unit[1]), Dual(vector[..., 2], unit[2])


def sqrt(a: Dual) -> Dual:
    """Square root."""
    root = np.sqrt(a.value)
    return Dual(root, a.slope * (0.5 / root))


def atan2(y: Dual, x: Dual) -> Dual:
    """Angle of (x, y), d atan2 = (x dy - y dx) / (x^2 + y^2)."""
    square = x.value * x.value + y.value * y.value
    return Dual(np.arctan2(y.value, x.value), (x.value / square) * y.slope - (y.value / square) * x.slope)

"""Robust losses, which bound the influence of outliers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...arrays import Floats, number, one_of

LOSSES: dict[str, tuple[Callable[[Any, float, Any], Any], Callable[[Floats, float], Floats]]] = {
    "huber": (
        lambda s, c, m: m.where(s > c * c, 2.0 * c * m.sqrt(m.fmax(s, c * c)) - c * c, s),
        lambda s, c: c / np.sqrt(np.maximum(s, c * c)),
    ),
    "cauchy": (lambda s, c, m: c * c * m.log1p(s / (c * c)), lambda s, c: 1.0 / (1.0 + s / (c * c))),
    "geman-mcclure": (lambda s, c, m: s / (1.0 + s / (c * c)), lambda s, c: (1.0 + s / (c * c)) ** -2.0),
    "truncated": (
        lambda s, c, m: m.where(s > c * c, c * c, s),
        lambda s, c: (s <= c * c).astype(np.float64),
    ),
}
"""rho(s, c, m) of the squared residual in any namespace m, such as NumPy or CasADi, and rho'(s, c) in NumPy."""


@dataclass(frozen=True)
class Loss:
    """rho(s) of the squared whitened residual s = |W (h(x) - z)|^2; half of it is what a measurement costs.

    huber: s up to c^2, then 2 c sqrt(s) - c^2. cauchy: c^2 log(1 + s/c^2). geman-mcclure: s / (1 + s/c^2).
    truncated: min(s, c^2). All equal s near zero. A measurement then has the weight rho'(s) (Barron, CVPR 2019;
    Black and Rangarajan, IJCV 1996). Only huber has a single minimum where least squares has.

    Args:
        name: of the four.
        scale: c > 0, in standard deviations.

    >>> float(Loss("huber", 1.0).cost(np.array(9.0))), float(Loss("huber", 1.0).weight(np.array(9.0)).round(3))
    (5.0, 0.333)
    """

    name: str
    scale: float

    def __post_init__(self) -> None:
        one_of("loss", self.name, LOSSES)
        hint, tiny = "It counts standard deviations: 1.5 to 3.", np.finfo(float).tiny
        object.__setattr__(self, "scale", number("scale", self.scale, tiny, allowed="> 0 and finite", hint=hint))

    def cost(self, square: Floats) -> Floats:
        """rho(s)."""
        return np.asarray(LOSSES[self.name][0](square, self.scale, np))

    def weight(self, square: Floats) -> Floats:
        """rho'(s), in [0, 1]."""
        return LOSSES[self.name][1](square, self.scale)

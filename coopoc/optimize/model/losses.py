"""Robust losses, which bound the influence of outliers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ...arrays import Floats, number
from ...plugins import one_of

Curve = Callable[[Floats, float], Floats]
Shape = tuple[Curve, Curve, Curve]
"""rho, rho' and rho'' of the squared residual."""

LOSSES: dict[str, Shape] = {
    "huber": (
        lambda s, c: np.where(s <= c * c, s, 2.0 * c * np.sqrt(np.maximum(s, c * c)) - c * c),
        lambda s, c: c / np.sqrt(np.maximum(s, c * c)),
        lambda s, c: np.where(s <= c * c, 0.0, -0.5 * c * np.maximum(s, c * c) ** -1.5),
    ),
    "cauchy": (
        lambda s, c: c * c * np.log1p(s / (c * c)),
        lambda s, c: 1.0 / (1.0 + s / (c * c)),
        lambda s, c: -((1.0 + s / (c * c)) ** -2.0) / (c * c),
    ),
    "geman-mcclure": (
        lambda s, c: s / (1.0 + s / (c * c)),
        lambda s, c: (1.0 + s / (c * c)) ** -2.0,
        lambda s, c: -2.0 * (1.0 + s / (c * c)) ** -3.0 / (c * c),
    ),
    "truncated": (
        lambda s, c: np.minimum(s, c * c),
        lambda s, c: (s <= c * c).astype(np.float64),
        lambda s, c: np.zeros_like(s),
    ),
}


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
        return LOSSES[self.name][0](square, self.scale)

    def weight(self, square: Floats) -> Floats:
        """rho'(s), in [0, 1]."""
        return LOSSES[self.name][1](square, self.scale)

    def second_derivative(self, square: Floats) -> Floats:
        """rho''(s), at most 0; 0 at the kink of a truncated loss."""
        return LOSSES[self.name][2](square, self.scale)

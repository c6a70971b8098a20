"""Body: what a recording in body frames holds beside its velocities, yaw rates and headings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import Floats, checked, refuse
from ..short_repr import short_repr


@dataclass(frozen=True, eq=False)
class Body:
    """Yaw rates and headings that vehicles measure, in R runs of T steps.

    Args:
        yaw_rate: (R, T, N) rad/s, mean over the step that ends at t; NaN where the vehicle is absent.
        heading: (R, T, N) rad from +x, anticlockwise, of a compass; NaN where there is none.

    Raises:
        InputError: arrays of other shapes, infinite numbers.

    >>> Body(np.zeros((1, 2, 1)), np.full((1, 2, 1), np.nan)).yaw_rate.shape
    (1, 2, 1)
    """

    yaw_rate: Floats
    heading: Floats

    __repr__ = short_repr

    def __post_init__(self) -> None:
        shape: tuple[int, ...] = (-1, -1, -1)
        for name in ("yaw_rate", "heading"):
            values = checked(name, getattr(self, name), "(R, T, N)", shape)
            shape = values.shape
            refuse(name, values, np.isinf(values), "must be finite, or NaN where missing", "Replace it by NaN.")
            object.__setattr__(self, name, values)

    def check(self, velocity: Floats) -> None:
        """InputError unless every vehicle that has a velocity (R, T, N, 3) m/s has a yaw rate."""
        rate = checked("yaw_rate", self.yaw_rate, "(R, T, N)", velocity.shape[:3])
        allowed = "must be there with a velocity, and only there"
        refuse("yaw_rate", rate, np.isnan(rate) != np.isnan(velocity[..., 0]), allowed, "A vehicle that stands has 0.")

"""A relative measurement as an edge from the ego to a neighbour: information matrix E and information vector eta.

A measurement is the eight numbers of `messages.Star.relative`, the last three its standard deviations; an infinite one
stands for a component that was not measured. A number is a float, or LANES runs side by side.
"""

from __future__ import annotations

import math

import numpy as np

from ...arrays import Floats
from ..compiling.compile import inner
from ..compiling.small import apply, from_upper, scale, subtract
from ..compiling.vectors import choose
from .relative import Numbers, completed, converted, exact, vector

EXACT, AT_GAP = np.arange(2)
"""Linear in range and angles at the present points; converted to a vector, weighted by the geometry of the points,
which must not depend on the measurement. NumPy's integers: for each constant of Python's numba would compile a function
once more."""


@inner
def edge(gap: Numbers, z: Numbers, std: Floats, least: float, how: int) -> tuple[Numbers, Numbers]:
    """E = J^T W J and eta = J^T W (z - h) at the vector `gap` m; without standard deviations E is the unit matrix.

    Args:
        gap: from the ego to the neighbour.
        z: the measurement.
        std: (3,) m, rad, rad, of no length for unit matrices.
        least: m; the angles of a measurement that is shorter have their standard deviations inflated.
        how: EXACT or AT_GAP.
    """
    z = z if how == AT_GAP else inflated(z, least)
    x, y, up = gap
    o, whole = 0.0 * z[0], 1e300 - (z[5] + z[6] + z[7])
    if len(std) == 0:
        there = choose(whole, o + 1.0, o)
        return from_upper((there, o, o, there, o, there)), scale(subtract(vector(z), gap), there)
    if how == EXACT:
        e = exact(x, y, up, z, z[5:], 0.0)
        return from_upper(e[:6]), e[6:]
    information = from_upper(converted(x, y, up, z[5:], least))
    return information, apply(information, subtract(vector(completed(z, gap)), gap))


@inner
def inflated(z: Numbers, least: float) -> Numbers:
    """The measurement, its angles' standard deviations inflated by least / range, up to half a turn."""
    wide = choose(1e300 - z[5], max(least / max(z[0], 1e-300), 1.0), 0.0 * z[0] + 1.0)
    s1, s2 = -max(-(wide * z[6]), -math.pi), -max(-(wide * z[7]), -math.pi)
    return z[0], z[1], z[2], z[3], z[4], z[5], max(s1, z[6]), max(s2, z[7])

"""Converted measurements: a vector, linear in the nodes, in place of a range and angles."""

from __future__ import annotations

from typing import Any

from .measurements import Measurement

LEAST_RANGE = 1.0
"""m; a noisy range near zero would make the converted angles seem exact."""
LEAST_SINE = 0.05
"""Of the inclination: near the vertical the azimuth carries no information."""


def is_converted(known: Measurement) -> bool:
    """Whether a kind's measurements become vectors; of the others those that are linear stay, and angles are left out.

    >>> from coopoc.optimize.model.measurements import lookup
    >>> is_converted(lookup("spherical")), is_converted(lookup("range"))
    (True, False)
    """
    return known.name == "spherical"


def converted_rows(z: list[Any], m: Any) -> tuple[Any, list[list[Any]]]:
    """Range d and rows of diag(1, 1/(d sin inc), 1/d) [u e_az e_inc]^T in any namespace, from measured values.

    The converted residual is their product with the vector between the nodes, less (d, 0, 0): d u is the measured one.

    Args:
        z: range, azimuth and, in space, inclination.
        m: with sin, cos, fabs, fmax and where.

    >>> import numpy as np
    >>> converted_rows([2.0, 0.0], np)[1]
    [[np.float64(1.0), np.float64(0.0)], [np.float64(-0.0), np.float64(0.5)]]
    """
    d, sa, ca = m.fmax(z[0], LEAST_RANGE), m.sin(z[1]), m.cos(z[1])
    if len(z) == 2:
        return d, [[ca, sa], [-sa / d, ca / d]]
    si, ci = m.sin(z[2]), m.cos(z[2])
    across = d * m.where(si < 0, -1.0, 1.0) * m.fmax(m.fabs(si), LEAST_SINE)
    return d, [[si * ca, si * sa, ci], [-sa / across, ca / across, 0.0 * d], [ci * ca / d, ci * sa / d, -si / d]]

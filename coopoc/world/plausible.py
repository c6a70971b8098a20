"""Plausibility: refuse numbers that nothing measures, degrees, and positions that float32 has rounded."""

import numpy as np

from ..arrays import TWO_TURNS, Floats, refuse
from .links import wrap

MAX_POSITION, MAX_SPEED, MAX_YAW_RATE = 1e8, 1e4, 100.0
"""m, m/s and rad/s (16 turns; odometry of mrclam6.pyfg has 10): what lies beyond was not measured on Earth, and its
square leaves no digits to what stands beside it."""
UNWRAPPED = 1e6
"""rad, beyond which an unwrapped angle has lost its digits."""
COARSE_SPACING = 0.01
"""m, of the resolution of float32 that matters."""


def plausible(field: str, values: Floats, limit: float, hint: str = "Is it in another unit?") -> None:
    """InputError for the first number beyond the limit, and for positions that float32 has rounded; NaN is missing.

    >>> plausible("velocity", np.array([3.0, -1e9]), MAX_SPEED)
    Traceback (most recent call last):
    coopoc.errors.InputError: velocity[1] = -1000000000.0: must be within +-10000 in SI units. Is it in another unit?
    """
    if not values.size:
        return
    largest = max(np.fmax.reduce(values, axis=None), -np.fmin.reduce(values, axis=None))
    if largest > limit:
        refuse(field, values, abs(values) > limit, f"must be within +-{limit:g} in SI units", hint)
    if (step := float(np.spacing(np.float32(largest)))) > COARSE_SPACING and limit == MAX_POSITION:
        there = values[np.isfinite(values)]
        rounded = np.full(values.shape, bool((there == there.astype(np.float32)).all() and (there % 1).any()))
        allowed = f"must have more digits than those of float32, which are {step:g} m apart there"
        refuse(field, values, rounded, allowed, "Subtract a local origin before you convert to float32.")


def radians(field: str, values: Floats, limit: float = TWO_TURNS) -> None:
    """InputError for the first angle that is in degrees; NaN is missing.

    >>> radians("azimuth", np.array([90.0]))
    Traceback (most recent call last):
    coopoc.errors.InputError: azimuth[0] = 90.0: must be within +-12.5664 in SI units. Convert degrees by \
np.deg2rad, and wrap what is unwrapped.
    """
    plausible(field, values, limit, "Convert degrees by np.deg2rad, and wrap what is unwrapped.")


def headings(values: Floats, velocity: Floats | None = None) -> None:
    """InputError for headings (..., T, N) in degrees. They may be unwrapped, but do not jump by more than two turns, as
    degrees do at 360, and beyond two turns are no courses of velocities (T, N, 3) m/s once they are converted."""
    radians("heading", values, UNWRAPPED)
    wrong, far = abs(np.diff(values, axis=-2, prepend=values[..., :1, :])) > TWO_TURNS, abs(values) > TWO_TURNS
    if velocity is not None and far.any():
        moving = far & (abs(velocity[..., :2]).max(axis=-1) > 1.0)
        course = np.arctan2(velocity[..., 1], velocity[..., 0])
        off = [abs(wrap(turn - course))[moving] for turn in (values, np.deg2rad(values))]
        wrong |= moving & bool(moving.any() and np.median(off[1]) < min(0.2, np.median(off[0])))
    refuse(
        "heading",
        values,
        wrong,
        "must be in radians, and jump by less than two turns",
        "Convert degrees by np.deg2rad.",
    )

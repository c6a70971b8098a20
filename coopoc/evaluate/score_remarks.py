"""Signs that an estimate and its truth do not speak of the same seconds or metres."""

from __future__ import annotations

from ..arrays import Floats
from ..errors import InputError
from .alignment import absolute_error, align
from .association import span

UNITS = {1e3: "ms", 1e6: "us", 1e9: "ns"}
LENGTHS = {1e-3: "km", 1e2: "cm", 1e3: "mm", 1 / 0.3048: "feet"}


def remarks(stamps: tuple[Floats, Floats], positions: tuple[Floats, Floats], max_diff: float) -> tuple[str, ...]:
    """What a reader should know before believing the scores, a sentence each.

    Args:
        stamps: (M,), (K,) s of the whole estimate and the whole truth.
        positions: (n, 3), (n, 3) m of both where they are compared.
        max_diff: s, how far stamps that belong together were allowed to be apart.

    >>> import numpy as np
    >>> t = np.arange(9.0)
    >>> remarks((1000 * t, t), (np.zeros((1, 3)), np.zeros((1, 3))), 0.01)[0]
    '1 of 9 stamps meet within 0.01 s: 0.0..8000.0 s and 0.0..8.0 s; the estimate looks like ms.'
    """
    return tuple(text for text in (_stamps(stamps, len(positions[0]), max_diff), _scale(*positions)) if text)


def _stamps(stamps: tuple[Floats, Floats], met: int, max_diff: float) -> str:
    count = min(map(len, stamps))
    if 2 * met >= count:
        return ""
    long, true = (float(t[-1] - t[0]) for t in stamps)
    looks = "another clock (offset), or rates that do not meet (max_diff)?"
    for factor, unit in UNITS.items():
        if 0.5 * factor < long / max(true, 1e-12) < 2 * factor:
            looks = f"the estimate looks like {unit}."
        if 0.5 * factor < true / max(long, 1e-12) < 2 * factor:
            looks = f"the truth looks like {unit}."
    return f"{met} of {count} stamps meet within {max_diff:g} s: {span(stamps[0])} and {span(stamps[1])}; {looks}"


def _scale(estimate: Floats, truth: Floats) -> str:
    """A scale that takes most of the error of the best rigid motion away, as a monocular camera or another unit has."""
    try:
        factor = float(align(estimate, truth, scale=True).scale)
    except InputError:  # a straight drive, or a standing one: its frame is open, and so is its scale
        return ""
    rigid, free = (float(absolute_error(estimate, truth, scale=scale).rmse) for scale in (False, True))
    if not factor or abs(factor - 1) < 0.05 or free > rigid / 2:
        return ""
    unit = next((f", as if it were in {unit}" for size, unit in LENGTHS.items() if abs(factor * size - 1) < 0.1), "")
    return (
        f"divided by {1 / factor:.3g}, its aligned error falls from {rigid:.3g} to {free:.3g} m: another scale{unit}."
    )

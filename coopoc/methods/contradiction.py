"""A note on estimates that an ego's own fixes contradict, as those of a filter that has diverged."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..arrays import Floats
from ..world.recording import Recording

BEYOND = 10.0
"""Standard deviations of a fix (norm of its axes) that no estimate is away from it at half of the steps."""


def contradicted(x: Floats, recording: Recording, columns: Sequence[int]) -> tuple[str, ...]:
    """A note if estimates (R, T, E, 3) m lie far from the egos' fixes at half of the steps that have one.

    >>> from coopoc import Fleet, Sensors, observe
    >>> fleet = Fleet(("a",), [0, 0.1], np.zeros((2, 1, 3)), np.zeros((2, 1, 3)))
    >>> contradicted(np.full((1, 2, 1, 3), 1e3), observe(fleet, Sensors()), [0])[0][:58]
    'estimates are over 26 m from most fixes in 1 of 1 runs: di'
    """
    noise = recording.sensors
    limit = BEYOND * (float(np.linalg.norm(noise.fix_std)) + noise.gnss_bias[1])
    gap = np.square(recording.gnss[:, :, columns] - x).sum(axis=-1)
    far, known = (gap > limit**2).sum(axis=1), np.isfinite(gap).sum(axis=1)
    if not (lost := int((2 * far > known).sum())):
        return ()
    why = "diverged, or fixes are worse than stated; covariances say nothing there"
    return (f"estimates are over {limit:.2g} m from most fixes in {lost} of {far.size} runs: {why}",)

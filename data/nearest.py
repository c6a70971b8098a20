"""Measurements at their own times as measurements of steps: of several of a pair at a step, the nearest in time."""

from __future__ import annotations

import numpy as np

from coopoc.arrays import Bools, Floats, Ints


def nearest(late: Floats, step: Ints, observer: Ints, neighbour: Ints) -> Ints:
    """Indices of one measurement per step, observer and neighbour, sorted by these.

    Args:
        late: (M,) s between a measurement and its step.
        step: (M,); negative ones are left out.
        observer: (M,) columns; negative ones are left out.
        neighbour: (M,) as `observer`.

    >>> nearest(np.array([0.04, 0.01, 0.02]), np.array([3, 3, -1]), np.zeros(3, int), np.ones(3, int))
    array([1])
    """
    order = np.lexsort((late, neighbour, observer, step))
    order = order[((step >= 0) & (observer >= 0) & (neighbour >= 0))[order]]
    return order[changes(step[order], observer[order], neighbour[order])]


def steps_of(t: Floats, dt: float, steps: int) -> tuple[Ints, Floats]:
    """Step of each time (M,) s after the first step, -1 outside the drive, and how far off it is in s.

    >>> steps_of(np.array([0.21, 9.0]), 0.1, 5)[0]
    array([ 2, -1])
    """
    step = np.rint(t / dt)
    return np.where((step >= 0) & (step < steps), step, -1).astype(np.int64), np.abs(t - dt * step)


def changes(*keys: Ints) -> Bools:
    """True at the first of each run of equal rows."""
    rows = np.column_stack(keys)
    first: Bools = np.append(True, (np.diff(rows, axis=0) != 0).any(axis=1))[: len(rows)]
    return first

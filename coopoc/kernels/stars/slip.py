"""Whether the ego slips in a step: the step is tried once more, with a motion that is not known, and the likelier of
both is kept.

Numbers beyond their gate count with no more than it, a fix as one: a range that is too long, or a receiver that jumps,
is no slip.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...arrays import Floats
from ..compiling.compile import part, storage
from .cooperative_state import DT, MOTION, OWN, WIDTH, Filter, Model, new_filter
from .gaussian import Rows

SLIPPED, SPEED_OF_LATE, NOW, LIKELY, NUMBERS, SQUARES = range(6)
"""Of `Filter.slip`: probability that the ego slips, its late speed m/s, whether this try assumes so, and of the step's
numbers the logarithm of their likelihood, how many there are, and their squared normalised innovations."""
LASTS, RARE, LATE, UNSEEN = 3.0, 3000.0, 10.0, 1.0
"""s: how long a slip lasts, how long none does, for which a speed is remembered, and until a slip shows."""


class Tries(NamedTuple):
    """A filter before a step and after its first try, and the step's rows."""

    before: Filter
    first: Filter
    own: Floats
    rows: Floats


@storage
def new_tries(slots: int, vehicles: int) -> Tries:
    """Memory for as many members and vehicles."""
    return Tries(new_filter(slots, vehicles), new_filter(slots, vehicles), np.zeros(OWN), np.zeros((slots, WIDTH)))


@part
def remember_speed(f: Filter, own: Floats) -> None:
    """The most of late speeds: wheels that are locked measure none."""
    square = 0.0
    for c in range(3):
        square += (own[MOTION + c] / own[DT]) ** 2
    f.slip[SPEED_OF_LATE] = max(math.sqrt(square), f.slip[SPEED_OF_LATE] * math.exp(-own[DT] / LATE))


@part
def slip_variance(f: Filter, model: Model, dt: float) -> float:
    """m^2, of the ego's motion in a step, if it is assumed to slip; one that begins now may have for UNSEEN s."""
    seconds = dt if f.slip[SLIPPED] > 0.5 else max(dt, UNSEEN)
    variance: float = f.slip[NOW] * (model.slip * f.slip[SPEED_OF_LATE] * seconds) ** 2
    return variance


@part
def score(f: Filter, h: Rows, gate: float, whole: bool) -> None:
    """Count the rows of an update, each, or as the fix that they are; beyond the gate no more."""
    square = 0.0
    for c in range(3):
        if h.used[c] and h.schur[c] > 0.0:
            q = h.q[c]
            square += q if whole else min(q, gate)
            f.slip[LIKELY] -= 0.5 * math.log(h.schur[c])
            f.slip[NUMBERS] += 1.0
    square = min(square, gate) if whole else square
    f.slip[LIKELY] -= 0.5 * square
    f.slip[SQUARES] += square


@part
def surprised(f: Filter) -> bool:
    """Whether the first try's numbers are worse than usual by a standard deviation, or the ego may have slipped."""
    n = f.slip[NUMBERS]
    return bool(f.slip[SLIPPED] > 0.1 or f.slip[SQUARES] > n + math.sqrt(2.0 * n))


@part
def chance(f: Filter, first: Filter, dt: float) -> float:
    """Probability of a slip, after both tries of a step, by that before it."""
    stays, begins = math.exp(-dt / LASTS), min(dt / RARE, 0.5)
    before = first.slip[SLIPPED] * stays + (1.0 - first.slip[SLIPPED]) * begins
    odds = f.slip[LIKELY] - first.slip[LIKELY] + math.log(before / (1.0 - before))
    return 1.0 / (1.0 + math.exp(min(-odds, 700.0)))

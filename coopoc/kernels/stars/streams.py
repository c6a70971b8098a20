"""Streams of stars: the rows of a step, the filters' steps for Python."""

from __future__ import annotations

import math

import numpy as np

from ...arrays import Floats, Ints
from ..compiling.compile import compiled
from ..dead_reckoning import dead_reckon
from ..motion import MotionNoise, process_variance
from .cooperative_filter import step
from .cooperative_state import (
    DT,
    FIX,
    FIX_VARIANCE,
    MOTION,
    MOTION_VARIANCE,
    SPEED,
    STEP,
    Filter,
    Guards,
    Model,
    begin,
    copy_filter,
    distrust,
    new_filter,
)
from .gaussian import PLACE


@compiled
def stream_row(given: Floats, history: Floats, motion: MotionNoise, fix: Floats, own: Floats) -> int:
    """The ego's row of a stream, by dead reckoning; a fix of some age is brought forward. `kernels.solo` says when it
    is NO_FIX_YET or BAD_INPUT.

    Args:
        given: (8,) fix m, velocity m/s, dt s, age of the fix s.
        history: of `motion`.
        motion: noise.
        fix: (3,) m^2, variance of a fix.
        own: (OWN,) out.
    """
    since, late = np.zeros(3), np.zeros(3)
    outcome = dead_reckon(given, history, motion, own[MOTION:MOTION_VARIANCE], own[MOTION_VARIANCE:DT], since, late)
    own[DT] = given[6]
    for c in range(3):
        own[FIX + c], own[FIX_VARIANCE + c] = given[c] + since[c], fix[c] + late[c]
    return int(outcome)


@compiled
def motion_of(rows: Floats, motion: MotionNoise, dt: float) -> None:
    """Fill the variance of one step's motion of neighbours by the velocity of the newest message of each."""
    interval = motion.interval if motion.interval > 0.0 else dt
    for i in range(len(rows)):
        q = process_variance(motion, rows[i, SPEED:STEP], interval)
        for c in range(3):
            rows[i, STEP + c] = q[c] * (dt / interval) ** 2


@compiled
def stream_step(
    f: Filter, known: Model, guards: Guards, own: Floats, rows: Floats, vehicles: Ints, start: Floats, answer: Floats
) -> int:
    """One step; 1 if a vehicle has lost trust.

    Args:
        f: filter.
        known: noise model.
        guards: against what may be wrong.
        own: (OWN,).
        rows: (k, WIDTH) of the neighbours that are measured now.
        vehicles: (k,) which they are; the ego is vehicle 0.
        start: (3,) m, known before the first step, NaN for none.
        answer: (12 + 3 k,) out: position m, covariance m^2, positions of the neighbours m.
    """
    if f.g.vectors[0] == 0:
        begin(f, known, guards, own, rows, len(vehicles), 0)
        if math.isfinite(start[0]):
            f.step[0], f.vague[0] = 1, 0.0
            for c in range(3):
                f.g.x[c] = start[c]
    f.alarm[0] = 0
    step(f, known, guards, own, rows, vehicles, len(vehicles))
    for c in range(3):
        answer[c] = f.g.x[c]
        for d in range(3):
            answer[3 + 3 * c + d] = f.g.p[c, d]
        for i in range(len(vehicles)):
            answer[12 + 3 * i + c] = f.g.x[3 * f.g.block[f.slot[vehicles[i]], PLACE] + c]
    return int(f.alarm[0])


@compiled
def make_filter(slots: int, vehicles: int) -> Filter:
    """A filter before its first step, for Python."""
    return new_filter(slots, vehicles)


@compiled
def keep(source: Filter, target: Filter) -> None:
    """Copy the state."""
    copy_filter(source, target)


@compiled
def restore(source: Filter, target: Filter, known: Model, guards: Guards) -> None:
    """Go back to a state, with trust revoked in those who have lost it since."""
    copy_filter(source, target)
    distrust(target, known, guards)

"""The smoother of one run: Gauss-Newton over a whole drive, each step two sweeps of `block_tridiagonal`."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from ...arrays import Floats, Ints
from .block_tridiagonal import Memory, Motion, eliminate, marginalised, marginals, substitute
from .fleet_normal import Drive, linearise, misfit, sum_vectors

EXTRA, HALVINGS = 20, 12
"""Sweeps beyond the asked ones while steps must be shortened, and how often one is halved."""


def smooth(
    at: Floats, drive: Drive, steps: int, settled: Callable[[float], bool], memory: Memory, tick: Callable[[], object]
) -> tuple[Floats, Floats]:
    """Positions (T, N, 3) m and covariances (T, N, 3, 3) m^2 of one run, NaN where a vehicle is inactive.

    Args:
        at: (T, N, 3) m to begin at.
        drive: its measurements.
        steps: Gauss-Newton steps after the converted solution; more with the last factors until one is `settled`.
        settled: whether to stop after a step that moved some position by so many metres.
        memory: of the factors.
        tick: called once a step of each sweep.

    Raises:
        numpy.linalg.LinAlgError: a number is not finite.
    """
    stays = _stays(drive.place)
    sweeps, whole = 0, False
    while True:
        moved, before = _motions(at, stays, drive), at
        weight, eta = linearise(at, drive, sweeps == 0)
        vectors = _vectors(sum_vectors(at, drive, eta), drive.place)
        if sweeps <= steps or not whole:
            motions, inverses = moved, eliminate(drive, weight, moved, memory, vectors, tick)
            sweeps += 1
        else:
            for t, motion in enumerate(moved[:-1]):
                vectors[t + 1][motion.new] += marginalised(inverses[t], vectors[t], motion)
        at = substitute(at, drive.place, moved, inverses, vectors)
        if sweeps > 1:
            at, whole = descended(before, at, drive)
        size = float(np.nanmax(np.abs(at - before))) if whole or sweeps <= steps + EXTRA else np.inf
        if sweeps > steps and (not steps or ((whole or size == np.inf) and settled(size))):
            return at, marginals(at, drive.place, motions, inverses)


def descended(before: Floats, at: Floats, drive: Drive) -> tuple[Floats, bool]:
    """The step from `before` to `at`, halved until it does not raise the cost, and whether it is whole."""
    cost = misfit(before, drive)
    for k in range(HALVINGS):
        shorter = before + 0.5**k * (at - before)
        if misfit(shorter, drive) <= cost * (1.0 + 1e-12):
            return shorter, k == 0
    return before, False


def _vectors(eta: Floats, place: Ints) -> list[Floats]:
    """(n,) of each step."""
    return [row[there].ravel() for row, there in zip(eta, place >= 0, strict=True)]


def _stays(place: Ints) -> list[tuple[Ints, Ints, Ints]]:
    """Columns of the vehicles present at each step and the next, and their rows here and there."""
    found = []
    for here, there in pairwise(place):
        columns = np.flatnonzero((here >= 0) & (there >= 0))
        old, new = ((3 * rows[columns, None] + np.arange(3)).ravel() for rows in (here, there))
        found.append((columns, old, new))
    return found


def _motions(at: Floats, stays: list[tuple[Ints, Ints, Ints]], drive: Drive) -> list[Motion]:
    """Of each step and the next; nothing after the last."""
    gap = drive.motion[1:] - np.diff(at, axis=0)
    motions = [
        Motion(old, new, drive.motion_weight[t + 1, columns].ravel(), gap[t, columns].ravel())
        for t, (columns, old, new) in enumerate(stays)
    ]
    none = np.zeros(0, np.int64)
    return [*motions, Motion(none, none, np.zeros(0), np.zeros(0))]

"""Normal equations of one run of a whole fleet: the information of fixes, motions and pairs at positions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...arrays import AnyArray, Floats
from ..compiling.compile import compiled
from ..compiling.small import load, store, subtract
from .fleet_graph import VECTOR, Assumed, Measured, Pairs, advance, pair


class Drive(NamedTuple):
    """One run.

    Attributes:
        place: (T, N) the vehicle's number among those of its step, -1 where inactive.
        pairs: those that count; `alive` is (1, P).
        relative: (L, 5).
        assumed: the noise model.
        fix_weight: (T, N, 3) 1/m^2, 0 where there is no fix.
        fix: (T, N, 3) m, any number where there is none.
        motion_weight: (T, N, 3) 1/m^2 of the motion from the step before.
        motion: (T, N, 3) m.
    """

    place: AnyArray
    pairs: Pairs
    relative: AnyArray
    assumed: Assumed
    fix_weight: AnyArray
    fix: AnyArray
    motion_weight: AnyArray
    motion: AnyArray


def misfit(at: Floats, drive: Drive) -> float:
    """Sum of the squared whitened residuals of fixes, motions, ranges and angles at positions (T, N, 3) m."""
    pairs, total = drive.pairs, float(np.nansum(drive.fix_weight * (drive.fix - at) ** 2))
    total += float(np.nansum(drive.motion_weight[1:] * (drive.motion[1:] - np.diff(at, axis=0)) ** 2))
    step = np.repeat(np.arange(len(at)), np.diff(pairs.start))
    gap = at[step, pairs.second] - at[step, pairs.first]
    for link, vector in ((pairs.link, gap), (pairs.link_back, -gap)):
        used = pairs.alive[0] & (link >= 0)
        seen, (x, y, z) = drive.relative[link[used]], vector[used].T
        flat = np.hypot(x, y)
        apart = np.stack(
            [
                np.where(seen[:, 0] >= 0.0, seen[:, 0] - np.hypot(flat, z), 0.0),
                np.arctan2(seen[:, 1] * x - seen[:, 2] * y, seen[:, 2] * x + seen[:, 1] * y),
                np.arctan2(seen[:, 3] * z - seen[:, 4] * flat, seen[:, 4] * z + seen[:, 3] * flat),
            ]
        )
        total += float(np.sum((apart / drive.assumed.std[:, None]) ** 2))
    return total


@compiled
def alone(measured: Measured, assumed: Assumed) -> Floats:
    """Positions (R, T, 3 N) m of each vehicle's own filter, NaN where inactive."""
    runs, steps, vehicles = measured.active.shape
    x, own = np.empty((runs, steps, 3 * vehicles)), np.zeros(9 * vehicles)
    for run in range(runs):
        for t in range(steps):
            advance(run, t, x[run], own, measured, assumed)
    return x


@compiled
def linearise(at: AnyArray, drive: Drive, converted: bool) -> tuple[Floats, Floats]:
    """Information (9 P) of each pair and its information vector (P, 3) at positions (T, N, 3) m."""
    pairs = drive.pairs
    weight, eta = np.zeros(9 * len(pairs.first)), np.zeros((len(pairs.first), 3))
    for t in range(len(at)):
        for k in range(pairs.start[t], pairs.start[t + 1]):
            if pairs.alive[0, k]:
                vector = subtract(load(at[t, pairs.second[k]], 0, VECTOR), load(at[t, pairs.first[k]], 0, VECTOR))
                one = pair(vector, k, pairs, drive.relative, drive.assumed, converted)
                store(weight, k, one[0])
                store(eta[k], 0, one[1])
    return weight, eta


@compiled
def gather(t: int, drive: Drive, weight: AnyArray, total: AnyArray) -> None:
    """Add the information of the fixes and pairs of step t to its matrix (n, n)."""
    for column in range(drive.place.shape[1]):
        a = 3 * drive.place[t, column]
        for c in range(3 if a >= 0 else 0):
            total[a + c, a + c] += drive.fix_weight[t, column, c]
    pairs = drive.pairs
    for k in range(pairs.start[t], pairs.start[t + 1]):
        a, b = 3 * drive.place[t, pairs.first[k]], 3 * drive.place[t, pairs.second[k]]
        for c in range(3 if pairs.alive[0, k] else 0):
            for r in range(3):
                total[b + r, a + c] -= weight[9 * k + 3 * r + c]
                if r >= c:
                    total[a + r, a + c] += weight[9 * k + 3 * r + c]
                    total[b + r, b + c] += weight[9 * k + 3 * r + c]


@compiled
def sum_vectors(at: AnyArray, drive: Drive, eta: AnyArray) -> Floats:
    """(T, N, 3) 1/m, information vectors of fixes and pairs at every position."""
    pairs = drive.pairs
    total: Floats = drive.fix_weight * (drive.fix - at)
    for t in range(len(at)):
        for k in range(pairs.start[t], pairs.start[t + 1]):
            for c in range(3 if pairs.alive[0, k] else 0):
                total[t, pairs.first[k], c] -= eta[k, c]
                total[t, pairs.second[k], c] += eta[k, c]
    return total

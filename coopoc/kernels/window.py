"""The most probable window of stars of each run and step: converted linear start, then exact Gauss-Newton steps.

A neighbour's points of consecutive steps are a chain that meets nobody but the ego (`coopoc.kernels.chains`). Slot t
modulo the length h of the window holds step t. The tuples `measured` and `assumed` are those of
`coopoc.kernels.star_messages`, `fresh` being where a message is held. In a plain tuple, `window`: said (h, 5, n, 3) of
`coopoc.kernels.roster`; weight (h, n, 3) 1/m^2 of the fixes; edge (h, n, 9), information and pull of a sighting; point
(h, n, 3) m; count (h,), how many there are; before and later (h, n), their places in the stars beside, or -1.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..arrays import AnyArray, Floats, Ints
from .chains import LEAST_PROCESS, dissolve, fold, unfold
from .compile import compiled
from .roster import FIX, MOVED, PROCESS, WEIGHT, places, stay, tell
from .sighting import exact, vector
from .snapshot import LIMIT, LOST, MET, SOLVED, as_measured, widened


@compiled
def windows(
    measured: Any, assumed: Any, fresh: AnyArray, length: int, tolerance: float, apart: float
) -> tuple[Floats, Floats, Floats, Ints]:
    """x (R, T, 3) m, covariance (R, T, 3, 3) m^2, neighbours (R, M, 3) m, NaN if never heard, how each ended (R, T).

    Args:
        fresh: (R, M) where a message is new; one that is merely held counts where the window meets its vehicle.
        length: steps. tolerance: m, largest move in the last step. apart: m on the ground, closer vehicles have met.
    """
    gnss, _, seen, neighbour, start, newest, _, _, _ = measured
    runs, steps, most, std, least = gnss.shape[0], gnss.shape[1], 1 + np.diff(start).max(), assumed[2], assumed[3]
    x, cov, others = np.empty((runs, steps, 3)), np.empty((runs, steps, 3, 3)), np.empty((runs, seen.shape[1], 3))
    ended, kept, met = np.empty((runs, steps), np.int64), places(neighbour, start), last_met(neighbour, start)
    place, held = np.zeros(most, np.int64), np.zeros((2, 2, most, 1), np.int64)
    said, weight, edge = np.zeros((length, 5, most, 3)), np.zeros((length, most, 3)), np.zeros((length, most, 9))
    point, count, later = np.zeros((length, most, 3)), np.zeros(length, np.int64), np.full((length, most), -1, np.int64)
    before = np.full((length, most), -1, np.int64)
    window = (said, weight, edge, point, count, before, later)
    memory = (np.zeros((length, most, 3, 3 * length)), np.zeros((length, most, 9)), np.zeros((3 * length, 3 * length)),
              np.zeros(3 * length))  # fmt: skip
    for run in range(runs):
        for t in range(steps):
            n, slot, first = stay(t, start, kept, place), t % length, max(0, t - length + 1)
            tell(measured, assumed, run, t, place[:n], held[t % 2], held[1 - t % 2], said[slot])
            count[slot] = n
            for k in range(n):
                later[slot, k], before[slot, k] = -1, place[k]
                if t > first and place[k] >= 0:
                    later[(t - 1) % length, place[k]] = k
            for step in range(first, t + 1):
                for k in range(count[step % length]):
                    link = start[step] + k - 1
                    used = k == 0 or fresh[run, link] or met[link] < first
                    for c in range(3):
                        weight[step % length, k, c] = said[step % length, WEIGHT, k, c] if used else 0.0
                        point[step % length, k, c] = said[step % length, FIX, k, c]
            ended[run, t] = solve(window, seen[run], start, first, t, std, least, tolerance, apart, memory, cov[run, t])
            for k in range(n):
                for c in range(3):
                    if k == 0:
                        x[run, t, c] = point[slot, 0, c]
                    else:
                        there = newest[run, start[t] + k - 1] >= 0
                        others[run, start[t] + k - 1, c] = point[slot, k, c] if there else np.nan
    return x, cov, others, ended


@compiled
def last_met(neighbour: AnyArray, start: AnyArray) -> Ints:
    """(M,) step at which the neighbour of each link was linked before, -1 for never."""
    found = np.empty(len(neighbour), np.int64)
    when = np.full(neighbour.max() + 1 if len(neighbour) else 0, -1, np.int64)
    for t in range(len(start) - 1):
        for link in range(start[t], start[t + 1]):
            found[link] = when[neighbour[link]]
            when[neighbour[link]] = t
    return found


@compiled
def solve(
    window: Any, seen: AnyArray, start: AnyArray, first: int, last: int, std: AnyArray, least: float,
    tolerance: float, apart: float, memory: Any, cov: AnyArray,
) -> int:  # fmt: skip
    """The window of some steps in place, the covariance of the ego's newest point, and how it ended."""
    linearise(window, seen, start, first, last, std, least, False)
    move(window, first, last, memory, cov)
    if len(std) == 0:
        return SOLVED
    for _ in range(LIMIT):
        linearise(window, seen, start, first, last, std, least, True)
        if move(window, first, last, memory, cov) <= tolerance:
            if not meeting(window, first, last, apart):
                return SOLVED
            linearise(window, seen, start, first, last, std, least, False)
            move(window, first, last, memory, cov)
            return MET
    return LOST


@compiled
def linearise(
    window: Any, seen: AnyArray, start: AnyArray, first: int, last: int, std: AnyArray, least: float, again: bool
) -> None:  # fmt: skip
    """The edges: linear in range and angles at the points, or `again` False, converted where they were measured."""
    _, _, edge, point, count, _, _ = window
    for step in range(first, last + 1):
        slot = step % len(point)
        for k in range(1, count[slot]):
            one, e = seen[start[step] + k - 1], edge[slot, k]
            x, y, z = (
                point[slot, k, 0] - point[slot, 0, 0], point[slot, k, 1] - point[slot, 0, 1],
                point[slot, k, 2] - point[slot, 0, 2],
            )  # fmt: skip
            if again:
                wide = widened(one, std, least)
                e[0], e[1], e[2], e[3], e[4], e[5], e[6], e[7], e[8] = exact(x, y, z, one, wide, 0.0)
                continue
            xx, xy, xz, yy, yz, zz = as_measured(one, std, least)
            a, b, c = vector(one)
            x, y, z = a - x, b - y, c - z
            e[0], e[1], e[2], e[3], e[4], e[5] = xx, xy, xz, yy, yz, zz
            e[6], e[7], e[8] = xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z


@compiled
def meeting(window: Any, first: int, last: int, apart: float) -> bool:
    """True if the ego and a neighbour stand in one place at some step."""
    point, count = window[3], window[4]
    for step in range(first, last + 1):
        slot = step % len(point)
        for k in range(1, count[slot]):
            x, y = point[slot, k, 0] - point[slot, 0, 0], point[slot, k, 1] - point[slot, 0, 1]
            if math.sqrt(x * x + y * y) < apart:
                return True
    return False


@compiled
def move(window: Any, first: int, last: int, memory: Any, cov: AnyArray) -> float:
    """One Gauss-Newton step: all points, the covariance of the ego's newest, and the largest move m."""
    arms, pivots, a, b = memory
    said, weight, edge, point, count, before, later = window
    length = len(point)
    h = last - first + 1
    ego(window, first, last, a, b)
    for step in range(first, last + 1):
        for k in range(1, count[step % length]):
            if step == first or before[step % length, k] < 0:
                fold(said, weight, edge, point, later, first, step, last, k, arms, pivots, a, b)
    dissolve(a, b, 3 * h, cov)
    most = 0.0
    for step in range(last, first - 1, -1):
        slot = step % length
        for k in range(1, count[slot]):
            most = max(most, unfold(said, point, later, first, step, k, arms, pivots, b))
    for s in range(h):
        for c in range(3):
            point[(first + s) % length, 0, c] += b[3 * s + c]
            most = max(most, abs(b[3 * s + c]))
    return most


@compiled
def ego(window: Any, first: int, last: int, a: AnyArray, b: AnyArray) -> None:
    """Information (3h, 3h), upper triangle, and pull of the ego's points: fixes, motion, and its end of each edge."""
    said, weight, edge, point, count, _, _ = window
    length, h = len(point), last - first + 1
    a[: 3 * h, : 3 * h] = 0.0
    b[: 3 * h] = 0.0
    for s in range(h):
        slot = (first + s) % length
        for c in range(3):
            row = 3 * s + c
            a[row, row] += weight[slot, 0, c]
            b[row] += weight[slot, 0, c] * (said[slot, FIX, 0, c] - point[slot, 0, c])
            if s > 0:
                last_slot = (first + s - 1) % length
                q = 1.0 / max(said[slot, PROCESS, 0, c], LEAST_PROCESS)
                force = q * (said[slot, MOVED, 0, c] - point[slot, 0, c] + point[last_slot, 0, c])
                a[row, row] += q
                a[row - 3, row - 3] += q
                a[row - 3, row] -= q
                b[row] += force
                b[row - 3] -= force
        for k in range(1, count[slot]):
            at = 0
            for i in range(3):
                b[3 * s + i] -= edge[slot, k, 6 + i]
                for j in range(i, 3):
                    a[3 * s + i, 3 * s + j] += edge[slot, k, at]
                    at += 1

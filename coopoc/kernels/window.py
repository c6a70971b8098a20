"""The most probable window of stars of each run and step: converted linear start, then exact Gauss-Newton steps.

A neighbour's points of consecutive steps are a chain that meets nobody but the ego (`coopoc.kernels.chains`). Slot t
modulo the length h of the window holds step t. The tuples `measured` and `assumed` are those of
`coopoc.kernels.star_messages`, `fresh` being where a message is held. In a plain tuple, `window`: said (h, 5, n, 3) of
`coopoc.kernels.roster`; weight (h, n, 3) 1/m^2 of the fixes; edge (h, n, 9), information and pull of a sighting; point
(h, n, 3) m; count (h,), how many there are; before and later (h, n), their places in the stars beside, or -1.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..arrays import AnyArray, Floats, Ints
from .blocks import width
from .compile import compiled
from .doubts import graduate
from .roster import FIX, WEIGHT, places, stay, tell, widest
from .snapshot import LOST, MET, SOLVED
from .window_steps import meeting, settle


@compiled
def windows(
    measured: Any, assumed: Any, fresh: AnyArray, length: int, tolerance: float, apart: float, doubt: Any = None
) -> tuple[Floats, Floats, Floats, Ints]:
    """x (R, T, 3) m, covariance (R, T, 3, 3) m^2, neighbours (R, M, 3) m, NaN if never heard, how each ended (R, T).

    Args:
        fresh: (R, M) where a message is new; one that is merely held counts where the window meets its vehicle.
        length: steps. tolerance: m, largest move in the last step. apart: m on the ground, closer vehicles have met.
        doubt: of the neighbours' fixes, as `coopoc.kernels.doubts.graduate` takes it; None believes everyone.
    """
    gnss, _, seen, neighbour, start, newest, _, _, _ = measured
    runs, steps, most, std, least = gnss.shape[0], gnss.shape[1], widest(start), assumed[2], assumed[3]
    x, cov, others = np.empty((runs, steps, 3)), np.empty((runs, steps, 3, 3)), np.empty((runs, seen.shape[1], 3))
    ended, kept = np.empty((runs, steps), np.int64), places(neighbour, start)
    met, about = last_met(neighbour, start, gnss.shape[2]), np.zeros((3, gnss.shape[2]))
    place, held = np.zeros(most, np.int64), np.zeros((2, 2, most, 1), np.int64)
    said, weight, edge = np.zeros((length, 5, most, 3)), np.zeros((length, most, 3)), np.zeros((length, most, 9))
    point, count, later = np.zeros((length, most, 3)), np.zeros(length, np.int64), np.full((length, most), -1, np.int64)
    before, given = np.full((length, most), -1, np.int64), np.zeros((length, most))
    window = (said, weight, edge, point, count, before, later)
    n, stride = 3 * length, width(3 * length)
    memory = (np.zeros(length * most * 3 * stride), np.zeros(length * most * 12), np.zeros(n * stride),
              np.zeros(n * stride), np.zeros(3 * n), np.zeros(n), np.zeros(3 * stride))  # fmt: skip
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
            ended[run, t] = solve(window, seen[run], start, first, t, std, least, tolerance, apart, memory, cov[run, t],
                                  neighbour, given, about, doubt)  # fmt: skip
            for k in range(n):
                for c in range(3):
                    if k == 0:
                        x[run, t, c] = point[slot, 0, c]
                    else:
                        there = newest[run, start[t] + k - 1] >= 0
                        others[run, start[t] + k - 1, c] = point[slot, k, c] if there else np.nan
    return x, cov, others, ended


@compiled
def solve(
    window: Any, seen: AnyArray, start: AnyArray, first: int, last: int, std: AnyArray, least: float,
    tolerance: float, apart: float, memory: Any, cov: AnyArray, neighbour: AnyArray, given: AnyArray, about: AnyArray,
    doubt: Any,
) -> int:  # fmt: skip
    """The window of some steps in place, the covariance of the ego's newest point, and how it ended."""
    exact, settled = len(std) > 0, True
    for stage in range(2 if exact and doubt is None else 1):
        settled = settle(window, seen, start, first, last, std, least, tolerance, memory, cov, stage > 0)
    if doubt is not None:
        settled = graduate(window, seen, start, first, last, std, least, tolerance, memory, cov, neighbour, given,
                           about, doubt)  # fmt: skip
    if not settled:
        return LOST
    if exact and meeting(window, first, last, apart):
        settle(window, seen, start, first, last, std, least, tolerance, memory, cov, not exact)
        return MET
    return SOLVED


@compiled
def last_met(neighbour: AnyArray, start: AnyArray, vehicles: int) -> Ints:
    """(M,) step at which the neighbour of each link was linked before, -1 for never."""
    found = np.empty(len(neighbour), np.int64)
    when = np.full(vehicles, -1, np.int64)
    for t in range(len(start) - 1):
        for link in range(start[t], start[t + 1]):
            found[link] = when[neighbour[link]]
            when[neighbour[link]] = t
    return found

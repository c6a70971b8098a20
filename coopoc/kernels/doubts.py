"""Which neighbours' fixes a window disbelieves: graduated non-convexity, each neighbour one weight.

The compiled twin of `coopoc.optimize.gnc` for windows of stars, whose arrays are those of `coopoc.kernels.window`: the
same schedule of mu, solves from where the last one ended, the same end.
"""

from __future__ import annotations

import math
from typing import Any

from ..arrays import AnyArray
from .compile import compiled
from .roster import FIX, WEIGHT
from .window_steps import settle

TRUST, RATIO, COUNT = range(3)
"""Rows of `about`: the weight of each vehicle, r^2 of its fixes, and how many they are."""
TINY = 1e-30


@compiled
def graduate(
    window: Any, seen: AnyArray, start: AnyArray, first: int, last: int, std: AnyArray, least: float,
    tolerance: float, memory: Any, cov: AnyArray, neighbour: AnyArray, given: AnyArray, about: AnyArray, doubt: Any,
) -> bool:  # fmt: skip
    """From the converted solution to that with the weights at which the surrogate losses end; False if they do not.

    Args:
        neighbour: (M,) vehicle of each link. given: (h, n) and about: (3, vehicles), scratch.
        doubt: c^2 (length + 1,) by the number of fixes; whether the loss is the truncated one; rate of mu, least mu
            that is inverted, largest change of a weight that is none, rounds.
    """
    bound, truncated, rate, easy, _, rounds = doubt
    whose, exact = (neighbour, start, first, last), len(std) > 0
    mu, ends = 0.0, 0 if open_minded(window, whose, given, about) else 2
    for _ in range(rounds + 2):
        if not settle(window, seen, start, first, last, std, least, tolerance, memory, cov, exact):
            return False
        if ends > 0:  # the reference solves once more for the weights, and then the window with them
            ends += 1
        else:
            worst = disagreement(window, whose, given, about, bound)
            if mu == 0.0:
                mu = 1.0 / max(2.0 * worst - 1.0, easy) if truncated else max(2.0 * worst, 1.0)
            else:
                mu = mu * rate if truncated else max(mu / rate, 1.0)
            ends = int(reweigh(window, whose, given, about, mu, doubt))
        if ends == 3:
            return True
    return False


@compiled
def open_minded(window: Any, whose: Any, given: AnyArray, about: AnyArray) -> bool:
    """Trust everyone, and note whose fixes are used, in `given` (h, n); False if there is nobody."""
    weight, count = window[1], window[4]
    neighbour, start, first, last = whose
    anyone = False
    for step in range(first, last + 1):
        slot = step % len(count)
        for k in range(1, count[slot]):
            about[TRUST, neighbour[start[step] + k - 1]] = 1.0
            given[slot, k] = 1.0 if weight[slot, k, 0] > 0.0 else 0.0
            anyone = True
    return anyone


@compiled
def disagreement(window: Any, whose: Any, given: AnyArray, about: AnyArray, bound: AnyArray) -> float:
    """r^2 of each neighbour's fixes, in `about`, and the largest r^2 / c^2."""
    said, point, count = window[0], window[3], window[4]
    neighbour, start, first, last = whose
    for step in range(first, last + 1):
        for link in range(start[step], start[step + 1]):
            about[RATIO, neighbour[link]], about[COUNT, neighbour[link]] = 0.0, 0.0
    for step in range(first, last + 1):
        slot = step % len(count)
        for k in range(1, count[slot]):
            who = neighbour[start[step] + k - 1]
            about[COUNT, who] += given[slot, k]
            for c in range(3):
                away = said[slot, FIX, k, c] - point[slot, k, c]
                about[RATIO, who] += given[slot, k] * said[slot, WEIGHT, k, c] * away * away
    worst = 0.0
    for step in range(first, last + 1):
        for link in range(start[step], start[step + 1]):
            who = neighbour[link]
            worst = max(worst, about[RATIO, who] / bound[int(about[COUNT, who])])
    return worst


@compiled
def reweigh(window: Any, whose: Any, given: AnyArray, about: AnyArray, mu: float, doubt: Any) -> bool:
    """Weights of the surrogate at mu, into the window; True if they have settled."""
    said, weight, count = window[0], window[1], window[4]
    neighbour, start, first, last = whose
    bound, truncated, _, _, settled, _ = doubt
    done = truncated or mu == 1.0
    for step in range(first, last + 1):
        slot = step % len(count)
        for k in range(1, count[slot]):
            who = neighbour[start[step] + k - 1]
            ratio, old = about[RATIO, who] / bound[int(about[COUNT, who])], about[TRUST, who]
            if truncated:
                new = min(max(math.sqrt(mu * (mu + 1.0) / max(ratio, TINY)) - mu, 0.0), 1.0)
                done = done and new == old and (new == 0.0 or new == 1.0)
            else:
                new = (mu / (ratio + mu)) ** 2
                done = done and abs(new - old) <= settled
            about[TRUST, who] = new
            for c in range(3):
                weight[slot, k, c] = new * given[slot, k] * said[slot, WEIGHT, k, c]
    return done

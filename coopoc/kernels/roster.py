"""Who is in the star at each step and what their messages say, several runs beside each other.

Who is linked is the same in all runs: only what was heard, and when, differs. A row of numbers holds one for each axis
and run of a block, `axis * runs + run`. The tuples `measured` and `assumed` are those of
`coopoc.kernels.star_messages`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy import uint64

from ..arrays import AnyArray, Ints
from .compile import compiled
from .star_messages import process_of, three_of

MOVED, PROCESS, FIX, WEIGHT, AHEAD = range(5)
"""Rows of what is said of a member: motion m, its variance m^2, fix m, its information 1/m^2 where it is new, and the
vector m from the ego to it as measured."""


@compiled
def places(neighbour: AnyArray, start: AnyArray) -> Ints:
    """(M,) place that the neighbour of each link has in the star before, the ego's being 0, or -1 if it has joined."""
    kept = np.full(len(neighbour), -1, np.int64)
    for t in range(1, len(start) - 1):
        for link in range(start[t], start[t + 1]):
            for before in range(start[t - 1], start[t]):
                if neighbour[before] == neighbour[link]:
                    kept[link] = 1 + before - start[t - 1]
    return kept


@compiled
def stay(t: int, start: AnyArray, kept: AnyArray, place: AnyArray) -> int:
    """How many are in the star of step t, and the place of each in the star before, (n,)."""
    n = 1 + start[t + 1] - start[t]
    place[0] = 0 if t > 0 else -1
    for k in range(1, n):
        place[k] = kept[start[t] + k - 1]
    return int(n)


@compiled
def widest(start: AnyArray) -> int:
    """Members of the largest star."""
    most = 0
    for t in range(len(start) - 1):
        most = max(most, start[t + 1] - start[t])
    return 1 + most


@compiled
def tell(
    measured: Any, assumed: Any, first: int, t: int, place: AnyArray, held: AnyArray, was: AnyArray, said: AnyArray
) -> None:  # fmt: skip
    """What the members of step t say in the runs from `first` on, as in `coopoc.methods.star.star_steps`.

    Args:
        place: (n,). held, was: (2, n or more, runs), the step of the message in use and its uses in a row, now and at
            the step before. said: (5, n or more, 3 runs), filled.
    """
    gnss, velocity, seen, neighbour, start, newest, fresh, ego, dt = measured
    variance, fixes, _, _, forgotten, acceleration, pace = assumed
    runs, wide = held.shape[2], uint64(held.shape[2])
    for k in range(len(place)):
        link = start[t] + k - 1
        member, was_at, at = ego if k == 0 else neighbour[link], place[k], uint64(k)
        for r in range(runs):
            run, lane = uint64(first + r), uint64(r)
            sent = t if k == 0 else newest[run, link]
            uses = was[1, was_at, r] + 1 if was_at >= 0 and was[0, was_at, r] == sent else 1
            held[0, k, r], held[1, k, r] = sent, uses
            when = sent if sent >= 0 else t
            age, new, often = t - when, k == 0 or fresh[run, link], 2 * uses - 1
            late = (dt * dt * age * acceleration) ** 2
            i, j = uint64(when), uint64(member)
            u, fix = three_of(velocity, run, i, j), three_of(gnss, run, i, j)
            one, noise = process_of(variance, pace, u, dt, run, i, j), three_of(fixes, run, i, j)
            for c in range(3):
                moved, spread = dt * u[c] if sent >= 0 else 0.0, one[c] + late
                said[MOVED, at, lane] = moved
                said[PROCESS, at, lane] = often * spread if sent >= 0 else forgotten
                said[FIX, at, lane] = fix[c] + age * moved
                said[WEIGHT, at, lane] = 1.0 / (noise[c] + age * age * spread) if new else 0.0
                lane += wide
            if k > 0:
                d, sine, cosine, up, level = seen[run, uint64(link)]
                lane = uint64(r)
                said[AHEAD, at, lane], said[AHEAD, at, lane + wide] = d * up * cosine, d * up * sine
                said[AHEAD, at, lane + wide + wide] = d * level


@compiled
def expect(before: AnyArray, place: AnyArray, said: AnyArray, state: AnyArray) -> None:
    """State (n, lanes) m of the new star from that of the last one: who joins stands where the ego sees it."""
    for k in range(len(place)):
        for lane in range(uint64(state.shape[1])):
            if place[k] >= 0:
                state[k, lane] = before[place[k], lane] + said[MOVED, k, lane]
            else:
                state[k, lane] = state[0, lane] + said[AHEAD, k, lane] if k > 0 else said[FIX, 0, lane]

"""The most probable star of each run and step: converted linear start, then exact Gauss-Newton steps.

LANES runs go abreast, each with the digits that it has alone: one that has settled stands still until the others have.
The tuples `measured` and `assumed` are those of `coopoc.kernels.star_messages`, `fresh` being where a message is held.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy import uint64

from ..arrays import AnyArray, Floats, Ints
from .abreast import put, take
from .blocks_abreast import put_three, three
from .compile import as_written
from .lanes import LANES
from .messages_abreast import tell as tell_abreast
from .snapshot_step import convert, ground, relinearise, step

SOLVED, MET, LOST = 0, 1, 2
"""Solved exactly; solved converted, since two vehicles met; not solved: Gauss-Newton did not settle."""
LIMIT = 12
"""Gauss-Newton steps; about 3 are needed."""
HALVES = 200
"""Half steps where whole ones go to and fro, before the damped reference has to do it. They gain a digit every three or
four, so that the last must be the shorter."""


@as_written
def snapshots(measured: Any, assumed: Any, tolerance: float, apart: float) -> tuple[Floats, Floats, Floats, Ints]:
    """x (R, T, 3) m, covariance (R, T, 3, 3) m^2, neighbours (R, M, 3) m, NaN if never heard, how each ended (R, T).

    The covariance is that of the last linearisation, at most `tolerance` away.

    Args:
        tolerance: m, largest move in the last step. apart: m on the ground, closer vehicles stand in one place.
    """
    gnss, _, seen, _, start = measured[:5]
    runs, steps, most = gnss.shape[0], gnss.shape[1], 1 + np.diff(start).max()
    x, cov, others = np.empty((runs, steps, 3)), np.empty((runs, steps, 3, 3)), np.empty((runs, seen.shape[1], 3))
    ended, each, held = np.empty((runs, steps), np.int64), most * LANES, np.zeros((5, most, LANES))
    motion, point, sight, edge = np.zeros(12 * each), np.zeros(3 * each), np.zeros(5 * each), np.zeros(9 * each)
    inverse, spread, settled, nearest = np.zeros(6 * each), np.zeros(6 * LANES), np.zeros(LANES), np.zeros(LANES)
    star = (motion, point, sight, edge, inverse, spread)
    for first in range(0, runs, LANES):
        last = min(first + LANES, runs) - 1
        for t in range(steps):
            n = 1 + start[t + 1] - start[t]
            hear(measured, assumed, first, last, t, n, held, star)
            here = (first, last, t, start[t])
            solve(star, n, assumed[2], assumed[3], tolerance, apart, settled, nearest, here, (x, cov, others, ended))
    return x, cov, others, ended


@as_written
def hear(measured: Any, assumed: Any, first: int, last: int, t: int, n: int, held: AnyArray, star: Any) -> None:
    """What the members say, and how the neighbours are seen."""
    seen, neighbour, start, newest, ego = measured[2], measured[3], measured[4], measured[5], measured[7]
    motion, _, sight = star[:3]
    for k in range(n):
        link = start[t] + k - 1
        for lane in range(LANES):
            run = min(first + lane, last)
            held[0, k, lane], held[1, k, lane] = t if k == 0 else newest[run, link], 1.0
            for c in range(5 if k > 0 else 0):
                sight[uint64(LANES * (5 * k + c) + lane)] = seen[run, link, c]
        tell_abreast(measured, assumed, (first, last), t, k, ego if k == 0 else neighbour[link], held, motion)


@as_written
def begin(star: Any, n: int) -> None:
    """Everyone stands where their fix is."""
    motion, point = star[:2]
    for k in range(n):
        put_three(point, k, three(motion, 4 * k + 2))


@as_written
def solve(
    star: Any, n: int, std: AnyArray, least: float, tolerance: float, apart: float, settled: AnyArray,
    nearest: AnyArray, here: Any, out: Any,
) -> None:  # fmt: skip
    """Points, the ego's covariance and how it ended, of each run that goes abreast, into `out`.

    Args:
        std: (3,) m, rad, rad, of no length for unit matrices. least: m, angles of a shorter range are widened.
        settled, nearest: (LANES,) scratch.
    """
    begin(star, n)
    convert(star, n, std, least)
    put(settled, uint64(0), step(star, n, 1.0))
    lanes, todo = here[1] - here[0] + 1, 0
    for lane in range(lanes):
        settled[lane] = 1.0 if len(std) == 0 else 0.0
        todo += settled[lane] == 0.0
        if settled[lane] == 1.0:
            tell(star, n, lane, here, SOLVED, out)
    for lane in range(lanes, LANES):
        settled[lane] = 1.0
    for count in range(LIMIT + HALVES):
        if todo == 0:
            break
        relinearise(star, n, std, least)
        share, enough = (1.0, tolerance) if count < LIMIT else (0.5, 1e-3 * tolerance)
        put(nearest, uint64(0), step(star, n, share * (1.0 - take(settled, uint64(0)))))
        for lane in range(lanes):
            if settled[lane] == 0.0 and nearest[lane] <= enough:
                settled[lane], todo = 1.0, todo - 1
                tell(star, n, lane, here, SOLVED, out)
    for lane in range(lanes):
        if settled[lane] == 0.0:
            tell(star, n, lane, here, LOST, out)
    if len(std):
        put(nearest, uint64(0), ground(star, n))
        mend_met(star, n, std, least, apart, settled, nearest, here, out)


@as_written
def mend_met(
    star: Any, n: int, std: AnyArray, least: float, apart: float, settled: AnyArray, nearest: AnyArray, here: Any,
    out: Any,
) -> None:  # fmt: skip
    """Where a neighbour is `apart` or less from the ego, the converted problem answers."""
    met = 0
    for lane in range(here[1] - here[0] + 1):
        met += settled[lane] == 1.0 and nearest[lane] < apart
    if met == 0:
        return
    begin(star, n)
    convert(star, n, std, least)
    step(star, n, 1.0)
    for lane in range(here[1] - here[0] + 1):
        if settled[lane] == 1.0 and nearest[lane] < apart:
            tell(star, n, lane, here, MET, out)


@as_written
def tell(star: Any, n: int, lane: int, here: Any, how: int, out: Any) -> None:
    """What one of the runs has found."""
    motion, point, _, _, _, spread = star
    x, cov, others, ended = out
    run, t, link = here[0] + lane, here[2], here[3]
    ended[run, t], at = how, 0
    for i in range(3):
        x[run, t, i] = point[i * LANES + lane]
        for j in range(i, 3):
            cov[run, t, i, j] = cov[run, t, j, i] = spread[at * LANES + lane]
            at += 1
    for k in range(1, n):
        for i in range(3):
            heard = motion[uint64((12 * k + 9) * LANES + lane)] > 0.0
            others[run, link + k - 1, i] = point[uint64((3 * k + i) * LANES + lane)] if heard else np.nan

"""What the messages of one ego's star say, as `coopoc.kernels.star_messages` does, to LANES runs abreast."""

from __future__ import annotations

from typing import Any

from numpy import uint64

from ..arrays import AnyArray
from .abreast import choose, pack, put, take
from .compile import inside
from .lanes import LANES
from .star_messages import paced, three_of


@inside
def tell(
    measured: Any, assumed: Any, runs: Any, t: int, k: int, member: int, held: AnyArray, motion: AnyArray
) -> None:  # fmt: skip
    """Put what member k says in the runs from first to last into `motion`: four vectors of each component, moved m, its
    variance m^2, fix m and the weight of that 1/m^2.

    Args:
        runs: first and last. held: (5, n or more, LANES) numbers, filled here from the first two: step of the message
            held, -1 for none; uses of it in a row; steps since; 1 where there is one; 1 where its fix is new.
    """
    gnss, velocity, _, _, start, _, fresh, _, dt = measured
    link = start[t] + k - 1
    zero, one, two, width = uint64(0), uint64(1), uint64(2), uint64(LANES)
    at = uint64(12 * LANES * k)
    for lane in range(LANES):
        run = min(runs[0] + lane, runs[1])
        sent = int(held[0, k, lane])
        there = sent >= 0
        when = sent if there else t
        held[2, k, lane], held[3, k, lane] = t - when, 1.0 if there else 0.0
        held[4, k, lane] = 1.0 if k == 0 or fresh[run, link] else 0.0
        i, j, m, to = uint64(run), uint64(when), uint64(member), at + uint64(lane)
        p, q, r = three_of(assumed[0], i, j, m)
        a, b, c = three_of(assumed[1], i, j, m)
        motion[to], motion[to + width] = velocity[i, j, m, zero], velocity[i, j, m, one]
        motion[to + two * width] = velocity[i, j, m, two]
        to += uint64(3) * width
        motion[to], motion[to + width], motion[to + two * width] = p, q, r
        to += uint64(3) * width
        motion[to], motion[to + width] = gnss[i, j, m, zero], gnss[i, j, m, one]
        motion[to + two * width] = gnss[i, j, m, two]
        to += uint64(3) * width
        motion[to], motion[to + width], motion[to + two * width] = a, b, c
    pace, first = assumed[6], uint64(12 * k)
    uses, age, held_, new = numbers(held, 1, k), numbers(held, 2, k), numbers(held, 3, k), numbers(held, 4, k)
    late, often = dt * dt * age * assumed[5], 2.0 * uses - 1.0
    late = late * late
    if len(pace):
        u, v, w = take(motion, first), take(motion, first + one), take(motion, first + two)
        p, q, r = paced(pace, u, v, w, dt)
        put(motion, first + uint64(3), p)
        put(motion, first + uint64(4), q)
        put(motion, first + uint64(5), r)
    for c in range(3):
        to = first + uint64(c)
        moved, spread = choose(held_, dt * take(motion, to), 0.0 * age), take(motion, to + uint64(3)) + late
        put(motion, to, moved)
        put(motion, to + uint64(3), choose(held_, often * spread, 0.0 * often + assumed[4]))
        put(motion, to + uint64(6), take(motion, to + uint64(6)) + age * moved)
        put(motion, to + uint64(9), new / (take(motion, to + uint64(9)) + age * age * spread))


@inside
def numbers(held: AnyArray, what: int, k: int) -> Any:
    """The vector of one row of `held`."""
    return pack(held[what, k, 0], held[what, k, 1], held[what, k, 2], held[what, k, 3])

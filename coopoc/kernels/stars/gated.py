"""Gates of a star: which numbers of a step weigh less, before they become information.

A filter in information form knows no innovation's covariance. So each member carries a bound of the covariance of its
vector from the ego, which the member's own relative measurements and both motions give, and the ego its covariance:
a gate is never tighter than that of the exact innovation.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, cast

import numpy as np

from ...arrays import Floats
from ..compiling.compile import inner, inside, storage
from ..compiling.small import add, add_diagonal, choose_each, load, scale, store, subtract, zeros
from ..compiling.vectors import LANES, choose
from ..gate import FIX_GATE, PATIENCE, count, distance, gain_of, gated_update, inflation
from .messages import BLOCK, POSITION, PROCESS, RELATIVE, ROW, VARIANCE, Star
from .relative import Numbers, angle, incomplete, vector

HITS = (0.0,) * 4


class Gates(NamedTuple):
    """What the gates of a star remember; arrays are (., LANES).

    Attributes:
        cov: (9 most,) m^2, bound of the covariance of each member's vector from the ego; of the ego, its covariance.
        hits: (4 most,) of `coopoc.kernels.gate`, of range, azimuth, inclination and position.
        last_cov: of the last star.
        last_hits: of the last star.
    """

    cov: Floats
    hits: Floats
    last_cov: Floats
    last_hits: Floats


@storage
def gates_within(most: int) -> Gates:
    """Room for `most` members."""
    a, b = 9 * most, 4 * most
    return Gates(np.zeros((a, LANES)), np.zeros((b, LANES)), np.zeros((a, LANES)), np.zeros((b, LANES)))


def new_gates(most: int) -> Gates:
    """The same, made by Python."""
    plain: Any = gates_within
    return cast(Gates, plain.py_func(most))


@inner
def carry(star: Star, gates: Gates, flat: float, n: int, old: int) -> None:
    """Bring the bounds forward to this star. A member one of whose components has PATIENCE hits may be elsewhere: it is
    forgotten, with `flat` m^2 as variance of its motion."""
    for k in range(old):
        store(gates.last_cov, k, load(gates.cov, k, BLOCK))
        store(gates.last_hits, k, load(gates.hits, k, HITS))
    own = load(star.motion, PROCESS, ROW)
    o = 0.0 * own[0]
    forgotten, nothing = (o + flat, o + flat, o + flat), zeros(o, ROW)
    for k in range(n):
        place, process = star.previous[k], load(star.motion, 4 * k + PROCESS, ROW)
        cov, hits = add_diagonal(zeros(o, BLOCK), forgotten), zeros(o, HITS)
        if place >= 0:
            hits = load(gates.last_hits, place, HITS)
            if k > 0:
                lost = max(max(hits[0], hits[1]), hits[2]) - PATIENCE
                process = choose_each(lost, forgotten, process)
                hits = choose_each(lost, zeros(o, HITS), hits)
                store(star.motion, 4 * k + PROCESS, process)
            cov = add_diagonal(load(gates.last_cov, place, BLOCK), add(process, own if k > 0 else nothing))
        store(gates.cov, k, cov)
        store(gates.hits, k, hits)


@inner
def gate_star(star: Star, gates: Gates, state: Floats, known: Floats, flat: float, least: float, n: int) -> None:
    """Inflate the deviations of relative measurements and the variances of positions that are beyond their gates.

    Args:
        star: of this step.
        gates: brought forward.
        state: (3 n, LANES) m, predicted positions; a member that is forgotten stands where it is measured.
        known: (n, LANES) 1 where something is known of where a member is, else 0.
        flat: m^2, variance of one of which nothing is known.
        least: m.
    """
    origin, own, hits = load(state, 0, ROW), load(gates.cov, 0, BLOCK), load(gates.hits, 0, HITS)
    store(gates.hits, 0, (hits[0], hits[1], hits[2], gate_position(star, 0, origin, own, hits[3])))
    for k in range(1, n):
        at, seen = load(state, k, ROW), load(star.relative, k, RELATIVE)
        lost = choose(1e300 - (seen[5] + seen[6] + seen[7]), load(gates.cov, k, BLOCK)[0] - 0.5 * flat, 0.0 * at[0])
        at = choose_each(lost, add(origin, vector(seen)), at)
        store(state, k, at)
        moved = gate_relative(star, gates, k, subtract(at, origin), load(known, k, (0.0,))[0], least)
        gate_position(star, k, add(at, moved), add(own, load(gates.cov, k, BLOCK)), 0.0 * at[0])


@inside
def gate_position(star: Star, k: int, at: Numbers, cov: Numbers, hits: float) -> float:
    """Inflate the variance of a member's position; the hits that follow. Callers drop those of neighbours: where many
    are beyond the gate, it is their messages that are wrong."""
    variance = load(star.motion, 4 * k + VARIANCE, ROW)
    q = distance(subtract(load(star.motion, 4 * k + POSITION, ROW), at), add_diagonal(cov, variance))
    store(star.motion, 4 * k + VARIANCE, scale(variance, inflation(q, FIX_GATE, hits)))
    return count(q, FIX_GATE, hits, gain_of(cov, variance))


@inside
def gate_relative(star: Star, gates: Gates, k: int, gap: Numbers, known: float, least: float) -> Numbers:
    """How far the relative measurement of member k moves its vector from the ego, m; its bound shrinks."""
    seen, cov, hits = load(star.relative, k, RELATIVE), load(gates.cov, k, BLOCK), load(gates.hits, k, HITS)
    o = 0.0 * known
    std = seen[5], seen[6], seen[7]
    if incomplete(seen):
        std = choose_each(known - 0.5, std, (o + math.inf, o + math.inf, o + math.inf))
    cov, moved, factor, hits = gate_components(gap, cov, seen, std, hits, least)
    store(gates.cov, k, cov)
    store(gates.hits, k, hits)
    store(star.relative, k, inflated(seen, factor))
    return moved


@inside
def inflated(seen: Numbers, factor: Numbers) -> Numbers:
    """A measurement, its standard deviations times three factors."""
    a, b, c = factor
    return seen[0], seen[1], seen[2], seen[3], seen[4], a * seen[5], b * seen[6], c * seen[7]


@inner
def gate_components(
    gap: Numbers, cov: Numbers, seen: Numbers, std: Numbers, hits: Numbers, least: float
) -> tuple[Numbers, Numbers, Numbers, Numbers]:
    """Update a vector by range, azimuth and inclination, one after the other, gated.

    Args:
        gap: m, the predicted vector.
        cov: (9,) m^2, of it.
        seen: `relative.five`.
        std: m, rad, rad; infinite for what was not measured.
        hits: (4,) the first three of these components.
        least: m, least distance at which an angle's error counts.

    Returns:
        Covariance, move m, factors of the standard deviations, and hits.
    """
    x, y, z = gap
    o = 0.0 * x
    ground, far = math.sqrt(x * x + y * y), math.sqrt(x * x + y * y + z * z)
    reach = max(far, least)
    flat = max(ground, 1e-3 * reach)
    turned = angle(seen[1] * x - seen[2] * y, seen[2] * x + seen[1] * y)
    raised = angle(seen[3] * z - seen[4] * ground, seen[4] * z + seen[3] * ground)
    a, b, c = std[0], std[1] * flat, std[2] * reach
    ray, side = (x / far, y / far, z / far), (-y / flat, x / flat, o)
    up = scale((x * z, y * z, -ground * ground), 1.0 / (flat * reach))
    cov, moved, f, first = gated_update(cov, zeros(o, ROW), ray, seen[0] - far, a * a, hits[0])
    cov, moved, g, second = gated_update(cov, moved, side, turned * flat, b * b, hits[1])
    cov, moved, h, third = gated_update(cov, moved, up, raised * reach, c * c, hits[2])
    return cov, moved, (math.sqrt(f), math.sqrt(g), math.sqrt(h)), (first, second, third, hits[3])

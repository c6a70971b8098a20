"""Graduated non-convexity over a window of stars: the fixes of each neighbour share one weight.

The schedule of mu is that of `coopoc.optimize.robust.gnc`: weighted least squares and the weights of the surrogate loss
alternate until the weights no longer change (Yang, Antonante, Tzoumas, Carlone, RA-L 2020, equations 12 and 14).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy import uint64

from ...arrays import Bools, Floats
from ..compiling.compile import inner
from ..compiling.small import load, scale, store, times
from ..compiling.vectors import LANES, choose, put, take
from ..compiling.vectors import lane as lane_of
from .slots import ROW, Window, count_of, fix_gap, motion, place_of

TINY = 1e-30


class GNC(NamedTuple):
    """The robust loss.

    Attributes:
        bound: (length + 1,) c^2 by the number of fixes of a group.
        truncated: whether the loss is truncated least squares, or Geman and McClure's.
        ego: whether the ego's fixes and its odometry are groups, too.
        rate: of mu.
        least: mu that is inverted.
        settled: largest change of a weight that counts as none.
        rounds: 0 for no robust loss.
    """

    bound: Floats
    truncated: bool
    ego: bool
    rate: float
    least: float
    settled: float
    rounds: int


class Weights(NamedTuple):
    """The state of the schedule; a group is a vehicle or, the last, the ego's odometry.

    Attributes:
        weight: (N + 1, LANES) of GNC.
        square: (N + 1, LANES) r^2.
        fixes: (N + 1, LANES) number of fixes.
        member: (N + 1,) whether the group is in the window.
        mu: (LANES,).
        going: (LANES,) whether the weights still change.
        blind: (LANES,) whether they had rejected every fix, so that all count.
    """

    weight: Floats
    square: Floats
    fixes: Floats
    member: Bools
    mu: Floats
    going: Bools
    blind: Bools


def new_weights(vehicles: int) -> Weights:
    """Room for the weights of all vehicles."""
    n = vehicles + 1
    return Weights(
        np.ones((n, LANES)),
        np.zeros((n, LANES)),
        np.zeros((n, LANES)),
        np.zeros(n, np.bool_),
        np.zeros(LANES),
        np.zeros(LANES, np.bool_),
        np.zeros(LANES, np.bool_),
    )


@inner
def trust_all(window: Window, span: Any, weights: Weights, ego: bool) -> bool:
    """Note which groups are in the window, all of weight one; False if there is none."""
    odometry = len(weights.weight) - 1
    weights.member[:], weights.weight[:] = False, 1.0
    weights.member[odometry] = ego and span[0] < span[1]
    for step in range(span[0], span[1] + 1):
        here = place_of(window.layout, step, 0)
        for place in range(here if ego else here + 1, here + count_of(window.sizes, step)):
            weights.member[window.member[place]] = True
    found = False
    for member in weights.member:
        found = found or member
    return found


@inner
def weigh(window: Window, span: Any, weights: Weights) -> None:
    """Put the weights of the groups into the window."""
    put(window.odometry, uint64(0), take(weights.weight, uint64(len(weights.weight) - 1)))
    for step in range(span[0], span[1] + 1):
        for place in range(
            place_of(window.layout, step, 0), place_of(window.layout, step, count_of(window.sizes, step))
        ):
            weight = take(weights.weight, uint64(window.member[place]))
            store(window.used, place, scale(load(window.fix, place, ROW), weight))


@inner
def residuals(window: Window, span: Any, weights: Weights, ego: bool) -> None:
    """r^2 and number of fixes of each group at the points."""
    odometry = len(weights.weight) - 1
    weights.square[:], weights.fixes[:] = 0.0, 0.0
    for step in range(span[0], span[1] + 1):
        here = place_of(window.layout, step, 0)
        if ego and step > span[0]:
            information, off = motion(window, place_of(window.layout, step - 1, 0), here)
            gap = off[0] / information[0], off[1] / information[1], off[2] / information[2]
            add_square(weights, odometry, information, gap)
        for place in range(here if ego else here + 1, here + count_of(window.sizes, step)):
            add_square(weights, window.member[place], load(window.fix, place, ROW), fix_gap(window, place))


@inner
def add_square(weights: Weights, group: int, information: Any, gap: Any) -> None:
    """Add one fix to a group, where it has any information."""
    row, (p, q, r) = uint64(group), times(information, times(gap, gap))
    one = 0.0 * p + 1.0
    put(weights.square, row, take(weights.square, row) + (p + q + r))
    put(weights.fixes, row, take(weights.fixes, row) + choose(information[0], one, one - one))


@inner
def reweigh(weights: Weights, gnc: GNC, lane: int) -> bool:
    """The next mu of a run, and its weights of the surrogate loss; True once they no longer change."""
    worst = 0.0
    for group in range(len(weights.weight)):
        if weights.member[group]:
            worst = max(worst, ratio_of(weights, gnc, group, lane))
    mu = weights.mu[lane]
    if mu == 0.0:
        mu = 1.0 / max(2.0 * worst - 1.0, gnc.least) if gnc.truncated else max(2.0 * worst, 1.0)
    else:
        mu = mu * gnc.rate if gnc.truncated else max(mu / gnc.rate, 1.0)
    weights.mu[lane], done = mu, gnc.truncated or mu == 1.0
    for group in range(len(weights.weight)):
        if not weights.member[group]:
            continue
        s, old = ratio_of(weights, gnc, group, lane), weights.weight[group, lane]
        if gnc.truncated:
            new = min(max(math.sqrt(mu * (mu + 1.0) / max(s, TINY)) - mu, 0.0), 1.0)
            done = done and new == old and (new == 0.0 or new == 1.0)
        else:
            new = (mu / (s + mu)) ** 2
            done = done and abs(new - old) <= gnc.settled
        weights.weight[group, lane] = new
    return done


@inner
def ratio_of(weights: Weights, gnc: GNC, group: int, lane: int) -> float:
    """r^2 / c^2."""
    return float(weights.square[group, lane] / gnc.bound[int(weights.fixes[group, lane])])


@inner
def restore(window: Window, span: Any, weights: Weights, active: Floats) -> None:
    """Where no fix has any weight the window's position is unobservable: there all groups get weight one for good."""
    total = 0.0 * take(window.odometry, uint64(0))
    for step in range(span[0], span[1] + 1):
        for place in range(
            place_of(window.layout, step, 0), place_of(window.layout, step, count_of(window.sizes, step))
        ):
            total = total + load(window.used, place, ROW)[0]
    for lane in range(LANES):
        if active[lane] > 0.0 and lane_of(total, lane) == 0.0:
            weights.weight[:, lane], weights.going[lane], weights.blind[lane] = 1.0, False, True
    weigh(window, span, weights)

"""Graduated non-convexity over a window of stars: the fixes of each neighbour share one weight.

The schedule of mu is that of `coopoc.optimize.robust.gnc`: weighted least squares and the weights of the surrogate of
truncated least squares alternate until the weights no longer change (Yang, Antonante, Tzoumas, Carlone, RA-L 2020,
equation 14).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy import uint64

from ...arrays import Bools, Floats
from ..compiling.compile import inner
from ..compiling.small import load, scale, store, times
from ..compiling.vectors import LANES, choose, put, take
from .window_layout import ROW, Window, count_of, fix_gap, row_of

TINY = 1e-30


class GNC(NamedTuple):
    """The robust loss.

    Attributes:
        bound: (length + 1,) c^2 by the number of fixes of a group.
        rate: of mu.
        least: mu that is inverted.
        rounds: 0 for no robust loss.
    """

    bound: Floats
    rate: float
    least: float
    rounds: int


class Weights(NamedTuple):
    """The state of the schedule; a group is a vehicle.

    Attributes:
        weight: (N, LANES) of GNC.
        square: (N, LANES) r^2.
        fixes: (N, LANES) number of fixes.
        member: (N,) whether the vehicle is in the window.
        mu: (LANES,).
        going: (LANES,) whether the weights still change.
    """

    weight: Floats
    square: Floats
    fixes: Floats
    member: Bools
    mu: Floats
    going: Bools


def new_weights(n: int) -> Weights:
    """Room for the weights of n vehicles."""
    weight, square, fixes = (np.ones((n, LANES)) for _ in range(3))
    return Weights(weight, square, fixes, np.zeros(n, np.bool_), np.zeros(LANES), np.zeros(LANES, np.bool_))


@inner
def trust_all(window: Window, span: tuple[int, int], weights: Weights) -> bool:
    """Note which neighbours are in the window, all of weight one; False if there is none."""
    weights.member[:], weights.weight[:] = False, 1.0
    some = False
    for step in range(span[0], span[1] + 1):
        ego = row_of(window.layout, step, 0)
        for row in range(ego + 1, ego + count_of(window.sizes, step)):
            weights.member[window.member[row]], some = True, True
    return some


@inner
def weigh(window: Window, span: tuple[int, int], weights: Weights) -> None:
    """Put the weights of the neighbours into the window."""
    for step in range(span[0], span[1] + 1):
        ego = row_of(window.layout, step, 0)
        for row in range(ego + 1, ego + count_of(window.sizes, step)):
            weight = take(weights.weight, uint64(window.member[row]))
            store(window.used, row, scale(load(window.fix, row, ROW), weight))


@inner
def residuals(window: Window, span: tuple[int, int], weights: Weights) -> None:
    """r^2 and number of fixes of each neighbour at the points."""
    weights.square[:], weights.fixes[:] = 0.0, 0.0
    for step in range(span[0], span[1] + 1):
        ego = row_of(window.layout, step, 0)
        for row in range(ego + 1, ego + count_of(window.sizes, step)):
            group, information, gap = uint64(window.member[row]), load(window.fix, row, ROW), fix_gap(window, row)
            p, q, r = times(information, times(gap, gap))
            one = 0.0 * p + 1.0
            put(weights.square, group, take(weights.square, group) + (p + q + r))
            put(weights.fixes, group, take(weights.fixes, group) + choose(information[0], one, one - one))


@inner
def reweigh(weights: Weights, gnc: GNC, lane: int) -> bool:
    """The next mu of a run, and its weights of the surrogate loss; True once they no longer change."""
    worst = 0.0
    for group in range(len(weights.weight)):
        if weights.member[group]:
            worst = max(worst, ratio_of(weights, gnc, group, lane))
    mu = weights.mu[lane]
    mu = 1.0 / max(2.0 * worst - 1.0, gnc.least) if mu == 0.0 else mu * gnc.rate
    weights.mu[lane], done = mu, True
    for group in range(len(weights.weight)):
        if weights.member[group]:
            s, old = ratio_of(weights, gnc, group, lane), weights.weight[group, lane]
            new = min(max(math.sqrt(mu * (mu + 1.0) / max(s, TINY)) - mu, 0.0), 1.0)
            done = done and new == old and (new == 0.0 or new == 1.0)
            weights.weight[group, lane] = new
    return done


@inner
def ratio_of(weights: Weights, gnc: GNC, group: int, lane: int) -> float:
    """r^2 / c^2."""
    return float(weights.square[group, lane] / gnc.bound[int(weights.fixes[group, lane])])

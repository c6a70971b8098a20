"""Adapt-then-combine least mean squares of a whole fleet over a drive, one run after the other.

Each vehicle keeps estimates of itself and of those in contact: entries begin[i]:begin[i + 1] of the lists `member` and
`w`, itself first.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...arrays import AnyArray, Floats
from ..compiling.compile import compiled, part
from ..compiling.small import add, load, scale, store, subtract
from .fleet_graph import VECTOR, Assumed, Measured, Pairs, at, filled, most_pairs

LARGEST_STEP = 0.1
"""Of the adaptation, as published."""


class Estimates(NamedTuple):
    """What the vehicles keep at one step.

    Attributes:
        begin: (N+1,) first entry of each vehicle.
        member: (M,) the vehicle that an entry estimates.
        w: (M, 3) m.
        measures: (M,) 1 where the keeper measures that member, else 0.
        degree: (N,) how many it measures.
        delta: (N, 3) m, minus the sum of its measured vectors.
        anchor: (N, 3) weight of the own fix over that of delta.
    """

    begin: AnyArray
    member: AnyArray
    w: AnyArray
    measures: AnyArray
    degree: AnyArray
    delta: AnyArray
    anchor: AnyArray


@compiled
def room(vehicles: int, most: int) -> Estimates:
    """For so many vehicles, and pairs of a step."""
    entries = vehicles + 2 * most
    return Estimates(
        np.zeros(vehicles + 1, np.int64),
        np.zeros(entries, np.int64),
        np.zeros((entries, 3)),
        np.zeros(entries),
        np.zeros(vehicles),
        np.zeros((vehicles, 3)),
        np.zeros((vehicles, 3)),
    )


@compiled
def follow(measured: Measured, pairs: Pairs, assumed: Assumed, rounds: int, anchored: bool) -> Floats:
    """Positions (R, T, N, 3) m, NaN where inactive.

    Args:
        measured: what the fleet measured.
        pairs: those that exchange messages.
        assumed: the noise model.
        rounds: of adaptation and combination a step.
        anchored: whether the own fix is used at every step.
    """
    runs, steps, vehicles = measured.active.shape
    x, most = np.full((runs, steps, vehicles, 3), np.nan), most_pairs(pairs)
    old, now, place = room(vehicles, most), room(vehicles, most), np.full(vehicles, -1)
    fill, next_w = np.zeros(vehicles, np.int64), np.zeros((vehicles + 2 * most, 3))
    for run in range(runs):
        old.begin[:] = 0
        for t in range(steps):
            meet(run, t, pairs, now, fill)
            start(run, t, measured, old, now, place, anchored)
            measure(run, t, measured, pairs, assumed, now, anchored)
            for _ in range(rounds):
                adapt(measured.gnss[run, t], now)
                combine(now, next_w, place)
            for n in range(vehicles):
                if measured.active[run, t, n]:
                    store(x[run, t, n], 0, load(now.w[now.begin[n]], 0, VECTOR))
            old, now = now, old
    return x


@part
def meet(run: int, t: int, pairs: Pairs, now: Estimates, fill: AnyArray) -> None:
    """Members of each vehicle's list."""
    fill[:] = 1
    for k in range(pairs.start[t], pairs.start[t + 1]):
        if pairs.alive[run, k]:
            fill[pairs.first[k]] += 1
            fill[pairs.second[k]] += 1
    for n in range(len(fill)):
        now.begin[n + 1] = now.begin[n] + fill[n]
        now.member[now.begin[n]], fill[n] = n, now.begin[n] + 1
    for k in range(pairs.start[t], pairs.start[t + 1]):
        if pairs.alive[run, k]:
            i, j = pairs.first[k], pairs.second[k]
            now.member[fill[i]], now.member[fill[j]] = j, i
            now.measures[fill[i]] = 1.0 if pairs.link[k] >= 0 else 0.0
            now.measures[fill[j]] = 1.0 if pairs.link_back[k] >= 0 else 0.0
            fill[i] += 1
            fill[j] += 1


@part
def start(
    run: int, t: int, measured: Measured, old: Estimates, now: Estimates, place: AnyArray, anchored: bool
) -> None:
    """Estimates of members that stay move with their velocities; a new one starts at its fix, or with an anchor at its
    own estimate."""
    for own in (True, False):
        for n in range(len(place)):
            for entry in range(old.begin[n], old.begin[n + 1]):
                place[old.member[entry]] = entry
            for entry in range(now.begin[n], now.begin[n] + 1) if own else range(now.begin[n] + 1, now.begin[n + 1]):
                k = now.member[entry]
                before, fix = place[k], measured.gnss[run, t, k]
                if before >= 0 and t > 0 and measured.active[run, t - 1, k]:
                    move = scale(load(measured.velocity[run, t, k], 0, VECTOR), measured.dt)
                    store(now.w[entry], 0, add(load(old.w[before], 0, VECTOR), move))
                elif own or not (anchored or math.isnan(fix[0] + fix[1] + fix[2])):
                    store(now.w[entry], 0, load(fix, 0, VECTOR))
                else:
                    store(now.w[entry], 0, load(now.w[now.begin[k]], 0, VECTOR))
            for entry in range(old.begin[n], old.begin[n + 1]):
                place[old.member[entry]] = -1


@part
def measure(
    run: int, t: int, measured: Measured, pairs: Pairs, assumed: Assumed, now: Estimates, anchored: bool
) -> None:
    """Each vehicle's row of the Laplacian, its delta, and the weight of its fix."""
    vehicles, unit = len(now.degree), len(assumed.std) == 0
    now.degree[:], now.delta[:], now.anchor[:] = 0.0, 0.0, 0.0
    for k in range(pairs.start[t], pairs.start[t + 1]):
        if pairs.alive[run, k]:
            i, j = pairs.first[k], pairs.second[k]
            vector = subtract(load(now.w[now.begin[j]], 0, VECTOR), load(now.w[now.begin[i]], 0, VECTOR))
            for n, link, sign in ((i, pairs.link[k], 1.0), (j, pairs.link_back[k], -1.0)):
                if link >= 0:
                    seen = measured.relative[run, link]
                    d, sine, cosine, up, level = filled(
                        (seen[0], seen[1], seen[2], seen[3], seen[4]), scale(vector, sign), (1.0, 1.0, 1.0)
                    )[0]
                    now.degree[n] += 1.0
                    for c, value in enumerate((d * up * cosine, d * up * sine, d * level)):
                        now.delta[n, c] -= value
                    if not unit:
                        d, std = max(d, assumed.min_range), assumed.std
                        now.anchor[n, 0] += (std[0] ** 2 + d * d * ((std[1] * up) ** 2 + std[2] ** 2)) / 3.0
    for n in range(vehicles):
        variance, fix, r = now.anchor[n, 0], measured.gnss[run, t, n], at(assumed.fix, run, t, n)
        variance = max(variance, 1.0)
        for c in range(3):
            now.anchor[n, c] = 0.0 if math.isnan(fix[c]) or not anchored else variance / r[c]


@part
def adapt(fix: AnyArray, now: Estimates) -> None:
    """w_i + mu L_i^T (delta_i - L_i w_i), and towards the own fix; mu = min(2 / |row|^2, 0.1)."""
    for n in range(len(now.degree)):
        first, degree = now.begin[n], now.degree[n]
        for c in range(3):
            weight, gap = now.anchor[n, c], now.delta[n, c] - degree * now.w[first, c]
            step = min(2.0 / max(degree * degree + degree + weight, 2.0), LARGEST_STEP)
            for entry in range(first + 1, now.begin[n + 1]):
                gap += now.measures[entry] * now.w[entry, c]
            toward = step * weight * (fix[n, c] - now.w[first, c]) if weight > 0.0 else 0.0
            now.w[first, c] += step * gap * degree + toward
            for entry in range(first + 1, now.begin[n + 1]):
                now.w[entry, c] -= step * gap * now.measures[entry]


@part
def combine(now: Estimates, new: AnyArray, place: AnyArray) -> None:
    """sum_j c_ij psi_j of those in contact that keep an estimate of the member, and the rest of the weight psi_i.

    Metropolis weights c_ij = 1 / max(deg_i + 1, deg_j + 1).
    """
    for n in range(len(now.degree)):
        first, last = now.begin[n], now.begin[n + 1]
        for entry in range(first, last):
            place[now.member[entry]] = entry
            store(new[entry], 0, load(now.w[entry], 0, VECTOR))
        for other in range(first + 1, last):
            j = now.member[other]
            share = 1.0 / max(last - first, now.begin[j + 1] - now.begin[j])
            for theirs in range(now.begin[j], now.begin[j + 1]):
                to = place[now.member[theirs]]
                if to >= 0:
                    for c in range(3):
                        new[to, c] += share * (now.w[theirs, c] - now.w[to, c])
        for entry in range(first, last):
            place[now.member[entry]] = -1
    for n in range(now.begin[-1]):
        store(now.w[n], 0, load(new[n], 0, VECTOR))

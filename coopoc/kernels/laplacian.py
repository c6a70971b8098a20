"""The Laplacian filter of one ego's star over a whole drive, several runs and all axes beside each other.

The filter of `coopoc.methods.lkf_sa` in information form: of a matrix (n, n, lanes) only the lower triangle counts, and
the ego is eliminated last, which leaves its variance. Where all runs know the same and differ in what they measured
only, the covariances are found once. The tuples `measured` and `assumed` are those of `coopoc.kernels.star_messages`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy import uint64

from ..arrays import AnyArray, Floats
from .compile import compiled
from .roster import AHEAD, FIX, PROCESS, WEIGHT, expect, places, stay, tell, widest

LEAST_PROCESS = 1e-90
"""m^2; its inverse is still a number, and far beyond any digit that counts."""
BLOCK = 16
"""Runs beside each other."""


@compiled
def follow(measured: Any, assumed: Any, alike: bool) -> tuple[Floats, Floats, Floats]:
    """x (R, T, 3) m, its variance (R, T, 3) m^2, neighbours (R, M, 3) m.

    Args:
        alike: all runs have heard the same and no variance depends on the run; then the variance is (1, T, 3).
    """
    runs, steps, links = measured[0].shape[0], measured[0].shape[1], measured[2].shape[1]
    x, others = np.empty((runs, steps, 3)), np.empty((runs, links, 3))
    variance = np.empty((1 if alike else runs, steps, 3))
    kept, most = places(measured[3], measured[4]), widest(measured[4])
    cov = np.zeros((steps if alike else 0, most, most, 3))
    for first in range(0, 1 if alike else runs, BLOCK):
        _block(measured, assumed, kept, first, 1 if alike else min(BLOCK, runs - first), cov, (x, variance, others))
    for first in range(0, runs if alike else 0, BLOCK):
        _known(measured, assumed, kept, first, min(BLOCK, runs - first), cov, (x, others))
    return x, variance, others


@compiled
def _block(measured: Any, assumed: Any, kept: AnyArray, first: int, runs: int, cov: AnyArray, found: Any) -> None:
    """The filter in some runs, and its covariances (T, n, n, lanes) m^2 if there is room for them."""
    start, unit = measured[4], len(assumed[2]) == 0
    most, lanes, old = widest(start), 3 * runs, 0
    held, was = np.zeros((2, most, runs), np.int64), np.zeros((2, most, runs), np.int64)
    said, place, edge = np.zeros((5, most, lanes)), np.zeros(most, np.int64), np.ones(lanes)
    state, pull = np.zeros((2, most, lanes)), np.zeros((most, lanes))
    last, a, scratch = np.zeros((most, most, lanes)), np.zeros((most, most, lanes)), np.zeros((2, most, lanes))
    for t in range(len(start) - 1):
        n = stay(t, start, kept, place)
        tell(measured, assumed, first, t, place[:n], held, was, said)
        before, now = state[t % 2], state[1 - t % 2, :n]
        expect(before, place[:n], said, now)
        if not unit:
            weigh(measured, assumed, first, t, edge)
        loosen(last, old, place[:n], said[PROCESS], scratch)
        join(last, place[:n], said[WEIGHT], assumed[4], a)
        tie(a, n, edge, unit)
        copy(a, n, last)
        factor(a, n, scratch[0])
        force(now, said, edge, unit, pull)
        substitute(a, n, pull)
        for k in range(n):
            for lane in range(uint64(lanes)):
                now[k, lane] += pull[k, lane]
        keep(now, first, t, start[t], found[0], found[2])
        for lane in range(lanes):
            found[1][first + lane % runs, t, lane // runs] = a[0, 0, lane]
        if len(cov):
            columns(a, n, cov[t])
        held, was, old = was, held, n


@compiled
def _known(measured: Any, assumed: Any, kept: AnyArray, first: int, runs: int, cov: AnyArray, found: Any) -> None:
    """The filter in some runs with covariances (T, n, n, 3) that are known."""
    start, unit = measured[4], len(assumed[2]) == 0
    most, lanes = widest(start), 3 * runs
    held, was = np.zeros((2, most, runs), np.int64), np.zeros((2, most, runs), np.int64)
    said, place, edge = np.zeros((5, most, lanes)), np.zeros(most, np.int64), np.ones(lanes)
    state, pull = np.zeros((2, most, lanes)), np.zeros((most, lanes))
    for t in range(len(start) - 1):
        n = stay(t, start, kept, place)
        tell(measured, assumed, first, t, place[:n], held, was, said)
        before, now = state[t % 2], state[1 - t % 2, :n]
        expect(before, place[:n], said, now)
        force(now, said, edge, unit, pull)
        for i in range(n):
            for j in range(n):
                for c in range(3):
                    gain = cov[t, i, j, c]
                    for lane in range(uint64(c * runs), uint64((c + 1) * runs)):
                        now[i, lane] += gain * pull[j, lane]
        keep(now, first, t, start[t], *found)
        held, was = was, held


@compiled
def weigh(measured: Any, assumed: Any, first: int, t: int, edge: AnyArray) -> None:
    """Information (lanes,) 1/m^2 of an edge: that of the mean variance per axis of the step's converted vectors."""
    seen, start, std, least = measured[2], measured[4], assumed[2], assumed[3]
    runs, links = len(edge) // 3, start[t + 1] - start[t]
    for r in range(runs):
        total = 0.0
        for link in range(start[t], start[t + 1]):
            d, up = max(seen[first + r, link, 0], least), seen[first + r, link, 3]
            total += std[0] ** 2 + d * d * ((std[1] * up) ** 2 + std[2] ** 2)
        for c in range(3 if links > 0 else 0):
            edge[c * runs + r] = 3 * links / total


@compiled
def loosen(a: AnyArray, n: int, place: AnyArray, process: AnyArray, scratch: AnyArray) -> None:
    """Information (A^-1 + Q)^-1 in place of A (n, n, lanes), member by member; infinite Q for who has left.

    Args:
        place: of the members to be, in A. process: (n or more, lanes) m^2 of these.
    """
    u, v = scratch
    lanes = uint64(a.shape[2])
    for k in range(n):
        after = -1
        for i in range(len(place)):
            if place[i] == k:
                after = i
        for i in range(n):
            for lane in range(lanes):
                u[i, lane] = a[i, k, lane] if i >= k else a[k, i, lane]
        for lane in range(lanes):
            stiffness = 1.0 / max(process[after, lane], LEAST_PROCESS) if after >= 0 else 0.0
            v[k, lane] = 1.0 / (u[k, lane] + stiffness)
        for i in range(n):
            for lane in range(lanes):
                v[i, lane] = u[i, lane] * v[k, lane] if i != k else v[k, lane]
        for lane in range(lanes):
            v[k, lane] = u[k, lane] * v[k, lane]
        for i in range(n):
            minus(a, i, i + 1, u[i], v)


@compiled
def minus(a: AnyArray, i: int, count: int, u: AnyArray, v: AnyArray) -> None:
    """a[i, j] -= u v[j] for the first j, lane by lane."""
    for j in range(count):
        for lane in range(uint64(a.shape[2])):
            a[i, j, lane] -= u[lane] * v[j, lane]


@compiled
def join(last: AnyArray, place: AnyArray, weight: AnyArray, forgotten: float, a: AnyArray) -> None:
    """Information of the new star from that of the last one, with the fixes; next to none of who joins."""
    lanes = uint64(a.shape[2])
    for i in range(len(place)):
        for j in range(i + 1):
            p, q = max(place[i], place[j]), min(place[i], place[j])
            for lane in range(lanes):
                a[i, j, lane] = last[p, q, lane] if q >= 0 else 0.0
        for lane in range(lanes):
            a[i, i, lane] += weight[i, lane] + (0.0 if place[i] >= 0 else 1.0 / forgotten)


@compiled
def tie(a: AnyArray, n: int, edge: AnyArray, unit: bool) -> None:
    """Add L W L, L the Laplacian of the star: W is 1, or the edges' information over the degree."""
    k = n - 1
    for lane in range(uint64(len(edge) if k > 0 else 0)):
        rim = edge[lane]
        hub = rim if unit else rim / k
        a[0, 0, lane] += k * k * hub + k * rim
        for i in range(1, n):
            a[i, 0, lane] -= k * hub + rim
            a[i, i, lane] += rim
            for j in range(1, i + 1):
                a[i, j, lane] += hub


@compiled
def force(state: AnyArray, said: AnyArray, edge: AnyArray, unit: bool, pull: AnyArray) -> None:
    """What the fixes and L W (delta - L x) pull at the state (n, lanes)."""
    k = len(state) - 1
    for lane in range(uint64(len(edge))):
        total = 0.0
        for j in range(1, k + 1):
            gap = said[AHEAD, j, lane] - state[j, lane] + state[0, lane]
            pull[j, lane] = gap
            total += gap
        rim = edge[lane]
        hub = total * (rim if unit else rim / max(k, 1))
        for j in range(k + 1):
            side = rim * pull[j, lane] + hub if j > 0 else -k * hub - rim * total
            pull[j, lane] = side + said[WEIGHT, j, lane] * (said[FIX, j, lane] - state[j, lane])


@compiled
def copy(source: AnyArray, n: int, target: AnyArray) -> None:
    """The lower triangle."""
    for i in range(n):
        for j in range(i + 1):
            for lane in range(uint64(source.shape[2])):
                target[i, j, lane] = source[i, j, lane]


@compiled
def factor(a: AnyArray, n: int, scratch: AnyArray) -> None:
    """A = U D U^T in place, with D U^T as rows and the inverse of D on the diagonal: the last members go first."""
    lanes = uint64(a.shape[2])
    for k in range(n - 1, -1, -1):
        for lane in range(lanes):
            a[k, k, lane] = 1.0 / a[k, k, lane]
        for i in range(k):
            for lane in range(lanes):
                scratch[i, lane] = a[k, i, lane] * a[k, k, lane]
        for i in range(k):
            minus(a, i, i + 1, a[k, i], scratch)


@compiled
def substitute(a: AnyArray, n: int, b: AnyArray) -> None:
    """Solution in place of the right-hand side b (n, lanes) of what was factored."""
    lanes = uint64(a.shape[2])
    for k in range(n - 1, -1, -1):
        for lane in range(lanes):
            scaled = b[k, lane] * a[k, k, lane]
            for j in range(uint64(k)):
                b[j, lane] -= a[k, j, lane] * scaled
    for k in range(n):
        for lane in range(lanes):
            total = b[k, lane]
            for j in range(uint64(k)):
                total -= a[k, j, lane] * b[j, lane]
            b[k, lane] = total * a[k, k, lane]


@compiled
def columns(a: AnyArray, n: int, cov: AnyArray) -> None:
    """The inverse (n, n, lanes) of what was factored, column by column."""
    lanes = a.shape[2]
    b = np.empty((n, lanes))
    for k in range(n):
        for i in range(n):
            for lane in range(lanes):
                b[i, lane] = 1.0 if i == k else 0.0
        substitute(a, n, b)
        for i in range(n):
            for lane in range(lanes):
                cov[i, k, lane] = b[i, lane]


@compiled
def keep(state: AnyArray, first: int, t: int, link: int, x: AnyArray, others: AnyArray) -> None:
    """What the state (n, lanes) says of the ego at step t and of its neighbours, from their first link on."""
    runs = state.shape[1] // 3
    for k in range(len(state)):
        for c in range(3):
            for r in range(runs):
                if k == 0:
                    x[first + r, t, c] = state[0, c * runs + r]
                else:
                    others[first + r, link + k - 1, c] = state[k, c * runs + r]

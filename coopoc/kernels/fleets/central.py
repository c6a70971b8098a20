"""Kalman filter of all vehicles of a fleet in one state, with one dense covariance, by connected components."""

from __future__ import annotations

import math

import numpy as np

from ...arrays import Bools, Floats, Ints
from ..compiling.compile import compiled, part
from ..compiling.small import add, add_diagonal, load, store, subtract
from ..gate import FIX_GATE, gate_fix
from .graph import MATRIX, VECTOR, Assumed, Matrix, Measured, Pairs, at, connect, gate_pair, pair_at_agreement

UNKNOWN = 1e6
"""m^2, variance of a vehicle before its first fix, where relative measurements are linearised."""


@compiled
def run_filter(measured: Measured, pairs: Pairs, assumed: Assumed, run: int) -> tuple[Floats, Floats]:
    """Positions (T, N, 3) m and covariances (T, N, 3, 3) m^2 of a run.

    P <- (P^-1 + F)^-1 = P (I + F P)^-1, F the information of the step's fixes and pairs. Only the vehicles of a
    connected component, over others or at earlier steps, have covariances that are not zero.

    Args:
        measured: what the fleet measured.
        pairs: those whose measurements reach the centre.
        assumed: the noise model.
        run: which of them.
    """
    _, steps, n = measured.active.shape
    x, cov = np.full((steps, n, 3), np.nan), np.full((steps, n, 3, 3), np.nan)
    P, label, hits = np.zeros((3 * n, 3 * n)), np.arange(n), np.zeros(n)
    active, present, alive = measured.active[run], np.zeros(n, np.bool_), pairs.alive[run]
    for t in range(steps):
        predict(measured, assumed, run, t, present, x, P)
        most = pairs.start[t + 1] - pairs.start[t]
        information, total = np.zeros((most, 9)), np.zeros(3 * n)
        for k in range(pairs.start[t], pairs.start[t + 1]):
            i, j = pairs.first[k], pairs.second[k]
            if alive[k]:
                connect(label, i, j)
                between = difference(P, i, j)
                vector = subtract(load(x[t, j], 0, VECTOR), load(x[t, i], 0, VECTOR))
                if assumed.robust:
                    joined = min(at(assumed.fix, run, t, i)[0], UNKNOWN) - UNKNOWN
                    joined *= (not present[i]) + (not present[j])
                    joint_information = add_diagonal(between, (joined, joined, joined))
                    gate_pair(vector, joint_information, k, pairs, measured.relative[run], assumed)
                weight, eta = pair_at_agreement(vector, between, k, pairs, measured.relative[run], assumed)
                store(information[k - pairs.start[t]], 0, weight)
                store(total, i, subtract(load(total, i, VECTOR), eta))
                store(total, j, add(load(total, j, VECTOR), eta))
        B = np.eye(3 * n)
        add_fixes(measured, assumed, run, t, present, x[t], P, B, total, np.bincount(label)[label] > 1, hits)
        for k in range(pairs.start[t], pairs.start[t + 1]):
            if alive[k]:
                add_pair(pairs.first[k], pairs.second[k], load(information[k - pairs.start[t]], 0, MATRIX), P, B)
        present = active[t]
        for component in range(n):
            members = np.flatnonzero((label == component) & present)
            if len(members):
                update(members, P, B, total, x[t], cov[t])
    return x, cov


@part
def predict(measured: Measured, assumed: Assumed, run: int, t: int, before: Bools, x: Floats, P: Floats) -> None:
    """x += dt u and P += Q; a vehicle that joins stands at its fix, and nothing is known of it."""
    for n in range(x.shape[1]):
        if measured.active[run, t, n]:
            process = at(assumed.process, run, t, n)
            for c in range(3):
                row = 3 * n + c
                if not before[n]:
                    P[row], P[:, row] = 0.0, 0.0
                P[row, row] = P[row, row] + process[c] if before[n] else UNKNOWN
                moved = x[t - 1, n, c] + measured.dt * measured.velocity[run, t, n, c]
                x[t, n, c] = moved if before[n] else measured.gnss[run, t, n, c]


@part
def block(P: Floats, i: int, j: int) -> Matrix:
    """Covariance of x_i with x_j."""
    row = 3 * i
    return *load(P[row], j, VECTOR), *load(P[row + 1], j, VECTOR), *load(P[row + 2], j, VECTOR)


@part
def difference(P: Floats, i: int, j: int) -> Matrix:
    """Covariance of x_j - x_i."""
    cov: Matrix = subtract(subtract(add(block(P, i, i), block(P, j, j)), block(P, i, j)), block(P, j, i))
    return cov


@part
def add_fixes(
    measured: Measured,
    assumed: Assumed,
    run: int,
    t: int,
    before: Bools,
    x: Floats,
    P: Floats,
    B: Floats,
    total: Floats,
    together: Bools,
    hits: Floats,
) -> None:
    """B += F P and the information vectors of the fixes; a vehicle that joins has the covariance of its own.

    The own filter of a vehicle whose fixes are false from the start believes them: here others, if it is `together`
    with any, contradict it.
    """
    for n in range(len(x)):
        noise, fix = load(at(assumed.fix, run, t, n), 0, VECTOR), measured.gnss[run, t, n]
        gap, share = subtract(load(fix, 0, VECTOR), load(x[n], 0, VECTOR)), 1.0
        if assumed.robust and together[n] and gap[0] + gap[1] + gap[2] + noise[0] < math.inf:
            share, hits[n] = gate_fix(gap, block(P, n, n), noise, FIX_GATE, hits[n])
        for c in range(3 if measured.active[run, t, n] else 0):
            row, variance = 3 * n + c, share * noise[c]
            if not before[n]:
                P[row, row] = variance
            elif not math.isnan(fix[c]):
                for d in range(len(P)):
                    B[row, d] += P[row, d] / variance
                total[row] += (fix[c] - x[n, c]) / variance


@part
def add_pair(i: int, j: int, information: Matrix, P: Floats, B: Floats) -> None:
    """B += F P of a pair."""
    for c in range(3):
        a, b, weight = 3 * i, 3 * j, (information[3 * c], information[3 * c + 1], information[3 * c + 2])
        for d in range(len(P)):
            moved = weight[0] * (P[b, d] - P[a, d])
            moved += weight[1] * (P[b + 1, d] - P[a + 1, d]) + weight[2] * (P[b + 2, d] - P[a + 2, d])
            B[a + c, d] -= moved
            B[b + c, d] += moved


@compiled
def update(members: Ints, P: Floats, B: Floats, total: Floats, x: Floats, cov: Floats) -> None:
    """Covariance of a component P B^-1, and its estimates moved by that times the information vectors.

    Args:
        members: (M,) columns.
        P: (3N, 3N) m^2, changed.
        B: (3N, 3N) I + F P.
        total: (3N,) 1/m.
        x: (N, 3) m, changed.
        cov: (N, 3, 3) m^2, written.
    """
    size = 3 * len(members)
    rows = np.empty(size, np.int64)
    for k in range(size):
        rows[k] = 3 * members[k // 3] + k % 3
    prior, right, eta = np.empty((size, size)), np.empty((size, size)), np.empty(size)
    for a in range(size):
        for b in range(size):
            prior[a, b], right[a, b] = P[rows[a], rows[b]], B[rows[a], rows[b]]
    posterior = np.linalg.solve(right.T, prior)
    posterior = 0.5 * (posterior + posterior.T)
    for a in range(size):
        for b in range(size):
            P[rows[a], rows[b]] = posterior[a, b]
    for a in range(size):
        eta[a] = total[rows[a]]
    moved = posterior @ eta
    for a in range(size):
        n, c = members[a // 3], a % 3
        x[n, c] += moved[a]
        for d in range(3):
            cov[n, c, d] = posterior[a, a - c + d]

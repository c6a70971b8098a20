"""Consensus ADMM with every local problem as one dense system: Boyd et al., 2011, section 7.2."""

from __future__ import annotations

import numpy as np


def admm(drive, rounds, rho):  # type: ignore[no-untyped-def]
    """Positions (T, N, 3) and covariances (T, N, 3, 3) of one run."""
    x = np.full((drive.steps, drive.vehicles, 3), np.nan)
    P = np.full((*x.shape, 3), np.nan)
    for t in range(drive.steps):
        for n in drive.here(t):
            x[t, n], P[t, n] = drive.solo(t, n, x[t - 1, n], P[t - 1, n]) if drive.stays(t, n) else drive.start(t, n)
        here = drive.here(t)
        held, systems = {n: [n] for n in here}, {n: [(0, 0, np.linalg.inv(P[t, n]), np.zeros(3))] for n in here}
        for k, i, j in drive.pairs(t):
            W, w = drive.factor_at_agreement(k, x[t, j] - x[t, i], P[t, i] + P[t, j])
            for n, other, sign in ((i, j, 1.0), (j, i, -1.0)):
                systems[n].append((0, len(held[n]), W / 2, sign * w / 2))
                held[n].append(other)
        z, dual = {n: np.zeros(3) for n in here}, {n: np.zeros((len(held[n]), 3)) for n in here}
        for _ in range(rounds):
            copies = {n: _local(systems[n], [z[m] for m in held[n]] - dual[n], rho) for n in here}
            holders = {n: [(h, held[h].index(n)) for h in here if n in held[h]] for n in here}
            z = {n: np.mean([copies[h][k] + dual[h][k] for h, k in holders[n]], axis=0) for n in here}
            dual = {n: dual[n] + copies[n] - [z[m] for m in held[n]] for n in here}
        for n in here:
            x[t, n] += z[n]
    return x, P


def _local(terms, target, rho):  # type: ignore[no-untyped-def]
    """argmin f(y) + rho / 2 sum |y_k - a_k|^2; the first term is the prior of y_0, others are of y_k - y_0."""
    size = 3 * len(target)
    A, b = rho * np.eye(size), rho * np.ravel(target)
    for first, k, W, w in terms:
        H = np.zeros((3, size))
        H[:, 3 * first : 3 * first + 3] = np.eye(3) if k == first else -np.eye(3)
        if k != first:
            H[:, 3 * k : 3 * k + 3] = np.eye(3)
        A, b = A + H.T @ W @ H, b + H.T @ w
    return np.linalg.solve(A, b).reshape(-1, 3)

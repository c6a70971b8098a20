"""The Kalman filter of all vehicles with one dense covariance, updated in information form."""

import numpy as np

UNKNOWN = 1e6
"""m^2, of a vehicle that joins, where it is asked where belief and measurement agree."""


def central_filter(drive):  # type: ignore[no-untyped-def]
    """Positions (T, N, 3) and covariances (T, N, 3, 3) of one run."""
    x = np.full((drive.steps, drive.vehicles, 3), np.nan)
    cov, P, before = np.full((*x.shape, 3), np.nan), np.zeros((0, 0)), []
    for t in range(drive.steps):
        here = drive.here(t)
        row = {n: slice(3 * k, 3 * k + 3) for k, n in enumerate(here)}
        old = {n: slice(3 * k, 3 * k + 3) for k, n in enumerate(before)}
        stay = [n for n in here if n in old]
        S = UNKNOWN * np.eye(3 * len(here))
        for a in stay:
            for b in stay:
                S[row[a], row[b]] = P[old[a], old[b]] + (np.diag(drive.q[t, a]) if a == b else 0.0)
        information, eta = np.zeros_like(S), np.zeros(len(S))
        kept = np.concatenate([np.arange(3) + row[n].start for n in stay]) if stay else np.zeros(0, int)
        information[np.ix_(kept, kept)] = np.linalg.inv(S[np.ix_(kept, kept)])
        for n in here:
            x[t, n] = x[t - 1, n] + drive.dt * drive.velocity[t, n] if n in old else drive.gnss[t, n]
            there = np.isfinite(drive.gnss[t, n])
            information[row[n], row[n]] += np.diag(there / drive.r[t, n])
            eta[row[n]] += np.where(there, (np.nan_to_num(drive.gnss[t, n]) - x[t, n]) / drive.r[t, n], 0.0)
        for k, i, j in drive.pairs(t):
            H = np.zeros((3, len(S)))
            H[:, row[i]], H[:, row[j]] = -np.eye(3), np.eye(3)
            W, w = drive.factor_at_agreement(k, x[t, j] - x[t, i], H @ S @ H.T)
            information, eta = information + H.T @ W @ H, eta + H.T @ w
        P, before = np.linalg.inv(information), here
        for n in here:
            x[t, n] += (P @ eta)[row[n]]
            cov[t, n] = P[row[n], row[n]]
    return x, cov

"""All positions of a drive as one dense least-squares problem, by Gauss-Newton to convergence."""

import numpy as np


def batch_smoother(drive, x, steps=40):  # type: ignore[no-untyped-def]
    """Positions (T, N, 3) from a start of that shape, and covariances (T, N, 3, 3), of one run."""
    index = {key: 3 * k for k, key in enumerate((t, n) for t in range(drive.steps) for n in drive.here(t))}
    x, size, eye = x.copy(), 3 * len(index), np.eye(3)
    for _ in range(steps if drive.noise_model.sensors else 1):
        A, b = np.zeros((size, size)), np.zeros(size)

        def add(terms, W, w, A=A, b=b):  # type: ignore[no-untyped-def]
            for key, sign in terms:
                at = index[key]
                b[at : at + 3] += sign * w
                for other, also in terms:
                    to = index[other]
                    A[at : at + 3, to : to + 3] += sign * also * W

        for t, n in index:
            there = np.isfinite(drive.gnss[t, n])
            W = np.diag(there / drive.r[t, n])
            add([((t, n), 1.0)], W, W @ np.where(there, drive.gnss[t, n] - x[t, n], 0.0))
            if drive.stays(t, n):
                W = eye / drive.q[t, n]
                gap = drive.dt * drive.velocity[t, n] - (x[t, n] - x[t - 1, n])
                add([((t, n), 1.0), ((t - 1, n), -1.0)], W, W @ gap)
        for t in range(drive.steps):
            for k, i, j in drive.pairs(t):
                W, w = drive.factor(k, x[t, j] - x[t, i], drive.noise_model.sensors is None)
                add([((t, j), 1.0), ((t, i), -1.0)], W, w)
        move = np.linalg.solve(A, b)
        for (t, n), at in index.items():
            x[t, n] += move[at : at + 3]
        if np.abs(move).max() < 1e-10:
            break
    cov, P = np.full((*x.shape, 3), np.nan), np.linalg.inv(A)
    for (t, n), at in index.items():
        cov[t, n] = P[at : at + 3, at : at + 3]
    return x, cov

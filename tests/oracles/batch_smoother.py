"""All positions of a drive as one dense least-squares problem, by Gauss-Newton to convergence."""

import numpy as np
from numpy import isfinite
from numpy.linalg import inv, norm, solve

from coopoc.world.links import spherical, to_vector, wrap
from oracles.messages import slopes


def batch_smoother(recording, noise_model, run, x):  # type: ignore[no-untyped-def]
    """Positions (T, N, 3) from a start of that shape, and covariances (T, N, 3, 3), of one run."""
    gnss, velocity, seen = (v[run] for v in (recording.gnss, recording.velocity, recording.usable_relative))
    q, r = (
        np.broadcast_to(values, recording.gnss.shape)[run]
        for values in (noise_model.process_variance(recording), noise_model.fix_variance(recording))
    )
    active = np.zeros(gnss.shape[:2], bool)
    for t, n in np.ndindex(active.shape):
        began = (t > 0 and active[t - 1, n]) or isfinite(gnss[t, n]).all()
        active[t, n] = isfinite(velocity[t, n]).all() and began
    index = {key: 3 * k for k, key in enumerate(zip(*np.nonzero(active), strict=True))}
    size, eye = 3 * len(index), np.eye(3)
    x = np.where(active[..., None], x, np.nan)
    for _ in range(40 if noise_model.sensors else 1):
        A, b = np.zeros((size, size)), np.zeros(size)

        def add(terms, W, w, A=A, b=b):  # type: ignore[no-untyped-def]
            for key, sign in terms:
                at = index[key]
                b[at : at + 3] += sign * w
                for other, also in terms:
                    to = index[other]
                    A[at : at + 3, to : to + 3] += sign * also * W

        for t, n in index:
            there = isfinite(gnss[t, n])
            W = np.diag(there / r[t, n])
            add([((t, n), 1.0)], W, W @ np.where(there, gnss[t, n] - x[t, n], 0.0))
            if (t - 1, n) in index:
                gap = recording.dt * velocity[t, n] - (x[t, n] - x[t - 1, n])
                add([((t, n), 1.0), ((t - 1, n), -1.0)], eye / q[t, n], gap / q[t, n])
        for k, t, i, j in measurements(recording, run, active):
            H, off = rows(x[t, j] - x[t, i], seen[k], noise_model.sensors)
            add([((t, j), 1.0), ((t, i), -1.0)], H.T @ H, H.T @ off)
        move = solve(A, b)
        for (t, n), at in index.items():
            x[t, n] += move[at : at + 3]
        if abs(move).max() < 1e-10:
            break
    cov, P = np.full((*x.shape, 3), np.nan), inv(A)
    for (t, n), at in index.items():
        cov[t, n] = P[at : at + 3, at : at + 3]
    return x, cov


def measurements(recording, run, active):  # type: ignore[no-untyped-def]
    """(link, step, observer, neighbour) of those that count: a message of either of the two arrives."""
    links, oldest = recording.links, recording.v2x.max_age / recording.dt + 1e-9
    keys = list(zip(links.step.tolist(), links.observer.tolist(), links.neighbour.tolist(), strict=True))
    arrival = dict(zip(keys, recording.arrival[run].tolist(), strict=True))
    for k, (t, i, j) in enumerate(keys):
        ways = [arrival.get(key, -1) for key in ((t, i, j), (t, j, i))]
        if active[t, i] and active[t, j] and any(0 <= way <= t + oldest for way in ways):
            yield k, t, i, j


def rows(vector, measured, sensors):  # type: ignore[no-untyped-def]
    """Whitened Jacobian and residual of what was measured of range, azimuth, inclination; without sensors, unit rows
    along the three axes of the measured direction."""
    there, least = isfinite(measured), max(sensors.min_range, 0.1 * sensors.range_std) if sensors else 0.0
    measured = np.where(there, measured, np.array(spherical(*vector)))
    at = vector if sensors else to_vector(measured)
    J = slopes(at, least)
    if sensors is None:
        J /= norm(J, axis=1)[:, None]
        return J[there], J[there] @ (at - vector)
    off = measured - np.array(spherical(*vector))
    off[1:] = wrap(off[1:])
    return (J / sensors.relative_std[:, None])[there], (off / sensors.relative_std)[there]

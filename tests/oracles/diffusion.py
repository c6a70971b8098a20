"""Adapt-then-combine LMS on the rows of the graph Laplacian, vehicle by vehicle."""

from __future__ import annotations

import numpy as np

from coopoc.world.spherical import spherical, to_vector


def diffusion(drive, rounds, anchored):  # type: ignore[no-untyped-def]
    """Positions (T, N, 3) of one run."""
    x, w = np.full((drive.steps, drive.vehicles, 3), np.nan), {}
    for t in range(drive.steps):
        here, pairs = drive.here(t), drive.pairs(t)
        contacts = {n: [j if i == n else i for _, i, j in pairs if n in (i, j)] for n in here}
        moved = {n: drive.dt * drive.velocity[t, n] for n in here}
        own = {n: w[n][n] + moved[n] if drive.stays(t, n) else drive.gnss[t, n] for n in here}
        before, w = w, {}
        for n in here:
            w[n] = {n: own[n]}
            for k in contacts[n]:
                start = own[k] if anchored or np.isnan(drive.gnss[t, k]).any() else drive.gnss[t, k]
                kept = drive.stays(t, n) and drive.stays(t, k) and k in before.get(n, {})
                w[n][k] = before[n][k] + moved[k] if kept else start
        seen = {n: _seen(drive, pairs, n, own) for n in here}
        for _ in range(rounds):
            psi = {n: _adapted(drive, t, n, w[n], seen[n], anchored) for n in here}
            w = {}
            for n in here:
                w[n] = {}
                for k in psi[n]:
                    share = {j: 1 / max(len(contacts[n]) + 1, len(contacts[j]) + 1) for j in contacts[n] if k in psi[j]}
                    w[n][k] = (1 - sum(share.values())) * psi[n][k] + sum(c * psi[j][k] for j, c in share.items())
        for n in here:
            x[t, n] = w[n][n]
    return x


def _seen(drive, pairs, n, own):  # type: ignore[no-untyped-def]
    """Measured vectors of vehicle n to others and their mean variance per axis; what is missing is as estimated."""
    found, sensors = {}, drive.known.sensors
    for k, i, j in pairs:
        link, other = (drive.met.link[k], j) if i == n else (drive.met.link_back[k], i)
        if n in (i, j) and link >= 0:
            seen = drive.relative[link]
            seen = np.where(np.isnan(seen), spherical(*(own[other] - own[n])), seen)
            d = max(seen[0], sensors.min_range if sensors else 0.0)
            std = sensors.relative_std * [1.0, d * np.sin(seen[2]), d] if sensors else np.zeros(3)
            found[other] = to_vector(seen), (std**2).sum() / 3
    return found


def _adapted(drive, t, n, w, seen, anchored):  # type: ignore[no-untyped-def]
    """w + mu L^T (delta - L w) on the row of the Laplacian, and on that of the own fix."""
    degree, fix = len(seen), drive.gnss[t, n]
    variance = max(sum(v for _, v in seen.values()), 1.0)
    anchor = np.where(np.isnan(fix) | (not anchored), 0.0, variance / drive.r[t, n])
    mu = np.minimum(2 / np.maximum(degree**2 + degree + anchor, 2.0), 0.1)
    gap = -sum((v for v, _ in seen.values()), np.zeros(3)) - (degree * w[n] - sum((w[k] for k in seen), np.zeros(3)))
    row = {k: degree if k == n else -float(k in seen) for k in w}
    out = {k: w[k] + mu * gap * row[k] for k in w}
    out[n] = out[n] + mu * anchor * (np.nan_to_num(fix) - w[n])
    return out

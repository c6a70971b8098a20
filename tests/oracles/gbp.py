"""Gaussian belief propagation step by step, each message the Schur complement of a 6 x 6 joint information.

Murai et al., "A Robot Web for Distributed Many-Device Localization", T-RO 40, 2024.
"""

import numpy as np


def gbp(drive, rounds, damping=0.0):  # type: ignore[no-untyped-def]
    """Positions (T, N, 3) and covariances (T, N, 3, 3) of one run."""
    x = np.full((drive.steps, drive.vehicles, 3), np.nan)
    P = np.full((*x.shape, 3), np.nan)
    own = P[0].copy()
    for t in range(drive.steps):
        for n in drive.here(t):
            estimate = drive.solo(t, n, x[t - 1, n], own[n]) if drive.stays(t, n) else drive.start(t, n)
            x[t, n], own[n] = estimate
        factors = [
            (i, j, *drive.factor_at_agreement(k, x[t, j] - x[t, i], own[i] + own[j])) for k, i, j in drive.pairs(t)
        ]
        messages = {(a, b): (np.zeros((3, 3)), np.zeros(3)) for i, j, _, _ in factors for a, b in ((i, j), (j, i))}

        def belief(n, messages=messages, own=own):  # type: ignore[no-untyped-def]
            mine = [message for (_, to), message in messages.items() if to == n]
            return np.linalg.inv(own[n]) + sum(m[0] for m in mine), sum((m[1] for m in mine), np.zeros(3))

        for _ in range(rounds):
            new = {}
            for i, j, W, w in factors:
                for sender, receiver, sign in ((i, j, 1.0), (j, i, -1.0)):
                    L, eta = (a - b for a, b in zip(belief(sender), messages[receiver, sender], strict=True))
                    gain = W @ np.linalg.inv(L + W)
                    message = W - gain @ W, sign * w + gain @ (eta - sign * w)
                    both = zip(messages[sender, receiver], message, strict=True)
                    new[sender, receiver] = tuple(damping * a + (1 - damping) * b for a, b in both)
            messages.update(new)
        for n in drive.here(t):
            L, eta = belief(n)
            P[t, n] = np.linalg.inv(L)
            x[t, n] += P[t, n] @ eta
    return x, P

"""Graduated non-convexity by the equations: weighted least squares and surrogate weights in turn (Yang et al. 2020)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.stats import chi2

from oracles.window import Row, descend


def gnc(rows: Sequence[Row], relative: Any, x: Any, ego: int, threshold: float) -> Any:
    """Points, covariance and the weight of each vehicle's fixes, the ego's excepted.

    Truncated: w = sqrt(mu (mu + 1)) c / |r| - mu in [0, 1], mu from c^2 / (2 r_max^2 - c^2) up by 1.4 a round.
    """
    groups = sorted({g for _, _, g in rows if isinstance(g, int) and g != ego})
    weight, mu = dict.fromkeys(groups, 1.0), 0.0
    for _ in range(300):
        scaled = [
            ({k: np.sqrt(weight.get(g, 1.0)) * c for k, c in terms.items()}, np.sqrt(weight.get(g, 1.0)) * right, g)
            for terms, right, g in rows
        ]
        x, cov = descend(scaled, relative, x)
        if mu < 0.0 or not groups:
            return x, cov, weight
        square, count = dict.fromkeys(groups, 0.0), dict.fromkeys(groups, 0)
        for terms, right, g in rows:
            if g in square:
                square[g] += float(np.sum((right - sum(c @ x[k] for k, c in terms.items())) ** 2))
                count[g] += 3
        s = {g: square[g] / chi2.ppf(threshold, count[g]) for g in groups}
        worst = max(s.values())
        mu = 1.0 / max(2.0 * worst - 1.0, 1e-06) if mu == 0.0 else 1.4 * mu
        new = {g: float(np.clip(np.sqrt(mu * (mu + 1.0) / max(s[g], 1e-30)) - mu, 0.0, 1.0)) for g in groups}
        done = all(new[g] == weight[g] and new[g] in (0.0, 1.0) for g in groups)
        weight = new
        if done:
            mu = -1.0
    return x, cov, weight

"""Robust means: what a few clients that send anything cannot move far."""

from __future__ import annotations

import torch
from torch import Tensor

from coopoc.errors import InputError


def median(weights: Tensor, sizes: Tensor | None = None, uncertainty: Tensor | None = None) -> Tensor:
    """Median of each weight over the clients (C, P), the mean of the middle two where C is even; sizes are not read.

    Source: Yin et al., ICML 2018, algorithm 1, option I.

    >>> median(torch.tensor([[1.0], [2.0], [90.0]])).tolist()
    [2.0]
    """
    ordered, count = weights.sort(0).values, len(weights)
    return (ordered[(count - 1) // 2] + ordered[count // 2]) / 2


def trimmed_mean(weights: Tensor, share: float) -> Tensor:
    """Mean of each weight over the clients (C, P) without its int(share C) least and greatest values.

    Source: Yin et al., ICML 2018, algorithm 1, option II.

    >>> trimmed_mean(torch.tensor([[1.0], [2.0], [4.0], [90.0]]), 0.25).tolist()
    [3.0]
    """
    cut = int(share * len(weights))
    return weights.sort(0).values[cut : len(weights) - cut].mean(0)


def krum_scores(weights: Tensor, byzantine: int) -> Tensor:
    """(C,) sum of the squared distances of each client to its C - f - 2 nearest others, in float64.

    Args:
        weights: (C, P). byzantine: f, clients that may send anything.

    Raises:
        InputError: C <= 2 f + 2, with which nothing is promised.

    Source: Blanchard et al., Machine Learning with Adversaries, NeurIPS 2017, section 4.

    >>> krum_scores(torch.tensor([[0.0], [1.0], [2.0], [3.0], [90.0]]), 1).tolist()
    [5.0, 2.0, 2.0, 5.0, 15313.0]
    """
    count = len(weights)
    if count <= 2 * byzantine + 2:
        given = f"{count} with byzantine = {byzantine}"
        allowed = f"Krum needs more than 2 f + 2 = {2 * byzantine + 2} clients"
        raise InputError("clients", given, allowed, "Expect fewer bad clients, or take the median.")
    exact = weights.double()
    square = torch.stack([(exact - one).square().sum(1) for one in exact])
    nearest: Tensor = square.fill_diagonal_(torch.inf).sort(1).values[:, : count - byzantine - 2]
    return nearest.sum(1)


def geometric_median(points: Tensor, weights: Tensor, smoothing: float = 1e-6, iterations: int = 1000) -> Tensor:
    """argmin_x sum_i w_i ||x - x_i|| by steps x <- sum_i b_i x_i / sum_i b_i, b_i = w_i / max(||x - x_i||, s).

    Args:
        points: (C, P). weights: (C,) w_i >= 0. smoothing: s relative to the spread of the points, so that a step onto
            one of them is defined. iterations: at most; it ends when the point rests.

    Source: Weiszfeld, Tohoku Math. J. 43, 1937; smoothed: Pillutla, Kakade, Harchaoui, IEEE TSP 70, 2022.

    >>> geometric_median(torch.tensor([[0.0], [1.0], [90.0]]), torch.ones(3)).round(decimals=3)
    tensor([1.])
    """
    exact, share = points.double(), weights.double() / weights.double().sum()
    x = (share[:, None] * exact).sum(0)
    spread = torch.linalg.vector_norm(exact - x, dim=1).max()
    for _ in range(iterations):
        pull = share / torch.linalg.vector_norm(exact - x, dim=1).clamp_min(smoothing * float(spread) + 1e-300)
        before, x = x, ((pull / pull.sum())[:, None] * exact).sum(0)
        if torch.linalg.vector_norm(x - before) <= 1e-12 * spread:
            break
    return x.to(points.dtype)

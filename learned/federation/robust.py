"""Byzantine-robust rules: a minority of wrong weights cannot move their result far."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from coopoc.errors import InputError

from .rule import Rule, within


def median(weights: Tensor, sizes: Tensor | None = None, uncertainty: Tensor | None = None) -> Tensor:
    """Median of each weight over the clients (C, P), the mean of the middle two where C is even; sizes are not read.

    References:
        Yin et al., ICML 2018, algorithm 1, option I.

    >>> median(torch.tensor([[1.0], [2.0], [90.0]])).tolist()
    [2.0]
    """
    ordered, count = weights.sort(0).values, len(weights)
    return (ordered[(count - 1) // 2] + ordered[count // 2]) / 2


@dataclass(frozen=True)
class TrimmedMean(Rule):
    """Mean of each weight over the clients without its int(share C) least and greatest values.

    Args:
        share: of the clients, left out at either end.

    References:
        Yin et al., ICML 2018, algorithm 1, option II.

    >>> TrimmedMean(0.25).combine(torch.tensor([[1.0], [2.0], [4.0], [90.0]]), torch.ones(4), torch.ones(4)).tolist()
    [3.0]
    """

    share: float = 0.25

    def __post_init__(self) -> None:
        within("share", self.share, 0 <= self.share < 0.5, "in [0, 0.5)")

    def combine(self, weights: Tensor, sizes: Tensor, uncertainty: Tensor) -> Tensor:
        """Unweighted."""
        cut = int(self.share * len(weights))
        return weights.sort(0).values[cut : len(weights) - cut].mean(0)


def krum_scores(weights: Tensor, byzantine: int) -> Tensor:
    """(C,) sum of the squared distances of each client to its C - f - 2 nearest others, in float64.

    Args:
        weights: (C, P) weights.
        byzantine: f, number of Byzantine clients that is tolerated.

    Raises:
        InputError: C <= 2 f + 2, for which there is no guarantee.

    References:
        Blanchard et al., Machine Learning with Adversaries, NeurIPS 2017, section 4.

    >>> krum_scores(torch.tensor([[0.0], [1.0], [2.0], [3.0], [90.0]]), 1).tolist()
    [5.0, 2.0, 2.0, 5.0, 15313.0]
    """
    count = len(weights)
    if count <= 2 * byzantine + 2:
        given = f"{count} with byzantine = {byzantine}"
        allowed = f"Krum needs more than 2 f + 2 = {2 * byzantine + 2} clients"
        raise InputError("clients", given, allowed, "Tolerate fewer Byzantine clients, or take the median.")
    exact = weights.double()
    square = torch.stack([(exact - one).square().sum(1) for one in exact])
    nearest: Tensor = square.fill_diagonal_(torch.inf).sort(1).values[:, : count - byzantine - 2]
    return nearest.sum(1)


@dataclass(frozen=True)
class Krum(Rule):
    """Mean of the m clients with the lowest scores (`krum_scores`): Krum with m = 1, multi-Krum with more.

    Args:
        byzantine: f, number of Byzantine clients that is tolerated; needs C > 2 f + 2.
        keep: m; None for C - f, as in the paper's experiments.

    References:
        Blanchard et al., NeurIPS 2017, sections 4 and 5.

    >>> Krum(byzantine=2).least
    7
    """

    byzantine: int = 1
    keep: int | None = 1

    def __post_init__(self) -> None:
        whole = self.byzantine == int(self.byzantine) and self.byzantine >= 0
        within("byzantine", self.byzantine, whole, "a whole number >= 0")
        within("keep", self.keep, self.keep is None or self.keep >= 1, ">= 1 or None")

    @property
    def least(self) -> int:
        """2 f + 3, or m if that is more."""
        return max(2 * self.byzantine + 3, self.keep or 0)

    def combine(self, weights: Tensor, sizes: Tensor, uncertainty: Tensor) -> Tensor:
        """Plain mean of the clients with the lowest scores; the first of equals."""
        best = krum_scores(weights, self.byzantine).argsort(stable=True)[: self.keep or len(weights) - self.byzantine]
        return weights[best.sort().values].mean(0)


@dataclass(frozen=True)
class GeometricMedian(Rule):
    """RFA: argmin_x sum_i n_i ||x - theta_i||, by x <- sum_i b_i theta_i / sum_i b_i with b_i = n_i / ||x - theta_i||.

    It tolerates Byzantine clients with less than half of all pieces.

    Args:
        smoothing: least distance in b_i, relative to the largest distance from the mean: a step may land on a point.
        iterations: at most; the iteration ends when the point rests.

    References:
        Weiszfeld, Tohoku Math. J. 43, 1937; Pillutla, Kakade, Harchaoui, IEEE TSP 70, 2022, algorithm 2.

    >>> GeometricMedian().combine(torch.tensor([[0.0], [1.0], [90.0]]), torch.ones(3), torch.ones(3)).round(decimals=3)
    tensor([1.])
    """

    smoothing: float = 1e-6
    iterations: int = 1000

    def __post_init__(self) -> None:
        within("smoothing", self.smoothing, self.smoothing > 0, "> 0")
        within("iterations", self.iterations, self.iterations >= 1, ">= 1")

    def combine(self, weights: Tensor, sizes: Tensor, uncertainty: Tensor) -> Tensor:
        """Weighted by the sizes."""
        exact, share = weights.double(), sizes.double() / sizes.double().sum()
        x = (share[:, None] * exact).sum(0)
        largest = torch.linalg.vector_norm(exact - x, dim=1).max()
        least = self.smoothing * float(largest) + 1e-300
        for _ in range(self.iterations):
            weight = share / torch.linalg.vector_norm(exact - x, dim=1).clamp_min(least)
            before, x = x, ((weight / weight.sum())[:, None] * exact).sum(0)
            if torch.linalg.vector_norm(x - before) <= 1e-12 * largest:
                break
        return x.to(weights.dtype)

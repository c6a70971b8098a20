"""Rules that a minority of wrong answers cannot move far."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from .robust import geometric_median, krum_scores, trimmed_mean
from .rule import Rule, State, within


@dataclass(frozen=True)
class TrimmedMean(Rule):
    """`robust.trimmed_mean`: without the int(share C) least and greatest values of each weight.

    Source: Yin et al., ICML 2018, algorithm 1, option II.

    >>> TrimmedMean(0.5)
    Traceback (most recent call last):
    coopoc.errors.InputError: share = 0.5: must be in [0, 0.5). The docstring of the rule names its source.
    """

    share: float = 0.25

    def __post_init__(self) -> None:
        within("share", self.share, 0 <= self.share < 0.5, "in [0, 0.5)")

    def __call__(
        self, state: State, theta: Tensor, weights: Tensor, sizes: Tensor, uncertainty: Tensor
    ) -> tuple[Tensor, State]:
        """Mean of what is left."""
        return trimmed_mean(weights, self.share), state


@dataclass(frozen=True)
class Krum(Rule):
    """The weights of the one client that is closest to its C - f - 2 nearest others (`robust.krum_scores`).

    Args:
        byzantine: f, clients that may send anything; it takes C > 2 f + 2 clients.

    Source: Blanchard et al., Machine Learning with Adversaries, NeurIPS 2017, section 4.

    >>> Krum(byzantine=2).least
    7
    """

    byzantine: int = 1

    def __post_init__(self) -> None:
        whole = self.byzantine == int(self.byzantine) and self.byzantine >= 0
        within("byzantine", self.byzantine, whole, "a whole number >= 0")

    @property
    def least(self) -> int:
        """2 f + 3."""
        return 2 * self.byzantine + 3

    def kept(self, count: int) -> int:
        """How many of `count` clients are averaged."""
        return 1

    def __call__(
        self, state: State, theta: Tensor, weights: Tensor, sizes: Tensor, uncertainty: Tensor
    ) -> tuple[Tensor, State]:
        """Plain mean of the clients with the lowest scores; the first of equals."""
        best = krum_scores(weights, self.byzantine).argsort(stable=True)[: self.kept(len(weights))]
        return weights[best.sort().values].mean(0), state


@dataclass(frozen=True)
class MultiKrum(Krum):
    """Mean of the m clients with the lowest scores of `Krum`.

    Args:
        keep: m; None for C - f, as in the paper's experiments.

    Source: Blanchard et al., NeurIPS 2017, section 4 and 5.

    >>> MultiKrum(byzantine=1).kept(12)
    11
    """

    keep: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        within("keep", self.keep, self.keep is None or self.keep >= 1, ">= 1 or None")

    @property
    def least(self) -> int:
        """2 f + 3, or m."""
        return max(super().least, self.keep or 0)

    def kept(self, count: int) -> int:
        """m."""
        return self.keep or count - self.byzantine


@dataclass(frozen=True)
class GeometricMedian(Rule):
    """RFA: the point with the least sum_i n_i ||theta - theta_i|| (`robust.geometric_median`).

    It withstands liars with less than half of all pieces.

    Source: Pillutla, Kakade, Harchaoui, IEEE TSP 70, 2022, algorithm 2.

    >>> import torch
    >>> rule, line = GeometricMedian(), torch.tensor([[0.0], [1.0], [90.0]])
    >>> round(rule((), line[0], line, torch.ones(3), torch.ones(3))[0].item(), 4)
    1.0
    """

    smoothing: float = 1e-6
    iterations: int = 1000

    def __post_init__(self) -> None:
        within("smoothing", self.smoothing, self.smoothing > 0, "> 0")
        within("iterations", self.iterations, self.iterations >= 1, ">= 1")

    def __call__(
        self, state: State, theta: Tensor, weights: Tensor, sizes: Tensor, uncertainty: Tensor
    ) -> tuple[Tensor, State]:
        """Weighted by the sizes."""
        return geometric_median(weights, sizes, self.smoothing, self.iterations), state

"""Aggregation rules: mean, median, trimmed mean and Krum."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from coopoc.arrays import check_fields
from coopoc.errors import InputError, shown
from coopoc.plugins import find

Combine = Callable[[Tensor, Tensor], Tensor]
"""New weights (P,) from the clients' weights (C, P) and numbers of training pieces (C,)."""


class Rule:
    """theta <- rule(theta, weights, sizes), which remembers nothing: servers with memory are Flower's.

    A rule that needs the clients' weights alone overrides `combine`, one that needs their changes `__call__`.
    """

    @property
    def name(self) -> str:
        """Name in messages."""
        return repr(self)

    @property
    def least(self) -> int:
        """Smallest number of clients that it can combine."""
        return 1

    def tolerated(self, clients: int) -> int:
        """Number of Byzantine clients among so many that cannot move the result as far as they like (the breakdown
        point); 0 unless a rule knows better."""
        return 0

    def combine(self, weights: Tensor, sizes: Tensor) -> Tensor:
        """New weights (P,) from those of the clients (C, P) and their pieces (C,)."""
        raise NotImplementedError(f"{type(self).__name__} defines neither combine nor __call__")

    def __call__(self, theta: Tensor, weights: Tensor, sizes: Tensor) -> Tensor:
        """New weights (P,); theta (P,) is what the clients received."""
        return self.combine(weights, sizes)


@dataclass(frozen=True)
class Function(Rule):
    """A plain function (weights, sizes) -> (P,) as a rule."""

    function: Combine

    @property
    def name(self) -> str:
        """Name of the function."""
        return getattr(self.function, "__name__", repr(self.function))

    def tolerated(self, clients: int) -> int:
        """Any minority for the median."""
        return (clients - 1) // 2 if self.function is median else 0

    def combine(self, weights: Tensor, sizes: Tensor) -> Tensor:
        """The value of the function."""
        return self.function(weights, sizes)


def mean(weights: Tensor, sizes: Tensor) -> Tensor:
    """FedAvg: sum_i a_i theta_i with a_i = n_i / sum n, of weights (C, P) and pieces (C,).

    References:
        McMahan et al., AISTATS 2017, algorithm 1; arXiv 2411.05847, equation 8.

    >>> mean(torch.tensor([[1.0], [3.0]]), torch.tensor([3.0, 1.0])).tolist()
    [1.5]
    """
    share = (sizes.double() / sizes.double().sum()).to(weights.dtype)
    return (share[:, None] * weights).sum(0)


def median(weights: Tensor, sizes: Tensor | None = None) -> Tensor:
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

    >>> TrimmedMean(0.25).combine(torch.tensor([[1.0], [2.0], [4.0], [90.0]]), torch.ones(4)).tolist()
    [3.0]
    """

    share: float = 0.25

    def __post_init__(self) -> None:
        check_fields(self, {"share": (0, math.nextafter(0.5, 0), "in [0, 0.5)")})

    @property
    def least(self) -> int:
        """The first number of clients of which one is left out at either end."""
        return math.ceil(1 / self.share) if self.share else 1

    def tolerated(self, clients: int) -> int:
        """As many as are left out at either end."""
        return int(self.share * clients)

    def combine(self, weights: Tensor, sizes: Tensor) -> Tensor:
        """Unweighted."""
        cut = self.tolerated(len(weights))
        return weights.sort(0).values[cut : len(weights) - cut].mean(0)


@dataclass(frozen=True)
class Krum(Rule):
    """Mean of the m clients with the lowest scores: Krum with m = 1, multi-Krum with more.

    A score is the sum of the squared distances of a client to its C - f - 2 nearest others, in float64.

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
        check_fields(self, {"byzantine": (0, 1e9, ">= 0"), "keep": (1, 1e9, ">= 1 or None")})

    @property
    def least(self) -> int:
        """2 f + 3, or m if that is more."""
        return max(2 * self.byzantine + 3, self.keep or 0)

    def tolerated(self, clients: int) -> int:
        """f."""
        return self.byzantine if clients >= self.least else 0

    def combine(self, weights: Tensor, sizes: Tensor) -> Tensor:
        """Plain mean of the clients with the lowest scores; the first of equals.

        >>> Krum().combine(torch.tensor([[0.0], [1.0], [2.0], [3.0], [90.0]]), torch.ones(5)).tolist()
        [1.0]
        """
        exact, near = weights.double(), len(weights) - self.byzantine - 2
        square = torch.stack([(exact - one).square().sum(1) for one in exact])
        scores = square.fill_diagonal_(torch.inf).sort(1).values[:, :near].sum(1)
        best = scores.argsort(stable=True)[: self.keep or len(weights) - self.byzantine]
        return weights[best.sort().values].mean(0)


RULES = {
    "mean": Function(mean),
    "median": Function(median),
    "trimmed_mean": TrimmedMean(),
    "krum": Krum(),
    "multi_krum": Krum(keep=None),
}
"""Bundled rules with their default parameters; others come from entry points in `coopoc.rules` or from files."""


def rule(name_or_rule: str | Rule | Combine) -> Rule:
    """The rule of a name or of a path "mine.py:NAME"; a `Rule`, a class of rules or a plain function as a rule.

    Raises:
        InputError: an unknown name (lists the rules and the nearest one), or an object that is no rule.

    >>> rule("krum").least
    5
    """
    chosen = (
        (RULES.get(name_or_rule) or find("coopoc.rules", name_or_rule))
        if isinstance(name_or_rule, str)
        else name_or_rule
    )
    made = chosen() if isinstance(chosen, type) else chosen
    if isinstance(made, Rule):
        return made
    if callable(made):
        return Function(made)
    hint = "Give a function of (weights, sizes), or a Rule."
    raise InputError("aggregate", shown(name_or_rule), f"is a {type(made).__name__}, no aggregation rule", hint)

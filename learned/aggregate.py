"""Aggregation rules: pure functions of what the clients send, with a state that the server keeps between rounds."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch
from torch import Tensor

from coopoc.errors import InputError

from .robust import geometric_median, krum_scores, median, trimmed_mean
from .schedule import Schedule

Combine = Callable[[Tensor, Tensor, Tensor], Tensor]
State = tuple[Tensor, ...]


def mean(weights: Tensor, sizes: Tensor, uncertainty: Tensor | None = None) -> Tensor:
    """FedAvg: sum_i a_i theta_i with a_i = n_i / sum n.

    Args:
        weights: (C, P) of C clients. sizes: (C,) training pieces n_i of each. uncertainty: not read.

    Source: McMahan et al., AISTATS 2017; arXiv 2411.05847, equation 8.

    >>> mean(torch.tensor([[1.0], [3.0]]), torch.tensor([3.0, 1.0])).tolist()
    [1.5]
    """
    share = (sizes.double() / sizes.double().sum()).to(weights.dtype)
    return (share[:, None] * weights).sum(0)


def uniform(weights: Tensor, sizes: Tensor, uncertainty: Tensor | None = None) -> Tensor:
    """sum_i theta_i / C, whatever the sizes: weights (C, P), sizes (C,).

    >>> uniform(torch.tensor([[1.0], [3.0]]), torch.tensor([3.0, 1.0])).tolist()
    [2.0]
    """
    return mean(weights, torch.ones_like(sizes))


def inverse_variance(weights: Tensor, sizes: Tensor, uncertainty: Tensor) -> Tensor:
    """sum_i a_i theta_i with a_i ~ n_i / v_i: the best unbiased mean of estimates with variances v_i / n_i.

    With equal v_i it is `mean`. A client whose v_i is not finite does not count; if none is finite, it is `mean`.

    Args:
        weights: (C, P). sizes: (C,) pieces n_i. uncertainty: (C,) v_i >= 0, m^2, the loss of the weights that all
            received on the client's own validation pieces.

    Source: Aitken, Proc. Royal Society of Edinburgh 55, 1935 (weights that are inverse variances).

    >>> inverse_variance(torch.tensor([[1.0], [5.0]]), torch.ones(2), torch.tensor([1.0, 3.0])).tolist()
    [2.0]
    """
    variance = uncertainty.double()
    trusted = torch.where(variance.isfinite(), sizes / variance.clamp_min(torch.finfo(torch.float64).tiny), 0.0)
    return mean(weights, trusted / trusted.max() if trusted.any() else sizes)


class Rule(ABC):
    """theta, state <- rule(state, theta, weights, sizes, uncertainty): how the server combines what the clients send.

    A rule holds its parameters and nothing else; what it remembers from round to round is in its state.
    """

    @property
    def name(self) -> str:
        """What to call it in messages."""
        return repr(self)

    @property
    def least(self) -> int:
        """Fewest clients that it can combine."""
        return 1

    def start(self, theta: Tensor) -> State:
        """State before the first round, with weights theta (P,)."""
        return ()

    def local(self, schedule: Schedule) -> Schedule:
        """The clients' schedule as this rule wants it."""
        return schedule

    @abstractmethod
    def __call__(
        self, state: State, theta: Tensor, weights: Tensor, sizes: Tensor, uncertainty: Tensor
    ) -> tuple[Tensor, State]:
        """New weights (P,) and state from the clients' weights (C, P), pieces (C,) and validation losses (C,) m^2."""


@dataclass(frozen=True)
class Stateless(Rule):
    """A plain function (weights, sizes, uncertainty) -> (P,) as a rule."""

    combine: Combine = mean

    @property
    def name(self) -> str:
        """Name of the function."""
        return getattr(self.combine, "__name__", repr(self.combine))

    def __call__(
        self, state: State, theta: Tensor, weights: Tensor, sizes: Tensor, uncertainty: Tensor
    ) -> tuple[Tensor, State]:
        """What the function makes of the answers."""
        return self.combine(weights, sizes, uncertainty), state


@dataclass(frozen=True)
class FedProx(Stateless):
    """`mean`, and mu / 2 ||theta - theta_g||^2 in the loss of every client unless the schedule has its own.

    Source: Li et al., Federated Optimization in Heterogeneous Networks, MLSys 2020, equation 2.

    >>> FedProx(0.1).local(Schedule()).proximal
    0.1
    """

    combine: Combine = field(default_factory=lambda: mean, init=False, repr=False)
    mu: float = 0.1

    def __post_init__(self) -> None:
        _within("mu", self.mu, self.mu >= 0, ">= 0")

    def local(self, schedule: Schedule) -> Schedule:
        """With the proximal term."""
        return schedule if schedule.proximal else replace(schedule, proximal=self.mu)


class Velocity(NamedTuple):
    """What FedAvgM remembers: velocity (P,)."""

    velocity: Tensor


@dataclass(frozen=True)
class FedAvgM(Rule):
    """Momentum at the server: v <- momentum v + (mean_i theta_i - theta);  theta <- theta + rate v.

    Momentum 0 and rate 1 are `mean`. Momentum makes a constant update 1 / (1 - momentum) times as long; with 0.9, which
    is usual where there are hundreds of rounds, a net of 20 rounds was still under way at its end.

    Source: Hsu, Qi, Brown, arXiv 1909.06335, section 4.3.

    >>> rule, two = FedAvgM(), torch.tensor([[1.0], [3.0]])
    >>> rule(rule.start(torch.zeros(1)), torch.zeros(1), two, torch.ones(2), torch.ones(2))[0].tolist()
    [2.0]
    """

    rate: float = 1.0
    momentum: float = 0.5

    def __post_init__(self) -> None:
        _within("rate", self.rate, self.rate > 0, "> 0")
        _within("momentum", self.momentum, 0 <= self.momentum < 1, "in [0, 1)")

    def start(self, theta: Tensor) -> State:
        """At rest."""
        return Velocity(torch.zeros_like(theta))

    def __call__(
        self, state: State, theta: Tensor, weights: Tensor, sizes: Tensor, uncertainty: Tensor
    ) -> tuple[Tensor, State]:
        """One step of the server's momentum."""
        velocity = self.momentum * state[0] + (mean(weights, sizes) - theta)
        return theta + self.rate * velocity, Velocity(velocity)


class Moments(NamedTuple):
    """What FedAdam remembers: first and second moment (P,)."""

    first: Tensor
    second: Tensor


@dataclass(frozen=True)
class FedAdam(Rule):
    """Adam at the server with d = mean_i theta_i - theta as its gradient, and without bias correction:

        m <- beta1 m + (1 - beta1) d;  v <- beta2 v + (1 - beta2) d^2;  theta <- theta + rate m / (sqrt(v) + tau),

    where v starts at tau^2: a weight moves by about `rate` per round, by less where d is below tau. As published beta1
    is 0.9; with 20 rounds 0.5 is better, see `FedAvgM`.

    Source: Reddi et al., Adaptive Federated Optimization, ICLR 2021, algorithm 2.

    >>> rule = FedAdam(rate=1.0, beta1=0.0, beta2=0.0, tau=0.5)
    >>> rule(rule.start(torch.zeros(1)), torch.zeros(1), torch.ones(2, 1), torch.ones(2), torch.ones(2))[0].item()
    0.6666666865348816
    """

    rate: float = 1e-2
    beta1: float = 0.5
    beta2: float = 0.99
    tau: float = 1e-3

    def __post_init__(self) -> None:
        for name in ("rate", "tau"):
            _within(name, getattr(self, name), getattr(self, name) > 0, "> 0")
        for name in ("beta1", "beta2"):
            _within(name, getattr(self, name), 0 <= getattr(self, name) < 1, "in [0, 1)")

    def start(self, theta: Tensor) -> State:
        """m = 0, v = tau^2."""
        return Moments(torch.zeros_like(theta), torch.full_like(theta, self.tau**2))

    def __call__(
        self, state: State, theta: Tensor, weights: Tensor, sizes: Tensor, uncertainty: Tensor
    ) -> tuple[Tensor, State]:
        """One step of the server's Adam."""
        change = mean(weights, sizes) - theta
        first = self.beta1 * state[0] + (1 - self.beta1) * change
        second = self.beta2 * state[1] + (1 - self.beta2) * change.square()
        return theta + self.rate * first / (second.sqrt() + self.tau), Moments(first, second)


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
        _within("share", self.share, 0 <= self.share < 0.5, "in [0, 0.5)")

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
        _within("byzantine", self.byzantine, whole, "a whole number >= 0")

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
        _within("keep", self.keep, self.keep is None or self.keep >= 1, ">= 1 or None")

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

    >>> rule, line = GeometricMedian(), torch.tensor([[0.0], [1.0], [90.0]])
    >>> round(rule((), line[0], line, torch.ones(3), torch.ones(3))[0].item(), 4)
    1.0
    """

    smoothing: float = 1e-6
    iterations: int = 1000

    def __post_init__(self) -> None:
        _within("smoothing", self.smoothing, self.smoothing > 0, "> 0")
        _within("iterations", self.iterations, self.iterations >= 1, ">= 1")

    def __call__(
        self, state: State, theta: Tensor, weights: Tensor, sizes: Tensor, uncertainty: Tensor
    ) -> tuple[Tensor, State]:
        """Weighted by the sizes."""
        return geometric_median(weights, sizes, self.smoothing, self.iterations), state


def _within(field: str, value: object, good: bool, allowed: str) -> None:
    if not good:
        raise InputError(field, value, f"must be {allowed}", "The docstring of the rule names its source.")


RULES: Mapping[str, Rule] = {
    "mean": Stateless(mean), "uniform": Stateless(uniform), "fedprox": FedProx(), "fedavgm": FedAvgM(),
    "fedadam": FedAdam(), "median": Stateless(median), "trimmed_mean": TrimmedMean(), "krum": Krum(),
    "multi_krum": MultiKrum(), "geometric_median": GeometricMedian(), "uncertainty": Stateless(inverse_variance),
}  # fmt: skip
"""Rules with their default parameters, by the names of the command line and recipes."""


def rule(name: str | Rule | Combine) -> Rule:
    """The rule of that name, the rule itself, or a plain function as a rule; InputError if there is none.

    >>> rule("krum").least
    5
    """
    if isinstance(name, Rule):
        return name
    if callable(name):
        return Stateless(name)
    if name not in RULES:
        raise InputError("aggregate", repr(name), f"must be one of {sorted(RULES)}, a Rule or a function", "Pick one.")
    return RULES[name]

"""Adaptive server optimisers: momentum, or Adam, along the mean change of the clients."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from .means import OfMean, mean
from .rule import State, within


class Velocity(NamedTuple):
    """State of FedAvgM: velocity (P,)."""

    velocity: Tensor


@dataclass(frozen=True)
class FedAvgM(OfMean):
    """Momentum at the server: v <- momentum v + (mean_i theta_i - theta);  theta <- theta + rate v.

    Momentum 0 and rate 1 are `mean`. Momentum makes a constant update 1 / (1 - momentum) times as long: 0.9 suits
    hundreds of rounds, and with 20 rounds training had not converged.

    Args:
        rate: of the server.
        momentum: share of the velocity that is carried over.

    References:
        Hsu, Qi, Brown, arXiv 1909.06335, section 4.3.

    >>> rule, two = FedAvgM(), torch.tensor([[1.0], [3.0]])
    >>> rule(rule.start(torch.zeros(1)), torch.zeros(1), two, torch.ones(2), torch.ones(2))[0].tolist()
    [2.0]
    """

    rate: float = 1.0
    momentum: float = 0.5

    def __post_init__(self) -> None:
        within("rate", self.rate, self.rate > 0, "> 0")
        within("momentum", self.momentum, 0 <= self.momentum < 1, "in [0, 1)")

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
    """State of FedAdam: first and second moment (P,)."""

    first: Tensor
    second: Tensor


@dataclass(frozen=True)
class FedAdam(OfMean):
    """Adam at the server with d = mean_i theta_i - theta as its gradient, and without bias correction:

        m <- beta1 m + (1 - beta1) d;  v <- beta2 v + (1 - beta2) d^2;  theta <- theta + rate m / (sqrt(v) + tau),

    where v starts at tau^2: a weight moves by about `rate` per round, by less where d is below tau. The published beta1
    is 0.9; with 20 rounds 0.5 is better, see `FedAvgM`.

    Args:
        rate: of the server.
        beta1: decay of the first moment.
        beta2: decay of the second moment.
        tau: added to the root of the second moment.

    References:
        Reddi et al., Adaptive Federated Optimization, ICLR 2021, algorithm 2.

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
            within(name, getattr(self, name), getattr(self, name) > 0, "> 0")
        for name in ("beta1", "beta2"):
            within(name, getattr(self, name), 0 <= getattr(self, name) < 1, "in [0, 1)")

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

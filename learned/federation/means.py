"""Means of the clients' weights: by their pieces, alike, or by how sure each is; FedProx holds clients near it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from ..training.schedule import Schedule
from .rule import Combine, Rule, State, within


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
        within("mu", self.mu, self.mu >= 0, ">= 0")

    def local(self, schedule: Schedule) -> Schedule:
        """With the proximal term."""
        return schedule if schedule.proximal else replace(schedule, proximal=self.mu)

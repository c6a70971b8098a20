"""Means of the clients' weights: by size, uniform, or by inverse variance; FedProx."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from ..training.schedule import Schedule
from .rule import Combine, Rule, within

FLOOR = 0.01
"""Least variance of a client in `inverse_variance`, as a share of the clients' median."""


def mean(weights: Tensor, sizes: Tensor, uncertainty: Tensor | None = None) -> Tensor:
    """FedAvg: sum_i a_i theta_i with a_i = n_i / sum n.

    Args:
        weights: (C, P) weights of C clients.
        sizes: (C,) training pieces n_i of each.
        uncertainty: not read.

    References:
        McMahan et al., AISTATS 2017, algorithm 1; arXiv 2411.05847, equation 8.

    >>> mean(torch.tensor([[1.0], [3.0]]), torch.tensor([3.0, 1.0])).tolist()
    [1.5]
    """
    share = (sizes.double() / sizes.double().sum()).to(weights.dtype)
    return (share[:, None] * weights).sum(0)


def uniform(weights: Tensor, sizes: Tensor, uncertainty: Tensor | None = None) -> Tensor:
    """sum_i theta_i / C, whatever the sizes; arguments as of `mean`.

    >>> uniform(torch.tensor([[1.0], [3.0]]), torch.tensor([3.0, 1.0])).tolist()
    [2.0]
    """
    return mean(weights, torch.ones_like(sizes))


def inverse_variance(weights: Tensor, sizes: Tensor, uncertainty: Tensor) -> Tensor:
    """sum_i a_i theta_i with a_i ~ n_i / v_i: the best unbiased mean of estimates with variances v_i / n_i.

    With equal v_i it is `mean`. A v_i below `FLOOR` times the median counts as that floor, so that no reported number
    gives one client all the weight. A client whose v_i is negative or not finite does not count; if no v_i is valid,
    the result is `mean`.

    Args:
        weights: (C, P) weights.
        sizes: (C,) training pieces n_i.
        uncertainty: (C,) v_i, m^2, loss of the received weights on the client's own validation pieces.

    References:
        Aitken, Proc. Royal Society of Edinburgh 55, 1935 (generalised least squares).

    >>> inverse_variance(torch.tensor([[1.0], [5.0]]), torch.ones(2), torch.tensor([1.0, 3.0])).tolist()
    [2.0]
    """
    variance = uncertainty.double()
    valid = variance.isfinite() & (variance >= 0)
    if not valid.any():
        return mean(weights, sizes)
    floor = max(FLOOR * float(variance[valid].quantile(0.5)), 1e-200)
    trusted = torch.where(valid, sizes / variance.clamp_min(floor), 0.0)
    return mean(weights, trusted / trusted.max())


@dataclass(frozen=True)
class Function(Rule):
    """A plain function (weights, sizes, uncertainty) -> (P,) as a rule."""

    function: Combine

    @property
    def name(self) -> str:
        """Name of the function."""
        return getattr(self.function, "__name__", repr(self.function))

    @property
    def mean_by(self) -> Literal["sizes", "uniform"] | None:
        """Of `mean` and `uniform`."""
        return "sizes" if self.function is mean else "uniform" if self.function is uniform else None

    def combine(self, weights: Tensor, sizes: Tensor, uncertainty: Tensor) -> Tensor:
        """The value of the function."""
        return self.function(weights, sizes, uncertainty)


class OfMean(Rule):
    """A rule that depends on the clients' mean by size only."""

    @property
    def mean_by(self) -> Literal["sizes"]:
        """By size."""
        return "sizes"

    def combine(self, weights: Tensor, sizes: Tensor, uncertainty: Tensor) -> Tensor:
        """`mean`."""
        return mean(weights, sizes)


@dataclass(frozen=True)
class FedProx(OfMean):
    """`mean`, and mu / 2 ||theta - theta_g||^2 in the loss of every client unless the schedule has its own.

    Args:
        mu: factor of the proximal term.

    References:
        Li et al., Federated Optimization in Heterogeneous Networks, MLSys 2020, equation 2.

    >>> FedProx(0.1).local(Schedule()).proximal
    0.1
    """

    mu: float = 0.1

    def __post_init__(self) -> None:
        within("mu", self.mu, self.mu >= 0, ">= 0")

    def local(self, schedule: Schedule) -> Schedule:
        """With the proximal term."""
        return schedule if schedule.proximal else replace(schedule, proximal=self.mu)

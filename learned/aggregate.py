"""Aggregation rules: pure functions of the clients' weights and sizes."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from coopoc.errors import InputError

Aggregate = Callable[[Tensor, Tensor], Tensor]


def mean(weights: Tensor, sizes: Tensor) -> Tensor:
    """FedAvg: sum_i a_i theta_i with a_i = n_i / sum n.

    Args:
        weights: (C, P) of C clients. sizes: (C,) training pieces n_i of each.

    Source: McMahan et al., AISTATS 2017; arXiv 2411.05847, equation 8.

    >>> mean(torch.tensor([[1.0], [3.0]]), torch.tensor([3.0, 1.0])).tolist()
    [1.5]
    """
    share = (sizes.double() / sizes.double().sum()).to(weights.dtype)
    return (share[:, None] * weights).sum(0)


def uniform(weights: Tensor, sizes: Tensor) -> Tensor:
    """sum_i theta_i / C, whatever the sizes: weights (C, P), sizes (C,).

    >>> uniform(torch.tensor([[1.0], [3.0]]), torch.tensor([3.0, 1.0])).tolist()
    [2.0]
    """
    return mean(weights, torch.ones_like(sizes))


RULES: dict[str, Aggregate] = {"mean": mean, "uniform": uniform}


def rule(name: str | Aggregate) -> Aggregate:
    """The rule of that name, or the function itself; InputError if there is none."""
    if callable(name):
        return name
    if name not in RULES:
        raise InputError("aggregate", repr(name), f"must be one of {sorted(RULES)} or a function", "Pick one.")
    return RULES[name]

"""Many nets of one shape as one matrix of weights: row s of theta (S, P) is net s."""

import copy
from collections.abc import Sequence
from typing import TypeVar

import torch
from torch import Tensor, nn

Net = TypeVar("Net", bound=nn.Module)


def flatten(models: Sequence[nn.Module]) -> Tensor:
    """(S, P) weights of S models of one shape, in the order of `parameters()`.

    >>> flatten([nn.Linear(2, 3), nn.Linear(2, 3)]).shape
    torch.Size([2, 9])
    """
    return torch.stack([nn.utils.parameters_to_vector(m.parameters()).detach() for m in models])


def unflatten(weights: Tensor, like: Net) -> Net:
    """A new model shaped as `like` with the weights (P,)."""
    model = copy.deepcopy(like)
    nn.utils.vector_to_parameters(weights.detach().clone(), model.parameters())
    return model


def named(theta: Tensor, like: nn.Module) -> dict[str, Tensor]:
    """Views (S, ...) into flat weights, or gradients, (S, P) by the names of the parameters of `like`.

    >>> named(torch.zeros(4, 9), nn.Linear(2, 3))["weight"].shape
    torch.Size([4, 3, 2])
    """
    views, at = {}, 0
    for name, parameter in like.named_parameters():
        views[name] = theta[:, at : at + parameter.numel()].view(len(theta), *parameter.shape)
        at += parameter.numel()
    return views

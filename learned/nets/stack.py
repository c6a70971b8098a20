"""Many nets of one shape as one matrix of weights: row s of theta (S, P) is net s."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor, nn

Net = TypeVar("Net", bound=nn.Module)


def flatten(models: Sequence[nn.Module]) -> Tensor:
    """(S, P) weights of S models of one shape, in the order of `parameters()`.

    >>> flatten([nn.Linear(2, 3), nn.Linear(2, 3)]).shape
    torch.Size([2, 9])
    """
    return torch.stack([nn.utils.parameters_to_vector(m.parameters()).detach() for m in models])


def unflatten(theta: Tensor, like: Net) -> list[Net]:
    """New models shaped as `like` with the weights theta (S, P)."""
    models = []
    for row in theta:
        model = copy.deepcopy(like)
        nn.utils.vector_to_parameters(row.detach().clone(), model.parameters())
        models.append(model)
    return models


class Layer(NamedTuple):
    """A stacked linear layer, or one of the two of a GRU: weight (S, out, in), bias (S, 1, out), weight^T as a view."""

    weight: Tensor
    bias: Tensor
    transposed: Tensor

    def __call__(self, x: Tensor) -> Tensor:
        """Output (S, B, out) of an input (S, B, in)."""
        return torch.baddbmm(self.bias, x, self.transposed)


Layers = dict[str, Layer]


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


def layers(theta: Tensor, like: nn.Module) -> Layers:
    """The weights of `named` as stacked linear layers: "update", ..., and of a GRU cell "process_ih", "process_hh".

    >>> layers(torch.zeros(1, 63), nn.ModuleDict({"a": nn.GRUCell(2, 3)}))["a_hh"].weight.shape
    torch.Size([1, 9, 3])
    """
    views = named(theta, like)
    return {
        name.replace(".weight", "").replace("weight_", "").replace(".", "_"): Layer(
            weight, views[name.replace("weight", "bias")].unsqueeze(1), weight.mT
        )
        for name, weight in views.items()
        if "weight" in name
    }


def gru(net: Layers, name: str, x: Tensor, h: Tensor) -> Tensor:
    """State (S, B, H) of stacked GRU cells after an input x (S, B, n); torch's GRUCell is the same for one net.

    r, z = sigmoid(W x + U h);  n = tanh(W x + r (U h));  h <- n + z (h - n), biases inside W and U.
    """
    size = h.shape[-1]
    gates, fresh = net[f"{name}_ih"](x).split([2 * size, size], -1)
    more, kept = net[f"{name}_hh"](h).split([2 * size, size], -1)
    reset, keep = (gates + more).sigmoid().chunk(2, -1)
    return torch.lerp(torch.addcmul(fresh, reset, kept).tanh(), h, keep)

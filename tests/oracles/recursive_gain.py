"""RecursiveGain step by step in plain torch, with the gradient by autograd: the referee of its compiled rollout."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from coopoc.learned.nets.recursive import RecursiveGain
from coopoc.learned.nets.stack import named
from coopoc.learned.training.clients import Batch


class _Alone(nn.Module):
    """One net along its drives (T, B, 3), as a module that can be called with other weights."""

    def __init__(self, net: RecursiveGain) -> None:
        super().__init__()
        self.net = net

    def forward(self, batch: Batch, s: int) -> Tensor:
        memory, found = self.net.start(batch.x0[s], None if batch.known is None else batch.known[s]), []
        for fix, speed in zip(batch.gnss[:, s].unbind(), batch.velocity[:, s].unbind(), strict=True):
            memory, x, variance = self.net.step(memory, fix, speed, batch.dt)
            found.append(torch.stack([x, variance]))
        return torch.stack(found, 1)


def rollout(theta: Tensor, like: RecursiveGain, batch: Batch) -> tuple[Tensor, Tensor]:
    """Estimates m and variances m^2 (T, S, B, 3) of nets with weights theta (S, P)."""
    rows = []
    for s in range(len(theta)):
        weights = {f"net.{name}": view[0] for name, view in named(theta[s : s + 1], like).items()}
        rows.append(torch.func.functional_call(_Alone(like), weights, (batch, s)))
    x, variance = torch.stack(rows, 2)
    return x, variance

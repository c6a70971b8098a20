"""SplitGain: Split-KalmanNet, a Kalman gain as the product of two nets' matrices."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from .gain import Recurrent, seed_of, size
from .stack import Layer, Layers, gru, layers

SIZE = 3
START_GAIN = 0.1
"""Diagonal of the untrained gain: a stable closed loop."""
SCALE = 0.5
"""m, where a feature turns from linear to logarithmic."""


class Memory(NamedTuple):
    """State of the net for B lanes: both GRUs (2, B, H); estimate (B, 3) m, the previous one, the last prior and the
    last fix."""

    hidden: Tensor
    x: Tensor
    x_before: Tensor
    prior_before: Tensor
    gnss_before: Tensor


class SplitGain(Recurrent):
    """Gain K = G_1 G_2: one net stands for the prior covariance, the other for the inverse innovation covariance.

    x_prior = x + dt u;  x <- x_prior + G_1 H^T G_2 (z - x_prior) with H = I. G_1 sees the last evolution x - x_before
    and update x - prior_before, G_2 the fix change z - z_before and the innovation z - x_prior, each component v as
    asinh(v / 0.5 m) / 2: with magnitudes, where the paper's KalmanNet has directions only. With H constant, the
    linearisation error is zero and the Jacobian the same at every step, so they are no inputs. A missing fix (NaN) has
    a gain of zero and does not change the GRUs.

    Args:
        hidden: width of each net's layer and GRU.
        seed: of the initial weights; K starts near 0.1 I.

    References:
        Choi, Park, Lim, Jeon, Kim, Shlezinger, Split-KalmanNet, IEEE TVT 2023 (arXiv 2210.09636).

    >>> sum(p.numel() for p in SplitGain().parameters())
    7986
    """

    def __init__(self, hidden: int = 24, seed: int = 0) -> None:
        super().__init__()
        self.hidden = size("hidden", hidden)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed_of(seed))
            self.see = nn.ModuleList(nn.Linear(2 * SIZE, hidden) for _ in range(2))
            self.cell = nn.ModuleList(nn.GRUCell(hidden, hidden) for _ in range(2))
            last = [nn.Linear(hidden, SIZE * SIZE) for _ in range(2)]
        self.factor = nn.ModuleList(last)
        with torch.no_grad():
            for part in last:
                part.weight.mul_(0.1)
                part.bias.copy_(START_GAIN**0.5 * torch.eye(SIZE).flatten())

    def start(self, x0: Tensor) -> Memory:
        """Memory before the first step: estimate x0 (B, 3) m, which is also the last fix; GRU states zero."""
        return Memory(torch.zeros(2, len(x0), self.hidden, dtype=x0.dtype), x0, x0, x0, x0)

    def step(self, memory: Memory, gnss: Tensor, velocity: Tensor, dt: float | Tensor) -> tuple[Memory, Tensor]:
        """One step: fix (B, 3) m, velocity (B, 3) m/s, dt s -> new memory (its `x` is the estimate), gain (B, 3, 3)."""
        net = self._layers(nn.utils.parameters_to_vector(self.parameters())[None])
        stacked = Memory(memory.hidden, *(position[None] for position in memory[1:]))
        after, gain = self._advance(net, stacked, gnss[None], (dt * velocity)[None])
        return Memory(after.hidden, *(position[0] for position in after[1:])), gain[0]

    def forward(self, gnss: Tensor, velocity: Tensor, x0: Tensor, dt: float | Tensor) -> Tensor:
        """Estimates (B, T, 3) m as in `Recurrent`, by `rollout`."""
        theta = nn.utils.parameters_to_vector(self.parameters())
        lanes = gnss.transpose(0, 1).unsqueeze(1), velocity.transpose(0, 1).unsqueeze(1)
        return self.rollout(theta[None], *lanes, x0[None], dt)[:, 0].transpose(0, 1)

    def rollout(self, theta: Tensor, gnss: Tensor, velocity: Tensor, x0: Tensor, dt: float | Tensor) -> Tensor:
        """Estimates (T, S, B, 3) m as in `Recurrent`, of all S nets at once."""
        spans = torch.as_tensor(dt, dtype=x0.dtype).expand(len(gnss))
        hidden = torch.zeros(2 * len(x0), x0.shape[1], self.hidden, dtype=x0.dtype)
        net, memory, estimates = self._layers(theta), Memory(hidden, x0, x0, x0, x0), []
        for fix, moved in zip(gnss, spans[:, None, None, None] * velocity, strict=True):
            memory, _ = self._advance(net, memory, fix, moved)
            estimates.append(memory.x)
        return torch.stack(estimates)

    def _advance(self, net: Layers, memory: Memory, gnss: Tensor, moved: Tensor) -> tuple[Memory, Tensor]:
        """One step of S nets, the two halves of each as 2 S rows: fix and motion (S, B, 3) m -> memory, gain."""
        missing, (models, lanes) = gnss.isnan().any(-1, keepdim=True), gnss.shape[:2]
        fix, prior = torch.where(missing, memory.gnss_before, gnss), memory.x + moved
        changes = memory.x - memory.x_before, memory.x - memory.prior_before, fix - memory.gnss_before, fix - prior
        features = ((torch.stack(changes) / SCALE).asinh() / 2).view(2, 2, models, lanes, SIZE).permute(0, 2, 3, 1, 4)
        features = net["see"](features.reshape(2 * models, lanes, 2 * SIZE)).relu()
        hidden = torch.where(missing.repeat(2, 1, 1), memory.hidden, gru(net, "cell", features, memory.hidden))
        first, second = net["factor"](hidden).view(2, models, lanes, SIZE, SIZE)
        gain = torch.where(missing[..., None], 0.0, first @ second)
        x = prior + (gain @ (fix - prior).unsqueeze(-1)).squeeze(-1)
        return Memory(hidden, x, memory.x, torch.where(missing, memory.prior_before, prior), fix), gain

    def _layers(self, theta: Tensor) -> Layers:
        """Layers of both halves, one after the other, as 2 S rows, under the names see, cell_ih, cell_hh, factor."""
        net, names = layers(theta, self), ("see_{}", "cell_{}_ih", "cell_{}_hh", "factor_{}")
        both = {name.replace("_{}", ""): [net[name.format(i)] for i in range(2)] for name in names}
        joined = {name: [torch.cat(parts) for parts in zip(*pair, strict=True)] for name, pair in both.items()}
        return {name: Layer(weight, bias, weight.mT) for name, (weight, bias, _) in joined.items()}

"""SplitGain: Split-KalmanNet, a Kalman gain as the product of two nets' matrices."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from .gain import Recurrent, seed_of, size
from .stack import Layer, layers

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
        missing = gnss.isnan().any(1, keepdim=True)
        fix, prior = torch.where(missing, memory.gnss_before, gnss), memory.x + dt * velocity
        changes = (memory.x - memory.x_before, memory.x - memory.prior_before), (fix - memory.gnss_before, fix - prior)
        seen = [(torch.cat(pair, 1) / SCALE).asinh() / 2 for pair in changes]
        parts = zip(self.see, self.cell, seen, memory.hidden, strict=True)
        hidden = [cell(see(given).relu(), state) for see, cell, given, state in parts]
        first, second = (part(h).view(-1, SIZE, SIZE) for part, h in zip(self.factor, hidden, strict=True))
        gain = torch.where(missing[:, :, None], 0.0, first @ second)
        x = prior + (gain @ (fix - prior).unsqueeze(-1)).squeeze(-1)
        after = torch.where(missing, memory.hidden, torch.stack(hidden))
        return Memory(after, x, memory.x, torch.where(missing, memory.prior_before, prior), fix), gain

    def forward(self, gnss: Tensor, velocity: Tensor, x0: Tensor, dt: float | Tensor) -> Tensor:
        """Estimates (B, T, 3) m as in `Recurrent`, by `rollout`."""
        return self.by_rollout(gnss, velocity, x0, dt)

    def rollout(self, theta: Tensor, gnss: Tensor, velocity: Tensor, x0: Tensor, dt: float | Tensor) -> Tensor:
        """Estimates (T, S, B, 3) m as in `Recurrent`: `step` with both nets of all S as rows of one product."""
        models, lanes = x0.shape[:2]
        names = ("see_{}", "cell_{}_ih", "cell_{}_hh", "factor_{}")
        see, into, back, factor = (self._pair(theta, name) for name in names)
        hidden = torch.zeros(2 * models, lanes, self.hidden, dtype=x0.dtype)
        x = x_before = prior_before = gnss_before = x0
        spans = torch.as_tensor(dt, dtype=x0.dtype).expand(len(gnss))
        estimates, whole = [], bool(gnss.isfinite().all())
        for given, move in zip(gnss.unbind(), (spans[:, None, None, None] * velocity).unbind(), strict=True):
            there = None if whole else given.isfinite().all(-1, keepdim=True)
            fix, prior = given if there is None else torch.where(there, given, gnss_before), x + move
            changes = torch.stack([x - x_before, x - prior_before, fix - gnss_before, fix - prior])
            seen = ((changes / SCALE).asinh() / 2).view(2, 2, models, lanes, SIZE).permute(0, 2, 3, 1, 4)
            seen = see(seen.reshape(2 * models, lanes, 2 * SIZE)).relu()
            gates, fresh = into(seen).split([2 * self.hidden, self.hidden], 2)
            more, kept = back(hidden).split([2 * self.hidden, self.hidden], 2)
            reset, keep = (gates + more).sigmoid().chunk(2, 2)
            after = torch.lerp(torch.addcmul(fresh, reset, kept).tanh(), hidden, keep)
            first, second = factor(after).view(2, models, lanes, SIZE, SIZE)
            correction = (first @ (second @ (fix - prior).unsqueeze(-1))).squeeze(-1)
            if there is not None:
                correction, prior_before = torch.where(there, correction, 0.0), torch.where(there, prior, prior_before)
                after = torch.where(there.repeat(2, 1, 1), after, hidden)
            hidden, prior_before = after, prior if there is None else prior_before
            x_before, x, gnss_before = x, prior + correction, fix
            estimates.append(x)
        return torch.stack(estimates)

    def _pair(self, theta: Tensor, name: str) -> Layer:
        """A layer of both nets, one after the other, as 2 S rows."""
        net = layers(theta, self)
        both = [net[name.format(i)] for i in range(2)]
        weight, bias = torch.cat([layer.weight for layer in both]), torch.cat([layer.bias for layer in both])
        return Layer(weight, bias, weight.mT)

"""GainNet: the three-GRU KalmanNet gain for a position state with a velocity control."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from coopoc.arrays import Floats
from coopoc.methods.track import Method

from .clients import Batch
from .gain import Gain

SIZE = 3
"""Components of state and measurement, m = n = 3."""
CELLS = SIZE * SIZE
"""Entries of each covariance-like GRU state."""


class Memory(NamedTuple):
    """What the net carries from step to step: three GRU states (B, 9) and four positions (B, 3) in metres."""

    process: Tensor
    prior: Tensor
    innovation: Tensor
    x: Tensor
    """Estimate of the last step, and below it the one before, the last prior and the last fix."""
    x_before: Tensor
    prior_before: Tensor
    gnss_before: Tensor


class GainNet(Gain):
    """Kalman gain from three GRUs that stand for process noise, prior covariance and innovation covariance.

    x_prior = x + dt u;  K = net(features);  x <- x_prior + K (z - x_prior).
    Features, each divided by its own Euclidean norm: fix change z - z_before, innovation z - x_prior, evolution
    x - x_before, update x - prior_before. With in_mult i and out_mult o there are 390 i + 504 o + 1818 parameters:
    (40, 5) has 19,938, the paper's "almost 20K".

    The default start is a stable closed loop, K near `start_gain` times the identity; torch's own initialisation
    (`start_gain=None`) is an unstable one for most seeds.

    Args:
        in_mult, out_mult: widths of the layers that feed the GRUs and of the layer that forms the gain.
        start_gain: diagonal of the untrained gain; the last layer's random weights are then scaled by 0.1.
        seed: of the initial weights.

    Source: Revach et al., KalmanNet, IEEE TSP 2022 (architecture 2); arXiv 2411.05847, section II.B.

    >>> sum(p.numel() for p in GainNet().parameters())
    19938
    """

    def __init__(self, in_mult: int = 40, out_mult: int = 5, start_gain: float | None = 0.1, seed: int = 0) -> None:
        super().__init__()
        self.in_mult, self.out_mult = in_mult, out_mult
        wide, both = SIZE * in_mult, 2 * CELLS
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.update = nn.Linear(SIZE, wide)
            self.evolution = nn.Linear(SIZE, wide)
            self.observation = nn.Linear(2 * SIZE, 2 * wide)
            self.process = nn.GRUCell(wide, CELLS)
            self.prior = nn.GRUCell(CELLS + wide, CELLS)
            self.prior_to_innovation = nn.Linear(CELLS, CELLS)
            self.innovation = nn.GRUCell(CELLS + 2 * wide, CELLS)
            self.gain_hidden = nn.Linear(both, both * out_mult)
            self.gain = nn.Linear(both * out_mult, CELLS)
            self.posterior_hidden = nn.Linear(both, CELLS)
            self.posterior = nn.Linear(both, CELLS)
        if start_gain is not None:
            with torch.no_grad():
                self.gain.weight.mul_(0.1)
                self.gain.bias.copy_(start_gain * torch.eye(SIZE).flatten())

    @property
    def settings(self) -> Mapping[str, Any]:
        """Widths."""
        return {"in_mult": self.in_mult, "out_mult": self.out_mult}

    def losses(self, theta: Tensor, batch: Batch) -> Tensor:
        """(S, B) squared error of each piece, mean over time, sum over components, m^2 (equation 7)."""
        from .gradient import loss
        from .stack import layers

        return loss(layers(theta, self), batch)

    def loss_and_gradient(self, theta: Tensor, batch: Batch) -> tuple[Tensor, Tensor]:
        """Loss (S,) m^2 and gradient (S, P)."""
        from .gradient import loss_and_gradient

        return loss_and_gradient(theta, self, batch)

    def method(self, name: str, x0: Floats | None = None) -> Method:
        """`LearnedGain` with this net."""
        from .method import LearnedGain

        return LearnedGain(self, name, x0)

    def start(self, x0: Tensor) -> Memory:
        """Memory before the first step: estimate x0 (B, 3) m, which is also the last fix; GRU states I, 0, I."""
        unit = torch.eye(SIZE, dtype=x0.dtype).flatten().expand(len(x0), CELLS)
        return Memory(unit, torch.zeros_like(unit), unit, x0, x0, x0, x0)

    def step(self, memory: Memory, gnss: Tensor, velocity: Tensor, dt: float) -> tuple[Memory, Tensor]:
        """One step: fix (B, 3) m, velocity (B, 3) m/s, dt s -> new memory (its `x` is the estimate), gain (B, 3, 3).

        This is the readable reference; `rollout` does the same for many models at once.
        """
        x_prior = memory.x + dt * velocity
        observed = torch.cat([normalize(gnss - memory.gnss_before), normalize(gnss - x_prior)], 1)
        evolved = normalize(memory.x - memory.x_before)
        updated = normalize(memory.x - memory.prior_before)

        process = self.process(self.update(updated).relu(), memory.process)
        prior = self.prior(torch.cat([process, self.evolution(evolved).relu()], 1), memory.prior)
        expected = self.prior_to_innovation(prior).relu()
        innovation = self.innovation(torch.cat([expected, self.observation(observed).relu()], 1), memory.innovation)
        gain = self.gain(self.gain_hidden(torch.cat([prior, innovation], 1)).relu())
        back = self.posterior_hidden(torch.cat([innovation, gain], 1)).relu()
        posterior = self.posterior(torch.cat([prior, back], 1)).relu()

        matrix = gain.view(-1, SIZE, SIZE)
        x = x_prior + (matrix @ (gnss - x_prior).unsqueeze(-1)).squeeze(-1)
        return Memory(process, posterior, innovation, x, memory.x, x_prior, gnss), matrix

    def forward(self, gnss: Tensor, velocity: Tensor, x0: Tensor, dt: float) -> Tensor:
        """Estimates (B, T, 3) m of T steps after the start, from fixes and velocities (B, T, 3)."""
        memory, estimates = self.start(x0), []
        for fix, speed in zip(gnss.unbind(1), velocity.unbind(1), strict=True):
            memory, _ = self.step(memory, fix, speed, dt)
            estimates.append(memory.x)
        return torch.stack(estimates, 1)

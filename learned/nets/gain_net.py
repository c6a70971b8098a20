"""GainNet: the three-GRU KalmanNet gain for a position state with a velocity control."""

from __future__ import annotations

from collections.abc import Mapping
from types import ModuleType
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from coopoc.arrays import Floats, Ints
from coopoc.kernels.compile import numba_is_there
from coopoc.methods.track import Method

from ..training.clients import Batch
from ..training.schedule import Moving, Schedule
from .gain import Gain
from .stack import named

SIZE = 3
"""Components of state and measurement, m = n = 3."""
CELLS = SIZE * SIZE
"""Entries of each covariance-like GRU state."""
SHORTEST = 1e-12
"""Length in m up to which a vector has no direction: its feature is zero and has no gradient."""
LOG_FLOOR = 0.01
"""Added to a length in m before its logarithm is taken."""


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
    (40, 5) has 19,938, the paper's "almost 20K". Where all of a fix is NaN it is missing: the step only predicts, and
    the GRU states, the last fix and the last prior stay as they were.

    The default start is a stable closed loop, K near `start_gain` times the identity; torch's own initialisation
    (`start_gain=None`) is an unstable one for most seeds.

    Args:
        in_mult, out_mult: widths of the layers that feed the GRUs and of the layer that forms the gain.
        start_gain: diagonal of the untrained gain; the last layer's random weights are then scaled by 0.1.
        seed: of the initial weights. magnitudes: each direction comes with log(length + 0.01 m), which the paper's net
            does not see; 18 i more parameters.

    Source: Revach et al., KalmanNet, IEEE TSP 2022 (architecture 2); arXiv 2411.05847, section II.B.

    >>> sum(p.numel() for p in GainNet().parameters())
    19938
    """

    def __init__(
        self, in_mult: int = 40, out_mult: int = 5, start_gain: float | None = 0.1, seed: int = 0,
        magnitudes: bool = False,
    ) -> None:  # fmt: skip
        super().__init__()
        self.in_mult, self.out_mult, self.magnitudes = in_mult, out_mult, magnitudes
        wide, both, seen = SIZE * in_mult, 2 * CELLS, SIZE + magnitudes
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.update = nn.Linear(seen, wide)
            self.evolution = nn.Linear(seen, wide)
            self.observation = nn.Linear(2 * seen, 2 * wide)
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
        """Widths, and what it sees."""
        return {"in_mult": self.in_mult, "out_mult": self.out_mult, "magnitudes": self.magnitudes}

    def losses(self, theta: Tensor, batch: Batch) -> Tensor:
        """(S, B) squared error of each piece, mean over time, sum over components, m^2 (equation 7)."""
        estimates = self.rollout(theta, batch.gnss, batch.velocity, batch.x0, batch.dt)
        errors = (estimates - batch.truth).square().sum(-1)
        return errors.movedim(0, -1).contiguous().mean(-1)  # in an order that does not depend on who is beside it

    def loss_and_gradient(self, theta: Tensor, batch: Batch) -> tuple[Tensor, Tensor]:
        """Loss (S,), the mean over the batch, and its gradient (S, P) at theta (S, P)."""
        if engine := _engine():
            found: tuple[Tensor, Tensor] = engine.loss_and_gradient(theta, self, batch)
            return found
        return super().loss_and_gradient(theta, batch)

    def descend(
        self, moving: Moving, rows: Ints, batch: Batch, step: int, rates: Floats, schedule: Schedule
    ) -> tuple[Tensor, Tensor]:
        """One optimiser step as in `Gain`, of each model from rollout to weights before the next one begins."""
        if engine := _engine():
            found: tuple[Tensor, Tensor] = engine.descend(moving, rows, self, batch, step, rates, schedule)
            return found
        return super().descend(moving, rows, batch, step, rates, schedule)

    def method(self, name: str, x0: Floats | None = None) -> Method:
        """`LearnedGain` with this net."""
        from ..method import LearnedGain

        return LearnedGain(self, name, x0)

    def start(self, x0: Tensor) -> Memory:
        """Memory before the first step: estimate x0 (B, 3) m, which is also the last fix; GRU states I, 0, I."""
        unit = torch.eye(SIZE, dtype=x0.dtype).flatten().expand(len(x0), CELLS)
        return Memory(unit, torch.zeros_like(unit), unit, x0, x0, x0, x0)

    def step(self, memory: Memory, gnss: Tensor, velocity: Tensor, dt: float | Tensor) -> tuple[Memory, Tensor]:
        """One step: fix (B, 3) m, velocity (B, 3) m/s, dt s -> new memory (its `x` is the estimate), gain (B, 3, 3).

        This is the readable reference of the compiled engine. A missing fix has a gain of zero.
        """
        missing = gnss.isnan().all(1, keepdim=True)
        fix = torch.where(missing, memory.gnss_before, gnss)
        x_prior = memory.x + dt * velocity
        observed = self._features(fix - memory.gnss_before, fix - x_prior)
        evolved = self._features(memory.x - memory.x_before)
        updated = self._features(memory.x - memory.prior_before)

        process = self.process(self.update(updated).relu(), memory.process)
        prior = self.prior(torch.cat([process, self.evolution(evolved).relu()], 1), memory.prior)
        expected = self.prior_to_innovation(prior).relu()
        innovation = self.innovation(torch.cat([expected, self.observation(observed).relu()], 1), memory.innovation)
        gain = self.gain(self.gain_hidden(torch.cat([prior, innovation], 1)).relu())
        back = self.posterior_hidden(torch.cat([innovation, gain], 1)).relu()
        posterior = self.posterior(torch.cat([prior, back], 1)).relu()

        matrix = torch.where(missing, 0.0, gain).view(-1, SIZE, SIZE)
        x = x_prior + (matrix @ (fix - x_prior).unsqueeze(-1)).squeeze(-1)
        new = Memory(process, posterior, innovation, x, memory.x, x_prior, fix)
        kept = memory._replace(x=x, x_before=memory.x)
        return Memory(*(torch.where(missing, old, now) for old, now in zip(kept, new, strict=True))), matrix

    def _features(self, *changes: Tensor) -> Tensor:
        """Directions of changes (B, 3) m, one after the other, and after them the logarithms of their lengths."""
        lengths = [torch.linalg.vector_norm(change, dim=1, keepdim=True) for change in changes]
        units = [torch.where(length > SHORTEST, change / length.clamp_min(SHORTEST), 0.0)
                 for change, length in zip(changes, lengths, strict=True)]  # fmt: skip
        logs = [(length + LOG_FLOOR).log() for length in lengths] if self.magnitudes else []
        return torch.cat([*units, *logs], 1)

    def reference(self, gnss: Tensor, velocity: Tensor, x0: Tensor, dt: float | Tensor) -> Tensor:
        """`forward` by plain torch, one `step` after the other; differentiable in everything."""
        memory, estimates = self.start(x0), []
        steps = torch.as_tensor(dt, dtype=gnss.dtype).expand(gnss.shape[1])
        for fix, speed, step in zip(gnss.unbind(1), velocity.unbind(1), steps.unbind(), strict=True):
            memory, _ = self.step(memory, fix, speed, step)
            estimates.append(memory.x)
        return torch.stack(estimates, 1)

    def forward(self, gnss: Tensor, velocity: Tensor, x0: Tensor, dt: float | Tensor) -> Tensor:
        """Estimates (B, T, 3) m of T steps after the start x0 (B, 3) m, from fixes, velocities (B, T, 3), dt or (T,) s.

        Compiled where numba is installed; where the inputs need gradients, or lie on another device, by `reference`.
        """
        theta = torch.cat([p.view(-1) for p in self.parameters()])
        if any(a.requires_grad for a in (gnss, velocity, x0)) or theta.device.type != "cpu":
            return self.reference(gnss, velocity, x0, dt)
        lanes = gnss.transpose(0, 1).unsqueeze(1), velocity.transpose(0, 1).unsqueeze(1)
        return self.rollout(theta[None], *lanes, x0[None], dt)[:, 0].transpose(0, 1)

    def rollout(self, theta: Tensor, gnss: Tensor, velocity: Tensor, x0: Tensor, dt: float | Tensor) -> Tensor:
        """Estimates (T, S, B, 3) m of S nets of this shape with weights theta (S, P), differentiable in theta.

        Args:
            gnss, velocity: (T, S, B, 3) m, m/s. x0: (S, B, 3) m. dt: s, or (T,).
        """
        if engine := _engine():
            found: Tensor = engine.rollout(theta, self, gnss, velocity, x0, dt)
            return found
        rows = []
        for s in range(len(theta)):
            weights = {f"net.{name}": view[0] for name, view in named(theta[s : s + 1], self).items()}
            lanes = gnss[:, s].transpose(0, 1), velocity[:, s].transpose(0, 1)
            rows.append(torch.func.functional_call(_Reference(self), weights, (*lanes, x0[s], dt)).transpose(0, 1))
        return torch.stack(rows, 1)


class _Reference(nn.Module):
    """A net whose forward is its `reference`, to be called with other weights."""

    def __init__(self, net: GainNet) -> None:
        super().__init__()
        self.net = net

    def forward(self, gnss: Tensor, velocity: Tensor, x0: Tensor, dt: float | Tensor) -> Tensor:
        return self.net.reference(gnss, velocity, x0, dt)


def _engine() -> ModuleType | None:
    """The compiled engine; None, with one warning, where numba is missing."""
    if not numba_is_there("GainNet runs in plain torch, some hundred times slower than compiled"):
        return None
    from ..engine import rollout as engine

    return engine

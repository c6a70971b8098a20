"""RecursiveGain: a Kalman filter per axis whose noise, gain and covariance a small recurrent net corrects."""

from __future__ import annotations

from collections.abc import Mapping
from types import ModuleType
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from coopoc.arrays import Floats
from coopoc.kernels.compile import numba_is_there
from coopoc.methods.track import Method

from ..training.clients import Batch
from .gain import Gain, over_time
from .levels import FEATURES, GNSS_STD, Levels, after, first, noise
from .stack import named

LIMIT = 3.0
"""Largest correction of a logarithm: whatever its weights, the net stays within exp(+-3) of the filter."""
HEADS = 4
"""What the net corrects: process variance, odds of the gain, Joseph's second term, claimed GNSS variance."""


class Memory(NamedTuple):
    """What the filter carries from step to step, B lanes: noise levels; estimate (B, 3) m; its variance over that of a
    fix; last normalised surprise; GRU state (3 B, H); variance (B, 3) m^2."""

    levels: Levels
    x: Tensor
    spread: Tensor
    surprise: Tensor
    hidden: Tensor
    variance: Tensor


class RecursiveGain(Gain):
    """Gain and error covariance from one GRU per axis, whose weights the three axes share.

    With r and q from running levels of fixes and velocities (`levels.noise`), i = z - x - dt u and c_1..c_4 of the net:
    p = s + e^c_1 q / r;  k = p e^c_2 / (1 + p e^c_2);  x += dt u + k i;  s = (1 - k)^2 p + k^2 e^c_3;  P = e^c_4 r s.
    The spread s is the variance over that of a fix, so what is learned of r while driving also holds for what older
    fixes were worth. Before training c = 0: the Kalman filter of these levels. The net reads logarithms of r, q, the
    speed, s, i^2 and the product of the last two surprises: it sees magnitudes, and all axes and signs alike.

    Args:
        hidden: GRU size. seed: of the initial weights; the heads start at zero.

    Source: Mortada et al., Recursive KalmanNet, EUSIPCO 2025 (arXiv 2506.11639): a gain net and a covariance in Joseph
    form with a learned second term, trained on the Gaussian negative log-likelihood.

    >>> sum(p.numel() for p in RecursiveGain().parameters())
    1364
    """

    def __init__(self, hidden: int = 16, seed: int = 0) -> None:
        super().__init__()
        self.hidden = hidden
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.cell = nn.GRUCell(FEATURES + 3, hidden)
            self.heads = nn.Linear(hidden, HEADS)
        nn.init.zeros_(self.heads.weight)
        nn.init.zeros_(self.heads.bias)

    @property
    def settings(self) -> Mapping[str, Any]:
        """Size of the GRU."""
        return {"hidden": self.hidden}

    def losses(self, theta: Tensor, batch: Batch) -> Tensor:
        """(S, B) negative log-likelihood of the true error without its constant, mean over time, sum over axes."""
        x, variance = self.rollout(theta, batch)
        return over_time(0.5 * ((x - batch.truth).square() / variance + variance.log()).sum(-1))

    def method(self, name: str, x0: Floats | None = None) -> Method:
        """`RecursiveFilter` with this net."""
        from .recursive_filter import RecursiveFilter

        return RecursiveFilter(self, name, x0)

    def start(self, x0: Tensor, known: Tensor | None = None) -> Memory:
        """Before the first step, at x0 (B, 3) m: the first fix, or exact where `known` (B,)."""
        spread = torch.ones_like(x0) if known is None else 1.0 - known[:, None].to(x0.dtype).expand_as(x0)
        hidden = torch.zeros(x0.numel(), self.hidden, dtype=x0.dtype)
        return Memory(first(x0), x0, spread, torch.zeros_like(x0), hidden, GNSS_STD**2 * spread)

    def step(
        self, memory: Memory, gnss: Tensor, velocity: Tensor, dt: float, late: float | Tensor = 0.0
    ) -> tuple[Memory, Tensor, Tensor]:
        """One step: fix (B, 3) m, NaN where it is missing, velocity (B, 3) m/s, dt s -> memory, x (B, 3), P (B, 3) m^2.

        This is the readable reference of the compiled rollout. late: (B, 3) m^2 that a delayed fix has more.
        """
        levels = after(memory.levels, gnss, velocity, dt)
        r, ratio, told = noise(levels, dt)
        more = 1.0 + late / r
        prior = memory.x + dt * velocity
        there = (gnss - prior).isfinite()
        e = (gnss - prior).nan_to_num(0.0)
        p = memory.spread + ratio
        surprise = e * ((more + p) * r).rsqrt()
        own = torch.stack([0.25 * p.log(), surprise.square().log1p(), (surprise * memory.surprise).tanh()], -1)
        hidden = self.cell(torch.cat([told, own], -1).flatten(0, 1), memory.hidden)
        corrections = LIMIT * (self.heads(hidden) / LIMIT).tanh()
        process, gain, second, claim = corrections.exp().view(*p.shape, HEADS).unbind(-1)
        p = memory.spread + ratio * process
        odds = p * gain / more
        k = there * odds / (1.0 + odds)
        x = prior + k * e
        spread = (1.0 - k).square() * p + k.square() * second * more
        variance = claim * r * spread
        return Memory(levels, x, spread, surprise, hidden, variance), x, variance

    def reference(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Estimates m and variances m^2 (T, B, 3) of this net by plain torch, for a batch of one model (S = 1)."""
        memory, found = self.start(batch.x0[0], None if batch.known is None else batch.known[0]), []
        for fix, speed in zip(batch.gnss[:, 0].unbind(), batch.velocity[:, 0].unbind(), strict=True):
            memory, x, variance = self.step(memory, fix, speed, batch.dt)
            found.append(torch.stack([x, variance]))
        return torch.stack(found, 1).unbind()  # type: ignore[return-value]

    def rollout(self, theta: Tensor, batch: Batch) -> tuple[Tensor, Tensor]:
        """Estimates m and variances m^2 (T, S, B, 3) of S nets theta (S, P), differentiable in theta."""
        if kernel := _kernel():
            found: tuple[Tensor, Tensor] = kernel.rollout(theta, self, batch)
            return found
        rows = []
        for s in range(len(theta)):
            weights = {f"net.{name}": view[0] for name, view in named(theta[s : s + 1], self).items()}
            gnss, velocity, truth = (a[:, s : s + 1] for a in batch[:3])
            alone = Batch(gnss, velocity, truth, batch.x0[s : s + 1], batch.dt,
                          None if batch.known is None else batch.known[s : s + 1])  # fmt: skip
            rows.append(torch.stack(torch.func.functional_call(_Reference(self), weights, (alone,))))
        return torch.stack(rows, 2).unbind()  # type: ignore[return-value]


class _Reference(nn.Module):
    """A net whose forward is its `reference`, to be called with other weights."""

    def __init__(self, net: RecursiveGain) -> None:
        super().__init__()
        self.net = net

    def forward(self, batch: Batch) -> tuple[Tensor, Tensor]:
        return self.net.reference(batch)


def _kernel() -> ModuleType | None:
    """The compiled rollout; None, with one warning, where numba is missing."""
    if not numba_is_there("RecursiveGain runs in plain torch, some fifty times slower than compiled"):
        return None
    from . import recursive_kernel

    return recursive_kernel

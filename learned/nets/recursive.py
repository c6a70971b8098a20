"""RecursiveGain: a Kalman filter per axis whose noise, gain and covariance a small recurrent net corrects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from coopoc.arrays import Floats
from coopoc.methods.stream import Stream, solo_track_of
from coopoc.methods.track import Track, check_options
from coopoc.short_repr import short_repr
from coopoc.world.recording import Recording
from coopoc.world.v2x import NO_MESSAGE, Message

from ..method import divergence
from ..training.clients import Batch
from ..training.machine import one_core
from .gain import Gain, error, has_truth, over_axes, over_time, seed_of, size
from .stack import Layers, flatten, gru, layers

FORGET = 1.0 - 1.0 / 300.0
"""Per step, of sums over fixes: noise that is the same for 30 s at 10 Hz is known to 7 %."""
FADE = 1.0 - 1.0 / 10.0
"""Per step, of sums over velocities: on a turn the noise of an axis changes within a second."""
GNSS_STD, VELOCITY_SHARE = 2.5, 0.1
"""m, and a share of the velocity: the prior before any measurement."""
WEIGHT = 0.7
"""Steps that the prior counts as."""
POOL = 60.0
"""Steps that the mean of the axes counts as in the GNSS variance of each; after n fixes, POOL^2 / (POOL + n)."""
STILL = 0.01
"""m/s, least velocity std, so that an axis that stands still keeps a process noise."""
FEATURES = 6
LIMIT = 3.0
"""Largest correction of a logarithm: at any weights the net stays within exp(+-3) of the filter."""
HEADS = 4
"""Corrections of the net: process variance, odds of the gain, Joseph's second term, claimed GNSS variance."""


class Levels(NamedTuple):
    """The past of a filter in (..., 3): last fix, m; what was driven since, m; last velocity, m/s; and running sums of
    half the squared fix changes, m^2, of their number, of half the squared velocity changes and of the squared
    velocities, (m/s)^2."""

    gnss: Tensor
    driven: Tensor
    velocity: Tensor
    jumps: Tensor
    fixes: Tensor
    turns: Tensor
    squares: Tensor


class Noise(NamedTuple):
    """GNSS variance r (..., 3) m^2, process over GNSS variance q / r, and what a net reads of both (..., 3, 6)."""

    gnss: Tensor
    ratio: Tensor
    features: Tensor


def first(x0: Tensor) -> Levels:
    """Before the first step; x0 (..., 3) m stands for the last fix."""
    one = torch.ones_like(x0)
    return Levels(
        x0,
        0.0 * one,
        torch.nan * one,
        WEIGHT * GNSS_STD**2 * one,
        WEIGHT * one,
        WEIGHT * VELOCITY_SHARE**2 * one,
        WEIGHT * one,
    )


def after(levels: Levels, gnss: Tensor, velocity: Tensor, dt: float) -> Levels:
    """One step later; a missing fix (NaN) leaves the sums over fixes as they were.

    A fix change less what was driven has the variance 2 r + q, a velocity change that of two velocity errors, as true
    velocities hardly change from step to step. The first velocity has none before it and is left out.
    """
    driven, there = levels.driven + dt * velocity, gnss.isfinite()
    jump = gnss - levels.gnss - driven
    turn = velocity - levels.velocity
    return Levels(
        torch.where(there, gnss, levels.gnss),
        torch.where(there, 0.0, driven),
        velocity,
        FORGET * levels.jumps + (0.5 * jump.square()).nan_to_num(0.0),
        FORGET * levels.fixes + jump.isfinite(),
        FADE * levels.turns + (0.5 * turn.square()).nan_to_num(0.0),
        FADE * levels.squares + torch.where(turn.isnan(), 0.0, velocity.square()),
    )


def noise(levels: Levels, dt: float) -> Noise:
    """r = mean of half the squared fix changes, drawn towards that of all axes; q = dt^2 (share u^2 + still^2), share =
    mean squared velocity error over mean squared velocity. Features are logs of standard deviations near unit size."""
    pooled = levels.jumps.sum(-1, keepdim=True) / levels.fixes.sum(-1, keepdim=True)
    weight = POOL**2 / (POOL + levels.fixes)
    gnss = (levels.jumps + weight * pooled) / (levels.fixes + weight)
    share, now = levels.turns / levels.squares, levels.velocity.square()
    ratio = dt**2 * (share * now + STILL**2) / gnss
    speed, error = now.sum(-1, keepdim=True).expand_as(now), (1.0 - FADE) * levels.turns
    features = [gnss, share, now + STILL**2, speed + STILL**2, levels.fixes, error + STILL**2]
    middle = torch.tensor([0.7, -2.3, 1.0, 2.0, 2.0, 0.0], dtype=gnss.dtype)
    return Noise(gnss, ratio, 0.5 * torch.stack(features, -1).log() - middle)


class Memory(NamedTuple):
    """State of S filters of B lanes: noise levels; estimate (S, B, 3) m; its variance relative to that of a fix; last
    normalised innovation; GRU state (S, 3 B, H); variance (S, B, 3) m^2."""

    levels: Levels
    x: Tensor
    relative: Tensor
    innovation: Tensor
    hidden: Tensor
    variance: Tensor


class RecursiveGain(Gain):
    """Gain and error covariance from one GRU per axis, whose weights the three axes share.

    With r and q from running levels of fixes and velocities (`noise`), i = z - x - dt u and c_1..c_4 of the net:
    p = s + e^c_1 q / r;  k = p e^c_2 / (1 + p e^c_2);  x += dt u + k i;  s = (1 - k)^2 p + k^2 e^c_3;  P = e^c_4 r s.
    The relative variance s is that of the estimate over that of a fix, so an estimate of r made while driving also
    applies to older fixes. Before training c = 0: the Kalman filter of these levels. The net reads logarithms of r, q,
    the speed, s, i^2 and the product of the last two normalised innovations: it sees magnitudes, and treats all axes
    and signs alike.

    Args:
        hidden: GRU size.
        seed: of the initial weights; the heads start at zero.

    References:
        Mortada et al., Recursive KalmanNet, EUSIPCO 2025 (arXiv 2506.11639): a gain net and a covariance in Joseph
        form with a learned second term, trained on the Gaussian negative log-likelihood.

    >>> sum(p.numel() for p in RecursiveGain().parameters())
    1364
    """

    def __init__(self, hidden: int = 16, seed: int = 0) -> None:
        super().__init__()
        self.hidden = size("hidden", hidden)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed_of(seed))
            self.cell = nn.GRUCell(FEATURES + 3, hidden)
            self.heads = nn.Linear(hidden, HEADS)
        nn.init.zeros_(self.heads.weight)
        nn.init.zeros_(self.heads.bias)

    def losses(self, theta: Tensor, batch: Batch) -> Tensor:
        """(S, B) negative log-likelihood of the true error without its constant, mean over time, sum over axes."""
        x, variance = self.rollout(theta, batch)
        squares = error(x, batch.truth).square()
        terms = over_axes(0.5 * (squares / variance + variance.log()), batch.truth)
        return over_time(terms, has_truth(batch.truth))

    def rollout(self, theta: Tensor, batch: Batch) -> tuple[Tensor, Tensor]:
        """Estimates m and variances m^2 (T, S, B, 3) of S nets theta (S, P), differentiable in theta."""
        net, memory, estimates = layers(theta, self), self.start(batch.x0, batch.exact), []
        for gnss, velocity in zip(batch.gnss, batch.velocity, strict=True):
            memory = self.step(net, memory, gnss, velocity, batch.dt)
            estimates.append((memory.x, memory.variance))
        x, variance = (torch.stack(part) for part in zip(*estimates, strict=True))
        return x, variance

    def method(self, name: str, x0: Floats | None = None) -> RecursiveFilter:
        """`RecursiveFilter` with this net."""
        return RecursiveFilter(self, name, x0)

    def start(self, x0: Tensor, exact: Tensor | None = None) -> Memory:
        """Before the first step, at x0 (S, B, 3) m: the first fix, or exact where `exact` (S, B)."""
        relative = torch.ones_like(x0) if exact is None else (~exact)[..., None].to(x0.dtype).expand_as(x0)
        hidden = torch.zeros(len(x0), 3 * x0.shape[1], self.hidden, dtype=x0.dtype)
        return Memory(first(x0), x0, relative, torch.zeros_like(x0), hidden, GNSS_STD**2 * relative)

    def step(
        self,
        net: Layers,
        memory: Memory,
        gnss: Tensor,
        velocity: Tensor,
        dt: float,
        late: float | Tensor = 0.0,
    ) -> Memory:
        """One step of S nets.

        Args:
            net: weights, as `stack.layers` gives them.
            memory: before the step.
            gnss: (S, B, 3) m, NaN where a fix is missing.
            velocity: (S, B, 3) m/s.
            dt: s.
            late: (S, B, 3) m^2, additional variance of a delayed fix.
        """
        levels = after(memory.levels, gnss, velocity, dt)
        r, ratio, features = noise(levels, dt)
        more = 1.0 + late / r
        prior = memory.x + dt * velocity
        there = (gnss - prior).isfinite()
        e = (gnss - prior).nan_to_num(0.0)
        p = memory.relative + ratio
        innovation = e * ((more + p) * r).rsqrt()
        own = torch.stack([0.25 * p.log(), innovation.square().log1p(), (innovation * memory.innovation).tanh()], -1)
        hidden = gru(net, "cell", torch.cat([features, own], -1).flatten(1, 2), memory.hidden)
        corrections = LIMIT * (net["heads"](hidden) / LIMIT).tanh()
        process, gain, second, claim = corrections.exp().view(*p.shape, HEADS).unbind(-1)
        p = memory.relative + ratio * process
        odds = p * gain / more
        k = there * odds / (1.0 + odds)
        relative = (1.0 - k).square() * p + k.square() * second * more
        return Memory(levels, prior + k * e, relative, innovation, hidden, claim * r * relative)


class RecursiveState(NamedTuple):
    """The state of a streamed net: its memory, one lane per filter, and the shape (..., 3) of the positions."""

    memory: Memory
    shape: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class SoloRecursive:
    """A net as a `Solo`, in double precision."""

    model: RecursiveGain
    net: Layers

    def begin(self, x: Floats, late: Floats | None) -> RecursiveState:
        """Exact (late None), or with the variance of a fix plus `late` m^2."""
        start, shape = _lanes(x, x.shape), x.shape
        memory = self.model.start(start, torch.full(start.shape[:2], late is None))
        if late is not None:
            more = _lanes(late, shape)
            memory = memory._replace(relative=memory.relative + more / GNSS_STD**2, variance=memory.variance + more)
        return RecursiveState(memory, shape)

    def process(self, velocity: Floats, dt: float) -> Floats:
        """Variance (3,) m^2 of an axis that stands still, from which `advance` takes the length of the step."""
        return np.full(3, (dt * STILL) ** 2)

    @one_core()
    def advance(
        self, state: RecursiveState, moved: Floats, process: Floats, fix: Floats, late: Floats
    ) -> RecursiveState:
        """`RecursiveGain.step`; a fix of NaN only predicts."""
        dt = float(np.sqrt(process[0])) / STILL
        step, measured, more = (_lanes(a, state.shape) for a in (moved / dt, fix, late))
        with torch.inference_mode():
            return RecursiveState(self.model.step(self.net, state.memory, measured, step, dt, more), state.shape)

    def read(self, state: RecursiveState) -> tuple[Floats, Floats]:
        """Position and diagonal covariance."""
        x, variance = (a.numpy().reshape(state.shape) for a in (state.memory.x, state.memory.variance))
        return x, variance[..., None] * np.eye(3)


def _lanes(array: Floats, shape: tuple[int, ...]) -> Tensor:
    return torch.from_numpy(np.broadcast_to(array, shape).reshape(1, -1, 3).astype(np.float64))


@dataclass(frozen=True, eq=False)
class RecursiveFilter:
    """Position and covariance from own fixes and velocities with a RecursiveGain; no messages are exchanged.

    Where a fix is missing it predicts only. It trained at 10 Hz; dt is an input.

    Args:
        model: trained net.
        name: label in tables.
        x0: (R, E, 3) or (E, 3) m, an exact start; None starts at the first fix.

    References:
        Mortada et al., Recursive KalmanNet, EUSIPCO 2025 (arXiv 2506.11639).

    >>> RecursiveFilter(RecursiveGain()).message.payload
    0
    """

    model: RecursiveGain
    name: str = "recursive"
    x0: Floats | None = None
    cooperative: bool = False
    message: Message = NO_MESSAGE

    __repr__ = short_repr

    def __post_init__(self) -> None:
        check_options(self, kinds={"model": RecursiveGain})

    def start(self, x0: npt.ArrayLike | None = None, *, history: float = 10.0) -> Stream[RecursiveState]:
        """The filter as a stream, one step at a time (docs/streaming.md).

        >>> x, covariance = RecursiveFilter(RecursiveGain()).start().step([1.0, 2.0, 0.0], [9.0, 0.0, 0.0], dt=0.1)
        >>> x.tolist(), covariance.trace().item()
        ([1.0, 2.0, 0.0], 18.75)
        """
        return Stream(self._solo(), x0, history)

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Estimates and covariances of the egos; `notes` count the runs that diverged from the fixes."""
        track = solo_track_of(self._solo(), recording, egos, self.x0)
        return replace(track, notes=tuple(divergence(track.x, recording, list(track.egos))))

    def _solo(self) -> SoloRecursive:
        return SoloRecursive(self.model, layers(flatten([self.model]).double(), self.model))

"""NoiseNet: a small net that estimates a vehicle's noise from its own fixes and velocities, and its filter."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from coopoc.arrays import Floats, Ints
from coopoc.errors import InputError
from coopoc.kernels.stars.messages import FORGOTTEN
from coopoc.methods.track import Method, Track
from coopoc.short_repr import short_repr
from coopoc.world.recording import Recording, check_recording
from coopoc.world.v2x import NO_MESSAGE, Message

from ..training.clients import Batch
from ..training.machine import one_core
from .gain import Gain, error, has_truth, over_axes, over_time, seed_of, size
from .stack import flatten, layers, named

MEMORY = 100.0
"""Steps after which a measurement counts 1/e: 10 s at 10 Hz, as long as a training piece."""
GNSS_STD, SHARE, SPEED = 2.5, 0.1, 1.0
"""m, a share of the speed, and the m/s of it: prior of the sums, worth one step."""
SHARED = 5.0
"""Steps that all axes together count in the GNSS std of each."""
EVEN, LEAST = 0.001, 1e-3
"""Regularisation of the two shares where all axes move alike, and where one of them is zero."""


class Guess(NamedTuple):
    """Closed-form estimate that the net corrects, and the net's inputs.

    Attributes:
        gnss: (T, S, B, 3) log of the GNSS std r m.
        axis: (T, S, B, 3) log of a, the velocity noise's share of the axis's velocity.
        speed: (T, S, B, 3) log of b, its share of the speed.
        of_fix: (..., 2) features of the fix.
        of_motion: (..., 5) features of the motion.
    """

    gnss: Tensor
    axis: Tensor
    speed: Tensor
    of_fix: Tensor
    of_motion: Tensor


def evidence(gnss: Tensor, velocity: Tensor, dt: float) -> Tensor:
    """Sums over fixes and velocities (T, ..., 3) that depend on their noise and on no filter, (4, T, ..., 3).

    Forgetting sums up to each step, per axis, of
    0, 1: (z_t - z_s - dt sum_{s < i <= t} u_i)^2, s the fix before, whose mean is 2 r^2 + (t - s) q, and their number;
    2, 3: (u_t - 2 u_{t-1} + u_{t-2})^2 / 6, which is noise alone where the true velocity is smooth, and u_t^2.
    The first velocity is left out: a filter that starts at the first fix never uses it. NaN adds nothing.
    """
    jump = jumps_of(gnss, velocity, dt)
    second_difference = velocity[3:] - 2.0 * velocity[2:-1] + velocity[1:-2]
    sums = torch.zeros((len(gnss), 4, *gnss.shape[1:]), dtype=gnss.dtype)
    sums[1:, 0], sums[1:, 1] = jump.square().nan_to_num(0.0), jump.isfinite().to(gnss.dtype)
    sums[3:, 2] = (second_difference.square() / 6.0).nan_to_num(0.0)
    sums[3:, 3] = torch.where(second_difference.isfinite(), velocity[3:].square(), 0.0)
    for before, now in pairwise(sums):
        now.add_(before, alpha=1.0 - 1.0 / MEMORY)
    return sums.transpose(0, 1)


def jumps_of(gnss: Tensor, velocity: Tensor, dt: float) -> Tensor:
    """Change (T - 1, ..., 3) m of each fix against the fix before, less what was driven since; NaN without both.

    >>> jumps_of(torch.tensor([1.0, torch.nan, 5.0]), torch.ones(3), 1.0).tolist()
    [nan, 2.0]
    """
    if gnss.isfinite().all():
        return gnss[1:] - gnss[:-1] - dt * velocity[1:]
    expected, rows = gnss[0], []
    for fix, speed in zip(gnss[1:], velocity[1:], strict=True):
        expected = expected + dt * speed
        rows.append(fix - expected)
        expected = torch.where(fix.isfinite(), fix, expected)
    return torch.stack(rows)


def guess(gnss: Tensor, velocity: Tensor, dt: float) -> Guess:
    """Closed-form noise of fixes and velocities (T, S, B, 3).

    r per axis, drawn to that of all axes while little was seen. The velocity's noise variance is a^2 u_i^2 + b^2 |u|^2
    on axis i: a line over the axis's share of the squared speed, fitted to the three axes.
    """
    jumps, count, second_differences, moved = evidence(gnss, velocity, dt)
    unseen = SHARED / (count + SHARED)
    all_jumps = (jumps.sum(-1, keepdim=True) + 2.0 * GNSS_STD**2) / (count.sum(-1, keepdim=True) + 1.0)
    r = 0.5 * torch.log((jumps + SHARED * all_jumps) / (2.0 * (count + SHARED)))
    driven = moved.sum(-1, keepdim=True) + SPEED**2
    noise, part = (second_differences + SHARE**2 * SPEED**2 / 3.0) / driven, (moved + SPEED**2 / 3.0) / driven
    mean = noise.mean(-1, keepdim=True)
    slope = ((part * noise).sum(-1, keepdim=True) - mean) / (part.square().sum(-1, keepdim=True) - 1.0 / 3.0 + EVEN)
    slope = torch.minimum(slope.clamp(min=0.0), 3.0 * mean)
    a, b = (0.5 * torch.log(square + LEAST**2).expand_as(r) for square in (slope, mean - slope / 3.0))
    now = velocity.nan_to_num(0.0).square() + 0.01
    speed = now.sum(-1, keepdim=True)
    motions = [
        0.5 * (a - math.log(SHARE)),
        0.3 * (b - math.log(SHARE)),
        0.25 * torch.log(driven / SPEED**2),
        torch.log(now / speed) / 8.0,
        0.25 * torch.log(speed),
    ]
    of_motion = torch.stack([feature.expand_as(r) for feature in motions], -1)
    return Guess(r, a, b, torch.stack([unseen * (r - math.log(GNSS_STD)), unseen], -1), of_motion)


class Variances(NamedTuple):
    """Estimated noise variances (T, S, B, 3) m^2: of each fix, and of the motion into each step."""

    fix: Tensor
    process: Tensor


class NoiseNet(Gain):
    """Noise of every fix and velocity from one small net for all axes; what filters with it is Kalman's.

    var z_t = exp(2 (r + c_1)), q_t = dt^2 (exp(2 (a + c_2)) u_t^2 + exp(2 (b + c_3)) |u_t|^2 + exp(2 (f - 5))):
    r, a and b from `guess`, corrections c from one hidden layer, 0 before training, and f trained. Nothing depends on
    the state of a filter: any filter may use it, the net cannot make one unstable, and all steps are computed at once.

    Args:
        hidden: width.
        seed: of the initial weights.

    References:
        Haarnoja et al., Backprop KF, NeurIPS 2016 (training through the recursion).

    >>> sum(p.numel() for p in NoiseNet().parameters())
    100
    """

    def __init__(self, hidden: int = 8, seed: int = 0) -> None:
        super().__init__()
        self.hidden = size("hidden", hidden)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed_of(seed))
            self.fix_hidden, self.fix = nn.Linear(2, hidden), nn.Linear(hidden, 1)
            self.motion_hidden, self.motion = nn.Linear(5, hidden), nn.Linear(hidden, 2)
        for last in (self.fix, self.motion):
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)
        self.floor = nn.Parameter(torch.zeros(1))

    def variances(self, theta: Tensor, gnss: Tensor, velocity: Tensor, dt: float) -> Variances:
        """Variances by S nets theta (S, P) from fixes and velocities (T, S, B, 3) m and m/s, NaN where missing."""
        with torch.no_grad():
            features = guess(gnss, velocity, dt)
        net, floor = layers(theta, self), torch.exp(2.0 * named(theta, self)["floor"] - 10.0)
        steps, models, *rest = features.gnss.shape
        of_fix, of_motion = (f.transpose(0, 1).reshape(models, -1, f.shape[-1]) for f in features[3:])
        out = [net["fix"](net["fix_hidden"](of_fix).tanh()), net["motion"](net["motion_hidden"](of_motion).tanh())]
        fix, axis, speed = torch.cat(out, 2).view(models, steps, *rest, 3).transpose(0, 1).unbind(-1)
        square = velocity.nan_to_num(0.0).square()
        noise = torch.exp(2.0 * (features.axis + axis)) * square
        noise = noise + torch.exp(2.0 * (features.speed + speed)) * square.sum(-1, keepdim=True)
        return Variances(torch.exp(2.0 * (features.gnss + fix)), dt**2 * (noise + floor[:, None]))

    def losses(self, theta: Tensor, batch: Batch) -> Tensor:
        """(S, B) Gaussian negative log-likelihood of the true error, mean over time, sum over components."""
        gnss = torch.cat([batch.x0[None], batch.gnss])
        velocity = torch.cat([batch.velocity[:1], batch.velocity])
        noise = self.variances(theta, gnss, velocity, batch.dt)
        x, relative = filtered(gnss, velocity, noise, batch.dt, batch.exact)
        squares = error(x[1:], batch.truth).square()
        terms = over_axes(0.5 * (squares / relative[1:] + relative[1:].log()), batch.truth)
        return over_time(terms, has_truth(batch.truth))

    def method(self, name: str, x0: Floats | None = None) -> Method:
        """`NoiseFilter` with this net."""
        return NoiseFilter(self, name, x0)


def filtered(
    gnss: Tensor, velocity: Tensor, noise: Variances, dt: float, exact: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Kalman filter per axis whose past is revised with its noise: estimate and variance (T, S, B, 3) m, m^2.

    p = s r_t + q_t;  k = p / (p + r_t);  x += k (z - x);  s = k. The relative variance s is that of the estimate over
    that of a fix, so a new r_t rescales the weight of older fixes: gains depend on q / r alone, as they should while r
    is one unknown number. Where a fix is missing (NaN), k = 0 and s = p / r_t.

    Args:
        gnss: (T, S, B, 3) m.
        velocity: (T, S, B, 3) m/s.
        noise: variances.
        dt: s.
        exact: (S, B) where gnss[0] is the exact start.
    """
    x, relative = gnss[0], FORGOTTEN / (FORGOTTEN + noise.fix[0])
    if exact is not None:
        relative = torch.where(exact[..., None], 0.0, relative)
    xs, ps, whole = [x], [relative * noise.fix[0]], bool(gnss.isfinite().all())
    rows = (gnss[1:], dt * velocity[1:], noise.fix[1:], noise.process[1:])
    for z, move, fix, process in zip(*rows, strict=True):
        x, p = x + move, torch.addcmul(process, relative, fix)
        relative = p / (p + fix)
        if whole:
            x = torch.addcmul(x, relative, z - x)
        else:
            there = z.isfinite()
            x = torch.addcmul(x, relative, torch.where(there, z - x, 0.0))
            relative = torch.where(there, relative, p / fix)
        xs.append(x)
        ps.append(relative * fix)
    return torch.stack(xs), torch.stack(ps)


@dataclass(frozen=True, eq=False)
class NoiseFilter:
    """Position from own fixes and velocities by a Kalman filter with the noise that a NoiseNet estimates.

    Args:
        model: trained net.
        name: label in tables.
        x0: (R, E, 3) or (E, 3) m, an exact start; None starts at the first fix.

    >>> NoiseFilter(NoiseNet()).message.payload
    0
    """

    model: NoiseNet
    name: str = "noise-net"
    x0: Floats | None = None
    cooperative: bool = False
    message: Message = NO_MESSAGE

    __repr__ = short_repr

    @one_core()
    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Estimates and covariances of the egos; InputError if one is unknown or absent, or x0 has another shape."""
        began, columns = time.perf_counter(), check_recording(recording).columns(egos, missing=True)
        gnss, velocity = (lanes(a[:, :, columns]) for a in (recording.gnss, recording.velocity))
        theta = flatten([self.model]).double()
        with torch.inference_mode():
            noise = self.model.variances(theta, gnss, velocity, recording.dt)
            exact = None
            if self.x0 is not None:
                gnss[0], exact = self._start(gnss[0], recording.runs), torch.ones(gnss.shape[1:3], dtype=torch.bool)
            x, p = (runs(a, recording.runs) for a in filtered(gnss, velocity, noise, recording.dt, exact))
        silent = np.zeros((recording.runs, len(columns)))
        seconds = time.perf_counter() - began
        return Track(
            recording.t, tuple(columns), x, p[..., None] * np.eye(3), silent, silent, seconds, ids=recording.ids
        )

    def _start(self, fixes: Tensor, count: int) -> Tensor:
        shape = (count, fixes.shape[1] // count, 3)
        given = np.asarray(self.x0, dtype=float)
        if given.shape not in (shape, shape[1:]):
            allowed = f"must be (R, E, 3) = {shape} or (E, 3)"
            raise InputError("x0", f"shape {given.shape}", allowed, "Give one position per ego.")
        return torch.from_numpy(np.broadcast_to(given, shape).reshape(1, -1, 3).copy())


def estimate_noise(
    model: NoiseNet, recording: Recording, vehicles: Sequence[int] | Ints | None = None
) -> tuple[Floats, Floats]:
    """Variances of fixes and of motion (R, T, N, 3) m^2 by the net on board of each vehicle, default all; run by run.

    Those of the other vehicles are NaN.
    """
    columns = np.arange(recording.gnss.shape[2]) if vehicles is None else np.asarray(vehicles, dtype=np.int64)
    theta, (fix, process) = flatten([model]).double(), np.full((2, *recording.gnss.shape), np.nan)
    with one_core(), torch.inference_mode():
        for run in range(recording.runs):
            gnss, velocity = (lanes(a[run][None, :, columns]) for a in (recording.gnss, recording.velocity))
            noise = model.variances(theta, gnss, velocity, recording.dt)
            for target, part in zip((fix, process), noise, strict=True):
                target[run, :, columns] = np.moveaxis(runs(part, 1)[0], 1, 0)
    return fix, process


def lanes(array: Floats) -> Tensor:
    """(R, T, E, 3) as (T, 1, R E, 3).

    >>> lanes(np.zeros((2, 5, 3, 3))).shape
    torch.Size([5, 1, 6, 3])
    """
    flat = np.moveaxis(array, 1, 0).reshape(array.shape[1], 1, -1, 3)
    return torch.from_numpy(np.array(flat, dtype=np.float64))


def runs(tensor: Tensor, count: int) -> Floats:
    """(T, 1, R E, 3) as (R, T, E, 3) of R = `count` runs.

    >>> runs(torch.zeros(5, 1, 6, 3), 2).shape
    (2, 5, 3, 3)
    """
    rows: Floats = np.moveaxis(tensor[:, 0].numpy().reshape(len(tensor), count, -1, 3), 0, 1)
    return rows

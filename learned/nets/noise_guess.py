"""Noise of fixes and velocities in closed form, from forgetting sums: what a NoiseNet corrects, and what it sees."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

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

"""Levels: running sums over fixes and velocities that estimate a vehicle's noise without a filter."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

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
    seen = [gnss, share, now + STILL**2, speed + STILL**2, levels.fixes, error + STILL**2]
    middle = torch.tensor([0.7, -2.3, 1.0, 2.0, 2.0, 0.0], dtype=gnss.dtype)
    return Noise(gnss, ratio, 0.5 * torch.stack(seen, -1).log() - middle)

"""The compiled engine of GainNet: rollouts of many models as a function of theta that torch can differentiate."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from coopoc.arrays import AnyArray, Ints
from coopoc.errors import InputError

from ..nets.gain_net import CELLS, SIZE, GainNet
from ..training.machine import threads
from . import backward as kernel_backward
from . import forward as kernel_forward

NAMES = ("update.weight", "evolution.weight", "observation.weight", "process.weight_ih", "process.weight_hh",
         "prior.weight_ih", "prior.weight_hh", "prior_to_innovation.weight", "innovation.weight_ih",
         "innovation.weight_hh", "gain_hidden.weight", "gain.weight", "posterior_hidden.weight",
         "posterior.weight")  # fmt: skip
"""The layers in the order of the kernels."""
PRODUCT = 256
"""Rows of one weight-gradient product, about as many as stay in the cache until it."""
OTHER_WIDTHS = (CELLS, 4 * CELLS, 4 * CELLS, 4 * CELLS, 4, SIZE)
"""Of the fields of the tape that the kernels name after what the layers read."""


def rollout(theta: Tensor, like: GainNet, gnss: Tensor, velocity: Tensor, x0: Tensor, dt: float | Tensor) -> Tensor:
    """Estimates x (T, S, B, 3) m of S models with weights theta (S, P): `GainNet.step`, T times, compiled.

    x_t = x_{t-1} + dt u_t + K_t (z_t - x_{t-1} - dt u_t). Differentiable in theta and in nothing else, by
    backpropagation through time that is written out. The numbers of a model do not depend on the others, nor on the
    number of threads.

    Args:
        like: net whose shape the rows have. gnss, velocity: (T, S, B, 3) m, m/s. x0: (S, B, 3) m. dt: s, or (T,).

    Raises:
        InputError: arrays that do not fit together, or theta neither float32 nor float64 in main memory.

    Source: arXiv 2411.05847, equations 4-6; Werbos, Proc. IEEE 1990 (backpropagation through time).

    >>> still = torch.zeros(5, 1, 2, 3)
    >>> rollout(torch.zeros(1, 19938), GainNet(), still, still, still[0], 0.1).abs().max().item()
    0.0
    """
    seen = _checked(theta, like, gnss, velocity, x0, dt)
    if theta.requires_grad and torch.is_grad_enabled():
        x: Tensor = _Rollout.apply(theta, like, seen)  # type: ignore[no-untyped-call]
        return x
    return torch.from_numpy(_forward(theta, like, seen, keep=False)[0])


class _Seen(NamedTuple):
    """Inputs of a rollout as the kernels take them, dt (T,)."""

    gnss: AnyArray
    velocity: AnyArray
    x0: AnyArray
    dt: AnyArray


class _Rollout(torch.autograd.Function):
    """The kernels as one operation of torch."""

    @staticmethod
    def forward(ctx: Any, theta: Tensor, like: GainNet, seen: _Seen) -> Tensor:
        x, ctx.memory, ctx.fields = _forward(theta, like, seen, keep=True)
        ctx.save_for_backward(theta)
        ctx.layers, ctx.gnss = _layers(like), seen.gnss
        return torch.from_numpy(x)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, pulls: Tensor) -> tuple[Tensor, None, None]:
        (theta,) = ctx.saved_tensors
        lanes, steps = ctx.gnss.shape[2], len(pulls)
        fields, size = _table(ctx.layers[:, 2], lanes, min(steps, -(-PRODUCT // lanes)))
        gradient, deltas = torch.empty_like(theta), np.empty((len(theta), size), ctx.memory.dtype)
        _spread(kernel_backward.backward, len(theta), theta.detach().numpy(), ctx.layers, ctx.gnss,
                pulls.contiguous().numpy(), ctx.memory, ctx.fields, deltas, fields, gradient.numpy())  # fmt: skip
        return gradient, None, None


def _forward(theta: Tensor, like: GainNet, seen: _Seen, keep: bool) -> tuple[AnyArray, AnyArray, Ints]:
    """Estimates (T, S, B, 3), the memory (S, size) of the tape, which keeps every step or the last, and its table."""
    layers, x = _layers(like), np.empty_like(seen.gnss)
    widths = np.concatenate([layers[:, 3], OTHER_WIDTHS])
    fields, size = _table(widths, x.shape[2], len(x) if keep else 1)
    memory = np.empty((len(theta), size), x.dtype)
    _spread(kernel_forward.forward, len(theta), theta.detach().numpy(), layers, *seen, memory, fields, x)
    return x, memory, fields


def _table(widths: Ints, lanes: int, slots: int) -> tuple[Ints, int]:
    """(fields, 3): where each begins, its width, its slots; and the size of all."""
    ends = np.cumsum(lanes * widths * slots)
    return np.stack([ends - lanes * widths * slots, widths, np.full_like(widths, slots)], axis=1), int(ends[-1])


def _layers(like: GainNet) -> Ints:
    """(layers, 4): where weight and bias begin in flat weights, outputs, inputs."""
    return _known(tuple(like.settings.items()))


@cache
def _known(settings: tuple[tuple[str, Any], ...]) -> Ints:
    begin, shapes, at = {}, {}, 0
    for name, parameter in GainNet(**dict(settings)).named_parameters():
        begin[name], shapes[name] = at, parameter.shape
        at += parameter.numel()
    return np.array([[begin[name], begin[name.replace("weight", "bias")], *shapes[name]] for name in NAMES])


def _spread(kernel: Callable[..., None], models: int, *arguments: Any) -> None:
    """Run a kernel over all models, a share of them in each thread."""
    shares = min(threads(), models)
    cuts = [models * share // shares for share in range(shares + 1)]
    if shares == 1:
        kernel(*arguments, 0, models)
        return
    jobs = [_pool(shares).submit(kernel, *arguments, *cut) for cut in pairwise(cuts)]
    for job in jobs:
        job.result()


@cache
def _pool(workers: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(workers, "rollout")


def _checked(theta: Tensor, like: GainNet, gnss: Tensor, velocity: Tensor, x0: Tensor, dt: float | Tensor) -> _Seen:
    """The inputs as contiguous arrays of theta's dtype."""
    if theta.dtype not in (torch.float32, torch.float64) or theta.device.type != "cpu":
        given = f"{theta.dtype} on {theta.device}"
        raise InputError("theta", given, "must be float32 or float64 in main memory", "Use theta.cpu().float().")
    steps, models, lanes = gnss.shape[:3]
    count = sum(p.numel() for p in like.parameters())
    wanted = {"theta": (theta, (models, count)), "gnss": (gnss, (steps, models, lanes, 3)),
              "velocity": (velocity, gnss.shape), "x0": (x0, gnss.shape[1:])}  # fmt: skip
    for name, (array, shape) in wanted.items():
        if array.shape != shape:
            raise InputError(name, f"shape {tuple(array.shape)}", f"must be {tuple(shape)}", "See rollout.")
    spans = torch.as_tensor(dt, dtype=theta.dtype)
    if spans.shape not in ((), (steps,)):
        raise InputError("dt", f"shape {tuple(spans.shape)}", f"must be one number or ({steps},)", "Give s per step.")
    fixes, speeds, start = (array.detach().to(theta.dtype).contiguous().numpy() for array in (gnss, velocity, x0))
    return _Seen(fixes, speeds, start, spans.expand(steps).contiguous().numpy())

"""The compiled engine of GainNet: rollouts of many models as a function of theta that torch can differentiate."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from coopoc.arrays import AnyArray, Floats, Ints
from coopoc.errors import InputError

from ..nets.gain_net import GainNet
from ..training.clients import Batch
from ..training.machine import threads
from ..training.schedule import Moving, Schedule
from . import backward as kernel_backward
from . import descent as kernel_descent
from . import forward as kernel_forward
from .arithmetic import PAD
from .layout import Plan, plan_of

PRODUCT = 128
"""Rows of one weight-gradient product, so few that they stay in the cache until it."""


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
    plan = plan_of(tuple(like.settings.items()))
    seen = _checked(theta, len(theta), plan.parameters, gnss, velocity, x0, dt)
    if theta.requires_grad and torch.is_grad_enabled():
        x: Tensor = _Rollout.apply(theta, plan, seen)  # type: ignore[no-untyped-call]
        return x
    return torch.from_numpy(_forward(theta, plan, seen, keep=False)[0])


def loss_and_gradient(theta: Tensor, like: GainNet, batch: Batch) -> tuple[Tensor, Tensor]:
    """Squared error (S,) m^2, mean over time and batch, sum over components, and its gradient (S, P); as `rollout`.

    It does without torch's graph, whose bookkeeping takes a fifth as long as one trajectory.

    >>> still = torch.zeros(5, 1, 2, 3)
    >>> loss_and_gradient(torch.zeros(1, 19938), GainNet(), Batch(still, still, still, still[0], 0.1))[0]
    tensor([0.])
    """
    weights, none = _array(theta, theta.dtype), np.empty(0)
    law = weights, weights, weights, 0, none, 0.0, 0.0, 0.0, 0.0, none.astype(np.bool_)
    found, gradient = _descend(weights, np.arange(len(weights)), like, theta, batch, law)
    return torch.from_numpy(found), torch.from_numpy(gradient)


def descend(
    moving: Moving, rows: Ints, like: GainNet, batch: Batch, step: int, rates: Floats, schedule: Schedule
) -> tuple[Tensor, Tensor]:
    """One optimiser step in place of the rows (R,) of theta and moments, as `Gain.descend`."""
    weights, began, first, second = (a.numpy() for a in moving)
    finite = np.empty(len(rows), np.bool_)
    law = float(schedule.weight_decay), float(schedule.l2), float(schedule.proximal), float(schedule.clip), finite
    found, _ = _descend(weights, rows, like, moving.theta, batch, (began, first, second, step, rates, *law))
    return torch.from_numpy(found), torch.from_numpy(finite)


def _descend(
    weights: AnyArray, rows: Ints, like: GainNet, theta: Tensor, batch: Batch, law: tuple[Any, ...]
) -> tuple[AnyArray, AnyArray]:
    """Losses (R,) and gradients (R, P), and if the law says so an optimiser step."""
    plan = plan_of(tuple(like.settings.items()))
    seen = _checked(theta, len(rows), plan.parameters, batch.gnss, batch.velocity, batch.x0, batch.dt)
    truth = _array(batch.truth, theta.dtype)
    if truth.shape != seen.gnss.shape:
        raise InputError("truth", f"shape {truth.shape}", f"must be {seen.gnss.shape}", "Give one position per fix.")
    steps, models, lanes, _ = truth.shape
    together = min(steps, -(-PRODUCT // lanes))
    tape, deltas = plan.tape(lanes, steps, together), plan.deltas(lanes, together)
    sizes = plan.size, tape.kept, tape.passing, deltas.passing
    losses, gradient = np.empty(models, truth.dtype), np.empty((models, plan.parameters), truth.dtype)
    _spread(kernel_descent.descend, models, weights, rows, plan.layers, plan.places, seen.gnss, seen.velocity, truth,
            seen.x0, seen.dt, tape.fields, deltas.fields, sizes, together, gradient, losses, *law)  # fmt: skip
    return losses, gradient


class _Seen(NamedTuple):
    """Inputs of a rollout as the kernels take them, dt (T,)."""

    gnss: AnyArray
    velocity: AnyArray
    x0: AnyArray
    dt: AnyArray


class _Rollout(torch.autograd.Function):
    """The kernels as one operation of torch."""

    @staticmethod
    def forward(ctx: Any, theta: Tensor, plan: Plan, seen: _Seen) -> Tensor:
        x, *ctx.left = _forward(theta, plan, seen, keep=True)
        ctx.save_for_backward(theta)
        ctx.plan, ctx.gnss = plan, seen.gnss
        return torch.from_numpy(x)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, pulls: Tensor) -> tuple[Tensor, None, None]:
        (theta,) = ctx.saved_tensors
        return _backward(theta, ctx.plan, ctx.gnss, pulls.contiguous().numpy(), *ctx.left), None, None


def _forward(theta: Tensor, plan: Plan, seen: _Seen, keep: bool) -> tuple[AnyArray, AnyArray, AnyArray]:
    """Estimates (T, S, B, 3), and for backward matrices (S, .) and the tape (S, .) of all steps, or of the last."""
    x, (steps, models, lanes, _) = np.empty_like(seen.gnss), seen.gnss.shape
    tape = plan.tape(lanes, steps if keep else 1)
    padded, kept = _aligned(models, plan.size, x.dtype), _aligned(models, tape.kept, x.dtype)
    _spread(kernel_forward.forward, models, _array(theta, theta.dtype), padded, plan.layers, plan.places, *seen, kept,
            tape.fields, tape.passing, int(keep), x)  # fmt: skip
    return x, padded, kept


def _backward(
    theta: Tensor, plan: Plan, gnss: AnyArray, pulls: AnyArray, padded: AnyArray, kept: AnyArray
) -> Tensor:  # fmt: skip
    """Gradient (S, P) from that of the estimates, `pulls` (T, S, B, 3)."""
    (steps, models, lanes, _), gradient = pulls.shape, torch.empty_like(theta)
    together = min(steps, -(-PRODUCT // lanes))
    tape, deltas = plan.tape(lanes, steps, together), plan.deltas(lanes, together)
    _spread(kernel_backward.backward, models, _array(theta, theta.dtype), padded, plan.layers, plan.places, gnss, pulls,
            kept, tape.fields, tape.passing, deltas.fields, deltas.passing, together, gradient.numpy())  # fmt: skip
    return gradient


def _aligned(models: int, size: int, dtype: np.dtype[Any]) -> AnyArray:
    """Memory (S, size) whose rows begin where a vector may begin."""
    memory = np.empty(models * size + PAD, dtype)
    first = -(memory.ctypes.data // memory.itemsize) % PAD
    return memory[first : first + models * size].reshape(models, size)


def _spread(kernel: Callable[..., None], models: int, *arguments: Any) -> None:
    """Run a kernel over all models, a share of them in each thread."""
    shares = max(1, min(threads(), models))
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


os.register_at_fork(after_in_child=_pool.cache_clear)  # a forked process has none of its parent's threads


def _checked(
    theta: Tensor, models: int, parameters: int, gnss: Tensor, velocity: Tensor, x0: Tensor, dt: float | Tensor
) -> _Seen:
    """The inputs of so many models as contiguous arrays of theta's dtype."""
    if theta.dtype not in (torch.float32, torch.float64) or theta.device.type != "cpu":
        found = f"{theta.dtype} on {theta.device}"
        raise InputError("theta", found, "must be float32 or float64 in main memory", "Use theta.cpu().float().")
    steps, lanes = gnss.shape[0], gnss.shape[2]
    wanted = {"theta": (theta, (len(theta), parameters)), "gnss": (gnss, (steps, models, lanes, 3)),
              "velocity": (velocity, (steps, models, lanes, 3)), "x0": (x0, (models, lanes, 3))}  # fmt: skip
    for name, (array, shape) in wanted.items():
        if array.shape != shape:
            raise InputError(name, f"shape {tuple(array.shape)}", f"must be {shape}", "See rollout.")
    fixes, speeds, start = _array(gnss, theta.dtype), _array(velocity, theta.dtype), _array(x0, theta.dtype)
    spans = np.full(steps, dt, fixes.dtype) if isinstance(dt, float) else np.asarray(dt, dtype=fixes.dtype)
    if spans.shape not in ((), (steps,)):
        raise InputError("dt", f"shape {spans.shape}", f"must be one number or ({steps},)", "Give s per step.")
    return _Seen(fixes, speeds, start, np.broadcast_to(spans, steps).copy() if spans.ndim == 0 else spans)


def _array(tensor: Tensor, dtype: torch.dtype) -> AnyArray:
    """The same numbers as a contiguous array; what is one is not asked twice, which takes as long as a step."""
    if tensor.dtype != dtype or not tensor.is_contiguous() or tensor.requires_grad:
        tensor = tensor.detach().to(dtype).contiguous()
    array: AnyArray = tensor.numpy()
    return array

"""The compiled engine of GainNet: rollouts of many models, their losses and gradients."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from coopoc import InputError
from coopoc.arrays import AnyArray

from ..training.clients import Batch
from . import backward, forward
from .forward import Drives
from .layers import Shapes, plan_of
from .optimiser import Moments, Outcome, Update


def rollout(theta: Tensor, shapes: Shapes, gnss: Tensor, velocity: Tensor, x0: Tensor, dt: float | Tensor) -> Tensor:
    """Estimates x (T, S, B, 3) m of S models with weights theta (S, P): `GainNet.step`, T times, compiled.

    x_t = x_{t-1} + dt u_t + K_t (z_t - x_{t-1} - dt u_t). The numbers of a model do not depend on the others. It has no
    gradient for torch: `loss_and_gradient` and `descend` compute that of the squared error.

    Args:
        theta: (S, P) weights.
        shapes: of the net's parameters, as `GainNet.shapes`.
        gnss: (T, S, B, 3) m.
        velocity: (T, S, B, 3) m/s.
        x0: (S, B, 3) m.
        dt: s, or (T,) s.

    Raises:
        InputError: arrays that do not fit together, or theta neither float32 nor float64 in main memory.

    References:
        arXiv 2411.05847, equations 4-6.

    >>> from coopoc.learned import GainNet
    >>> still = torch.zeros(5, 1, 2, 3)
    >>> rollout(torch.zeros(1, 19938), GainNet().shapes, still, still, still[0], 0.1).abs().max().item()
    0.0
    """
    drives = _checked(theta, shapes, len(theta), gnss, velocity, x0, dt)
    x = np.empty_like(drives.gnss)
    forward.forward(_array(theta, theta.dtype), plan_of(shapes), drives, x)
    return torch.from_numpy(x)


def loss_and_gradient(theta: Tensor, shapes: Shapes, batch: Batch) -> tuple[Tensor, Tensor]:
    """Squared error (S,) m^2, mean over time and batch, sum over components, and its gradient (S, P); as `rollout`.

    References:
        Werbos, Proc. IEEE 1990 (backpropagation through time).

    >>> from coopoc.learned import GainNet
    >>> still = torch.zeros(5, 1, 2, 3)
    >>> loss_and_gradient(torch.zeros(1, 19938), GainNet().shapes, Batch(still, still, still, still[0], 0.1))[0]
    tensor([0.])
    """
    update = Update(np.arange(len(theta)), 0, np.empty(0), 0.0, 0.0)
    outcome = descend(Moments(*[_array(theta, theta.dtype)] * 3), shapes, batch, update)
    return torch.from_numpy(outcome.losses), torch.from_numpy(outcome.gradient)


def descend(moments: Moments, shapes: Shapes, batch: Batch, update: Update) -> Outcome:
    """Losses (R,) and gradients (R, P) of the rows, and an optimiser step if the update asks for one."""
    theta, plan, models = torch.from_numpy(moments.theta), plan_of(shapes), len(update.rows)
    drives = _checked(theta, shapes, models, batch.gnss, batch.velocity, batch.x0, batch.dt)
    truth = _array(batch.truth, theta.dtype)
    if truth.shape != drives.gnss.shape:
        raise InputError("truth", f"shape {truth.shape}", f"must be {drives.gnss.shape}", "Give one position per fix.")
    gradient, losses = np.empty((models, plan.places.shape[1]), truth.dtype), np.empty(models, truth.dtype)
    outcome = Outcome(gradient, losses, np.empty(models, np.bool_))
    backward.descend(moments, plan, drives, truth, outcome, update)
    return outcome


def _checked(theta: Tensor, shapes: Shapes, models: int, gnss: Tensor, velocity: Tensor, x0: Tensor, dt: Any) -> Drives:
    """The inputs of so many models as contiguous arrays of theta's dtype."""
    if theta.dtype not in (torch.float32, torch.float64) or theta.device.type != "cpu":
        actual = f"{theta.dtype} on {theta.device}"
        raise InputError("theta", actual, "must be float32 or float64 in main memory", "Use theta.cpu().float().")
    steps, lanes = gnss.shape[0], gnss.shape[2]
    wanted = {
        "theta": (theta, (len(theta), plan_of(shapes).places.shape[1])),
        "gnss": (gnss, (steps, models, lanes, 3)),
        "velocity": (velocity, (steps, models, lanes, 3)),
        "x0": (x0, (models, lanes, 3)),
    }
    for name, (array, shape) in wanted.items():
        if array.shape != shape:
            raise InputError(name, f"shape {tuple(array.shape)}", f"must be {shape}", "See rollout.")
    fixes, speeds, start = _array(gnss, theta.dtype), _array(velocity, theta.dtype), _array(x0, theta.dtype)
    spans = np.asarray(dt, fixes.dtype)
    if spans.shape not in ((), (steps,)):
        raise InputError("dt", f"shape {spans.shape}", f"must be one number or ({steps},)", "Give s per step.")
    return Drives(fixes, speeds, start, np.broadcast_to(spans, steps).copy())


def _array(tensor: Tensor, dtype: torch.dtype) -> AnyArray:
    """The same numbers as a contiguous array, without a copy where possible."""
    if tensor.dtype != dtype or not tensor.is_contiguous() or tensor.requires_grad:
        tensor = tensor.detach().to(dtype).contiguous()
    return tensor.numpy()

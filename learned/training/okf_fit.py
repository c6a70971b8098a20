"""fit_okf: train the nine parameters of an OptimisedKF on all segments at once, in double precision."""

import math
import time
from typing import Any

import torch
from torch import Tensor

from ..nets.gain import over_time
from ..nets.okf import NoiseParameters, log_scale, scan
from .clients import Batch, Segments
from .fit import padded
from .machine import one_core, watched


@one_core()
def fit_okf(
    training: Segments,
    validation: Segments,
    steps: int = 300,
    progress: str | None = None,
) -> tuple[NoiseParameters, dict[str, Any]]:
    """Train noise parameters by gradient through the Kalman recursion on 1/T sum_t ||xhat_t - x_t||^2.

    The estimates depend on ratios of variances only, so the loss cannot see a common factor per axis; that factor is
    set afterwards so that the training innovations have the variance that the filter claims for them.

    Args:
        training: segments to train on.
        validation: segments that select the parameters.
        steps: of Adam on all training segments.
        progress: name of the stage of a progress bar on stderr.

    Returns:
        The trained parameters; the validation loss per check, m^2, and the training seconds.

    >>> import numpy as np
    >>> from coopoc.learned import clients
    >>> from coopoc.world.fleet import Fleet
    >>> (only,) = clients(Fleet(("a",), np.arange(33) / 10, np.zeros((33, 1, 3)), np.zeros((33, 1, 3))), piece=10)
    >>> len(fit_okf(only.training, only.validation, steps=2)[1]["validation_loss"])
    2
    """
    began, like = time.perf_counter(), NoiseParameters()
    data, judge = (_doubled(*padded([part])) for part in (training, validation))
    logs = like.logs.detach().double().reshape(1, -1).clone().requires_grad_()
    adam = torch.optim.Adam([logs], lr=0.1)
    fall = torch.optim.lr_scheduler.CosineAnnealingLR(adam, steps)
    best, history = logs.detach().clone(), list[float]()
    for step in watched(range(steps), progress, "step"):
        if step % 25 == 0 or step == steps - 1:
            with torch.no_grad():
                validated = float(_loss(like, logs, *judge))
            best = logs.detach().clone() if validated < min(history, default=math.inf) else best
            history.append(validated)
        adam.zero_grad()
        _loss(like, logs, *data).backward()
        adam.step()
        fall.step()
    with torch.no_grad():  # the factor per axis that gives the normalised innovations unit variance
        normalised, share = scan(like.stds(best), data[0])[1], data[1][..., None]
        factor = log_scale((over_time(normalised.square(), normalised.isfinite()) * share).sum(1))
        made = like.with_logs(best.view(3, 3) + factor)
    return made, {"validation_loss": tuple(history), "seconds": time.perf_counter() - began}


def _doubled(batch: Batch, share: Tensor) -> tuple[Batch, Tensor]:
    """The same in float64."""
    gnss, velocity, truth, x0 = (array.double() for array in batch[:4])
    return Batch(gnss, velocity, truth, x0, batch.dt, batch.exact), share.double()


def _loss(like: NoiseParameters, logs: Tensor, batch: Batch, weight: Tensor) -> Tensor:
    """(1,) mean over pieces and time of the squared error, m^2."""
    return (like.losses(logs, batch) * weight).sum(1)

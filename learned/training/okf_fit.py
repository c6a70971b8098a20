"""fit_okf: train the nine parameters of an OptimisedKF on all segments at once, in double precision."""

import time
from collections.abc import Sequence
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
    tasks: Sequence[tuple[Segments, Segments]],
    steps: int = 300,
    progress: str | None = None,
) -> list[tuple[NoiseParameters, dict[str, Any]]]:
    """Train noise parameters by gradient through the Kalman recursion on 1/T sum_t ||xhat_t - x_t||^2, of several
    settings at once.

    The estimates depend on ratios of variances only, so the loss cannot see a common factor per axis; that factor is
    set afterwards so that the training innovations have the variance that the filter claims for them.

    Args:
        tasks: of each setting the segments to train on, and those that select the parameters.
        steps: of Adam on all training segments.
        progress: name of the stage of a progress bar on stderr.

    Returns:
        Of each setting the trained parameters, the validation loss per check, m^2, and the training seconds.

    >>> import numpy as np
    >>> from coopoc.learned import clients
    >>> from coopoc.world.fleet import Fleet
    >>> (only,) = clients(Fleet(("a",), np.arange(33) / 10, np.zeros((33, 1, 3)), np.zeros((33, 1, 3))), piece=10)
    >>> len(fit_okf([(only.training, only.validation)], steps=2)[0][1]["validation_loss"])
    2
    """
    began, like = time.perf_counter(), NoiseParameters()
    data, judge = (_doubled(*padded([task[i] for task in tasks])) for i in range(2))
    logs = like.logs.detach().double().flatten().repeat(len(tasks), 1).requires_grad_()
    adam = torch.optim.Adam([logs], lr=0.1)
    fall = torch.optim.lr_scheduler.CosineAnnealingLR(adam, steps)
    lowest, best, history = torch.full((len(tasks),), torch.inf, dtype=torch.float64), logs.detach().clone(), []
    for step in watched(range(steps), progress, "step"):
        if step % 25 == 0 or step == steps - 1:
            with torch.no_grad():
                validated = _loss(like, logs, *judge)
            better = validated < lowest
            best[better], lowest[better] = logs.detach()[better], validated[better]
            history.append(validated.tolist())
        adam.zero_grad()
        _loss(like, logs, *data).sum().backward()
        adam.step()
        fall.step()
    with torch.no_grad():
        best = best.view(-1, 3, 3) + _calibration(like.stds(best), *data)[:, None]
    seconds = (time.perf_counter() - began) / len(tasks)
    losses = zip(*history, strict=True)
    return [
        (like.with_logs(row), {"validation_loss": h, "seconds": seconds}) for row, h in zip(best, losses, strict=True)
    ]


def _doubled(batch: Batch, share: Tensor) -> tuple[Batch, Tensor]:
    """The same in float64."""
    gnss, velocity, truth, x0 = (array.double() for array in batch[:4])
    return Batch(gnss, velocity, truth, x0, batch.dt, batch.exact), share.double()


def _loss(like: NoiseParameters, logs: Tensor, batch: Batch, weight: Tensor) -> Tensor:
    """(S,) mean over pieces and time of the squared error, m^2."""
    return (like.losses(logs, batch) * weight).sum(1)


def _calibration(numbers: Tensor, batch: Batch, weight: Tensor) -> Tensor:
    """(S, 3) logarithm of the factor per axis that gives the normalised innovations unit variance."""
    normalised = scan(numbers, batch)[1]
    return log_scale((over_time(normalised.square(), normalised.isfinite()) * weight[..., None]).sum(1))

"""fit: train a net on pieces, and keep the weights that validate best; fit_okf: the nine numbers of an OptimisedKF."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from math import inf, nan
from time import perf_counter
from typing import Any

import numpy as np
import torch
from torch import Tensor

from coopoc.arrays import Floats, Ints, instance
from coopoc.text import short_repr
from coopoc.world.sensors import stream

from ..engine.backward import Moments, Update
from ..nets.gain import Gain, flatten, unflatten
from ..nets.okf import NoiseParameters
from .clients import Batch, Segments, check_segments, mirrored
from .schedule import Schedule, cosine, generator, one_core, watched


@dataclass(frozen=True, eq=False)
class Progress:
    """A row of a history: optimiser steps so far, weights (P,), mean training loss since the last row, and the score of
    `Judge` (the validation loss, or that of the long pieces if it is larger), m^2."""

    step: int
    weights: Tensor
    training_loss: float
    validation_loss: float

    __repr__ = short_repr


@dataclass(frozen=True, eq=False)
class Fit:
    """A trained net: a net of its shape, how it went, why it stopped early (None: it did not), seconds, and what it was
    trained on."""

    like: Gain
    history: tuple[Progress, ...]
    stopped: str | None
    seconds: float
    training: Segments

    __repr__ = short_repr

    @cached_property
    def model(self) -> Gain:
        """The net with the weights that validated best, calibrated."""
        return unflatten(self.best.weights, self.like).calibrate([self.training])

    @property
    def best(self) -> Progress:
        """The row whose weights are kept."""
        return min(self.history, key=lambda row: row.validation_loss)


@one_core()
def fit(
    model: Gain,
    training: Segments,
    validation: Segments,
    schedule: Schedule = Schedule(),
    seed: int = 0,
    progress: str | None = None,
    long: Segments | None = None,
    name: str = "",
) -> Fit:
    """Minimise 1/T sum_t ||xhat_t - x_t||^2 over batches of pieces; weights decay by AdamW.

    Args:
        model: the start; it is not changed.
        training: segments to train on.
        validation: segments that select the weights.
        schedule: default `Schedule()`.
        seed: of the order of the batches.
        progress: name of the stage for a progress bar on stderr, None for no bar.
        long: long segments on which the selected weights must not diverge.
        name: of the data, which with the seed decides the order of the batches.

    References:
        arXiv 2411.05847, equation 7; KalmanNet_TSP for "epoch".

    >>> from coopoc.world.fleet import Fleet
    >>> from coopoc.learned import GainNet, Schedule, clients, fit
    >>> line = Fleet(("a",), np.arange(33) / 10, np.zeros((33, 1, 3)), np.zeros((33, 1, 3)))
    >>> (only,) = clients(line, piece=10)
    >>> fit(GainNet(), only.training, only.validation, Schedule(epochs=2)).history[-1].step
    2
    """
    instance("model", model, Gain, "Give GainNet().")  # type: ignore[type-abstract]
    instance("schedule", schedule, Schedule)
    check_segments("training", training)
    check_segments("validation", validation)
    if long is not None:
        check_segments("long", long)
    began, theta, draw = perf_counter(), flatten([model]), stream(seed, "batches", 0, name)
    plan, judge = schedule.plan(len(training), draw), Judge([[validation], *([] if long is None else [[long]])], model)
    history, so_far = [Progress(0, theta[0].clone(), nan, float(judge(theta)))], []
    due = set(np.linspace(0, len(plan), schedule.checks + 1).round().astype(int).tolist())
    rates, draws, stopped = schedule.learning_rate * cosine(len(plan)), [generator(draw)], dict[int, str]()
    steps = descend(theta, model, training, [plan], [rates], schedule, draws, stopped)
    for step, losses in watched(steps, progress, "step", len(plan)):
        so_far.append(losses)
        if step in due and not stopped:
            mean = float(torch.cat(so_far[history[-1].step :]).mean())
            history.append(Progress(step, theta[0].clone(), mean, float(judge(theta))))
    if not stopped and min(row.validation_loss for row in history) == inf:
        stopped[0] = "no weights had a finite validation loss; start from GainNet(start_gain=0.1)"
    return Fit(model, tuple(history), stopped.get(0), perf_counter() - began, training)


def descend(
    theta: Tensor,
    like: Gain,
    pool: Segments,
    plans: Sequence[Ints],
    rates: Sequence[Floats],
    schedule: Schedule,
    draws: Sequence[torch.Generator],
    stopped: dict[int, str],
) -> Iterator[tuple[int, Tensor]]:
    """Change theta (S, P) in place, one optimiser step per iteration, and yield (steps so far, losses (S,) m^2).

    A model whose loss or gradient is not finite is left as it is from then on and its reason is put into `stopped`;
    models with shorter plans wait for the longest. Their loss is NaN.
    """
    weights = theta.numpy()
    moments = Moments(weights, np.zeros_like(weights), np.zeros_like(weights))
    for step in range(max(map(len, plans))):
        going = [row for row, plan in enumerate(plans) if step < len(plan) and row not in stopped]
        losses = np.full(len(plans), nan, np.float32)
        for size in {plans[row].shape[1] for row in going}:
            rows = [row for row in going if plans[row].shape[1] == size]
            dice = [draws[r] for r in rows]
            batch = pool.batch(torch.from_numpy(np.array([plans[r][step] for r in rows])))
            batch = mirrored(batch, dice) if schedule.mirror else batch
            rate = np.array([rates[r][step] for r in rows])
            update = Update(np.array(rows), step + 1, rate, schedule.weight_decay, schedule.clip)
            outcome = like.descend(moments, batch, update)
            losses[rows] = outcome.losses
            stopped |= {
                r: f"loss or gradient not finite at step {step + 1}"
                for r, good in zip(rows, outcome.finite, strict=True)
                if not good
            }
        yield step + 1, torch.from_numpy(losses)


class Judge:
    """Score (S,) m^2 of S models: the larger of the mean losses on each kind of their pieces, infinite if not finite.

    The kinds are the validation pieces and, where there are any, the long ones: over a long drive a stable filter is
    the better for its start being over, so they decide only against weights that drift away.
    A score does not depend on the other models: a model's segments have their own random draws and are summed in order.
    """

    def __init__(self, kinds: Sequence[Sequence[Segments]], like: Gain) -> None:
        self.like = like
        self.batches = [padded(parts) for parts in kinds]

    def __call__(self, theta: Tensor) -> Tensor:
        with torch.no_grad():
            parts = [(self.like.losses(theta, batch) * share).unbind(1) for batch, share in self.batches]
        return torch.stack([reduce(torch.add, each) for each in parts]).nan_to_num(inf, inf).amax(0)


def padded(parts: Sequence[Segments]) -> tuple[Batch, Tensor]:
    """All pieces of S models as one batch, and the share (S, B) of each in its model's mean, 0 for padding."""
    pool, members = pooled(parts)
    most = max(map(len, members))
    index = torch.from_numpy(np.stack([np.resize(m, most) for m in members]))
    share = torch.tensor([[(i < len(m)) / len(m) for i in range(most)] for m in members])
    return pool.batch(index), share


def pooled(parts: Sequence[Segments]) -> tuple[Segments, list[Ints]]:
    """All pieces in one, and the indices of each part in it."""
    ends = np.cumsum([len(p) for p in parts])
    return Segments.join(parts), [np.arange(end - len(p), end) for p, end in zip(parts, ends, strict=True)]


@one_core()
def fit_okf(
    training: Segments, validation: Segments, steps: int = 300, progress: str | None = None
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
    began, like = perf_counter(), NoiseParameters()
    data, judge = (padded([part.double()]) for part in (training, validation))
    logs = like.logs.detach().double().reshape(1, -1).clone().requires_grad_()
    adam = torch.optim.Adam([logs], lr=0.1)
    fall = torch.optim.lr_scheduler.CosineAnnealingLR(adam, steps)
    best, history = logs.detach().clone(), list[float]()

    def loss(batch: Batch, share: Tensor) -> Tensor:
        return (like.losses(logs, batch) * share).sum(1)

    for step in watched(range(steps), progress, "step"):
        if step % 25 == 0 or step == steps - 1:
            with torch.no_grad():
                validated = float(loss(*judge))
            best = logs.detach().clone() if validated < min(history, default=inf) else best
            history.append(validated)
        adam.zero_grad()
        loss(*data).backward()
        adam.step()
        fall.step()
    made = like.with_logs(best.view(3, 3)).calibrate([training])
    return made, {"validation_loss": tuple(history), "seconds": perf_counter() - began}

"""OptimisedKF: a Kalman filter whose noise numbers are trained on the loss and the pieces of the nets."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from coopoc.arrays import Floats
from coopoc.errors import InputError
from coopoc.methods.kalman import Gaussian, solo_filter
from coopoc.methods.stream import Stream
from coopoc.methods.track import Track
from coopoc.world.noise import stream
from coopoc.world.recording import Recording
from coopoc.world.v2x import NO_MESSAGE, Message

from .clients import Batch, Pieces
from .machine import one_core, watched
from .schedule import generator
from .stream import okf_stream

Three = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class OptimisedKF:
    """Solo Kalman filter with trained noise: per axis, process variance a^2 + (b dt u)^2 and GNSS variance r^2.

    Args:
        process_std: a, m per step. velocity_ratio: b, share of the measured velocity. gnss_std: r, m.
        x0: (R, E, 3) or (E, 3) m, a known start; None starts at the first fix.

    Source: Greenberg, Yannay, Mannor, Optimization or Architecture: How to Hack Kalman Filtering, NeurIPS 2023.

    >>> OptimisedKF((0.1, 0.1, 0.1), (0.0, 0.0, 0.0), (1.5, 1.5, 1.5)).cooperative
    False
    """

    process_std: Three
    velocity_ratio: Three
    gnss_std: Three
    x0: Floats | None = None
    name: str = "okf"
    cooperative: bool = False
    message: Message = NO_MESSAGE

    def __post_init__(self) -> None:
        for field in ("process_std", "velocity_ratio", "gnss_std"):
            value = np.array(getattr(self, field), dtype=float)
            if value.shape != (3,) or not (np.isfinite(value) & (value >= 0)).all():
                raise InputError(field, getattr(self, field), "must be three numbers >= 0", "Train it with fit_okf.")
        if min(self.gnss_std) == 0:
            raise InputError("gnss_std", self.gnss_std, "must be > 0", "Assumed noise may not be zero.")

    def start(
        self, x0: npt.ArrayLike | None = None, *, interval: float = 0.1, history: float = 10.0
    ) -> Stream[Gaussian]:
        """The filter that is fed step by step (docs/streaming.md); interval: s, of the training."""
        return okf_stream(self, x0, interval, history)

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Estimates and covariances of the egos."""
        began, columns = time.perf_counter(), recording.columns(egos)
        velocity = recording.velocity[:, :, columns]
        moved = np.array(self.velocity_ratio) * recording.dt * velocity
        x, spread = solo_filter(recording.gnss[:, :, columns], velocity, np.square(self.process_std) + moved**2,
                                np.square(self.gnss_std), recording.dt, self.x0)  # fmt: skip
        silent = np.zeros((recording.runs, len(columns)))
        seconds = time.perf_counter() - began
        return Track(recording.t, tuple(columns), x, spread[..., None] * np.eye(3), silent, silent, seconds)


@dataclass(frozen=True, eq=False)
class OkfFit:
    """A trained filter, its validation loss per check, m^2, and the training seconds."""

    method: OptimisedKF
    validation_loss: tuple[float, ...]
    seconds: float


def fit_okf(training: Pieces, validation: Pieces, steps: int = 300, velocity_part: bool = True) -> OkfFit:
    """Train the noise numbers by gradient through the Kalman recursion on 1/T sum_t ||xhat_t - x_t||^2.

    The estimates depend on ratios of variances only, so the loss cannot see a common factor per axis; that factor is
    set afterwards so that the training innovations have the variance that the filter claims for them.

    Args:
        training, validation: pieces. steps: of Adam on all training pieces. velocity_part: train b too, else b = 0.

    >>> from coopoc.learned.clients import clients
    >>> from coopoc.world.fleet import Fleet
    >>> (only,) = clients(Fleet(("a",), np.arange(33) / 10, np.zeros((33, 1, 3)), np.zeros((33, 1, 3))), piece=10)
    >>> fit_okf(only.training, only.validation, steps=2, velocity_part=False).method.velocity_ratio
    (0.0, 0.0, 0.0)
    """
    return fit_okf_many([(training, validation)], steps, velocity_part)[0]


@one_core()
def fit_okf_many(
    tasks: Sequence[tuple[Pieces, Pieces]], steps: int = 300, velocity_part: bool = True, progress: str | None = None
) -> list[OkfFit]:
    """`fit_okf` for many settings, stacked; `progress` names the stage of a progress bar on stderr."""
    began = time.perf_counter()
    data, judge = (_stacked([task[i] for task in tasks], kind) for i, kind in enumerate(("training", "validation")))
    logs = torch.log(torch.tensor([0.1, 0.1 if velocity_part else 1e-30, 1.0], dtype=torch.float64))
    logs = logs[None, :, None].repeat(len(tasks), 1, 3).requires_grad_()
    adam = torch.optim.Adam([logs], lr=0.1)
    fall = torch.optim.lr_scheduler.CosineAnnealingLR(adam, steps)
    lowest, best, history = torch.full((len(tasks),), torch.inf, dtype=torch.float64), logs.detach().clone(), []
    for step in watched(range(steps), progress, "step"):
        if step % 25 == 0 or step == steps - 1:
            with torch.no_grad():
                found = _loss(logs, *judge)
            better = found < lowest
            best[better], lowest[better] = logs.detach()[better], found[better]
            history.append(found.tolist())
        adam.zero_grad()
        _loss(logs, *data).sum().backward()
        adam.step()
        fall.step()
    with torch.no_grad():
        numbers = torch.exp(best) * _calibration(best, *data)[:, None]
    if not velocity_part:
        numbers[:, 1] = 0.0
    seconds = (time.perf_counter() - began) / len(tasks)
    return [
        OkfFit(OptimisedKF(_three(row[0]), _three(row[1]), _three(row[2])), tuple(h), seconds)
        for row, h in zip(numbers, zip(*history, strict=True), strict=True)
    ]


def _stacked(parts: Sequence[Pieces], kind: str) -> tuple[Batch, Tensor]:
    """All pieces of S settings in float64; (2, S, B): weight in the mean, 0 for padding, and uncertain start.

    Fresh noise is drawn once, the same for every setting and another for training than for validation.
    """
    pool, most = Pieces.join(parts), max(map(len, parts))
    ends = np.cumsum([len(p) for p in parts])
    rows = [np.resize(np.arange(end - len(p), end), most) for p, end in zip(parts, ends, strict=True)]
    index = torch.from_numpy(np.stack(rows))
    batch = pool.batch(index, [generator(stream(0, kind, 0, "")) for _ in parts])
    weight = torch.tensor([[float(i < len(p)) / len(p) for i in range(most)] for p in parts], dtype=torch.float64)
    gnss, velocity, truth, x0 = (array.double() for array in batch[:4])
    uncertain = 1.0 - pool.true_start[index].double()
    return Batch(gnss, velocity, truth, x0, pool.dt), torch.stack([weight, uncertain])


def _scan(logs: Tensor, batch: Batch, uncertain: Tensor) -> tuple[Tensor, Tensor]:
    """Estimates and normalised innovations (T, S, B, 3) of the filters exp(logs) (S, 3 kinds, 3 axes)."""
    process, ratio, gnss_std = torch.exp(logs).unsqueeze(2).unbind(1)
    noise, x, spread = gnss_std.square(), batch.x0, gnss_std.square() * uncertain[..., None]
    estimates, normalised = [], []
    moves = process.square() + (ratio * batch.dt * batch.velocity).square()
    for fix, speed, move in zip(batch.gnss.unbind(), batch.velocity.unbind(), moves.unbind(), strict=True):
        spread = spread + move
        gain = spread / (spread + noise)
        surprise = fix - x - batch.dt * speed
        x = x + batch.dt * speed + gain * surprise
        normalised.append(surprise / (spread + noise).sqrt())
        spread = (1.0 - gain) * spread
        estimates.append(x)
    return torch.stack(estimates), torch.stack(normalised)


def _loss(logs: Tensor, batch: Batch, weights: Tensor) -> Tensor:
    """(S,) mean over pieces and time of the squared error, m^2."""
    error = _scan(logs, batch, weights[1])[0] - batch.truth
    return (error.square().sum(-1).mean(0) * weights[0]).sum(1)


def _calibration(logs: Tensor, batch: Batch, weights: Tensor) -> Tensor:
    """(S, 3) factor per axis that gives the normalised innovations unit variance."""
    normalised = _scan(logs, batch, weights[1])[1]
    return (normalised.square().mean(0) * weights[0][..., None]).sum(1).sqrt()


def _three(values: Tensor) -> Three:
    first, second, third = values.tolist()
    return first, second, third

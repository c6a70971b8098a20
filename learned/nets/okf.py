"""OptimisedKF: a Kalman filter whose noise numbers are trained on the loss and the pieces of the nets."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from coopoc.arrays import Floats
from coopoc.errors import InputError
from coopoc.methods.kalman import Gaussian, solo_filter
from coopoc.methods.stream import Stream
from coopoc.methods.track import Track
from coopoc.world.recording import Recording
from coopoc.world.v2x import NO_MESSAGE, Message

from ..stream import okf_stream
from ..training.clients import Batch, Pieces
from ..training.machine import one_core
from .gain import Gain, over_time

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
        began, columns = time.perf_counter(), recording.columns(egos, missing=True)
        velocity = recording.velocity[:, :, columns]
        moved = np.array(self.velocity_ratio) * recording.dt * velocity
        x, spread = solo_filter(recording.gnss[:, :, columns], velocity, np.square(self.process_std) + moved**2,
                                np.square(self.gnss_std), recording.dt, self.x0)  # fmt: skip
        silent = np.zeros((recording.runs, len(columns)))
        seconds = time.perf_counter() - began
        return Track(recording.t, tuple(columns), x, spread[..., None] * np.eye(3), silent, silent, seconds)


class NoiseNumbers(Gain):
    """The nine numbers of an OptimisedKF as a net: what a federation of Kalman filters exchanges is 36 bytes.

    p = s + a^2 + (b dt u)^2;  k = p / (p + r^2);  x <- x + dt u + k (z - x - dt u);  s = (1 - k) p, with log a, log b,
    log r per axis as weights. The squared error sees ratios of variances only; `finished` sets their common scale.

    Args:
        velocity_part: use b, else b = 0. seed: every net takes one; this one starts at the same numbers for each.

    Source: Greenberg, Yannay, Mannor, Optimization or Architecture: How to Hack Kalman Filtering, NeurIPS 2023.

    >>> NoiseNumbers().method("okf").gnss_std
    (1.0, 1.0, 1.0)
    """

    def __init__(self, velocity_part: bool = True, seed: int = 0) -> None:
        super().__init__()
        self.velocity_part = velocity_part
        self.logs = nn.Parameter(torch.tensor([0.1, 0.1, 1.0]).log()[:, None].repeat(1, 3))

    @property
    def settings(self) -> Mapping[str, Any]:
        """Whether the measured velocity has a part in the process noise."""
        return {"velocity_part": self.velocity_part}

    def numbers(self, theta: Tensor) -> Tensor:
        """a m, b, r m per axis (S, 3, 3) of weights (S, 9)."""
        used = torch.tensor([[1.0], [float(self.velocity_part)], [1.0]], dtype=theta.dtype)
        return theta.view(-1, 3, 3).exp() * used

    def losses(self, theta: Tensor, batch: Batch) -> Tensor:
        """(S, B) squared error of each piece, mean over time, sum over components, m^2."""
        x, _ = scan(self.numbers(theta), batch)
        return over_time((x - batch.truth).square().sum(-1))

    def method(self, name: str, x0: Floats | None = None) -> OptimisedKF:
        """`OptimisedKF` with these numbers."""
        process, ratio, gnss = self.numbers(nn.utils.parameters_to_vector(self.parameters()).detach()[None])[0].double()
        return OptimisedKF(_three(process), _three(ratio), _three(gnss), x0, name)

    @one_core()
    def finished(self, parts: Sequence[Pieces]) -> NoiseNumbers:
        """The same filter with the scale that gives the normalised innovations of all training pieces unit variance.

        Of each client's pieces it needs the mean square per axis only: three numbers a client.
        """
        numbers = self.numbers(nn.utils.parameters_to_vector(self.parameters()).detach()[None])
        squares = torch.zeros(3)
        for pieces in parts:
            drawn = [torch.Generator().manual_seed(0)]
            seen = scan(numbers, pieces.batch(torch.arange(len(pieces))[None], drawn))[1]
            squares += seen.square().mean(0).sum((0, 1))
        scale = (squares / sum(map(len, parts))).sqrt()
        made = NoiseNumbers(self.velocity_part)
        with torch.no_grad():
            made.logs.copy_(self.logs + scale.log())
        return made


def scan(numbers: Tensor, batch: Batch) -> tuple[Tensor, Tensor]:
    """Estimates m and normalised innovations (T, S, B, 3) of filters with a, b, r (S, 3 kinds, 3 axes)."""
    process, ratio, gnss_std = numbers.unsqueeze(2).unbind(1)
    noise, x = gnss_std.square(), batch.x0
    spread = noise if batch.known is None else noise * (~batch.known)[..., None]
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


def _three(values: Tensor) -> Three:
    first, second, third = values.tolist()
    return first, second, third

"""OptimisedKF: a Kalman filter whose noise parameters are trained on the loss and the segments of the nets."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import repeat

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn

from coopoc import Recording, Track
from coopoc.arrays import Floats, check_fields, seed_of
from coopoc.kernels.compiling.waiting import clock
from coopoc.kernels.motion import MotionNoise, own_variances
from coopoc.kernels.solo import FixNoise
from coopoc.methods.kalman import FilterStream, solo_filter, solo_track
from coopoc.methods.noise_model import check_interval, check_std
from coopoc.methods.track import Alone, in_stretches
from coopoc.text import short_repr
from coopoc.world.recording import Vehicles, check_recording

from ..training.clients import Batch, Segments
from ..training.schedule import one_core
from .gain import Gain, flatten, squared_error


@dataclass(frozen=True, eq=False)
class OptimisedKF(Alone):
    """Solo Kalman filter with trained noise: per axis, process variance a^2 + (b dt u)^2 and GNSS variance r^2.

    Args:
        process_std: (3,) m per step, a.
        velocity_ratio: (3,) share of the measured velocity, b.
        gnss_std: (3,) m, r.
        x0: (R, E, 3) or (E, 3) m, an exact start; None starts at the first fix.
        name: label in tables.

    References:
        Greenberg, Yannay, Mannor, Optimization or Architecture: How to Hack Kalman Filtering, NeurIPS 2023.

    >>> OptimisedKF((0.1, 0.1, 0.1), (0.0, 0.0, 0.0), (1.5, 1.5, 1.5)).cooperative
    False
    """

    process_std: tuple[float, ...]
    velocity_ratio: tuple[float, ...]
    gnss_std: tuple[float, ...]
    x0: Floats | None = None
    name: str = "okf"

    __repr__ = short_repr

    def __post_init__(self) -> None:
        check_std(self, "process_std", 0.0)
        check_std(self, "velocity_ratio", 0.0)
        check_std(self, "gnss_std")
        check_fields(self)

    def start(
        self, x0: ArrayLike | None = None, *, interval: float | None = None, history: float = 10.0
    ) -> FilterStream:
        """The filter as a stream, one step at a time (docs/streaming.md).

        Args:
            x0: (3,) m, the exact start; None starts at the first fix.
            interval: s, of a step: the variance of a motion of dt s is dt / interval times a step's; None: every motion
                is one step, as in a recording.
            history: s, the oldest fix that is accepted.

        >>> OptimisedKF((1.0,) * 3, (0.0,) * 3, (1.0,) * 3).start().step([1.0, 2.0, 0.0], [9.0, 0.0, 0.0], dt=0.1)[0]
        array([1., 2., 0.])
        """
        return FilterStream(
            self._motion(0.0 if interval is None else check_interval(interval)),
            FixNoise(np.square(self.gnss_std)),
            x0,
            history,
        )

    @in_stretches
    def __call__(self, recording: Recording, egos: Vehicles = (0,)) -> Track:
        """Estimates and covariances of the egos."""
        began, columns = clock(), check_recording(recording).columns(egos, self.x0 is None)
        fixes = FixNoise(np.square(self.gnss_std))
        x, variance, _ = solo_filter(recording, columns, self._motion(0.0), fixes, self.x0)
        return solo_track(recording, columns, x, variance, began)

    def _motion(self, interval: float) -> MotionNoise:
        base, ratio = np.array([self.process_std, self.velocity_ratio], float)
        return MotionNoise(base, ratio, 0.0, 0.0, interval)


class NoiseParameters(Gain):
    """The nine parameters of an OptimisedKF as a net: a federation of Kalman filters exchanges 36 bytes.

    p = s + a^2 + (b dt v)^2 at the pace v;  k = p / (p + r^2);  x <- x + dt u + k (z - x - dt u);  s = (1 - k) p, with
    log a, log b, log r per axis as weights. The squared error sees ratios of variances only; `calibrate` sets their
    common scale.

    Args:
        seed: without effect, every net has this argument; the start is the same for each.

    References:
        Greenberg, Yannay, Mannor, Optimization or Architecture: How to Hack Kalman Filtering, NeurIPS 2023.

    >>> NoiseParameters().method("okf").gnss_std
    (1.0, 1.0, 1.0)
    """

    def __init__(self, seed: int = 0) -> None:
        super().__init__()
        seed_of(seed)
        self.logs = nn.Parameter(torch.tensor([0.1, 0.1, 1.0]).log()[:, None].repeat(1, 3))

    def stds(self, theta: Tensor) -> Tensor:
        """a m, b, r m per axis (S, 3, 3) of weights (S, 9)."""
        return theta.view(-1, 3, 3).exp()

    def with_logs(self, logs: Tensor) -> "NoiseParameters":
        """A filter of this kind with other log a, log b, log r (3, 3)."""
        made = NoiseParameters()
        with torch.no_grad():
            made.logs.copy_(logs)
        return made

    def losses(self, theta: Tensor, batch: Batch) -> Tensor:
        """(S, B) squared error of each segment, mean over time, sum over components, m^2."""
        x, _ = scan(self.stds(theta), batch)
        return squared_error(x, batch.truth)

    def method(self, name: str, x0: Floats | None = None) -> OptimisedKF:
        """`OptimisedKF` with these parameters."""
        process, ratio, gnss = (tuple(row.tolist()) for row in self.stds(flatten([self]))[0].double())
        return OptimisedKF(process, ratio, gnss, x0, name)

    @one_core()
    def calibrate(self, parts: Sequence[Segments]) -> "NoiseParameters":
        """The same filter with the scale that gives the normalised innovations of all training segments unit variance.

        Of each client's segments it needs the sum of squares per axis and the number of fixes: four numbers per client.
        """
        every = Segments.join(parts)
        innovations = scan(self.stds(flatten([self])), every.batch(torch.arange(len(every))[None]))[1]
        squares = innovations.square().nanmean((0, 1, 2))  # NaN on an axis without any, whose scale stays
        return self.with_logs(self.logs + 0.5 * torch.where(squares > 0.0, squares, 1.0).log())


OF_PACE = MotionNoise(np.zeros(3), np.ones(3), 0.0, 0.0, 0.0)
"""Its variance is the square of dt times the pace."""


def scan(stds: Tensor, batch: Batch) -> tuple[Tensor, Tensor]:
    """Estimates m and normalised innovations (T, S, B, 3) of filters with a, b, r (S, 3 kinds, 3 axes); where a fix is
    missing the filter predicts, and the innovation is NaN."""
    process, ratio, gnss_std = stds.unsqueeze(2).unbind(1)
    noise, x = gnss_std.square(), batch.x0
    noises = repeat(noise) if batch.scale is None else iter(noise * batch.scale.square())
    variance = next(noises) * (not batch.exact)
    estimates, normalised = [], []
    paces = own_variances(OF_PACE, batch.velocity.transpose(0, 1).double().numpy(), batch.dt)
    motions = process.square() + ratio.square() * torch.from_numpy(paces).transpose(0, 1).to(ratio)
    for fix, speed, motion, noise in zip(batch.gnss, batch.velocity, motions, noises, strict=False):
        variance = variance + motion
        there = fix.isfinite()
        gain = torch.where(there, variance / (variance + noise), 0.0)
        innovation = fix - x - batch.dt * speed
        x = x + batch.dt * speed + gain * torch.where(there, innovation, 0.0)
        normalised.append(innovation / (variance + noise).sqrt())
        variance = (1.0 - gain) * variance
        estimates.append(x)
    return torch.stack(estimates), torch.stack(normalised)

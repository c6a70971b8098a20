"""Noise-adaptive Kalman filters: the variance of the fixes is estimated while driving, per axis."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..arrays import Floats
from ..errors import InputError
from ..kernels.solo import FixNoise
from ..short_repr import short_repr
from ..world.recording import Recording, check_recording
from ..world.sensors import Sensors
from ..world.v2x import NO_MESSAGE, Message
from .kalman import axis_track, drive_of, filtered
from .noise_model import NoiseModel
from .options import check_options
from .stream import FilterStream, motion_noise
from .track import Track

ASSUMED = Sensors(gnss_std=(2.5, 2.5, 2.5), velocity_floor=0.02)
"""Velocity noise of the paper's training, 10 % per axis, and where the estimate of the fixes' noise starts."""


@dataclass(frozen=True, eq=False)
class NoiseAdaptive(ABC):
    """Base of the noise-adaptive filters, which differ in how they revise the variance r of the fixes.

    A position is a mean of past fixes moved forward. Joseph's form splits its variance into a part that is linear in r
    and a part from motion. When r is revised, the past is reread with it: a start at a fix that was believed too good,
    or too bad, does no lasting harm.

    Args:
        assumed: velocity noise (ratio, reading per axis or speed, floor), and the GNSS std to start from.
        prior_weight: fixes that this start counts for; inf keeps it for ever.
        x0: (R, E, 3) or (E, 3) m, a known start; None starts at the first fix.
    """

    assumed: Sensors = ASSUMED
    prior_weight: float = 5.0
    x0: Floats | None = None
    name: str = ""
    cooperative: bool = False
    message: Message = NO_MESSAGE

    def __post_init__(self) -> None:
        check_options(self)
        positive("prior_weight", self.prior_weight)

    @property
    @abstractmethod
    def fixes(self) -> FixNoise:
        """Noise of the fixes: where it starts, and how it is revised."""

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos; InputError if one is unknown or absent, or x0 has another shape."""
        began, columns = time.perf_counter(), check_recording(recording).columns(egos, missing=True)
        x, p, _ = self._filtered(recording, columns)
        return axis_track(recording, columns, x, p, began, (velocity_note(self.assumed),))

    def start(
        self, x0: npt.ArrayLike | None = None, *, interval: float | None = None, history: float = 10.0
    ) -> FilterStream:
        """Start the filter for one step at a time, as `Kalman.start`; `state.noise` is the estimated variance."""
        return FilterStream(motion_noise(NoiseModel.nominal(self.assumed), interval), self.fixes, x0, history)

    def gnss_std(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Floats:
        """(R, T, E, 3) m, the estimated standard deviation of the fixes at every step."""
        noise = self._filtered(recording, check_recording(recording).columns(egos, missing=True))[2]
        known = np.broadcast_to(self.fixes.variance, (recording.runs, len(recording.t), len(egos), 3))
        return np.sqrt(noise if noise.size else known)

    def _filtered(self, recording: Recording, columns: Sequence[int]) -> tuple[Floats, Floats, Floats]:
        return filtered(drive_of(recording, NoiseModel.nominal(self.assumed), columns), self.fixes, self.x0)


@dataclass(frozen=True, eq=False)
class AdaptiveKalman(NoiseAdaptive):
    """Kalman filter whose GNSS variance r is estimated from its innovations, per axis.

    With innovation v of variance p + r, p that of the prediction: r <- r + (v^2 - p - r) / n, n <- min(n + 1, window).
    So r is the mean of v^2 - p over all fixes and `prior_weight` fixes of the assumed variance, and once there are
    `window` it forgets exponentially. The process noise follows the measured velocity as in NoiseModel.nominal. A bias
    that is there from the first fix on does not show in innovations.

    Args:
        window: fixes; inf never forgets. The others as in `NoiseAdaptive`.

    References:
        Mehra, IEEE TAC 15(2) 1970; Mohamed and Schwarz, Journal of Geodesy 73, 1999. Defaults were chosen on
        `town10-validation` (docs/methods.md).

    >>> from coopoc import Fleet, observe
    >>> fleet = Fleet(("a",), np.arange(400) / 10, np.zeros((400, 1, 3)), np.zeros((400, 1, 3)))
    >>> seen = observe(fleet, Sensors(gnss_std=(3.5, 3.5, 3.5)), runs=50)
    >>> bool(abs(AdaptiveKalman().gnss_std(seen)[:, -1].mean() - 3.5) < 0.1)
    True
    """

    window: float = 100.0
    name: str = "kalman-adaptive"

    __repr__ = short_repr

    def __post_init__(self) -> None:
        super().__post_init__()
        positive("window", self.window)

    @property
    def fixes(self) -> FixNoise:
        """Running mean of v^2 - p."""
        variance = NoiseModel.nominal(self.assumed).gnss_variance
        return FixNoise(variance, float(self.prior_weight), float(self.window))


def velocity_note(assumed: Sensors) -> str:
    """The noise model of the velocity, for tables and figures.

    >>> velocity_note(Sensors())
    'assumes velocity noise of 10 % of each axis, at least 0.05 m/s'
    """
    of, floor = "each axis" if assumed.velocity_reading == "axis" else "the speed", assumed.velocity_floor
    return f"assumes velocity noise of {100 * assumed.velocity_std_ratio:g} % of {of}, at least {floor:g} m/s"


def positive(field: str, value: float) -> None:
    """InputError unless value > 0; infinity is allowed."""
    if not value > 0:
        raise InputError(field, value, "must be > 0", "Use infinity for never.")

"""Noise-adaptive Kalman filters: the variance of the fixes is estimated while driving, per axis."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ..arrays import Floats
from ..errors import InputError
from ..world.recording import Recording
from ..world.sensors import Sensors
from ..world.v2x import NO_MESSAGE, Message
from .knowledge import Knowledge
from .stream import Stream, Variance, assumed_motion, scan, solo_track
from .track import Track

ASSUMED = Sensors(gnss_std=(2.5, 2.5, 2.5), velocity_floor=0.02)
"""Velocity noise of the paper's training, 10 % per axis, and where the estimate of the fixes' noise starts."""
LEAST = 1e-4
"""m^2, least variance of a fix: 1 cm."""


class Belief(NamedTuple):
    """What an adaptive filter carries; its variance per axis is share * noise + motion. All (..., 3).

    A position is a mean of past fixes moved forward. Joseph's form splits its variance into a part that is linear in
    the fixes' variance and a part from motion. So when the estimate of that variance is revised, the past is reread
    with it: a start at a fix that was believed too good, or too bad, does no lasting harm.

    Args:
        x: m. share: without unit. motion: m^2. noise: m^2, the estimated variance of a fix. weight: fixes behind it.
    """

    x: Floats
    share: Floats
    motion: Floats
    noise: Floats
    weight: Floats


Revise = Callable[[Belief, Floats, Floats], tuple[Floats, Floats]]
"""Predicted belief, innovation m and what a delayed fix has more m^2 -> estimated variance m^2 and its weight."""


@dataclass(frozen=True, eq=False)
class AdaptiveSolo:
    """A noise-adaptive filter as a `Solo`: what it assumes at first, and how it revises that at every fix."""

    process: Variance
    noise: Floats
    weight: float
    revise: Revise

    def begin(self, x: Floats, late: Floats | None) -> Belief:
        """Exact, or as uncertain as a fix is assumed to be."""
        one = np.ones_like(x)
        share, motion = (0 * one, 0 * one) if late is None else (one, late * one)
        return Belief(x, share, motion, self.noise * one, self.weight * one)

    def advance(self, state: Belief, moved: Floats, process: Floats, fix: Floats, late: Floats) -> Belief:
        """Predict; where there is a fix, revise its variance and correct."""
        prior = state._replace(x=state.x + moved, motion=state.motion + process)
        missing = np.isnan(fix)
        surprise = np.where(missing, 0.0, fix - prior.x)
        noise, weight = self.revise(prior, surprise, late)
        spread = prior.share * noise + prior.motion
        gain = spread / (spread + noise + late)
        found = Belief(
            prior.x + gain * surprise, (1 - gain) ** 2 * prior.share + gain**2,
            (1 - gain) ** 2 * prior.motion + gain**2 * late, noise, weight,
        )  # fmt: skip
        return Belief(*(np.where(missing, a, b) for a, b in zip(prior, found, strict=True)))

    def read(self, state: Belief) -> tuple[Floats, Floats]:
        """Position and diagonal covariance."""
        return state.x, (state.share * state.noise + state.motion)[..., None] * np.eye(3)


@dataclass(frozen=True, eq=False)
class NoiseAdaptive(ABC):
    """What the noise-adaptive filters share; they differ in how they revise the variance of the fixes.

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
        positive("prior_weight", self.prior_weight)

    @abstractmethod
    def revise(self, prior: Belief, surprise: Floats, late: Floats) -> tuple[Floats, Floats]:
        """Estimated variance of the fixes and its weight after an innovation, as in `Revise`."""

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos; InputError if one is unknown or absent, or x0 has another shape."""
        return solo_track(self._solo(recording.dt), recording, egos, self.x0, (velocity_note(self.assumed),))

    def start(self, x0: npt.ArrayLike | None = None, *, interval: float = 0.1, history: float = 10.0) -> Stream[Belief]:
        """The filter that is fed step by step: arguments as in `Kalman.start`; `state.noise` is what it estimates."""
        return Stream(self._solo(interval), x0, history)

    def gnss_std(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Floats:
        """(R, T, E, 3) m, the estimated standard deviation of the fixes at every step."""
        states = scan(self._solo(recording.dt), recording, recording.columns(egos, missing=True), self.x0)
        return np.sqrt(np.stack([state.noise for state in states], axis=1))

    def _solo(self, interval: float) -> AdaptiveSolo:
        known = Knowledge.nominal(self.assumed)
        return AdaptiveSolo(assumed_motion(known, interval), known.gnss_variance, self.prior_weight, self.revise)


@dataclass(frozen=True, eq=False)
class AdaptiveKalman(NoiseAdaptive):
    """Kalman filter whose GNSS variance r is the mean of what innovations say of it, per axis.

    With innovation v of variance p + r, p that of the prediction: r <- r + (v^2 - p - r) / n, n <- min(n + 1, window).
    So r is the mean of v^2 - p over all fixes and `prior_weight` fixes of the assumed variance, and once there are
    `window` it forgets exponentially. The process noise follows the measured velocity as in Knowledge.nominal. A bias
    that is there from the first fix on does not show in innovations.

    Args:
        window: fixes; inf never forgets. The others as in `NoiseAdaptive`.

    Source: Mehra, IEEE TAC 15(2) 1970; Mohamed and Schwarz, Journal of Geodesy 73, 1999. Defaults were chosen on
    `town10-validation` (docs/methods.md).

    >>> from coopoc import Fleet, observe
    >>> fleet = Fleet(("a",), np.arange(400) / 10, np.zeros((400, 1, 3)), np.zeros((400, 1, 3)))
    >>> seen = observe(fleet, Sensors(gnss_std=(3.5, 3.5, 3.5)), runs=50)
    >>> bool(abs(AdaptiveKalman().gnss_std(seen)[:, -1].mean() - 3.5) < 0.1)
    True
    """

    window: float = 100.0
    name: str = "kalman-adaptive"

    def __post_init__(self) -> None:
        super().__post_init__()
        positive("window", self.window)

    def revise(self, prior: Belief, surprise: Floats, late: Floats) -> tuple[Floats, Floats]:
        """r <- r + (v^2 - p - r) / n; a late fix and the prediction share the motion since, so v does not hold it."""
        weight = np.minimum(prior.weight + 1, self.window)
        sample = surprise**2 - prior.share * prior.noise - prior.motion
        return np.maximum(prior.noise + (sample - prior.noise) / weight, LEAST), weight


def velocity_note(assumed: Sensors) -> str:
    """What is assumed of the velocity, for tables and figures.

    >>> velocity_note(Sensors())
    'assumes velocity noise of 10 % of each axis, at least 0.05 m/s'
    """
    of, floor = "each axis" if assumed.velocity_reading == "axis" else "the speed", assumed.velocity_floor
    return f"assumes velocity noise of {100 * assumed.velocity_std_ratio:g} % of {of}, at least {floor:g} m/s"


def positive(field: str, value: float) -> None:
    """InputError unless value > 0; infinity is allowed."""
    if not value > 0:
        raise InputError(field, value, "must be > 0", "Use infinity for never.")

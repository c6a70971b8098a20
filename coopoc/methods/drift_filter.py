"""The joint filter for time-correlated errors of fixes: it estimates them along with the positions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ..kernels.stars.drift import Drift, run_filter
from ..world.inbox import Inbox
from ..world.recording import Recording
from ..world.v2x import FIX_AND_VELOCITY, Message
from .egos import Estimate, assumptions, follow_egos, measurements
from .noise_model import NoiseModel, resolve
from .track import Track, check_options


@dataclass(frozen=True, eq=False)
class DriftFilter:
    """`JointFilter` with the Gauss-Markov errors of the fixes in the state: z = x + drift + common + white noise.

    At K = 0 it is the solo Kalman filter with coloured noise. Relative measurements make a receiver's own drift
    observable, an error common to all is not. Without either error it equals `JointFilter`.

    Args:
        noise_model: "nominal", or a NoiseModel whose `sensors` describe the errors of the fixes.

    References:
        Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section
        8.2 (augmentation for autocorrelated measurement noise).
    """

    noise_model: NoiseModel | str = "nominal"
    name: str = "drift"
    cooperative: bool = True
    message: Message = FIX_AND_VELOCITY

    def __post_init__(self) -> None:
        check_options(self)

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos and of the neighbours in their stars; InputError if an ego is unknown or absent."""
        known = resolve(self.noise_model, recording)
        sensors, assumed = known.sensors or recording.sensors, assumptions(recording, known)
        if known.sensors:  # a NoiseModel counts all of a fix's error, of which the drifts are in the state here
            white = assumed.fixes + np.square(sensors.gnss_std) - known.gnss_variance
            assumed = assumed._replace(fixes=white, broadcast=white)
        keep = float(np.exp(-recording.dt / sensors.gnss_drift_time))
        drift = Drift(float(sensors.gnss_drift_std**2), float(sensors.gnss_common_std**2), keep)

        def run(ego: int, box: Inbox) -> Iterator[Estimate]:
            x, cov, neighbours = run_filter(measurements(recording, ego, box), assumed, known.exact_relative, drift)
            yield Estimate(slice(None), x, cov, box.link, neighbours)

        return follow_egos(self, recording, egos, run, known.notes, missing=True)

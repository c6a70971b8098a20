"""The solo Kalman filter on position with measured velocity as input, vectorised over runs and vehicles."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ..arrays import Floats
from ..errors import InputError
from ..kernels.compile import use_kernels
from ..world.recording import Recording
from ..world.v2x import NO_MESSAGE, Message
from .knowledge import Knowledge, resolve
from .stream import Stream, Variance, alone, assumed_motion
from .track import Track


class Gaussian(NamedTuple):
    """Position x (..., 3) m and its variance per axis (..., 3) m^2."""

    x: Floats
    variance: Floats


@dataclass(frozen=True, eq=False)
class SoloKalman:
    """The Kalman filter as a `Solo`: variance of the motion, and of a fix, (3,) m^2."""

    process: Variance
    gnss_variance: Floats

    def begin(self, x: Floats, late: Floats | None) -> Gaussian:
        """Exact, or as uncertain as a fix."""
        return Gaussian(x, np.broadcast_to(0.0 if late is None else self.gnss_variance + late, x.shape))

    def advance(self, state: Gaussian, moved: Floats, process: Floats, fix: Floats, late: Floats) -> Gaussian:
        """Predict, and correct where there is a fix."""
        return correct(state.x + moved, state.variance + process, fix, self.gnss_variance + late)

    def read(self, state: Gaussian) -> tuple[Floats, Floats]:
        """Position and diagonal covariance."""
        return state.x, state.variance[..., None] * np.eye(3)


@dataclass(frozen=True, eq=False)
class Kalman:
    """Kalman filter of x_t = x_{t-1} + dt u_t, z_t = x_t + n, with the noise that `knowledge` names.

    Args:
        knowledge: "identity", "nominal" or a Knowledge.
        x0: (R, E, 3) or (E, 3) m, a known start; None starts at the first fix.

    >>> from coopoc import Fleet, Sensors, observe
    >>> fleet = Fleet(("a",), [0, 0.1], np.zeros((2, 1, 3)), np.zeros((2, 1, 3)))
    >>> Kalman("nominal")(observe(fleet, Sensors(), runs=4)).x.shape
    (4, 2, 1, 3)
    """

    knowledge: Knowledge | str = "nominal"
    x0: Floats | None = None
    name: str = "kalman"
    cooperative: bool = False
    message: Message = NO_MESSAGE

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos; InputError if one is unknown or absent, or x0 has another shape."""
        began = time.perf_counter()
        columns = recording.columns(egos, missing=True)
        known = resolve(self.knowledge, recording)
        variance = known.process_variance(recording, columns)
        x0 = self.x0
        if x0 is not None and x0.shape[-2:] != (len(columns), 3):
            raise InputError("x0", x0.shape, f"must end in (E, 3) = ({len(columns)}, 3)", "One start per ego.")
        x, p = solo_filter(
            recording.gnss.take(columns, axis=2), recording.velocity.take(columns, axis=2), variance,
            known.gnss_variance, recording.dt, x0,
        )  # fmt: skip
        cov, free = np.zeros((*p.shape, 3)), np.zeros((recording.runs, len(columns)))
        np.einsum("...ii->...i", cov)[:] = p
        return Track(recording.t, tuple(columns), x, cov, free, free, time.perf_counter() - began)

    def start(
        self, x0: npt.ArrayLike | None = None, *, interval: float = 0.1, history: float = 10.0
    ) -> Stream[Gaussian]:
        """The filter that is fed step by step; a stream has no recording, so "nominal" is Knowledge.nominal(sensors).

        Args:
            x0: (3,) m, known before the first step; None starts at the first fix.
            interval: s, dt of the recordings that the assumed process noise belongs to.
            history: s, how old a delayed fix may be.

        >>> x, covariance = Kalman("identity").start().step([1.0, 2.0, 0.0], [9.0, 0.0, 0.0], dt=0.1)
        >>> x.tolist(), covariance.trace()
        ([1.0, 2.0, 0.0], np.float64(3.0))
        """
        known = alone(self.knowledge)
        return Stream(SoloKalman(assumed_motion(known, interval), known.gnss_variance), x0, history)


def correct(prior: Floats, spread: Floats, fix: Floats, noise: Floats) -> Gaussian:
    """Kalman update per axis, gain k = p / (p + r), x += k (z - x), p = (1 - k)^2 p + k^2 r (Joseph); none for NaN.

    Args:
        prior: (..., 3) m. spread: (..., 3) m^2 its variance. fix: (..., 3) m. noise: (..., 3) m^2 its variance.

    >>> correct(np.zeros(3), np.ones(3), np.array([2.0, 2.0, np.nan]), np.ones(3)).x
    array([1., 1., 0.])
    """
    missing = np.isnan(fix)
    gain = np.where(missing, 0.0, spread / (spread + noise))
    x = np.where(missing, prior, prior + gain * (fix - prior))
    return Gaussian(x, (1 - gain) ** 2 * spread + gain**2 * noise)


def solo_filter(
    gnss: Floats, velocity: Floats, process_variance: Floats, gnss_variance: Floats, dt: float,
    x0: Floats | None = None,
) -> tuple[Floats, Floats]:  # fmt: skip
    """Kalman filter per axis: all covariances are diagonal, so the three axes do not couple.

    predict x += dt u, p += q, and `correct`. A fix of NaN is missing: prediction only.

    Args:
        gnss, velocity: (R, T, N, 3), both NaN where a vehicle is absent; it starts anew at its first fix.
        process_variance: broadcastable to (R, T, N, 3) m^2. gnss_variance: (3,) m^2. dt: s.
        x0: (..., N, 3) m exact position at step 0, or None for the first fix.

    Returns:
        x and p of shape (R, T, N, 3): m and m^2.
    """
    q = np.broadcast_to(process_variance, gnss.shape)
    x, p = np.empty(gnss.shape), np.empty(gnss.shape)
    x[:, 0] = gnss[:, 0] if x0 is None else x0
    p[:, 0] = gnss_variance if x0 is None else 0.0
    if use_kernels():
        from ..kernels.solo import follow

        gnss, velocity = np.ascontiguousarray(gnss), np.ascontiguousarray(velocity)
        follow(gnss, velocity, q, np.asarray(gnss_variance), dt, x, p)
        return x, p
    for t in range(1, gnss.shape[1]):
        prior = x[:, t - 1] + dt * velocity[:, t]
        found = correct(prior, p[:, t - 1] + q[:, t], gnss[:, t], gnss_variance)
        joining = np.isnan(prior)
        x[:, t] = np.where(joining, gnss[:, t], found.x)
        p[:, t] = np.where(joining, gnss_variance, found.variance)
    return x, p

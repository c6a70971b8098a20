"""The solo Kalman filter on position with measured velocity as input, over all runs and vehicles at once."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..arrays import Floats
from ..errors import InputError
from ..kernels.motion import MotionNoise
from ..kernels.solo import Drive, FixNoise, drive
from ..short_repr import short_repr
from ..world.recording import Recording, check_recording
from ..world.v2x import NO_MESSAGE, Message
from .noise_model import NoiseModel, resolve
from .options import check_options
from .stream import NO_VARIANCE, FilterStream, alone, motion_noise, process_noise
from .track import Track


@dataclass(frozen=True, eq=False)
class Kalman:
    """Kalman filter of x_t = x_{t-1} + dt u_t, z_t = x_t + n, with the noise that `noise_model` names.

    Args:
        noise_model: "identity", "nominal" or a NoiseModel.
        x0: (R, E, 3) or (E, 3) m, a known start; None starts at the first fix.

    >>> from coopoc import Fleet, Sensors, observe
    >>> fleet = Fleet(("a",), [0, 0.1], np.zeros((2, 1, 3)), np.zeros((2, 1, 3)))
    >>> Kalman("nominal")(observe(fleet, Sensors(), runs=4)).x.shape
    (4, 2, 1, 3)
    """

    noise_model: NoiseModel | str = "nominal"
    x0: Floats | None = None
    name: str = "kalman"
    cooperative: bool = False
    message: Message = NO_MESSAGE

    __repr__ = short_repr

    def __post_init__(self) -> None:
        check_options(self)

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos; InputError if one is unknown or absent, or x0 has another shape."""
        began = time.perf_counter()
        columns = check_recording(recording).columns(egos, missing=True)
        known = resolve(self.noise_model, recording, relative=False)
        x, p, _ = filtered(drive_of(recording, known, columns), FixNoise(known.gnss_variance), self.x0)
        return axis_track(recording, columns, x, p, began)

    def start(
        self, x0: npt.ArrayLike | None = None, *, interval: float | None = None, history: float = 10.0
    ) -> FilterStream:
        """Start the filter for one step at a time: `step(gnss, velocity, dt, fix_age)`.

        A stream has no recording, so that "nominal" is NoiseModel.nominal(sensors).

        Args:
            x0: (3,) m, known before the first step; None starts at the first fix.
            interval: s, the step that the assumed process noise belongs to: a motion of dt s has dt / interval times
                its variance. None: every step is one, with the error of one measured velocity, as in a recording.
            history: s, how old a delayed fix may be.

        >>> x, covariance = Kalman("identity").start().step([1.0, 2.0, 0.0], [9.0, 0.0, 0.0], dt=0.1)
        >>> x.tolist(), covariance.trace()
        ([1.0, 2.0, 0.0], np.float64(3.0))
        """
        known = alone(self.noise_model)
        return FilterStream(motion_noise(known, interval), FixNoise(known.gnss_variance), x0, history)


def axis_track(
    recording: Recording, columns: Sequence[int], x: Floats, p: Floats, began: float, notes: tuple[str, ...] = ()
) -> Track:
    """Track of a solo filter with the variances p (R, T, E, 3) m^2; it receives and sends nothing."""
    cov, none = np.zeros((*p.shape, 3)), np.zeros((recording.runs, len(columns)))
    np.einsum("...ii->...i", cov)[:] = p
    return Track(recording.t, tuple(columns), x, cov, none, none, time.perf_counter() - began, notes=notes)


def drive_of(recording: Recording, known: NoiseModel | MotionNoise, columns: npt.ArrayLike) -> Drive:
    """What the solo filters of some vehicles run over, with the process noise of a noise model or of the velocity."""
    process, motion = (NO_VARIANCE, known) if isinstance(known, MotionNoise) else process_noise(known, recording)
    gnss, velocity = np.ascontiguousarray(recording.gnss), np.ascontiguousarray(recording.velocity)
    return Drive(gnss, velocity, np.broadcast_to(process, gnss.shape), motion, np.asarray(columns), recording.dt)


def filtered(seen: Drive, fixes: FixNoise, x0: Floats | None = None) -> tuple[Floats, Floats, Floats]:
    """Run a solo filter axis by axis: all covariances are diagonal, so that the three axes do not couple.

    Args:
        seen: measurements, and which vehicles are filtered.
        fixes: noise of the fixes, known or revised.
        x0: (..., E, 3) m, exact at step 0; None starts at the first fix.

    Returns:
        Position m, variance m^2, and believed variance of a fix m^2 (of no length where it is known), (R, T, E, 3).

    Raises:
        InputError: x0 of another shape.
    """
    shape = *seen.gnss.shape[:2], len(seen.columns), 3
    if x0 is not None and np.shape(x0)[-2:] != shape[2:]:
        raise InputError("x0", np.shape(x0), f"must end in (E, 3) = {shape[2:]}", "One start per ego.")
    x, p = np.empty(shape), np.empty(shape)
    if x0 is not None:
        x[:, 0] = x0
    return x, p, drive(seen, fixes, x0 is not None, np.arange(shape[2]), x, p)

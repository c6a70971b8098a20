"""Solo methods: the raw fix, and the Kalman filter on position, also fed one step at a time, with missing and delayed
fixes and whatever dt there is."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Floats, last_true
from ..kernels.compiling.waiting import clock
from ..kernels.dead_reckoning import ESTIMATE, NO_FIX_YET
from ..kernels.gate import FIX_GATE
from ..kernels.motion import MotionNoise, own_variances
from ..kernels.odometry_fault import new_state
from ..kernels.solo import POSITION, STATE, FixNoise, SoloMeasurements, run_filter, stream_step
from ..text import short_repr
from ..world.recording import Recording, Vehicles, check_recording
from .doubts import doubts
from .motion_history import MotionHistory, three
from .noise_model import NoiseModel, constant_noise, motion_noise, resolve
from .odometry_fault import with_odometry
from .track import Alone, Checked, Track, in_stretches, start_of


@dataclass(frozen=True)
class GNSS(Alone):
    r"""The latest fix, $\hat x_t = z_t$, with the assumed GNSS covariance; where there is none, the last one is
    held."""

    name: str = "gnss"

    @in_stretches
    def __call__(self, recording: Recording, egos: Vehicles = (0,)) -> Track:
        """Track of the egos; InputError if one is unknown or absent."""
        began = clock()
        columns = check_recording(recording).columns(egos)
        fixes = recording.gnss[:, :, columns]
        there = np.isfinite(fixes).all(axis=-1, keepdims=True)
        x, missing = np.take_along_axis(fixes, last_true(there, axis=1).clip(0), axis=1), 100 * (1 - there.mean())
        notes = (f"holds the last fix where there is none: {missing:.0f} % of the steps",) if missing else ()
        variance = np.broadcast_to(np.square(recording.sensors.gnss_std * recording.fix_scale[:, columns]), x.shape)
        return solo_track(recording, columns, x, variance, began, notes)


class FilterStream:
    """A compiled solo filter, step by step: `step` takes the new measurements and returns the estimate.

    Args:
        motion: noise of the motion.
        fixes: noise of the fixes.
        x0: (3,) m, a position known before the first step; None starts at the first fix.
        history: s, how old a delayed fix may be.
    """

    def __init__(self, motion: MotionNoise, fixes: FixNoise, x0: ArrayLike | None, history: float) -> None:
        self.history = MotionHistory(history)
        self._state, self._given = np.full(len(STATE), np.nan), np.zeros(8)
        self._noise = np.hstack((*motion, *fixes))
        self._odometry = new_state(motion) if fixes.gate > 0.0 else np.empty((0, 0))
        if x0 is not None:
            self._state[:] = STATE
            self._state[POSITION] = three("x0", x0)

    def step(
        self, gnss: ArrayLike | None, velocity: ArrayLike, dt: float, fix_age: float = 0.0
    ) -> tuple[Floats, Floats | None]:
        """Position (3,) m and covariance (3, 3) m^2 now; NaN and None before the first fix.

        A fix that was true `fix_age` seconds ago is moved by the dead-reckoned motion since, and its covariance grows
        by the noise of that motion. The filter's own prediction has made the same error of motion, and so have other
        delayed fixes: that correlation is ignored (docs/streaming.md gives its cost).

        Args:
            gnss: (3,) m; None or NaN for no fix.
            velocity: (3,) m/s, the mean over the step.
            dt: s since the last step.
            fix_age: s, of the fix; without a fix it means nothing.

        Raises:
            InputError: another shape, dt <= 0, a number that is not finite, a fix older than the history; the filter is
                then as it was before.
        """
        self.history.write(self._given, gnss, velocity, dt, fix_age)
        answer = np.empty(12)
        outcome = stream_step(self._given, self._state, self.history.reserve(), self._odometry, self._noise, answer)
        if outcome == NO_FIX_YET:
            return np.full(3, np.nan), None
        if outcome != ESTIMATE:
            self.history.check(gnss, velocity, dt, fix_age)
        return answer[:3], answer[3:].reshape(3, 3)


@dataclass(frozen=True, eq=False)
class Kalman(Alone, Checked):
    r"""Kalman filter of $x_t = x_{t-1} + \Delta t \, u_t + w$, $z_t = x_t + n$, with the noise that `noise_model`
    names.

    Args:
        noise_model: "identity", "nominal" or a NoiseModel.
        x0: (R, E, 3) or (E, 3) m, a known start; None starts at the first fix.
        robust: a fix whose innovation is beyond its gate weighs less, far beyond it nothing (`coopoc.kernels.gate`),
            unless many are. False believes every fix. With the identity noise model nothing is gated.

    >>> from coopoc import Fleet, Sensors, observe
    >>> fleet = Fleet(("a",), [0, 0.1], np.zeros((2, 1, 3)), np.zeros((2, 1, 3)))
    >>> Kalman("nominal")(observe(fleet, Sensors(), runs=4)).x.shape
    (4, 2, 1, 3)
    """

    noise_model: NoiseModel | str = "nominal"
    x0: Floats | None = None
    robust: bool = True
    name: str = "kalman"

    __repr__ = short_repr

    @in_stretches
    def __call__(self, recording: Recording, egos: Vehicles = (0,)) -> Track:
        """Track of the egos; InputError if one is unknown or absent, or x0 has another shape."""
        began = clock()
        columns = check_recording(recording).columns(egos, self.x0 is None)
        assumed = resolve(self.noise_model, recording, relative=False)
        if self.robust:
            recording, assumed = with_odometry(recording, columns, assumed)
        x, p, _ = solo_filter(recording, columns, assumed, fix_noise(assumed, self.robust), self.x0)
        return solo_track(recording, columns, x, p, began, assumed.notes, noise_model=assumed)

    def start(
        self, x0: ArrayLike | None = None, *, interval: float | None = None, history: float = 10.0
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
        noise_model = constant_noise(self.noise_model)
        return FilterStream(motion_noise(noise_model, interval), fix_noise(noise_model, self.robust), x0, history)


def fix_noise(noise_model: NoiseModel, robust: bool) -> FixNoise:
    """Known noise of fixes, gated if robust; not where no noise is stated that an innovation could exceed."""
    return FixNoise(noise_model.gnss_variance, FIX_GATE if robust and noise_model.exact_relative else 0.0)


def solo_track(
    recording: Recording,
    columns: Sequence[int],
    x: Floats,
    p: Floats | None,
    began: float,
    notes: tuple[str, ...] = (),
    noise_model: NoiseModel | str = "nominal",
) -> Track:
    """Track of a solo filter with the variances p (R, T, E, 3) m^2, if it claims any; it receives and sends nothing."""
    cov, none = None if p is None else np.zeros((*p.shape, 3)), np.zeros((recording.runs, len(columns)))
    if cov is not None:
        np.einsum("...ii->...i", cov)[:] = p
        cov.flags.writeable = False  # so that the Track need not copy it
    notes = (*notes, *doubts(recording, columns, x, cov, noise_model, earlier=notes))
    x.flags.writeable = False
    return Track(recording.t, tuple(columns), x, cov, none, none, clock() - began, notes=notes, ids=recording.ids)


def solo_filter(
    recording: Recording,
    columns: ArrayLike,
    noise: NoiseModel | MotionNoise,
    fixes: FixNoise,
    x0: Floats | None = None,
    *,
    in_place: bool = False,
) -> tuple[Floats, Floats, Floats]:
    """Run a solo filter axis by axis: all covariances are diagonal, so that the three axes do not couple.

    Args:
        recording: of all vehicles.
        columns: (E,) vehicles that are filtered.
        noise: of the motion.
        fixes: noise of the fixes.
        x0: (..., E, 3) m, exact at step 0; None starts at the first fix.
        in_place: leave the vehicles at their columns among all N; of others nothing is written.

    Returns:
        Position m, variance m^2, and variance of each fix m^2 where it is gated (else of no length),
        (R, T, E, 3) or (R, T, N, 3).

    Raises:
        InputError: x0 of another shape.
    """
    gnss, velocity = np.ascontiguousarray(recording.gnss), np.ascontiguousarray(recording.velocity)
    columns = np.asarray(columns)
    shape = *gnss.shape[:2], len(columns), 3
    first = int(x0 is not None)
    if isinstance(noise, MotionNoise):
        process, scale = own_variances(noise, velocity[:, :, columns], recording.dt, first), recording.fix_scale
        process = process + recording.motion_extra[:, columns]
    else:
        process, scale = noise.process_variance(recording, columns, first=first), noise.fix_scale(recording)
    variance = np.broadcast_to(scale**2 * fixes.variance, gnss.shape[1:])[:, columns]
    inputs = SoloMeasurements(gnss, velocity, np.broadcast_to(process, shape), variance, columns, recording.dt)
    index, size = (columns, gnss.shape) if in_place else (np.arange(len(columns)), shape)
    x, p = np.empty(size), np.empty(size)
    if first:
        x[:, 0] = start_of(x0, gnss[:, 0, columns])
    return x, p, run_filter(inputs, fixes.gate, first > 0, index, x, p)

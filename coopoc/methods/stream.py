"""Streaming: a solo filter that is fed one step at a time, with missing and delayed fixes and whatever dt there is."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from ..arrays import Floats, number
from ..errors import InputError
from ..kernels.motion import NO_MOTION_NOISE, MotionNoise
from ..kernels.solo import ESTIMATE, GNSS, HISTORY_FULL, NO_FIX_YET, VELOCITY, FixNoise, packed, stream_step
from ..world.recording import Recording, check_recording
from .motion_history import PLAIN, MotionHistory, check_step, three
from .noise_model import NoiseModel, resolve
from .track import Track

State = TypeVar("State")
NO_VARIANCE: Floats = np.zeros((1, 1, 1, 3))


class Solo(Protocol[State]):
    """A filter of one vehicle as pure functions of its state; arrays are (..., 3), runs and egos before the axes."""

    def begin(self, x: Floats, late: Floats | None) -> State:
        """State at a position x m that is known exactly (None), or at a first fix with `late` m^2 more than others."""

    def process(self, velocity: Floats, dt: float) -> Floats:
        """Variance m^2 of the motion dt u."""

    def advance(self, state: State, moved: Floats, process: Floats, fix: Floats, late: Floats) -> State:
        """One step: motion m, its variance m^2, fix m or NaN for none, variance m^2 that a late fix has more."""

    def read(self, state: State) -> tuple[Floats, Floats | None]:
        """Position (..., 3) m and covariance (..., 3, 3) m^2, or None if it claims none."""


class Stream(Generic[State]):
    """A solo filter of one's own, step by step: `step` takes the new measurements and returns the estimate.

    Args:
        solo: the filter.
        x0: (3,) m, a position known before the first step; None starts at the first fix.
        history: s, how old a delayed fix may be.
    """

    def __init__(self, solo: Solo[State], x0: npt.ArrayLike | None = None, history: float = 10.0) -> None:
        self.solo, self.history = solo, MotionHistory(history)
        self.state: State | None = None if x0 is None else solo.begin(three("x0", x0), None)

    def step(
        self, gnss: npt.ArrayLike | None, velocity: npt.ArrayLike, dt: float, fix_age: float = 0.0
    ) -> tuple[Floats, Floats | None]:
        """Position (3,) m and covariance (3, 3) m^2, as `FilterStream.step`; None if the filter claims none."""
        check_step(gnss, velocity, dt, fix_age, self.history)
        speed = np.asarray(velocity, dtype=float)
        moved, process = dt * speed, self.solo.process(speed, dt)
        self.history.push(dt, moved, process)
        fix, late = self.history.forward(gnss, fix_age)
        if self.state is not None:
            self.state = self.solo.advance(self.state, moved, process, fix, late)
        elif np.isfinite(fix).all():
            self.state = self.solo.begin(fix, late)
        else:
            return np.full(3, np.nan), None
        return self.solo.read(self.state)


class AxisStates(NamedTuple):
    """State of a compiled solo filter, (3,) each: position m, its variance share * noise + motion m^2, the variance of
    a fix m^2, and the fixes behind that."""

    x: Floats
    share: Floats
    motion: Floats
    noise: Floats
    weight: Floats


class FilterStream:
    """A compiled solo filter, step by step: `step` takes the new measurements and returns the estimate.

    Args:
        motion: noise of the motion.
        fixes: noise of the fixes.
        x0: (3,) m, a position known before the first step; None starts at the first fix.
        history: s, how old a delayed fix may be.
    """

    def __init__(self, motion: MotionNoise, fixes: FixNoise, x0: npt.ArrayLike | None, history: float) -> None:
        self.history = MotionHistory(history)
        self._state, self._given, self._noise = np.full((3, 5), np.nan), np.zeros(8), packed(motion, fixes)
        if x0 is not None:
            zero = np.zeros(3)
            weight = np.full(3, fixes.weight)
            self._state[:] = np.stack([three("x0", x0), zero, zero, fixes.variance, weight], axis=1)

    @property
    def state(self) -> AxisStates | None:
        """State of the filter; None before the first fix."""
        return None if np.isnan(self._state[0, 0]) else AxisStates(*self._state.T.copy())

    def step(
        self, gnss: npt.ArrayLike | None, velocity: npt.ArrayLike, dt: float, fix_age: float = 0.0
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
        given, answer = self._given, np.empty(12)
        if not (isinstance(dt, float) and isinstance(fix_age, float) and {type(gnss), type(velocity)} <= PLAIN):
            check_step(gnss, velocity, dt, fix_age, self.history)
        try:
            if np.shape(velocity) != (3,) or (gnss is not None and np.shape(gnss) != (3,)):
                check_step(gnss, velocity, dt, fix_age, self.history)
            given[GNSS], given[VELOCITY], given[6], given[7] = np.nan if gnss is None else gnss, velocity, dt, fix_age
        except Exception:  # a class from elsewhere may raise anything
            check_step(gnss, velocity, dt, fix_age, self.history)
            raise
        found = stream_step(given, self._state, self.history.rows, self._noise, answer)
        while found == HISTORY_FULL:
            self.history.grow()
            found = stream_step(given, self._state, self.history.rows, self._noise, answer)
        if found == NO_FIX_YET:
            return np.full(3, np.nan), None
        if found != ESTIMATE:
            check_step(gnss, velocity, dt, fix_age, self.history)
        return answer[:3], answer[3:].reshape(3, 3)


def alone(noise_model: NoiseModel | str) -> NoiseModel:
    """The noise model of a filter without a recording: "identity" or a NoiseModel of constant noise, which needs
    none."""
    name = noise_model.name if isinstance(noise_model, NoiseModel) else noise_model
    bound = isinstance(noise_model, NoiseModel) and (
        type(noise_model) is not NoiseModel or noise_model.velocity is not None
    )
    if bound or noise_model == "nominal":
        raise InputError(
            "noise_model",
            repr(name),
            "needs a recording, and a stream has none",
            "Pass NoiseModel.nominal(Sensors(...)), a fitted NoiseModel or 'identity'.",
        )
    return resolve(noise_model, None)  # type: ignore[arg-type]


def motion_noise(known: NoiseModel, interval: float | None) -> MotionNoise:
    """White motion noise as `known` assumes it of a recording with dt = `interval` s; None for the dt of each step."""
    interval = 0.0 if interval is None else check_interval(interval)
    if known.process_std is not None:
        return MotionNoise(np.array(known.process_std, dtype=float), np.zeros(3), 0.0, 0.0, interval)
    assert known.sensors is not None
    ratio, of_speed = np.full(3, known.sensors.velocity_std_ratio), known.sensors.velocity_reading == "speed"
    return MotionNoise(np.zeros(3), ratio, float(known.sensors.velocity_floor), float(of_speed), interval)


def process_noise(known: NoiseModel, recording: Recording) -> tuple[Floats, MotionNoise]:
    """Process noise of a recording's steps as a sum: m^2 broadcastable to (R, T, N, 3), and that of the velocity."""
    if known.follows_measured_velocity:
        return NO_VARIANCE, motion_noise(known, None)
    return np.ascontiguousarray(known.process_variance(recording)), NO_MOTION_NOISE


def check_interval(interval: float) -> float:
    """The interval, s; InputError unless it is finite and > 0."""
    hint = "The dt that the noise belongs to."
    found: float = number("interval", interval, sys.float_info.min, allowed="finite and > 0", hint=hint)
    return found


def scan(solo: Solo[State], recording: Recording, columns: Sequence[int], x0: Floats | None) -> Iterator[State]:
    """The T states (R, E, 3) of a solo filter over a recording, from a known start (..., E, 3) m or the first fix."""
    if x0 is not None and np.shape(x0)[-2:] != (len(columns), 3):
        raise InputError("x0", np.shape(x0), f"must end in (E, 3) = ({len(columns)}, 3)", "One start per ego.")
    gnss, velocity = recording.gnss[:, :, columns], recording.velocity[:, :, columns]
    on_time = np.zeros(3)
    state = solo.begin(gnss[:, 0], on_time) if x0 is None else solo.begin(np.broadcast_to(x0, gnss[:, 0].shape), None)
    yield state
    for t in range(1, gnss.shape[1]):
        process = solo.process(velocity[:, t], recording.dt)
        state = solo.advance(state, recording.dt * velocity[:, t], process, gnss[:, t], on_time)
        yield state


def solo_track(
    solo: Solo[State], recording: Recording, egos: Sequence[int | str], x0: Floats | None, notes: tuple[str, ...] = ()
) -> Track:
    """Track of a solo filter, which receives and sends nothing; InputError if an ego is unknown or absent."""
    began, columns = time.perf_counter(), check_recording(recording).columns(egos, missing=True)
    found = [solo.read(state) for state in scan(solo, recording, columns, x0)]
    x = np.stack([position for position, _ in found], axis=1)
    claims = [covariance for _, covariance in found if covariance is not None]
    free = np.zeros((recording.runs, len(columns)))
    return Track(
        recording.t,
        tuple(columns),
        x,
        np.stack(claims, axis=1) if claims else None,
        free,
        free,
        time.perf_counter() - began,
        notes=notes,
    )

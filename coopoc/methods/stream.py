"""Streaming: a solo filter that is fed one step at a time, with missing and delayed fixes and whatever dt there is."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from ..arrays import Floats
from ..errors import InputError
from ..kernels.dead_reckoning import ESTIMATE, NO_FIX_YET
from ..kernels.motion import MotionNoise
from ..kernels.solo import FixNoise, stream_step
from ..world.recording import Recording, check_recording
from .motion_history import MotionHistory, three
from .track import Track

State = TypeVar("State")


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
        self.history.check(gnss, velocity, dt, fix_age)
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
        self._state, self._given, self._noise = np.full((3, 6), np.nan), np.zeros(8), (motion, fixes)
        if x0 is not None:
            zero, weight = np.zeros(3), np.full(3, fixes.weight)
            self._state[:] = np.stack([three("x0", x0), zero, zero, fixes.variance, weight, zero], axis=1)

    @property
    def state(self) -> AxisStates | None:
        """State of the filter; None before the first fix."""
        return None if np.isnan(self._state[0, 0]) else AxisStates(*self._state.T[:5].copy())

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
        self.history.write(self._given, gnss, velocity, dt, fix_age)
        answer = np.empty(12)
        outcome = stream_step(self._given, self._state, self.history.reserve(), *self._noise, answer)
        if outcome == NO_FIX_YET:
            return np.full(3, np.nan), None
        if outcome != ESTIMATE:
            self.history.check(gnss, velocity, dt, fix_age)
        return answer[:3], answer[3:].reshape(3, 3)


def solo_track_of(solo: Solo[State], recording: Recording, egos: Sequence[int | str], x0: Floats | None) -> Track:
    """Track of a solo filter of one's own, from a known start x0 (..., E, 3) m or the first fix.

    Raises:
        InputError: an ego that is unknown or absent; x0 of another shape.
    """
    began, columns = time.perf_counter(), check_recording(recording).columns(egos, missing=True)
    gnss, velocity = recording.gnss[:, :, columns], recording.velocity[:, :, columns]
    if x0 is not None and np.shape(x0)[-2:] != gnss.shape[2:]:
        raise InputError("x0", np.shape(x0), f"must end in (E, 3) = {gnss.shape[2:]}", "One start per ego.")
    on_time, dt = np.zeros(3), recording.dt
    state = solo.begin(gnss[:, 0], on_time) if x0 is None else solo.begin(np.broadcast_to(x0, gnss[:, 0].shape), None)
    estimates = [solo.read(state)]
    for t in range(1, gnss.shape[1]):
        process = solo.process(velocity[:, t], dt)
        state = solo.advance(state, dt * velocity[:, t], process, gnss[:, t], on_time)
        estimates.append(solo.read(state))
    x = np.stack([position for position, _ in estimates], axis=1)
    claims = [covariance for _, covariance in estimates if covariance is not None]
    none = np.zeros((recording.runs, len(columns)))
    cov = np.stack(claims, axis=1) if claims else None
    return Track(recording.t, tuple(columns), x, cov, none, none, time.perf_counter() - began)

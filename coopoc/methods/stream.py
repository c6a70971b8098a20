"""Streaming: a solo filter that is fed one step at a time, with missing and delayed fixes and whatever dt there is."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from ..arrays import Floats
from ..errors import InputError
from ..world.recording import Recording
from .knowledge import Knowledge, resolve
from .track import Track

State = TypeVar("State")
Variance = Callable[[Floats, float], Floats]
"""Velocity (..., 3) m/s and dt s -> variance (..., 3) m^2 of the motion dt u."""
ROUNDING = 1e-9
"""s, by how much sums of time steps may miss a time."""


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


class Moved(NamedTuple):
    """One step of dead reckoning: dt s, motion (3,) m, its variance (3,) m^2."""

    dt: float
    moved: Floats
    process: Floats


@dataclass(frozen=True, eq=False)
class Past:
    """How a vehicle moved lately: the newest steps, `seen` seconds in all, which is `span` or what there has been."""

    span: float
    steps: tuple[Moved, ...] = ()
    seen: float = 0.0

    def __post_init__(self) -> None:
        seconds("history", self.span)

    def then(self, step: Moved) -> Past:
        """The past one step later."""
        steps, seen = (*self.steps, step), self.seen + step.dt
        while len(steps) > 1 and seen - steps[0].dt >= self.span:
            seen -= steps[0].dt
            steps = steps[1:]
        return Past(self.span, steps, seen)

    def since(self, age: float) -> tuple[Floats, Floats]:
        """Motion (3,) m in the last `age` seconds and its variance (3,) m^2; of a step that is cut, its part.

        Raises:
            InputError: negative, or before what is kept.
        """
        if not -ROUNDING <= age <= self.seen + ROUNDING:
            raise InputError("fix_age", f"{age} s", f"must be in 0..{self.seen:g} s, the motion that is kept",
                             "Leave such a fix out (None), or keep more: start(..., history=).")  # fmt: skip
        moved, process, left = np.zeros(3), np.zeros(3), age
        for step in reversed(self.steps):
            if left <= 0:
                break
            part = min(left / step.dt, 1.0)
            moved, process, left = moved + part * step.moved, process + part * step.process, left - step.dt
        return moved, process

    def forward(self, gnss: npt.ArrayLike | None, age: float) -> tuple[Floats, Floats]:
        """A fix of `age` seconds ago moved to now, (3,) m, NaN for none, and the variance of that motion, (3,) m^2."""
        fix = fix_or_none(gnss)
        if np.isnan(fix).all():
            return fix, np.zeros(3)
        moved, process = self.since(age)
        return fix + moved, process


class Stream(Generic[State]):
    """A solo filter that runs: `step` takes what came since the last one and answers with what is known now.

    Args:
        solo: the filter. x0: (3,) m, a known position before the first step; None: the first fix starts it.
        history: s, how old a delayed fix may be.
    """

    def __init__(self, solo: Solo[State], x0: npt.ArrayLike | None = None, history: float = 10.0) -> None:
        self.solo, self.past = solo, Past(history)
        self.state: State | None = None if x0 is None else solo.begin(three("x0", x0), None)

    def step(
        self, gnss: npt.ArrayLike | None, velocity: npt.ArrayLike, dt: float, fix_age: float = 0.0
    ) -> tuple[Floats, Floats | None]:
        """Position (3,) m and covariance (3, 3) m^2 now; NaN and None before the first fix, None if it claims none.

        A fix that was true `fix_age` seconds ago is moved by the dead-reckoned motion since, and its covariance grows
        by the noise of that motion. The filter's own prediction has made the same error of motion, and so have other
        delayed fixes: that correlation is ignored (docs/streaming.md says what it costs).

        Args:
            gnss: (3,) m, or None or NaN: no fix. velocity: (3,) m/s, the mean over the step. dt: s since the last step.
            fix_age: s, of the fix; it means nothing without one.

        Raises:
            InputError: another shape, dt <= 0, a number that is not finite, a fix older than the history; the filter is
                then as it was before.
        """
        moved = motion(velocity, dt)
        process = self.solo.process(np.asarray(velocity, dtype=float), dt)
        past = self.past.then(Moved(dt, moved, process))
        fix, late = past.forward(gnss, fix_age)
        self.past = past
        if self.state is not None:
            self.state = self.solo.advance(self.state, moved, process, fix, late)
        elif np.isfinite(fix).all():
            self.state = self.solo.begin(fix, late)
        else:
            return np.full(3, np.nan), None
        return self.solo.read(self.state)


def three(field: str, value: npt.ArrayLike) -> Floats:
    """(3,) finite numbers; InputError naming the field if they are not.

    >>> three("velocity", [1, 2])
    Traceback (most recent call last):
    ...
    coopoc.errors.InputError: velocity = [1, 2]: must be three finite numbers. Give east, north, up.
    """
    array = np.asarray(value, dtype=float)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise InputError(field, value, "must be three finite numbers", "Give east, north, up.")
    return array


def fix_or_none(gnss: npt.ArrayLike | None, field: str = "gnss") -> Floats:
    """(3,) m, all NaN if there is no fix; InputError for a fix in part."""
    if gnss is None or (np.shape(gnss) == (3,) and np.isnan(np.asarray(gnss, dtype=float)).all()):
        return np.full(3, np.nan)
    return three(field, gnss)


def motion(velocity: npt.ArrayLike, dt: float) -> Floats:
    """dt u, (3,) m; InputError for a velocity that is not finite or dt <= 0."""
    if not (np.isfinite(dt) and dt > 0):
        raise InputError("dt", f"{dt} s", "must be finite and > 0", "Give the seconds since the last step.")
    return dt * three("velocity", velocity)


def seconds(field: str, value: float) -> float:
    """A time that is finite and >= 0; InputError naming the field if it is not."""
    if not (np.isfinite(value) and value >= 0):
        raise InputError(field, f"{value} s", "must be finite and >= 0", "Give seconds.")
    return value


def alone(knowledge: Knowledge | str) -> Knowledge:
    """What a filter without a recording assumes: "identity" or a Knowledge of constant noise, which needs none."""
    name = knowledge.name if isinstance(knowledge, Knowledge) else knowledge
    bound = isinstance(knowledge, Knowledge) and (type(knowledge) is not Knowledge or knowledge.velocity is not None)
    if bound or knowledge == "nominal":
        raise InputError("knowledge", repr(name), "needs a recording, and a stream has none",
                         "Pass Knowledge.nominal(Sensors(...)), a fitted Knowledge or 'identity'.")  # fmt: skip
    return knowledge if isinstance(knowledge, Knowledge) else resolve(knowledge, None)  # type: ignore[arg-type]


def white(step: Callable[[Floats], Floats], interval: float) -> Variance:
    """Variance of motion as white noise: of a step of `interval` s at a velocity, `step(u)`, times dt / interval.

    So a step of 0.2 s is as uncertain as two of 0.1 s, and one of `interval` as in a recording of that dt.
    """
    if not (np.isfinite(interval) and interval > 0):
        raise InputError("interval", f"{interval} s", "must be finite and > 0", "The dt that the noise belongs to.")
    return lambda velocity, dt: dt / interval * step(velocity)


def assumed_motion(known: Knowledge, interval: float) -> Variance:
    """White motion noise as `known` assumes it of a recording with dt = `interval` s."""

    def step(velocity: Floats) -> Floats:
        if known.process_std is not None:
            return np.square(known.process_std)
        assert known.sensors is not None
        return np.asarray((interval * known.sensors.assumed_velocity_std(velocity)) ** 2)

    return white(step, interval)


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
    began, columns = time.perf_counter(), recording.columns(egos, missing=True)
    found = [solo.read(state) for state in scan(solo, recording, columns, x0)]
    x = np.stack([position for position, _ in found], axis=1)
    claims = [covariance for _, covariance in found if covariance is not None]
    free = np.zeros((recording.runs, len(columns)))
    return Track(recording.t, tuple(columns), x, np.stack(claims, axis=1) if claims else None, free, free,
                 time.perf_counter() - began, notes=notes)  # fmt: skip

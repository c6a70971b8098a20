"""Streaming with neighbours: the star around one vehicle, fed step by step with measurements and messages."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from ..arrays import Floats, Ints, instance
from ..errors import InputError
from ..kernels.dead_reckoning import ESTIMATE, NO_FIX_YET
from ..kernels.motion import NO_MOTION_NOISE
from ..kernels.stars.messages import ACCELERATION_STD, FIX_GROWTH, FORGOTTEN, Assumptions
from ..kernels.stars.star_stream import (
    FIX,
    LAST_AGE,
    MESSAGE,
    MESSAGE_AGE,
    PREVIOUS,
    RELATIVE,
    VELOCITY,
    WIDTH,
    Noise,
    packed,
    resized,
    stream_step,
)
from .egos import relative_noise
from .joint_filter import JointFilter
from .motion_history import MotionHistory, fix_or_none, names_of, numbers, seconds, three
from .noise_model import constant_noise, motion_noise


@dataclass(frozen=True, eq=False)
class RelativeMeasurement:
    """A neighbour as the ego measures it now, with the message that has newly come from it, if any.

    Args:
        id: name of the neighbour.
        relative: (3,) range m, world azimuth rad, inclination rad; NaN for a component that is missing.
        gnss: (3,) m, the fix in the message; None or NaN for none.
        velocity: (3,) m/s of the message; None for no message.
        age: s since fix and velocity of the message were measured.

    >>> RelativeMeasurement("b", [9.0, 0.1, 1.57]).velocity is None
    True
    """

    id: str
    relative: npt.ArrayLike
    gnss: npt.ArrayLike | None = None
    velocity: npt.ArrayLike | None = None
    age: float = 0.0
    row: Floats = field(init=False, repr=False)

    def __post_init__(self) -> None:
        row = np.full(11, np.nan)
        relative, named = numbers(self.relative), isinstance(self.id, str) and self.id
        if relative.shape != (3,) or not named or not (0.0 < relative[0] < math.inf or math.isnan(relative[0])):
            text = "must have a name and three numbers, the range first and > 0"
            raise InputError("relative", (self.id, self.relative), text, "Give NaN for what was not measured.")
        row[RELATIVE], row[MESSAGE] = relative, float(self.velocity is not None)
        row[FIX], row[MESSAGE_AGE] = fix_or_none(self.gnss, "neighbour's gnss"), seconds("age", self.age)
        if self.velocity is not None:
            row[VELOCITY] = three("neighbour's velocity", self.velocity)
        elif math.isfinite(row[FIX][0]):
            raise InputError("velocity", None, f"must come with the fix of {self.id}", "Send both in one message.")
        object.__setattr__(self, "row", row)


class StarStream:
    """The joint filter, fed step by step: like `FilterStream`, with the neighbours that are measured at each step.

    The neighbours measured now are in the star. Between messages a neighbour moves with the velocity of its newest one
    until that is `max_age` seconds old; a velocity used for L seconds makes an error of L times its own. Of a vehicle
    that is measured but whose messages never arrive, nothing is assumed.

    For a recording the std of ranges that are finer than their angles bear is raised (`noise_model.resolve`); a stream
    does not know the ranges to come, and takes what the noise model says.

    Args:
        filter: its noise model is "identity" or holds constant noise.
        x0: (3,) m, a position known before the first step; None starts at the first fix.
        interval: s, the step that the assumed process noise belongs to: a motion of dt s has dt / interval times its
            variance. None: every step is one, with the error of one measured velocity, as in a recording.
        history: s, how old a delayed fix may be.
        max_age: s, older messages of neighbours are not used.

    Raises:
        InputError: a noise model that needs a recording, a time that is negative or not finite.

    >>> from coopoc import JointFilter
    >>> ego = StarStream(JointFilter("identity"))
    >>> other = RelativeMeasurement("b", [9.0, 0.0, 1.5707963], gnss=[10.0, 0.0, 0.0], velocity=[9.0, 0.0, 0.0])
    >>> x, _ = ego.step([0.0, 0.0, 0.0], [9.0, 0.0, 0.0], dt=0.1, neighbours=[other])
    >>> float(x[0].round(3)), float(ego.neighbours["b"][0].round(3))  # 10 m apart by the fixes, 9 m as measured
    (0.333, 9.667)
    """

    def __init__(
        self,
        filter: JointFilter,
        x0: npt.ArrayLike | None = None,
        *,
        interval: float | None = None,
        history: float = 10.0,
        max_age: float = 1.0,
    ) -> None:
        known = constant_noise(instance("filter", filter, JointFilter).noise_model)
        refine = filter.exact and known.exact_relative
        motion, fixes = motion_noise(known, interval), known.gnss_variance[None, None, None]
        assumed = Assumptions(
            fixes, fixes, fixes, FIX_GROWTH, *relative_noise(known), FORGOTTEN, ACCELERATION_STD, NO_MOTION_NOISE
        )
        self.max_age, self.history = seconds("max_age", max_age), MotionHistory(history)
        self._noise = packed(Noise(motion, assumed, self.max_age, refine))
        self._members: dict[str, int] = {}
        self._messages: dict[str, tuple[Floats, float]] = {}
        self._time, self._size = 0.0, 0
        self._given, self._answer = np.zeros(12), np.zeros(12)
        if x0 is not None:
            self._given[8:11], self._given[11] = three("x0", x0), 1.0
        self._memory: Floats = np.zeros(0)
        self._columns: Ints = np.zeros(0, np.int64)
        self._reserve(8)

    def _reserve(self, most: int) -> None:
        """Room for `most` members of the star, with the state and the information of the last one."""
        self._memory = resized(self._memory, self._size, len(self._columns) // 3, most)
        self._columns, self._rows = np.zeros(3 * most, np.int64), np.zeros((most, WIDTH))

    @property
    def neighbours(self) -> dict[str, Floats]:
        """Positions (3,) m of the neighbours in the star."""
        return dict(zip(self._members, self._answer[12:].reshape(-1, 3).copy(), strict=True))

    def step(
        self,
        gnss: npt.ArrayLike | None,
        velocity: npt.ArrayLike,
        dt: float,
        fix_age: float = 0.0,
        neighbours: Sequence[RelativeMeasurement] = (),
    ) -> tuple[Floats, Floats | None]:
        """Position (3,) m and covariance (3, 3) m^2 of the ego; NaN and None before its first fix.

        Args:
            gnss: (3,) m of the ego; None or NaN for no fix.
            velocity: (3,) m/s of the ego, the mean over the step.
            dt: s since the last step.
            fix_age: s, of the fix.
            neighbours: the relative measurements of now, one for each neighbour.

        Raises:
            InputError: as `FilterStream.step`; a neighbour that is given twice. The filter is then as it was before.
        """
        names = names_of("neighbours", neighbours, RelativeMeasurement)
        self.history.write(self._given, gnss, velocity, dt, fix_age)
        rows, answer = self._fill(names, neighbours), np.empty(12 + 3 * len(names))
        memory, history = self._memory, self.history.reserve()
        outcome = stream_step(self._given, rows, memory, self._columns, self._size, history, self._noise, answer)
        if outcome not in (ESTIMATE, NO_FIX_YET):
            self.history.check(gnss, velocity, dt, fix_age)
        self._remember(names, rows, dt)
        if outcome == NO_FIX_YET:
            return np.full(3, np.nan), None
        self._members, self._size, self._answer = {name: k for k, name in enumerate(names, 1)}, 1 + len(names), answer
        return answer[:3], answer[3:12].reshape(3, 3)

    def _fill(self, names: list[str], neighbours: Sequence[RelativeMeasurement]) -> Floats:
        """(k, WIDTH) the measurements, each with its vehicle's last message and index in the last star."""
        if 3 * len(names) >= len(self._columns):
            self._reserve(2 * (len(names) + 1))
        rows = self._rows[: len(names)]
        for row, name, measured in zip(rows, names, neighbours, strict=True):
            row[:11] = measured.row
            last, when = self._messages.get(name, NO_MESSAGE)
            row[11:16], row[PREVIOUS] = last, self._members.get(name, -1)
            row[LAST_AGE] += self._time - when
        return rows

    def _remember(self, names: list[str], rows: Floats, dt: float) -> None:
        """Keep the last messages; forget vehicles whose messages are too old."""
        self._time += dt
        if len(self._messages) > 64 + 2 * len(names):
            self._messages = {
                name: (last, when)
                for name, (last, when) in self._messages.items()
                if last[3] + self._time - when <= self.max_age
            }
        for name, last in zip(names, rows[:, 11:16].copy(), strict=True):
            self._messages[name] = last, self._time


NO_MESSAGE = np.array([0.0, 0.0, 0.0, np.inf, 0.0]), 0.0
"""Velocity m/s, age s and how long it has served, s, and when that was so."""

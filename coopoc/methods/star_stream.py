"""Streaming with neighbours: the star around one vehicle, fed step by step with measurements and messages."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from ..arrays import Floats, Ints
from ..errors import InputError
from ..kernels.motion import NO_MOTION_NOISE
from ..kernels.solo import ESTIMATE, HISTORY_FULL, NO_FIX_YET
from ..kernels.stars.messages import Assumptions
from ..kernels.stars.star_stream import (
    FIX,
    MESSAGE,
    MESSAGE_AGE,
    RELATIVE,
    VELOCITY,
    Noise,
    packed,
    resized,
    stream_step,
)
from .motion_history import PLAIN, MotionHistory, check_step, fix_or_none, names_of, numbers, seconds, three
from .noise_model import NoiseModel
from .star import ACCELERATION_STD, FORGOTTEN, relative_noise
from .stream import motion_noise


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
    """The joint filter, fed step by step: like `Stream`, with the neighbours that are measured at each step.

    The neighbours measured now are in the star. Between messages a neighbour moves with the velocity of its newest one
    until that is `max_age` seconds old; a velocity used for L seconds makes an error of L times its own. Of a vehicle
    that is measured but whose messages never arrive, nothing is assumed.

    Args:
        known: the noise model.
        refine: one Gauss-Newton step on range and angles.
        x0: (3,) m, a position known before the first step; None starts at the first fix.
        interval: s, the step that the assumed process noise belongs to; None for every step.
        history: s, how old a delayed fix may be.
        max_age: s, older messages are not used.
    """

    def __init__(
        self,
        known: NoiseModel,
        refine: bool,
        x0: npt.ArrayLike | None,
        interval: float | None,
        history: float,
        max_age: float,
    ) -> None:
        motion, fixes = motion_noise(known, interval), known.gnss_variance[None, None, None]
        assumed = Assumptions(
            fixes, fixes, fixes, (1.0, 0.0), *relative_noise(known), FORGOTTEN, ACCELERATION_STD, NO_MOTION_NOISE
        )
        self.max_age = seconds("max_age", max_age)
        self._noise = packed(Noise(motion, assumed, float(max_age), refine))
        self.history = MotionHistory(history)
        self.slots: dict[str, int] = {}
        self.members: list[str] = []
        self._given, self._answer, self._free = np.zeros(12), np.zeros(12), list[int]()
        if x0 is not None:
            self._given[8:11], self._given[11] = three("x0", x0), 1.0
        self._numbers: Floats = np.zeros(0)
        self._index, self._last = np.zeros(2, np.int64), np.zeros((0, 5))
        self._reserve(8)

    def _reserve(self, most: int) -> None:
        """Room for `most` members of the star."""
        size, place = self._index[:2].copy(), self._place
        self._numbers = resized(self._numbers, size, most)
        self._index = np.concatenate([[size[0], most], np.zeros(3 * most, np.int64), place])
        self._inbox = np.zeros((most, 12))

    @property
    def _place(self) -> Ints:
        return self._index[2 + 3 * self._index[1] :]

    def _slot(self, name: str, names: Sequence[str]) -> int:
        """A row for a vehicle that is not known, or no longer."""
        if not self._free:
            last, place = self._last, self._place
            old = [n for n, k in self.slots.items() if last[k, 3] > self.max_age and place[k] < 0 and n not in names]
            self._free = [self.slots.pop(n) for n in old]
        if not self._free:
            more = max(16, len(last))
            self._free = list(range(len(last), len(last) + more))
            self._last, self._index = np.pad(last, ((0, more), (0, 0))), np.append(self._index, np.full(more, -1))
        slot = self.slots[name] = self._free.pop()
        self._last[slot] = (0.0, 0.0, 0.0, np.inf, 0.0)
        return slot

    @property
    def neighbours(self) -> dict[str, Floats]:
        """Positions (3,) m of the neighbours in the star."""
        return dict(zip(self.members, self._answer[12:].reshape(-1, 3).copy(), strict=True))

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
            InputError: as `Stream.step`; a neighbour that is given twice. The filter is then as it was before.
        """
        names, given = names_of("neighbours", neighbours, RelativeMeasurement), self._given
        if not (isinstance(dt, float) and isinstance(fix_age, float) and {type(gnss), type(velocity)} <= PLAIN):
            check_step(gnss, velocity, dt, fix_age, self.history)
        try:
            if np.shape(velocity) != (3,) or (gnss is not None and np.shape(gnss) != (3,)):
                check_step(gnss, velocity, dt, fix_age, self.history)
            given[:3], given[3:6], given[6], given[7] = np.nan if gnss is None else gnss, velocity, dt, fix_age
        except Exception:  # a class from elsewhere may raise anything
            check_step(gnss, velocity, dt, fix_age, self.history)
            raise
        k = len(names)
        if k >= self._index[1]:
            self._reserve(2 * (k + 1))
        for i, one in enumerate(neighbours):
            self._inbox[i, :11] = one.row
        slots = [self.slots.get(name, -1) for name in names]
        if -1 in slots:
            slots = [self._slot(name, names) if slot < 0 else slot for name, slot in zip(names, slots, strict=True)]
        self._inbox[:k, 11] = slots
        answer = np.empty(12 + 3 * k)
        found = self._run(answer, k)
        while found == HISTORY_FULL:
            self.history.grow()
            found = self._run(answer, k)
        if found == NO_FIX_YET:
            return np.full(3, np.nan), None
        if found != ESTIMATE:
            check_step(gnss, velocity, dt, fix_age, self.history)
        self.members, self._answer = names, answer
        return answer[:3], answer[3:12].reshape(3, 3)

    def _run(self, answer: Floats, k: int) -> int:
        rows, inbox = self.history.rows, self._inbox[:k]
        numbers, index, last = self._numbers, self._index, self._last
        return int(stream_step(self._given, inbox, numbers, index, last, rows, self._noise, answer))

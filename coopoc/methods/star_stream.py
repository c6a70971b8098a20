"""Streaming with neighbours: the star around one vehicle, fed step by step with measurements and messages."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import inf
from typing import Any

import numpy as np
from numpy import nan
from numpy.typing import ArrayLike

from ..arrays import Floats, Ints, instance, number, refuse
from ..errors import InputError, shown
from ..kernels.dead_reckoning import ESTIMATE, NO_FIX_YET
from ..kernels.geometry import components
from ..kernels.motion import MotionNoise
from ..kernels.odometry_fault import new_state
from ..kernels.stars.cooperative_state import (
    AGE,
    FIX_VARIANCE,
    MOTION,
    ODOMETER,
    OWN,
    SINCE,
    SOLO,
    SOLO_VARIANCE,
    SPEED,
    STEP,
    TRUSTED,
    USED,
    WIDTH,
)
from ..kernels.stars.gaussian import ABSENT
from ..kernels.stars.streams import make_filter, restore, stream_rows, stream_step
from ..world.links import drop_steep_azimuths
from ..world.plausible import MAX_POSITION, MAX_SPEED
from .cooperative_filter import Broadcast, CooperativeFilter, model_of, priors_of
from .motion_history import MotionHistory, fix_or_none, relative_vector, three
from .noise_model import constant_noise, motion_noise

START_VARIANCE = 0.01
"""m^2, of a start that is known, as it is sent."""


@dataclass(frozen=True, eq=False)
class RelativeMeasurement:
    """A neighbour as the ego measures it now, with the message that has newly come from it, if any.

    Args:
        id: name of the neighbour.
        relative: (3,) range m, world azimuth rad, inclination rad; NaN for a component that is missing.
        gnss: (3,) m, the estimate of the `Broadcast` that came; None for no message.
        velocity: (3,) m/s of it.
        variance: (3,) m^2 of it.
        odometer: (3,) m of it.
        age: s since fix and velocity of the message were measured.

    >>> RelativeMeasurement("b", [9.0, 0.1, 1.57]).velocity is None
    True
    """

    id: str
    relative: ArrayLike
    gnss: ArrayLike | None = None
    velocity: ArrayLike | None = None
    variance: ArrayLike | None = None
    odometer: ArrayLike | None = None
    age: float = 0.0
    row: bytes = field(init=False, repr=False)

    def __post_init__(self) -> None:
        row = np.full(WIDTH, nan)
        if not (isinstance(self.id, str) and self.id):
            raise InputError("id", shown(self.id), "must be a name", 'Give for example "b".')
        relative = relative_vector(self.relative)
        row[:AGE], row[AGE] = (
            components(drop_steep_azimuths(relative)[None, None], np.zeros(1, int))[0, 0],
            number("age", self.age),
        )
        row[SOLO:SOLO_VARIANCE] = fix_or_none(self.gnss, "neighbour's gnss")
        if self.variance is not None:
            row[SOLO_VARIANCE:ODOMETER] = variance = three("neighbour's variance", self.variance, MAX_POSITION**2)
            refuse("neighbour's variance", variance, variance <= 0, "must be > 0 m^2", "Send stream.broadcast.")
        if self.odometer is not None:
            row[ODOMETER:SPEED] = three("neighbour's odometer", self.odometer)
        if self.velocity is not None:
            row[SPEED:STEP] = three("neighbour's velocity", self.velocity, MAX_SPEED)
        if 0 < np.isfinite(row[SOLO:STEP]).sum() < STEP - SOLO:
            allowed = f"of {self.id} must hold position, velocity, variance and odometer"
            raise InputError("message", "a part of one", allowed, "Send stream.broadcast.")
        self.__dict__["row"] = row.tobytes()


def _names(neighbours: Any) -> list[str]:
    """Names of the neighbours of a step; InputError for anything but measurements of them, or for one twice."""
    if not isinstance(neighbours, Sequence) or not all(isinstance(each, RelativeMeasurement) for each in neighbours):
        hint = "Give a list of RelativeMeasurement, empty for none."
        raise InputError("neighbours", shown(neighbours), "must hold RelativeMeasurements", hint)
    names = [each.id for each in neighbours]
    if len(set(names)) < len(names):
        raise InputError("neighbours", names, "must be given once each", "Merge the measurements of one vehicle.")
    return names


class StarStream:
    """The cooperative filter, step by step: `FilterStream` with the neighbours measured at each step.

    The neighbours measured now are in the star. Between messages a neighbour moves with the velocity of its newest one
    until that is `max_age` seconds old; a velocity used for L seconds makes an error of L times its own. Of a vehicle
    that is measured but whose messages never arrive, nothing is assumed.

    In a recording the std of ranges is raised where their direction is uncertain (`noise_model.resolve`). A stream does
    not know the ranges to come and takes the noise model as it is.

    Args:
        filter: its noise model is "identity" or holds constant noise. Neighbours send what `broadcast` of theirs holds.
        x0: (3,) m, a position known before the first step; None starts at the first fix, or where
            neighbours see the ego.
        interval: s, the step that the assumed process noise belongs to: a motion of dt s has dt / interval times its
            variance. None: every step is one, with the error of one measured velocity, as in a recording.
        history: s, how old a delayed fix may be.
        max_age: s, older messages of neighbours are not used.
        measured: True where measurements are not simulated: then the settings are those of such a Recording.

    Raises:
        InputError: a noise model that needs a recording, a time that is negative or not finite.

    >>> from coopoc import NoiseModel, Sensors
    >>> ego, other = (StarStream(CooperativeFilter(NoiseModel.nominal(Sensors()))) for _ in "ab")
    >>> _ = other.step([10.0, 0.0, 0.0], [9.0, 0.0, 0.0], dt=0.1)
    >>> seen = RelativeMeasurement("b", [9.0, 0.0, 1.5707963], *other.broadcast)
    >>> x, _ = ego.step([0.0, 0.0, 0.0], [9.0, 0.0, 0.0], dt=0.1, neighbours=[seen])
    >>> float(x[0].round(1)), float(ego.neighbours["b"][0].round(1))  # 10 m apart by the fixes, 9 m as measured
    (0.4, 9.6)
    """

    def __init__(
        self,
        filter: CooperativeFilter,
        x0: ArrayLike | None = None,
        *,
        interval: float | None = None,
        history: float = 10.0,
        max_age: float = 1.0,
        measured: bool = False,
    ) -> None:
        noise_model = constant_noise(instance("filter", filter, CooperativeFilter).noise_model)
        self._start = np.full(3, nan) if x0 is None else three("x0", x0)
        priors = priors_of(filter, noise_model, measured)
        self._trusted, self._model = float(priors.fix_gate == 0.0), model_of(noise_model, priors)
        self._filter, self._tries = make_filter(1, 1)
        self._motion: MotionNoise = motion_noise(noise_model, interval)
        self._fix = priors.fix**2 * np.array(noise_model.gnss_variance)
        self.max_age, self.history = number("max_age", max_age), MotionHistory(history)
        self._given, self._time = np.zeros(8), 0.0
        self._numbers, self._names = dict[str, int](), list[str]()
        self._last: Floats = np.full((1, WIDTH), nan)
        self._answer: Floats = np.full(12, nan)
        self._memory: Floats = np.append(np.zeros(9), np.full(3, nan))
        self._odometry: Floats = new_state(self._motion) if priors.fix_gate else np.empty((0, 0))
        if x0 is not None:
            self._memory[:6] = *self._start, *np.full(3, 1.0 / START_VARIANCE)

    @property
    def neighbours(self) -> dict[str, Floats]:
        """Positions (3,) m of the neighbours in the star."""
        return dict(zip(self._names, self._answer[12:].reshape(-1, 3).copy(), strict=True))

    @property
    def broadcast(self) -> Broadcast | None:
        """What this vehicle sends now; None before its first fix."""
        mean, weight, odometer = self._memory[:9].reshape(3, 3)
        if not weight.all():
            return None
        return Broadcast(mean.copy(), self._given[3:6].copy(), 1.0 / weight, odometer.copy())

    @property
    def trusted(self) -> dict[str, bool]:
        """Whether the fixes of each neighbour in the star count as they are."""
        return {name: bool(self._filter.status[self._numbers[name], TRUSTED]) for name in self._names}

    def step(
        self,
        gnss: ArrayLike | None,
        velocity: ArrayLike,
        dt: float,
        fix_age: float = 0.0,
        neighbours: Sequence[RelativeMeasurement] = (),
    ) -> tuple[Floats, Floats | None]:
        """Position (3,) m and covariance (3, 3) m^2 of the ego; NaN and None until a fix, or what a
        neighbour sends and the ego measures of it (range and both angles), shows where it is.

        Args:
            gnss: (3,) m of the ego; None or NaN for no fix.
            velocity: (3,) m/s of the ego, the mean over the step.
            dt: s since the last step.
            fix_age: s, of the fix.
            neighbours: the relative measurements of now, one for each neighbour.

        Raises:
            InputError: as `FilterStream.step`; a neighbour that is given twice. The filter is then as it was before.
        """
        names = _names(neighbours)
        given = np.zeros(8)
        self.history.write(given, gnss, velocity, dt, fix_age)
        columns, own, time = self._columns(names), np.empty(OWN), self._time + float(dt)
        rows = np.frombuffer(bytearray().join([each.row for each in neighbours])).reshape(len(names), WIDTH)
        outcome = stream_rows(
            given,
            self.history.reserve(),
            self._motion,
            self._fix,
            self._odometry,
            own,
            rows,
            columns,
            self._last,
            time,
            self.max_age,
            self._memory,
        )
        if outcome not in (ESTIMATE, NO_FIX_YET):
            self.history.check(gnss, velocity, dt, fix_age)
        self._given, self._time = given, time
        own[FIX_VARIANCE:MOTION] -= (1.0 - self._model.white) * self._fix
        answer = np.empty(12 + 3 * len(columns))
        if not stream_step(self._filter, self._tries, self._model, own, rows, columns, self._start, answer):
            return np.full(3, nan), None
        self._names, self._answer = names, answer
        return self._answer[:3], self._answer[3:12].reshape(3, 3)

    def _columns(self, names: list[str]) -> Ints:
        """Numbers of the vehicles, 1 and up; the filter has room for them."""
        if new := [name for name in names if name not in self._numbers]:
            self._meet(new, names)
        self._reserve(1 + len(names), len(self._last))
        return np.array([self._numbers[name] for name in names], int)

    def _meet(self, new: list[str], names: list[str]) -> None:
        """Number new vehicles; forget those that are in no star that is remembered, and whose messages are too old."""
        if len(self._numbers) + len(new) >= len(self._last):
            oldest = self._time - self.max_age
            for name, number in list(self._numbers.items()):
                there = self._filter.slot[number] != ABSENT or name in names
                if not there and self._last[number, AGE] < oldest:
                    del self._numbers[name]
        if (wanted := len(self._numbers) + len(new)) >= len(self._last):
            self._last = np.pad(self._last, ((0, 2 * wanted), (0, 0)))
            self._reserve(1, len(self._last))
        free = sorted(set(range(1, len(self._last))) - set(self._numbers.values()))
        for name, number in zip(new, free, strict=False):
            self._numbers[name] = number
            self._last[number], self._last[number, AGE] = nan, -inf
            status = self._filter.status[number]
            status[:] = 0.0
            status[TRUSTED], status[USED], status[SINCE] = self._trusted, -inf, -inf

    def _reserve(self, slots: int, vehicles: int) -> None:
        """Room for a star of that many members, of that many vehicles."""
        before, tries = self._filter, self._tries
        if slots > len(before.who) or vehicles > len(before.slot):
            self._filter, self._tries = make_filter(max(len(before.who), 2 * slots), vehicles)
            restore(before, tries, self._filter, self._tries)

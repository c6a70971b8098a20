"""Streaming with neighbours: the star around one vehicle, fed step by step with what it sees and hears."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from ..arrays import Floats
from ..errors import InputError
from ..world.spherical import to_vector
from .knowledge import Knowledge
from .star import ACCELERATION_STD, FORGOTTEN, StarStep
from .stream import ROUNDING, Moved, Past, assumed_motion, fix_or_none, motion, seconds, three

EGO = ""
"""Key of the ego in the star."""
Advance = Callable[[Floats, Floats, StarStep], tuple[Floats, Floats]]
"""State (1, m, 3) m and covariance (1, 3m, 3m) m^2 of the last star, and the new one -> those of the new star."""


@dataclass(frozen=True, eq=False)
class Sighting:
    """A neighbour as the ego measures it now, with the message that has newly come from it, if any.

    Args:
        id: who it is. relative: (3,) range m, world azimuth rad, inclination rad.
        velocity: (3,) m/s of the message, None: no message. gnss: (3,) m its fix, None or NaN: it has none.
        age: s since fix and velocity of the message were measured.

    >>> Sighting("b", [9.0, 0.1, 1.57]).velocity is None
    True
    """

    id: str
    relative: npt.ArrayLike
    gnss: npt.ArrayLike | None = None
    velocity: npt.ArrayLike | None = None
    age: float = 0.0

    def __post_init__(self) -> None:
        relative = three("relative", self.relative)
        if relative[0] < 0 or self.id == EGO:
            raise InputError("sighting", (self.id, self.relative), "must have a name and a range >= 0", "Check it.")
        fix = fix_or_none(self.gnss, "neighbour's gnss")
        if self.velocity is None and np.isfinite(fix).all():
            raise InputError("velocity", None, f"must come with the fix of {self.id}", "Send both in one message.")
        if self.velocity is not None:
            three("neighbour's velocity", self.velocity)
        seconds("age", self.age)


@dataclass(frozen=True, eq=False)
class Held:
    """The newest message of a neighbour: its velocity m/s and the variance of that (3,) m^2/s^2, its age s, and for how
    long its velocity has moved the neighbour without a break, s."""

    velocity: Floats
    variance: Floats
    age: float
    used: float = 0.0


class StarStream:
    """A cooperative filter that runs: like `Stream`, with the neighbours that are seen at each step.

    Who is seen is in the star, who is no longer seen is forgotten. Between messages a neighbour moves with the velocity
    of its newest one until that is `max_age` seconds old; a velocity used for L seconds makes an error of L times its
    own. Of one that is seen and was never heard, nothing is assumed.

    Args:
        advance: one step of the filter. known: what it assumes. x0, interval, history: as in `Kalman.start`.
    """

    def __init__(
        self, advance: Advance, known: Knowledge, x0: npt.ArrayLike | None, interval: float, history: float,
        max_age: float,
    ) -> None:  # fmt: skip
        self.advance, self.known, self.max_age = advance, known, seconds("max_age", max_age)
        self.variance, self.interval, self.past = assumed_motion(known, interval), interval, Past(history)
        self.members: tuple[str, ...] = () if x0 is None else (EGO,)
        self.held: Mapping[str, Held] = {}
        self.x: Floats = np.empty((1, 0, 3)) if x0 is None else three("x0", x0)[None, None]
        self.cov: Floats = np.zeros((1, 3 * len(self.members), 3 * len(self.members)))

    @property
    def neighbours(self) -> dict[str, Floats]:
        """Positions (3,) m of who is in the star."""
        return dict(zip(self.members[1:], self.x[0, 1:], strict=True))

    def step(
        self, gnss: npt.ArrayLike | None, velocity: npt.ArrayLike, dt: float, fix_age: float = 0.0,
        neighbours: Sequence[Sighting] = (),
    ) -> tuple[Floats, Floats | None]:  # fmt: skip
        """Position (3,) m and covariance (3, 3) m^2 of the ego; NaN and None before its first fix.

        Args:
            gnss, velocity, dt, fix_age: of the ego, as in `Stream.step`. neighbours: who is seen now, once each.

        Raises:
            InputError: as `Stream.step`; a neighbour that is seen twice. The filter is then as it was before.
        """
        names = (EGO, *(s.id for s in neighbours))
        if len(set(names)) < len(names):
            raise InputError("neighbours", list(names[1:]), "must be seen once each", "Merge sightings of one vehicle.")
        moved = motion(velocity, dt)
        process = self.variance(np.asarray(velocity, dtype=float), dt)
        past = self.past.then(Moved(dt, moved, process))
        fix, late = past.forward(gnss, fix_age)
        held = self._listen(neighbours, dt)
        self.past, self.held = past, {name: replace(h, used=h.used + dt) for name, h in held.items()}
        if not self.members and np.isnan(fix).any():
            return np.full(3, np.nan), None
        star = self._star(names, neighbours, held, dt)
        star.moved[0, 0], star.process[0, 0], star.fix[0, 0] = moved, process, fix
        star.fix_variance[0, 0], star.heard[0, 0] = self.known.gnss_variance + late, np.isfinite(fix).all()
        star.fix[~star.heard] = 0.0
        self.x, self.cov = self.advance(self.x, self.cov, star)
        self.members = names
        return self.x[0, 0], self.cov[0, :3, :3]

    def _listen(self, neighbours: Sequence[Sighting], dt: float) -> dict[str, Held]:
        """The newest message of everyone, none older than `max_age`; who was not seen has not been moved."""
        here = {s.id for s in neighbours}
        held = {
            name: replace(h, age=h.age + dt, used=h.used if name in here and name in self.members else 0.0)
            for name, h in self.held.items()
        }
        for s in neighbours:
            if s.velocity is not None:
                u = np.asarray(s.velocity, dtype=float)
                held[s.id] = Held(u, self.variance(u, self.interval) / self.interval**2, s.age)
        return {name: h for name, h in held.items() if h.age <= self.max_age + ROUNDING}

    def _star(
        self, names: Sequence[str], neighbours: Sequence[Sighting], held: Mapping[str, Held], dt: float
    ) -> StarStep:
        """The star, its first row, the ego, to be filled."""
        n = len(names)
        kept = np.array([self.members.index(name) if name in self.members else -1 for name in names])
        moved, fix, fix_variance = np.zeros((3, 1, n, 3))
        process = np.full((1, n, 3), FORGOTTEN)
        heard = np.zeros((1, n), dtype=bool)
        for k, s in enumerate(neighbours, start=1):
            if s.id not in held:
                continue
            h = held[s.id]
            now = h.variance + (h.age * ACCELERATION_STD) ** 2
            moved[0, k] = dt * h.velocity
            process[0, k] = ((h.used + dt) ** 2 - h.used**2) * now
            if s.velocity is not None:
                fix[0, k] = fix_or_none(s.gnss) + h.age * h.velocity
                heard[0, k] = np.isfinite(fix[0, k]).all()
                fix_variance[0, k] = self.known.gnss_variance + h.age**2 * now
        fix_variance[~heard] = 1.0
        relative = np.array([s.relative for s in neighbours], dtype=float).reshape(1, -1, 3)
        return StarStep(0, kept, np.arange(n - 1), relative, to_vector(relative), moved, process, fix, fix_variance,
                        heard)  # fmt: skip

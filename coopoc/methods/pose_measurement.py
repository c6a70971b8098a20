"""What a stream of poses is fed: measurements of a vehicle itself, and of neighbours and landmarks in its own frame."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from ..arrays import Floats, instance, number
from ..errors import InputError
from .motion_history import fix_or_none, numbers, seconds, three


@dataclass(frozen=True, eq=False)
class OwnMeasurement:
    """What a vehicle measures of itself in a step, and broadcasts.

    Args:
        velocity: (3,) m/s, forward, left and up, the mean over the step.
        yaw_rate: rad/s, the mean over the step.
        gnss: (3,) m; None or NaN for no fix.
        heading: rad, of a compass; None or NaN for none.

    >>> OwnMeasurement([9.0, 0.0, 0.0], 0.1).row.shape
    (8,)
    """

    velocity: npt.ArrayLike
    yaw_rate: float
    gnss: npt.ArrayLike | None = None
    heading: float | None = None
    row: Floats = field(init=False, repr=False)

    def __post_init__(self) -> None:
        heading = np.nan
        if self.heading is not None and not (isinstance(self.heading, float) and np.isnan(self.heading)):
            heading = number("heading", self.heading, -np.inf, allowed="finite rad, or None", hint="None: no compass.")
        rate = number("yaw_rate", self.yaw_rate, -np.inf, allowed="finite rad/s", hint="Of one that stands it is 0.")
        row = np.concatenate([fix_or_none(self.gnss, "gnss"), [heading], three("velocity", self.velocity), [rate]])
        object.__setattr__(self, "row", row)


@dataclass(frozen=True, eq=False)
class BodyMeasurement:
    """A neighbour or a landmark as the ego measures it now, with the message that has newly come from it, if any.

    Args:
        id: name.
        relative: (3,) range m, bearing from the heading rad, inclination rad, NaN for a component that is missing; None
            for a message of a neighbour that is not measured now.
        message: what the neighbour measured of itself.
        age: s since then.
        place: (3,) m, of a landmark.

    >>> BodyMeasurement("mast", [9.0, 0.1, 1.57], place=[5.0, 5.0, 3.0]).message is None
    True
    """

    id: str
    relative: npt.ArrayLike | None
    message: OwnMeasurement | None = None
    age: float = 0.0
    place: npt.ArrayLike | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "age", seconds("age", self.age))
        if self.message is not None:
            instance("message", self.message, OwnMeasurement)
        for name in ("relative", "place"):
            given = getattr(self, name)
            values = None if given is None else numbers(given)
            if values is not None and (values.shape != (3,) or np.isinf(values).any()):
                raise InputError(name, (self.id, given), "must be three numbers", "Give NaN for what is missing.")
            object.__setattr__(self, name, values)
        if not isinstance(self.id, str) or (self.place is not None and (self.message or self.relative is None)):
            hint = "Its position is known."
            raise InputError("id", self.id, "must be a name; a landmark is measured and sends nothing", hint)

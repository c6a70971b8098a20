"""Inputs of streams: checks of a step, and the newest motions of a vehicle, which bring a late fix forward."""

import numpy as np
from numpy import nan
from numpy.typing import ArrayLike

from ..arrays import Floats, number, plain
from ..errors import InputError, shown
from ..kernels.dead_reckoning import ROUNDING, SQUARE, push, since
from ..world.plausible import MAX_POSITION, MAX_SPEED, radians


class MotionHistory:
    """The newest motions of a vehicle, `span` seconds or what there has been, for fixes that come late, and its pace.

    Args:
        span: s.
    """

    def __init__(self, span: float) -> None:
        self.rows: Floats = np.zeros((65, 7))
        self.rows[0, 3], self.rows[0, SQUARE] = number("history", span), nan

    def __len__(self) -> int:
        return int(self.rows[0, 1])

    def reserve(self) -> Floats:
        """The rows, with room for one more step."""
        first, count, room = int(self.rows[0, 0]), len(self), len(self.rows) - 1
        if count + 1 >= room:
            rows = np.zeros((1 + 2 * room, 7))
            rows[1 : 1 + count] = self.rows[1 + (first + np.arange(count)) % room]
            rows[0] = self.rows[0]
            rows[0, 0] = 0.0
            self.rows = rows
        return self.rows

    def push(self, dt: float, moved: Floats, variance: Floats) -> None:
        """Add a step: dt s, motion (3,) m, its variance (3,) m^2."""
        push(self.reserve(), dt, moved, variance)

    def forward(self, gnss: ArrayLike | None, age: float) -> tuple[Floats, Floats]:
        """A fix of `age` seconds ago moved to now, (3,) m, NaN for none, and the variance of that motion, (3,) m^2."""
        fix, moved, late = fix_or_none(gnss), np.zeros(3), np.zeros(3)
        if not np.isnan(fix).all():
            since(self.rows, age, moved, late)
        return fix + moved, late

    def check(self, gnss: ArrayLike | None, velocity: ArrayLike, dt: float, fix_age: float) -> None:
        """InputError if a stream cannot take this step."""
        number(
            "dt", dt, ROUNDING, MAX_POSITION, allowed="finite and > 1 ns", hint="Give the seconds since the last step."
        )
        three("velocity", velocity, MAX_SPEED)
        if np.isnan(fix_or_none(gnss)).all():
            return
        kept = min(self.rows[0, 2] + float(dt), self.rows[0, 3])
        hint, allowed = "Leave such a fix out (None), or keep more: start(..., history=).", f"in 0..{kept:g} s"
        number("fix_age", fix_age, -ROUNDING, kept + ROUNDING, allowed=f"{allowed}, the motion that is kept", hint=hint)

    def write(self, row: Floats, gnss: ArrayLike | None, velocity: ArrayLike, dt: float, fix_age: float) -> None:
        """Write fix, velocity, dt and age of the fix to the input of a kernel; InputError as `check`."""
        simple = isinstance(dt, float) and isinstance(fix_age, float) and {type(gnss), type(velocity)} <= UNCHECKED
        try:
            if not simple or np.shape(velocity) != (3,) or (gnss is not None and np.shape(gnss) != (3,)):
                self.check(gnss, velocity, dt, fix_age)
            row[:3], row[3:6], row[6], row[7] = nan if gnss is None else gnss, velocity, dt, fix_age
            if any(abs(number) > most for number, most in zip(row.tolist(), LARGEST, strict=True)):
                self.check(gnss, velocity, dt, fix_age)
        except Exception:  # a class from elsewhere may raise anything
            self.check(gnss, velocity, dt, fix_age)
            raise


LARGEST = (MAX_POSITION,) * 3 + (MAX_SPEED,) * 3 + (MAX_POSITION,) * 2
"""Of fix m, velocity m/s, dt and age s."""
UNCHECKED = frozenset({list, tuple, np.ndarray, type(None)})
"""What a stream takes as it is; anything else, such as an array with a mask, is checked first."""


def three(field: str, value: ArrayLike, limit: float = MAX_POSITION) -> Floats:
    """(3,) numbers within the limit; InputError naming the field if they are not.

    >>> three("velocity", [1, 2])
    Traceback (most recent call last):
    ...
    coopoc.errors.InputError: velocity = [1, 2]: must be three finite numbers within +-1e+08. Give east, north, up.
    """
    array = numbers(value)
    if array.shape != (3,) or not (abs(array) <= limit).all():
        raise InputError(field, value, f"must be three finite numbers within +-{limit:g}", "Give east, north, up.")
    return array


def fix_or_none(gnss: ArrayLike | None, field: str = "gnss") -> Floats:
    """(3,) m, all NaN if there is no fix; InputError for a fix in part."""
    fix = np.full(3, nan) if gnss is None else numbers(gnss)
    return fix if fix.shape == (3,) and np.isnan(fix).all() else three(field, "none" if gnss is None else gnss)


def relative_vector(value: ArrayLike) -> Floats:
    """(3,) range m and two angles rad, NaN where not measured; InputError for a range <= 0 and angles in degrees."""
    relative = numbers(value)
    if relative.shape != (3,) or not (0.0 < relative[0] < MAX_POSITION or np.isnan(relative[0])):
        text = "must be three numbers, the range first and > 0"
        raise InputError("relative", shown(value), text, "Give NaN for what was not measured.")
    radians("relative angles", relative[1:])
    return relative


def numbers(value: ArrayLike) -> Floats:
    """As an array of floats; an empty one of what holds no numbers.

    >>> numbers("east").size
    0
    """
    array = plain(value)
    return array.astype(float) if array.dtype.kind in "fiu" else np.empty(0)

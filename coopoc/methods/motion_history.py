"""Recent motion of a vehicle by dead reckoning, and the checks of a stream's inputs."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ..arrays import Floats, number, plain
from ..errors import InputError, shown
from ..kernels.motion import ROUNDING, push, since


class MotionHistory:
    """The newest motions of a vehicle, `span` seconds or what there has been, for fixes that come late.

    Args:
        span: s.
    """

    def __init__(self, span: float) -> None:
        self.rows: Floats = np.zeros((65, 7))
        self.rows[0, 3] = seconds("history", span)

    @property
    def seen(self) -> float:
        """Seconds that are kept."""
        return float(self.rows[0, 2])

    def __len__(self) -> int:
        return int(self.rows[0, 1])

    def grow(self) -> None:
        """Room for twice as many steps."""
        first, count, room = int(self.rows[0, 0]), len(self), len(self.rows) - 1
        rows = np.zeros((1 + 2 * room, 7))
        rows[1 : 1 + count] = self.rows[1 + (first + np.arange(count)) % room]
        rows[0] = self.rows[0]
        rows[0, 0] = 0.0
        self.rows = rows

    def push(self, dt: float, moved: Floats, variance: Floats) -> None:
        """Add a step: dt s, motion (3,) m, its variance (3,) m^2."""
        if len(self) + 1 >= len(self.rows) - 1:
            self.grow()
        push(self.rows, dt, moved, variance)

    def reach(self, dt: float) -> float:
        """Seconds that are kept after one more step of dt s."""
        seen, first, room = self.seen + dt, int(self.rows[0, 0]), len(self.rows) - 1
        for k in range(len(self)):
            oldest = self.rows[1 + (first + k) % room, 0]
            if seen - oldest < self.rows[0, 3]:
                break
            seen -= oldest
        return float(seen)

    def forward(self, gnss: npt.ArrayLike | None, age: float) -> tuple[Floats, Floats]:
        """A fix of `age` seconds ago moved to now, (3,) m, NaN for none, and the variance of that motion, (3,) m^2.

        Raises:
            InputError: an age that is negative, or beyond the history.
        """
        fix, moved, late = fix_or_none(gnss), np.zeros(3), np.zeros(3)
        if not np.isnan(fix).all():
            check_age(age, self.seen)
            since(self.rows, age, moved, late)
        return fix + moved, late


def check_age(age: float, seen: float) -> None:
    """InputError unless the motion since a fix of this age, s, is kept."""
    hint = "Leave such a fix out (None), or keep more: start(..., history=)."
    kept = f"in 0..{seen:g} s, the motion that is kept"
    number("fix_age", age, -ROUNDING, seen + ROUNDING, allowed=kept, hint=hint)


PLAIN = frozenset({list, tuple, np.ndarray, type(None)})
"""What a stream takes as it is; anything else, such as an array with a mask, is checked first."""


def check_step(
    gnss: npt.ArrayLike | None, velocity: npt.ArrayLike, dt: float, fix_age: float, history: MotionHistory
) -> None:
    """InputError if a stream cannot take this step; the history is not changed."""
    number("dt", dt, sys.float_info.min, allowed="finite and > 0", hint="Give the seconds since the last step.")
    three("velocity", velocity)
    if not np.isnan(fix_or_none(gnss)).all():
        check_age(fix_age, history.reach(dt))


def three(field: str, value: npt.ArrayLike) -> Floats:
    """(3,) finite numbers; InputError naming the field if they are not.

    >>> three("velocity", [1, 2])
    Traceback (most recent call last):
    ...
    coopoc.errors.InputError: velocity = [1, 2]: must be three finite numbers. Give east, north, up.
    """
    array = numbers(value)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise InputError(field, value, "must be three finite numbers", "Give east, north, up.")
    return array


def names_of(field: str, given: Any, kind: type[Any]) -> list[str]:
    """Names of the vehicles that a stream is given measurements of, each once.

    Args:
        field: name of the argument.
        given: a sequence of measurements.
        kind: their class.

    Raises:
        InputError: anything else, or a vehicle twice.
    """
    if not isinstance(given, Sequence) or not all(isinstance(one, kind) for one in given):
        hint = f"Give a list of {kind.__name__}, empty for none."
        raise InputError(field, shown(given), f"must hold {kind.__name__}s", hint)
    names: list[str] = [one.id for one in given]
    if len(set(names)) < len(names):
        raise InputError(field, names, "must be given once each", "Merge the measurements of one vehicle.")
    return names


def fix_or_none(gnss: npt.ArrayLike | None, field: str = "gnss") -> Floats:
    """(3,) m, all NaN if there is no fix; InputError for a fix in part."""
    given = np.full(3, np.nan) if gnss is None else numbers(gnss)
    return given if given.shape == (3,) and np.isnan(given).all() else three(field, "none" if gnss is None else gnss)


def seconds(field: str, value: float) -> float:
    """A time that is finite and >= 0; InputError naming the field if it is not."""
    found: float = number(field, value, hint="Give seconds.")
    return found


def numbers(value: npt.ArrayLike) -> Floats:
    """As an array of floats; an empty one of what holds no numbers.

    >>> numbers("east").size
    0
    """
    given = plain(value)
    return given.astype(float) if given.dtype.kind in "fiu" else np.empty(0)

"""The axes of a drive: vehicles with unique names, equally spaced instants."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt

from ..arrays import Floats, checked, listed, refuse
from ..errors import InputError, shown, unknown

FARTHEST, FASTEST = 1e8, 1e4
"""m and m/s: what lies beyond was not measured on Earth, and its square leaves no digits to what stands beside it."""


def plausible(field: str, values: Floats, limit: float) -> None:
    """InputError for the first number beyond the limit; NaN stands for what is missing.

    >>> plausible("velocity", np.array([3.0, -1e9]), FASTEST)
    Traceback (most recent call last):
    coopoc.errors.InputError: velocity[1] = -1000000000.0: must be within +-10000 in SI units. Is it in another unit?
    """
    if values.size and max(np.fmax.reduce(values, axis=None), -np.fmin.reduce(values, axis=None)) > limit:
        wrong = np.abs(values) > limit
        refuse(field, values, wrong, f"must be within +-{limit:g} in SI units", "Is it in another unit?")


def texts(field: str, values: object) -> tuple[str, ...]:
    """A tuple of texts; InputError if it is one text, or holds anything else.

    >>> texts("notes", ["a reconstruction"])
    ('a reconstruction',)
    """
    hint = 'Give a tuple such as ("a note",).'
    found = listed(field, values, hint)
    if not all(isinstance(value, str) for value in found):
        raise InputError(field, shown(values), "must be a sequence of texts", hint)
    return tuple(found)


def check_texts(owner: object, *fields: str) -> None:
    """InputError for the first of these attributes that is no text.

    >>> from types import SimpleNamespace
    >>> check_texts(SimpleNamespace(name=3), "name")
    Traceback (most recent call last):
    coopoc.errors.InputError: name = 3: must be text. Leave it out, or give a word.
    """
    for field in fields:
        if not isinstance(value := getattr(owner, field), str):
            raise InputError(field, shown(value), "must be text", "Leave it out, or give a word.")


def names(ids: Iterable[object]) -> tuple[str, ...]:
    """Ids of vehicles as a tuple of words; InputError if there is none, or one stands twice.

    >>> names([7, "b"])
    ('7', 'b')
    """
    hint = 'Give a tuple such as ("a", "b").'
    given = listed("ids", ids, hint)
    if isinstance(ids, set) or not all(isinstance(i, str | int | np.integer) for i in given):
        raise InputError("ids", shown(ids), "must be a sequence of names or whole numbers", hint)
    found = tuple(str(i) for i in given)
    if not found:
        raise InputError("ids", "no vehicle", "must be at least one", "Check that the file holds a drive.")
    for name in found:
        if not name.isprintable():
            raise InputError("ids", shown(name), "must be printable", "Remove line ends and control characters.")
    if len(set(found)) != len(found):
        twice = sorted(i for i, count in Counter(found).items() if count > 1)
        raise InputError("ids", twice[:3], "must be unique", "Rename the vehicles that share an id.")
    return found


def column(field: str, vehicle: object, ids: Sequence[str]) -> int:
    """Column of a vehicle given by id or index; InputError, which proposes the nearest id, if there is none.

    >>> column("ego", "b", ("a", "b"))
    1
    """
    if isinstance(vehicle, str):
        if vehicle in ids:
            return ids.index(vehicle)
        raise unknown(field, vehicle, ids)
    if isinstance(vehicle, int | np.integer) and not isinstance(vehicle, bool | np.timedelta64):
        place = int(vehicle)
        if 0 <= place < len(ids):
            return place
    raise InputError(field, shown(vehicle), f"must be an index in 0..{len(ids) - 1} or an id", "List them with .ids.")


def columns(field: str, vehicles: Iterable[object], ids: Sequence[str]) -> list[int]:
    """Columns of several vehicles; InputError for one that is unknown, and for a single one outside a list.

    >>> columns("egos", ["b", 0], ("a", "b"))
    [1, 0]
    """
    given = listed(field, vehicles, "Give a list of indices or ids.")
    return [column(field, vehicle, ids) for vehicle in given]


def clock(t: npt.ArrayLike) -> Floats:
    """Instants (T,) s as a read-only array.

    Raises:
        InputError: fewer than two, or instants that are not finite, not increasing or not equally spaced.

    >>> clock([0, 1]).tolist()
    [0.0, 1.0]
    """
    times = checked("t", t, "(T,)", (-1,))
    if len(times) < 2:
        raise InputError("t", f"{len(times)} steps", "needs at least 2", "Check that the file holds a drive.")
    if not np.isfinite(times).all():
        step = int(np.argmin(np.isfinite(times)))
        raise InputError("t", f"{times[step]} at step {step}", "must be finite", "Give seconds for every step.")
    gaps = np.diff(times)
    if not (gaps > 0).all():
        raise InputError(
            "dt",
            f"{gaps.min():g} s at step {int(np.argmin(gaps)) + 1}",
            "must be > 0",
            "Sort the rows by time and drop repeated stamps.",
        )
    if np.ptp(gaps) > 1e-3 * gaps.mean() + 1e-6:
        raise InputError(
            "t",
            f"steps between {gaps.min():g} and {gaps.max():g} s",
            "must be equally spaced",
            "Resample first: coopoc data convert --dt 0.1.",
        )
    return times


def interval(t: Floats) -> float:
    """Sampling interval of a clock, s.

    >>> interval(np.array([0.0, 0.1, 0.2]))
    0.1
    """
    return round(float((t[-1] - t[0]) / (len(t) - 1)), 9)

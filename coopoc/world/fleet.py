"""Fleet: the ground truth of N vehicles that drive, their unique names, equally spaced instants; tables of pandas."""

import hashlib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import AnyArray, Bools, Floats, check_arrays, check_fields, checked, listed, number, refuse, remade
from ..errors import InputError, shown, unknown
from .plausible import MAX_POSITION, MAX_SPEED, headings, plausible

if TYPE_CHECKING:
    import pandas as pd

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False)
class Fleet:
    """Ground truth of N vehicles over T steps in a local east-north-up frame.

    Positions obey x_t = x_{t-1} + dt u_t for the bundled fleets, u being `velocity`.
    A vehicle that is absent at a step has NaN in all six numbers of that step.

    Args:
        ids: (N,) unique names.
        t: (T,) seconds, equally spaced.
        position: (T, N, 3) metres.
        velocity: (T, N, 3) metres per second.
        name: where it comes from, for cards and reports.
        source: where it comes from, for cards and reports.
        licence: where it comes from, for cards and reports.
        heading: (T, N) rad from +x, anticlockwise, NaN where absent or unknown; None where it is the course.

    Raises:
        InputError: shapes, time steps, ids or NaN patterns that no filter could use.

    >>> Fleet(("a",), [0, 0.1], np.zeros((2, 1, 3)), np.zeros((2, 1, 3))).dt
    0.1
    """

    ids: tuple[str, ...]
    t: Floats
    position: Floats
    velocity: Floats
    name: str = ""
    source: str = ""
    licence: str = ""
    heading: Floats | None = None

    __reduce__ = remade

    def __post_init__(self) -> None:
        self.__dict__["ids"] = names(self.ids)
        check_fields(self)
        self.__dict__["t"] = clock(self.t)
        shape = len(self.t), len(self.ids), 3
        positions = "(T, N, 3)", shape
        check_arrays(self, {"position": positions, "velocity": positions, "heading": ("(T, N)", shape[:2])})
        if self.heading is not None:
            headings(self.heading, self.velocity)
        _check_gaps(self)
        plausible("position", self.position, MAX_POSITION)
        plausible("velocity", self.velocity, MAX_SPEED)

    @property
    def dt(self) -> float:
        """Sampling interval, s."""
        return interval(self.t)

    @property
    def present(self) -> Bools:
        """(T, N) True where the vehicle exists."""
        return np.isfinite(self.position[..., 0])

    @property
    def digest(self) -> str:
        """SHA-256 of ids, time and truth: the same numbers give the same digest."""
        sha = hashlib.sha256("\n".join(self.ids).encode())
        for name in ("t", *self._arrays):
            sha.update(getattr(self, name).tobytes())
        return sha.hexdigest()

    def index(self, vehicle: str | int) -> int:
        """Column of a vehicle given by its id or its index; InputError if there is none."""
        return column("vehicle", vehicle, self.ids)

    def select(self, vehicles: Sequence[str | int]) -> "Fleet":
        """The same drive with these vehicles only."""
        cols = columns("vehicles", vehicles, self.ids)
        parts = {name: getattr(self, name)[:, cols] for name in self._arrays}
        return replace(self, ids=tuple(self.ids[c] for c in cols), **parts)

    def between(self, start: int, stop: int) -> "Fleet":
        """Steps start..stop-1 of the drive; negative ones count from the end. InputError if one is no whole number."""
        check_steps(start, stop, -(2**62))
        return replace(self, t=self.t[start:stop], **{name: getattr(self, name)[start:stop] for name in self._arrays})

    def to_frame(self) -> "pd.DataFrame":
        """A row per step and vehicle that is present, for pandas; a step at which a vehicle is absent has no row.

        Columns: `step`, `t` s, `vehicle` (its id), `x`, `y`, `z` m, `vx`, `vy`, `vz` m/s, and `heading` rad where the
        fleet has headings.

        >>> Fleet(("a", "b"), [0, 0.1], np.zeros((2, 2, 3)), np.zeros((2, 2, 3))).to_frame().vehicle.tolist()
        ['a', 'b', 'a', 'b']
        """
        columns = {"step": np.arange(len(self.t))[:, None], "t": self.t[:, None], "vehicle": np.array(self.ids, object)}
        columns |= {name: self.position[..., axis] for axis, name in enumerate("xyz")}
        columns |= {f"v{name}": self.velocity[..., axis] for axis, name in enumerate("xyz")}
        columns |= {} if self.heading is None else {"heading": self.heading}
        return long_table(columns, self.present)

    @property
    def _arrays(self) -> tuple[str, ...]:
        return ("position", "velocity", *(() if self.heading is None else ("heading",)))

    def __repr__(self) -> str:
        return f"Fleet({self.name or 'unnamed'}: {len(self.ids)} vehicles x {len(self.t)} steps, dt {self.dt:g} s)"


def _check_gaps(fleet: Fleet) -> None:
    numbers = np.concatenate([fleet.position, fleet.velocity], 2)
    bad = np.isinf(numbers).any(axis=2) | (np.isnan(numbers).any(axis=2) & ~np.isnan(numbers).all(axis=2))
    if bad.any():
        step, vehicle = np.argwhere(bad)[0]
        raise InputError(
            "position/velocity",
            f"{numbers[step, vehicle]} of vehicle {fleet.ids[vehicle]} at step {step}",
            "must be finite, or NaN in all six numbers where the vehicle is absent",
            "Interpolate the gap or drop the row.",
        )


def same_drive(noun: Any, ids: Sequence[str], t: Floats) -> None:
    """InputError unless a Fleet or Recording has these vehicles in this order, and its steps are at times t (T,) s.

    >>> fleet = Fleet(("a",), [0, 0.1], np.zeros((2, 1, 3)), np.zeros((2, 1, 3)))
    >>> same_drive(fleet, ("b",), fleet.t)
    Traceback (most recent call last):
    coopoc.errors.InputError: fleet = Fleet(unnamed: 1 vehicles x 2 steps, dt 0.1 s): ids and times differ from those \
that were recorded. Give the fleet that was observed, its vehicles in the same order.
    """
    if tuple(ids) != noun.ids or len(t) != len(noun.t) or not np.allclose(t, noun.t, 0, 0.01 * noun.dt):
        kind = type(noun).__name__.lower()
        hint = f"Give the {kind} that was observed, its vehicles in the same order."
        raise InputError(kind, repr(noun), "ids and times differ from those that were recorded", hint)


def names(ids: Iterable[object]) -> tuple[str, ...]:
    """Ids of vehicles as a tuple of words; InputError if there is none, or one stands twice.

    >>> names([7, "b"])
    ('7', 'b')
    """
    hint = 'Give a tuple such as ("a", "b").'
    listed_ids = listed("ids", ids, hint)
    if not all(isinstance(i, str | int | np.integer) for i in listed_ids):
        raise InputError("ids", shown(ids), "must be a sequence of names or whole numbers", hint)
    texts = tuple(str(i) for i in listed_ids)
    if not texts:
        raise InputError("ids", "no vehicle", "must be at least one", "Check that the file holds a drive.")
    for name in texts:
        if not name.strip() or not name.isprintable():
            raise InputError("ids", shown(name), "must be printable", "Remove line ends and control characters.")
    if twice := sorted(i for i, count in Counter(texts).items() if count > 1):
        raise InputError("ids", twice[:3], "must be unique", "Rename the vehicles that share an id.")
    return texts


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
        index = int(vehicle)
        if 0 <= index < len(ids):
            return index
    raise InputError(field, shown(vehicle), f"must be an index in 0..{len(ids) - 1} or an id", "List them with .ids.")


def columns(field: str, vehicles: Iterable[object], ids: Sequence[str]) -> list[int]:
    """Columns of several vehicles; InputError for one that is unknown, and for a single one outside a list.

    >>> columns("egos", ["b", 0], ("a", "b"))
    [1, 0]
    """
    chosen = listed(field, vehicles, "Give a list of indices or ids.")
    return [column(field, vehicle, ids) for vehicle in chosen]


def check_steps(start: int, stop: int, least: int) -> None:
    """InputError for the ends of a part that are no steps."""
    for name, step in (("start", start), ("stop", stop)):
        number(name, step, least, 2**62, kind=int, allowed="a step", hint="Count steps from 0.")


def clock(t: ArrayLike) -> Floats:
    """Instants (T,) s as a read-only array.

    Raises:
        InputError: fewer than two, or instants that are not finite, not increasing or not equally spaced.

    >>> clock([0, 1]).tolist()
    [0.0, 1.0]
    """
    times = checked("t", t, "(T,)", (-1,))
    if len(times) < 2:
        raise InputError("t", f"{len(times)} steps", "needs at least 2", "Check that the file holds a drive.")
    gaps = np.diff(times)
    wrong = ~np.isfinite(times) | np.append(False, ~(gaps > 0))
    refuse("t", times, wrong, "must be finite, and increase", "Sort the rows by time and drop repeated stamps.")
    if np.ptp(gaps) > 1e-3 * gaps.mean() + 1e-6:
        raise InputError(
            "t",
            f"steps between {gaps.min():g} and {gaps.max():g} s",
            "must be equally spaced",
            "Resample first, as FILE?dt=0.1 does.",
        )
    return times


def interval(t: Floats) -> float:
    """Sampling interval of a clock, s.

    >>> interval(np.array([0.0, 0.1, 0.2]))
    0.1
    """
    return round(float((t[-1] - t[0]) / (len(t) - 1)), 9)


def long_table(columns: Mapping[str, AnyArray], where: Bools | None = None) -> "pd.DataFrame":
    """A row per element of the arrays' common shape, the last axis fastest.

    Args:
        columns: name -> array that broadcasts to the common shape.
        where: of the common shape, the elements to keep; all if None.

    >>> long_table({"t": np.array([[0.0], [0.1]]), "x": np.array([[1.0, 2], [3, 4]])}).to_numpy().tolist()
    [[0.0, 1.0], [0.0, 2.0], [0.1, 3.0], [0.1, 4.0]]
    """
    import pandas as pd

    kept = ... if where is None else where
    arrays = np.broadcast_arrays(*columns.values())
    return pd.DataFrame({name: array[kept].reshape(-1) for name, array in zip(columns, arrays, strict=True)})

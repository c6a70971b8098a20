"""Links: which vehicle measured which at each step, and range, azimuth and inclination between two vehicles."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy import pi

from ..arrays import Bools, Floats, Ints, checked, frozen, number, refuse, remade


@dataclass(frozen=True, eq=False)
class Links:
    """Which vehicle measured which, the same in all runs, sorted by (step, observer, distance).

    Args:
        step: (L,) step of the link.
        observer: (L,) column of the Recording that measures.
        neighbour: (L,) column that is measured.

    Raises:
        InputError: arrays of other lengths or kinds, a negative index, rows out of order, a vehicle that measures
            itself or measures another twice in a step.

    >>> Links([0, 0], [0, 1], [1, 0])
    Links(2 of 2 observers)
    """

    step: Ints
    observer: Ints
    neighbour: Ints

    __reduce__ = remade

    def __post_init__(self) -> None:
        size = -1
        for name in ("step", "observer", "neighbour"):
            column = checked(f"links.{name}", getattr(self, name), "(L,)", (size,), int)
            size = len(column)
            self.__dict__[name] = column
            refuse(f"links.{name}", column, column < 0, "must be >= 0", "Count steps and columns from 0.")
        forward, aside = (np.diff(column, prepend=column[:1]) for column in (self.step, self.observer))
        late = (forward < 0) | ((forward == 0) & (aside < 0))
        refuse("links.step", self.step, late, "must be sorted by step, then observer", "Sort with numpy.lexsort.")
        itself = self.neighbour == self.observer
        refuse("links.neighbour", self.neighbour, itself, "must differ from the observer", "Drop the link.")
        pair = np.cumsum((forward != 0) | (aside != 0)) * (self.neighbour.max(initial=0) + 1) + self.neighbour
        order, twice = np.argsort(pair), np.zeros(len(pair), bool)
        twice[order[1:]] = np.diff(pair[order]) == 0
        allowed = "must stand once for each step and observer"
        refuse("links.neighbour", self.neighbour, twice, allowed, "Keep one measurement of a pair in a step.")

    def of(self, observer: int) -> Ints:
        """Indices of the links of one observer, in time order and nearest first within a step."""
        number("observer", observer, -(2**62), 2**62, kind=int, allowed="a column", hint="Count columns from 0.")
        order, start = self._by_observer
        if not 0 <= observer < len(start) - 1:
            return np.empty(0, int)
        return order[start[observer] : start[observer + 1]]

    @cached_property
    def _by_observer(self) -> tuple[Ints, Ints]:
        """Links in the order of their observers, and the first of each observer, which spares a search per observer."""
        order = np.argsort(self.observer, kind="stable")
        last = int(self.observer.max(initial=-1))
        return frozen(order, int), np.searchsorted(self.observer[order], np.arange(last + 2))

    def __len__(self) -> int:
        return len(self.step)

    def __repr__(self) -> str:
        return f"Links({len(self)} of {len(np.unique(self.observer))} observers)"


def spherical(dx: Any, dy: Any, dz: Any, m: Any = np) -> tuple[Any, Any, Any]:
    """Range, azimuth and inclination of the vector (dx, dy, dz), for any namespace `m` with sqrt and atan2.

    d = |v|, az = atan2(dy, dx) anticlockwise from +x, inc = atan2(hypot(dx, dy), dz) from +z.

    Args:
        dx: metres, of any one shape.
        dy: metres, of any one shape.
        dz: metres, of any one shape.
        m: numpy, torch, casadi, or anything with `sqrt` and `atan2`.

    Returns:
        metres, radians, radians.

    >>> [round(float(v), 3) for v in spherical(0.0, 2.0, 0.0)]
    [2.0, 1.571, 1.571]
    """
    ground = dx * dx + dy * dy
    return m.sqrt(ground + dz * dz), m.atan2(dy, dx), m.atan2(m.sqrt(ground), dz)


def to_vector(relative: Floats) -> Floats:
    """Vectors d [sin inc cos az, sin inc sin az, cos inc] of measurements (..., 3), in metres.

    >>> to_vector(np.array([2.0, 0.0, np.pi / 2])).round(3) + 0.0
    array([2., 0., 0.])
    """
    d, az, inc = np.moveaxis(relative, -1, 0)
    return np.stack([d * np.sin(inc) * np.cos(az), d * np.sin(inc) * np.sin(az), d * np.cos(inc)], axis=-1)


STEEP = 0.2
"""rad from the vertical within which errors of the positions turn an azimuth as they like."""


def drop_steep_azimuths(relative: Floats) -> Floats:
    """Measurements (..., 3) without the azimuths (NaN) of what is straight above or below: their variance grows without
    bound as the horizontal distance vanishes.

    >>> drop_steep_azimuths(np.array([9.0, 0.5, 0.1])).tolist()
    [9.0, nan, 0.1]
    """
    steep = abs(abs(relative[..., 2:]) - pi / 2) > pi / 2 - STEEP
    return np.where(steep & (np.arange(3) == 1), np.nan, relative) if steep.any() else relative


def vector_cov(relative: Floats, std: Floats, min_range: float = 0.0) -> Floats:
    """Covariance J diag(std^2) J^T of `to_vector(relative)`, J its Jacobian: (..., 3, 3) m^2.

    The tangential part uses max(d, min_range): a noisy range near zero would make the angles seem exact.

    Args:
        relative: (..., 3) m, rad, rad.
        std: (3,) m, rad, rad.
        min_range: m.

    >>> np.diag(vector_cov(np.array([0.5, 0.0, np.pi / 2]), np.array([1.0, 0.2, 0.2]))).round(6)
    array([1.  , 0.01, 0.01])
    """
    d, azimuth, inclination = np.moveaxis(relative, -1, 0)
    reach = np.maximum(d, min_range)
    metres = std * np.stack([np.ones_like(d), reach * np.sin(inclination), reach], axis=-1)
    root = metres[..., None] * directions(azimuth, inclination)
    cov: Floats = root.mT @ root
    return cov


def directions(azimuth: Floats, inclination: Floats) -> Floats:
    """Unit vectors (..., 3, 3), by rows, along which range, azimuth and inclination grow.

    >>> directions(np.array(0.0), np.array(np.pi / 2)).round().tolist()
    [[1.0, 0.0, 0.0], [-0.0, 1.0, 0.0], [0.0, 0.0, -1.0]]
    """
    sa, ca, si, ci = np.sin(azimuth), np.cos(azimuth), np.sin(inclination), np.cos(inclination)
    rows = [[si * ca, si * sa, ci], [-sa, ca, 0.0 * sa], [ci * ca, ci * sa, -si]]
    return np.stack([np.stack(row, axis=-1) for row in rows], -2)


def stretches(flags: Bools) -> list[tuple[int, int]]:
    """(start, stop) of the runs of True.

    >>> stretches(np.array([True, False, True, True]))
    [(0, 1), (2, 4)]
    """
    edges = np.flatnonzero(np.diff(flags.astype(int), prepend=0, append=0)).reshape(-1, 2)
    return [(int(start), int(stop)) for start, stop in edges]


def wrap(angle: Any) -> Any:
    """The same angle in [-pi, pi).

    >>> round(float(wrap(3.5)), 4)
    -2.7832
    """
    return (angle + pi) % (2 * pi) - pi

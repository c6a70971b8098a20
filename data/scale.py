"""What no drive in metres and seconds looks like: degrees, milliseconds, millions of steps for a few rows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from coopoc.arrays import Floats, Ints
from coopoc.errors import InputError

SLOWEST, FASTEST = 2e-3, 500.0
"""m/s: a car in degrees per second has 0.0003 at most, an airliner in metres 250."""
LATEST = 1e11
"""s since 1970, the year 5138."""
LONGEST_ID = 200
"""Characters."""
CELLS, PER_ROW = 500_000, 200
"""Steps times vehicles that any file may take, and how many more a row of it may."""


def check_scale(t: Floats, position: Floats, by_vehicle: Sequence[Ints], file: str) -> None:
    """InputError where rows look like degrees or milliseconds, or move too fast for metres and seconds.

    The typical speed of a vehicle is the median of |dx| / dt over the pairs of rows between which it moves, that of a
    file the largest of its vehicles. A file in which nothing moves has none.

    Args:
        t: (L,) s.
        position: (L, 3) m.
        by_vehicle: rows of each vehicle in time order.
        file: named in the error.

    >>> x = np.array([[11.58, 48.14, 0.0], [11.5801, 48.1401, 0]])
    >>> check_scale(np.array([0.0, 1]), x, [np.arange(2)], "drive.csv")
    Traceback (most recent call last):
    coopoc.errors.InputError: drive.csv: columns x, y = 11.58..11.5801, 48.14..48.1401: look like degrees, must be \
metres in a local frame. Give latitude and longitude to co.load_recording, which converts them, or pass any_scale=True.
    """
    check_time(t, file)
    speeds = [_typical_speed(t[rows], position[rows]) for rows in by_vehicle]
    speed = max([0.0, *speeds])
    (west, east), (south, north) = ((float(v.min()), float(v.max())) for v in position[:, :2].T)
    if 0 < speed < SLOWEST and max(-west, east) <= 360 and max(-south, north) <= 180:
        raise InputError(
            f"{file}: columns x, y",
            f"{west:.8g}..{east:.8g}, {south:.8g}..{north:.8g}",
            "look like degrees, must be metres in a local frame",
            "Give latitude and longitude to co.load_recording, which converts them, or pass any_scale=True.",
        )
    if speed > FASTEST:
        raise InputError(
            f"{file}: columns t, x, y, z",
            f"a typical speed of {speed:.4g} m/s",
            f"must be below {FASTEST:g} m/s",
            "Check the units (seconds, metres) and that no two vehicles share an id, or pass any_scale=True.",
        )


def check_time(t: Floats, file: str) -> None:
    """InputError where times (L,) s are beyond any date.

    >>> check_time(np.array([1.7e9]), "drive.csv")
    """
    late = np.flatnonzero(np.abs(t) > LATEST)
    if len(late):
        raise InputError(
            f"{file}: column t",
            f"{t[late[0]]:.15g}",
            "must be seconds: it looks like milliseconds or nanoseconds since 1970",
            "Divide it by 1e3 or 1e9, or store dates.",
        )


def check_size(steps: float, vehicles: int, rows: int, dt: float, file: str) -> None:
    """InputError where a time step asks for many more instants than the file has rows.

    Args:
        steps: T.
        vehicles: N.
        rows: L.
        dt: s.
        file: named in the error.

    >>> check_size(3.0, 2, 6, 0.1, "drive.csv")
    """
    if not steps * vehicles <= max(CELLS, PER_ROW * rows):
        raise InputError(
            f"{file}: column t with dt = {dt:g} s",
            f"{steps:.3g} steps of {vehicles} vehicles for {rows} rows",
            f"must be at most {PER_ROW} instants a row",
            "Check that t is in seconds (not nanoseconds or milliseconds), or take a longer dt.",
        )


def check_ids(vehicle: Sequence[str], file: str) -> None:
    """InputError at the first id that is too long to be one.

    >>> check_ids(["a", "b"], "drive.csv")
    """
    for row, one in enumerate(vehicle):
        if len(one) > LONGEST_ID:
            allowed = f"must have at most {LONGEST_ID} characters"
            raise InputError(f"{file}: row {row + 1}, column id", f"{one[:40]}...", allowed, "Check the column.")


def _typical_speed(t: Floats, position: Floats) -> float:
    if len(t) < 2:
        return 0.0
    speed = np.linalg.norm(np.diff(position[:, :2], axis=0), axis=1) / np.diff(t)
    return float(np.median(speed[speed > 0])) if (speed > 0).any() else 0.0

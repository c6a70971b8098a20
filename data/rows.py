"""Rows (one per vehicle and instant) -> Fleet: what every reader ends with."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from coopoc.arrays import Bools, Floats, Ints
from coopoc.errors import InputError
from coopoc.world.fleet import Fleet

from .scale import check_ids, check_scale, check_size

SAME = 1e-6
"""s, stamps this close are one instant: the digits that a double keeps of seconds since 1970."""


def assemble(
    vehicle: Sequence[str],
    t: Floats,
    position: Floats,
    velocity: Floats | None = None,
    *,
    dt: float | None = None,
    max_gap: float | None = None,
    any_scale: bool = False,
    file: str = "rows",
    name: str = "",
    source: str = "",
    licence: str = "",
) -> Fleet:
    """Fleet of L rows; vehicles keep the order of their first row, absence is a missing row.

    Args:
        vehicle: (L,) ids.
        t: (L,) s.
        position: (L, 3) m.
        velocity: (L, 3) m/s; None: the backward difference u_t = (x_t - x_{t-1})/dt, with u_0 := u_1.
        dt: s; None keeps the stamps, a number resamples every vehicle linearly.
        max_gap: s, the longest gap between two rows of a vehicle that `dt` bridges; in a longer one it is absent. None:
            the largest of 5 dt, 0.5 s and 1.5 times the vehicle's own median interval.
        any_scale: True accepts positions that do not look like metres and seconds.
        file: named in errors.
        name: of the Fleet.
        source: of the Fleet.
        licence: of the Fleet.

    Raises:
        InputError: dt <= 0, no row, stamps of a vehicle that do not increase, stamps that are not equally spaced, a
            vehicle that would vanish or never be there at two instants in a row, an implausible scale (`check_scale`),
            many times more steps than rows, or what Fleet refuses.

    >>> assemble(["a", "a"], np.array([0, 0.1]), np.array([[0.0, 0, 0], [1, 0, 0]])).velocity[0, 0, 0]
    np.float64(10.0)
    """
    if dt is not None and not dt > 0:
        raise InputError("dt", f"{dt} s", "must be > 0", "Give the sampling interval in seconds.")
    if max_gap is not None and not max_gap > 0:
        raise InputError("max_gap", f"{max_gap} s", "must be > 0", "Give the longest gap to bridge in seconds.")
    if not len(t):
        raise InputError(file, "0 rows", "must hold at least two instants", "Check that the file is complete.")
    check_ids(vehicle, file)
    place = {one: k for k, one in enumerate(dict.fromkeys(map(str, vehicle)))}
    column = np.array([place[str(one)] for one in vehicle], dtype=np.int64)
    numbers = np.hstack([position, velocity]) if velocity is not None else np.asarray(position, dtype=float)
    stamps = np.round(np.asarray(t, dtype=float), 6)
    ids, by_vehicle = tuple(place), rows_of_each(column)
    for one, rows in zip(ids, by_vehicle, strict=True):
        increasing(stamps[rows], lambda row, rows=rows: f"{file}: row {rows[row] + 1}", one)  # type: ignore[misc]
    if not any_scale:
        check_scale(stamps, numbers[:, :3], by_vehicle, file)
    if dt is None:
        grid, table = _on_stamps(stamps, column, numbers, file)
    else:
        grid, table = _resampled(stamps, by_vehicle, numbers, dt, max_gap, file)
    _refuse_holes(np.isfinite(table[..., 0]), np.bincount(column), ids, file)
    u = table[..., 3:] if velocity is not None else backward_difference(grid, table[..., :3], ids, file)
    return Fleet(ids, grid, table[..., :3], u, name=name, source=source, licence=licence)


def backward_difference(t: Floats, position: Floats, ids: Sequence[str], file: str = "rows") -> Floats:
    """(T, N, 3) u_t = (x_t - x_{t-1})/(t_t - t_{t-1}); the first step of a presence takes the next one's value.

    >>> backward_difference(np.array([0, 0.5]), np.array([[[0.0, 0, 0]], [[1, 0, 0]]]), ["a"])[1, 0]
    array([2., 0., 0.])
    """
    u = np.full_like(position, np.nan)
    if len(t) > 1:
        u[1:] = np.diff(position, axis=0) / np.diff(t)[:, None, None]
        starts = np.isfinite(position[:-1]) & ~np.isfinite(u[:-1])
        u[:-1][starts] = u[1:][starts]
    alone = np.isfinite(position[..., 0]) & ~np.isfinite(u[..., 0])
    if alone.any():
        step, column = np.argwhere(alone)[0]
        raise InputError(
            f"{file}: velocity",
            f"none for {ids[column]} at t = {t[step]:g} s",
            "needs two instants in a row to be derived",
            "Add the columns vx, vy, vz, or leave out the vehicle's single instants.",
        )
    return u


def interpolate(t: Floats, values: Floats, grid: Floats, max_gap: float) -> Floats:
    """(G, C) linear interpolation of (L, C) values, NaN outside the stamps and inside gaps longer than max_gap seconds.

    >>> interpolate(np.array([0.0, 1, 9]), np.array([[0.0], [1], [9]]), np.array([0.5, 5]), max_gap=2).ravel()
    array([0.5, nan])
    """
    right = np.clip(np.searchsorted(t, grid, side="left"), 1, len(t) - 1)
    left = right - 1
    near = np.where(np.abs(grid - t[left]) < np.abs(grid - t[right]), left, right)
    on_stamp = np.abs(grid - t[near]) <= SAME
    grid = np.where(on_stamp, t[near], grid)
    out = np.column_stack([np.interp(grid, t, v, left=np.nan, right=np.nan) for v in values.T])
    out[(t[right] - t[left] > max_gap + SAME) & ~on_stamp] = np.nan
    return out


def rows_of_each(column: Ints) -> list[Ints]:
    """Rows of each column, in order.

    >>> [rows.tolist() for rows in rows_of_each(np.array([0, 1, 0]))]
    [[0, 2], [1]]
    """
    order = np.argsort(column, kind="stable")
    ends = np.cumsum(np.bincount(column))
    return np.split(order, ends[:-1])


def increasing(stamps: Floats, place: Callable[[int], str], vehicle: str) -> None:
    """InputError at the first row of one vehicle whose stamp does not come after the stamp before.

    >>> increasing(np.array([0.0, 0.1]), "row {}".format, "a")
    """
    late = np.flatnonzero(np.diff(stamps) <= 0)
    if len(late):
        row = int(late[0]) + 1
        twice = stamps[row] == stamps[row - 1]
        raise InputError(
            f"{place(row)}, column t",
            f"{stamps[row]!s} s after {stamps[row - 1]!s} s of vehicle {vehicle}",
            "dt must be > 0: the stamps of a vehicle increase from row to row",
            "Remove the repeated row." if twice else "Sort the rows by time.",
        )


def _on_stamps(stamps: Floats, column: Ints, numbers: Floats, file: str) -> tuple[Floats, Floats]:
    instants, step = np.unique(stamps, return_inverse=True)
    grid, place = _regular(instants, file)
    table = np.full((len(grid), column.max() + 1, numbers.shape[1]), np.nan)
    table[place[step], column] = numbers
    return grid, table


def _regular(instants: Floats, file: str) -> tuple[Floats, Ints]:
    """Equally spaced grid and the place of every instant on it: instants without any vehicle are filled in."""
    gaps = np.diff(instants)
    if not len(gaps):
        return instants, np.zeros(1, dtype=np.int64)
    steps = np.rint((instants - instants[0]) / gaps.min())
    sparse = steps[-1] > 50 * len(steps)
    place = np.zeros(len(steps), dtype=np.int64) if sparse else steps.astype(np.int64)
    grid = instants.copy() if sparse else np.round(np.linspace(instants[0], instants[-1], place[-1] + 1), 6)
    if sparse or np.abs(grid[place] - instants).max() > 1e-3 * gaps.min() + 1e-6:
        raise InputError(
            f"{file}: t",
            f"instants between {gaps.min():g} and {gaps.max():g} s apart",
            "must be equally spaced",
            "Resample: load_fleet(..., dt=0.1), --data 'FILE?dt=0.1' or coopoc data convert --dt 0.1.",
        )
    grid[place] = instants
    return grid, place


def _refuse_holes(present: Bools, rows: Ints, ids: Sequence[str], file: str) -> None:
    """InputError if a vehicle has rows but no instant, or more than one row and never two instants in a row."""
    runs = (present[1:] & present[:-1]).any(axis=0)
    for column in np.flatnonzero(~present.any(axis=0) | ((rows > 1) & ~runs)).tolist():
        raise InputError(
            f"{file}: vehicle {ids[column]}",
            f"{rows[column]} rows, but {present[:, column].sum()} instants, no two in a row",
            "must be there at instants in a row",
            "Resample all vehicles with a dt like that of its rows, bridge longer gaps with max_gap=, or leave it out.",
        )


def _resampled(
    stamps: Floats, by_vehicle: list[Ints], numbers: Floats, dt: float, max_gap: float | None, file: str
) -> tuple[Floats, Floats]:
    start = stamps.min()
    since = np.round(stamps - start, 6)  # seconds since 1970 would leave few digits to compare
    steps = (since.max() + SAME) / dt + 1
    check_size(steps, len(by_vehicle), len(stamps), dt, file)
    grid = dt * np.arange(int(steps))
    table = np.full((len(grid), len(by_vehicle), numbers.shape[1]), np.nan)
    for k, rows in enumerate(by_vehicle):
        own = 1.5 * float(np.median(np.diff(since[rows]))) if len(rows) > 1 else 0.0
        table[:, k] = interpolate(since[rows], numbers[rows], grid, max_gap or max(5 * dt, 0.5, own))
    return start + grid, table

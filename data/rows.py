"""Rows (one per vehicle and instant) -> Fleet: what every reader ends with."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from coopoc.arrays import Bools, Floats, Ints
from coopoc.errors import InputError
from coopoc.world.fleet import Fleet


def assemble(
    vehicle: Sequence[str],
    t: Floats,
    position: Floats,
    velocity: Floats | None = None,
    *,
    dt: float | None = None,
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
        dt: s; None keeps the stamps, a number resamples every vehicle linearly (gaps above 5 dt and 0.5 s stay absent).
        file: named in errors.
        name: of the Fleet.
        source: of the Fleet.
        licence: of the Fleet.

    Raises:
        InputError: dt <= 0, no row, stamps of a vehicle that do not increase, stamps that are not equally spaced, a
            vehicle that would vanish or never be there at two instants in a row, or what Fleet refuses.

    >>> assemble(["a", "a"], np.array([0, 0.1]), np.array([[0.0, 0, 0], [1, 0, 0]])).velocity[0, 0, 0]
    np.float64(10.0)
    """
    if dt is not None and not dt > 0:
        raise InputError("dt", f"{dt} s", "must be > 0", "Give the sampling interval in seconds.")
    if not len(t):
        raise InputError(file, "0 rows", "must hold at least two instants", "Check that the file is complete.")
    names, first, column = np.unique(np.asarray(vehicle, dtype=str), return_index=True, return_inverse=True)
    order = np.argsort(first)
    column = np.argsort(order)[column]
    numbers = np.hstack([position, velocity]) if velocity is not None else np.asarray(position, dtype=float)
    stamps = np.round(np.asarray(t, dtype=float), 6)
    for k, one in enumerate(names[order]):
        rows = np.flatnonzero(column == k)
        increasing(stamps[rows], lambda row, rows=rows: f"{file}: row {rows[row] + 1}", one)  # type: ignore[misc]
    grid, table = _on_stamps(stamps, column, numbers, file) if dt is None else _resampled(stamps, column, numbers, dt)
    ids = tuple(str(n) for n in names[order])
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
    out = np.column_stack([np.interp(grid, t, v, left=np.nan, right=np.nan) for v in values.T])
    on_stamp = np.isclose(grid, t[right], atol=1e-9) | np.isclose(grid, t[right - 1], atol=1e-9)
    out[(t[right] - t[right - 1] > max_gap) & ~on_stamp] = np.nan
    return out


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
            f"{stamps[row]:g} s after {stamps[row - 1]:g} s of vehicle {vehicle}",
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
    place = np.rint((instants - instants[0]) / gaps.min()).astype(np.int64)
    sparse = place[-1] > 50 * len(place)
    grid = instants.copy() if sparse else np.round(np.linspace(instants[0], instants[-1], place[-1] + 1), 6)
    if sparse or np.abs(grid[place] - instants).max() > 1e-3 * gaps.min() + 1e-6:
        raise InputError(
            f"{file}: t",
            f"instants between {gaps.min():g} and {gaps.max():g} s apart",
            "must be equally spaced",
            "Resample: load(..., dt=0.1) or coopoc data convert --dt 0.1.",
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
            "Resample all vehicles with a dt like that of its rows, or leave the vehicle out.",
        )


def _resampled(stamps: Floats, column: Ints, numbers: Floats, dt: float) -> tuple[Floats, Floats]:
    grid = stamps.min() + dt * np.arange(int(np.floor((np.ptp(stamps) + 1e-9) / dt)) + 1)
    table = np.full((len(grid), column.max() + 1, numbers.shape[1]), np.nan)
    for k in range(table.shape[1]):
        rows = np.flatnonzero(column == k)
        table[:, k] = interpolate(stamps[rows], numbers[rows], grid, max(5 * dt, 0.5))
    return grid, table

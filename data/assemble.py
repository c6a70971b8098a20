"""Rows at their own times on equal steps: drives -> Fleet, measurements in a plane -> Recording in body frames."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from numpy import nan

from coopoc import V2X, Body, Fleet, InputError, Links, Recording, Sensors
from coopoc.arrays import Bools, Floats, Ints, number
from coopoc.world.plausible import MAX_SPEED, plausible

SAME_INSTANT = 1e-6
"""s, stamps this close are one instant: the digits that a double keeps of seconds since 1970."""
MIN_TYPICAL_SPEED, MAX_TYPICAL_SPEED = 2e-3, 500.0
"""m/s: a car in degrees per second has 0.0003 at most, an airliner in metres 250."""
NOISE_STDS = 6.0
"""Standard deviations of a position that the fastest moves between two of which a speed is taken."""
MAX_HEIGHT = 1e5
"""m, beyond which a height is a coordinate from the centre of the earth."""
REGION = 2.0
"""Degrees that a fleet spans at most; robots that stand in a room, and tremble in motion capture, are metres apart."""
MIN_INSTANTS, MAX_INSTANTS_PER_ROW = 500_000, 200
"""Steps times vehicles that a file of any length may fill, and most of them for each row of a longer one."""
PLANE_STD = 0.01
"""m and rad, standard deviations of z = 0 and of an inclination of pi/2 where heights were not measured."""


def assemble(
    vehicle: Sequence[str],
    t: Floats,
    numbers: Floats,
    *,
    dt: float | None = None,
    max_gap: float | None = None,
    any_scale: bool = False,
    path: Path = Path("rows"),
    source: str = "",
) -> Fleet:
    """Fleet of L rows; vehicles keep the order of their first row, absence is a missing row.

    Args:
        vehicle: (L,) ids.
        t: (L,) s.
        numbers: (L, 6) positions m and velocities m/s; (L, 3) positions alone, whose velocity is the backward
            difference u_t = (x_t - x_{t-1})/dt, with u_0 := u_1.
        dt: s; None keeps the stamps, a number resamples every vehicle linearly.
        max_gap: s, the longest gap between two rows of a vehicle that `dt` bridges; in a longer one it is absent. None:
            as `longest_gap`.
        any_scale: True accepts positions that do not look like metres and seconds.
        path: that names the Fleet, and its file in errors.
        source: of the Fleet.

    Raises:
        InputError: dt <= 0, no row, stamps of a vehicle that do not increase, stamps that are not equally spaced, a
            vehicle that would vanish or never be there at two instants in a row, an implausible scale (`check_scale`),
            many times more steps than rows, or what Fleet refuses.

    >>> assemble(["a", "a"], np.array([0, 0.1]), np.array([[0.0, 0, 0], [1, 0, 0]])).velocity[0, 0, 0]
    np.float64(10.0)
    """
    file = path.name
    check_intervals(dt=dt, max_gap=max_gap)
    if not len(t):
        raise InputError(file, "0 rows", "must hold at least two instants", "Check that the file is complete.")
    column, names = pd.Series(vehicle).factorize()
    ids = tuple(names)
    stamps = np.round(np.asarray(t, float), 6)
    order = np.argsort(column, kind="stable")
    back = np.flatnonzero((np.diff(stamps[order]) <= 0) & (np.diff(column[order]) == 0))
    if len(back):
        before, row = order[back[0] : back[0] + 2].tolist()
        raise InputError(
            f"{file}: row {row + 1}, column t",
            f"{stamps[row]!s} s after {stamps[before]!s} s of vehicle {ids[column[row]]}",
            "dt must be > 0: the stamps of a vehicle increase from row to row",
            "Sort the rows by time, or remove one that repeats.",
        )
    by_vehicle = np.split(order, np.cumsum(np.bincount(column))[:-1])
    if not any_scale:
        check_time(stamps, file)
        check_scale([(stamps[rows], numbers[rows]) for rows in by_vehicle], file)
    if dt is None:
        grid, table = _on_stamps(stamps, column, numbers, file)
    else:
        start = stamps.min()
        since = np.round(stamps - start, 6)  # seconds since 1970 would leave few digits to compare
        steps = (since.max() + SAME_INSTANT) / dt + 1
        check_size(steps, len(ids), len(stamps), dt, file)
        grid = dt * np.arange(int(steps))
        paths = [(since[rows], numbers[rows]) for rows in by_vehicle]
        table = np.stack([interpolate(t, x, grid, longest_gap(t, dt, max_gap)) for t, x in paths], axis=1)
        grid = start + grid
    present = np.isfinite(table[..., 0])
    lonely = (np.bincount(column) > 1) & ~(present[1:] & present[:-1]).any(0)
    for k in np.flatnonzero(~present.any(0) | lonely).tolist():
        raise InputError(
            f"{file}: vehicle {ids[k]}",
            f"{(column == k).sum()} rows, but {present[:, k].sum()} instants, no two consecutive",
            "must be present at consecutive instants",
            "Resample all with a dt like that of its rows, bridge longer gaps with max_gap=, or leave it out.",
        )
    x, u = table[..., :3], table[..., 3:]
    return Fleet(ids, grid, x, u if u.size else backward_difference(grid, x, ids, file), name=path.stem, source=source)


def check_intervals(**seconds: float | None) -> None:
    """InputError for an interval that is given, and no number > 0."""
    for field, value in seconds.items():
        if value is not None:
            number(field, value, 1e-12, allowed="a number > 0 s", hint="Give seconds.")


def longest_gap(t: Floats, dt: float, max_gap: float | None) -> float:
    """s, the longest gap between times (L,) s that is bridged: max_gap, or the largest of 5 dt, 0.5 s and 1.5 times the
    interval that nine of ten do not exceed.

    >>> longest_gap(np.arange(4.0), 0.1, None)
    1.5
    """
    return max_gap or max(5 * dt, 0.5, 1.5 * float(np.quantile(np.diff(t), 0.9)) if len(t) > 1 else 0.0)


def backward_difference(t: Floats, position: Floats, ids: Sequence[str], file: str = "rows") -> Floats:
    """(T, N, 3) u_t = (x_t - x_{t-1})/(t_t - t_{t-1}); the first step of a presence takes the next one's value.

    >>> backward_difference(np.array([0, 0.5]), np.array([[[0.0, 0, 0]], [[1, 0, 0]]]), ["a"])[1, 0]
    array([2., 0., 0.])
    """
    u = np.full_like(position, nan)
    if len(t) > 1:
        u[1:] = np.diff(position, axis=0) / np.diff(t)[:, None, None]
        starts = np.isfinite(position[:-1]) & ~np.isfinite(u[:-1])
        u[:-1][starts] = u[1:][starts]
    plausible(f"{file}: velocity [step, vehicle, axis]", u, MAX_SPEED, "Do positions jump, as between zones of UTM?")
    alone = np.argwhere(np.isfinite(position[..., 0]) & ~np.isfinite(u[..., 0]))
    if len(alone):
        raise InputError(
            f"{file}: velocity",
            f"none for {ids[alone[0, 1]]} at t = {t[alone[0, 0]]:g} s",
            "needs two consecutive instants to be derived",
            "Add the columns vx, vy, vz, or leave out the vehicle's single instants.",
        )
    return u


def interpolate(t: Floats, values: Floats, grid: Floats, max_gap: float) -> Floats:
    """(G, C) linear interpolation of (L, C) values, NaN outside the stamps and inside gaps longer than max_gap seconds.

    >>> interpolate(np.array([0.0, 1, 9]), np.array([[0.0], [1], [9]]), np.array([0.5, 5]), max_gap=2).ravel()
    array([0.5, nan])
    """
    stamp = t[np.clip(np.searchsorted(t, grid - SAME_INSTANT), 0, len(t) - 1)]
    grid = np.where(abs(grid - stamp) <= SAME_INSTANT, stamp, grid)
    out = np.column_stack([np.interp(grid, t, v) for v in values.T])
    return np.where(covered(t, grid, max_gap, 0.0)[:, None], out, nan)


def covered(t: Floats, at: Floats, gap: float, edge: float) -> Bools:
    """True between samples at most `gap` apart, and up to `edge` beyond a sample.

    >>> covered(np.array([0.0, 1, 5]), np.array([0.5, 2, 4.8]), 2.0, 0.3).tolist()
    [True, False, True]
    """
    right = np.clip(np.searchsorted(t, at), min(1, len(t) - 1), len(t) - 1)
    left = np.maximum(right - 1, 0)
    between = (
        (at >= t[left] - SAME_INSTANT) & (at <= t[right] + SAME_INSTANT) & (t[right] - t[left] <= gap + SAME_INSTANT)
    )
    return between | (np.minimum(abs(at - t[left]), abs(at - t[right])) <= edge + SAME_INSTANT)


def check_scale(paths: Sequence[tuple[Floats, Floats]], file: str, std: float = 0.0) -> None:
    """InputError where paths look like degrees or ECEF, or move too fast for metres and seconds.

    The typical speed of a vehicle is the median of |dx| / dt over the pairs of rows between which it moves, each so
    much later that noise hardly counts; that of a file the largest of its vehicles. A file in which nothing moves has
    none.

    Args:
        paths: (L,) s and (L, 2 or more) m of each vehicle in time order.
        file: named in the error.
        std: m, of positions.

    >>> check_scale([(np.array([0.0, 1]), np.array([[11.58, 48.14], [11.5801, 48.1401]]))], "drive.csv")
    Traceback (most recent call last):
    coopoc.errors.InputError: drive.csv: columns x, y = 11.58..11.5801, 48.14..48.1401: look like degrees, must be \
metres in a local frame. Give latitude and longitude to co.read_log, which converts them, or pass any_scale=True.
    """
    speed, places = 0.0, np.concatenate([position[:, :2] for _, position in paths])
    for t, position in paths:
        later = np.searchsorted(t, t[:-1] + NOISE_STDS * std / MAX_TYPICAL_SPEED, "right").clip(max=len(t) - 1)
        each = np.linalg.norm((position[later] - position[:-1])[:, :2], axis=1) / (t[later] - t[:-1])
        speed = max(speed, float(np.median(each[each > 0])) if (each > 0).any() else 0.0)
    low, high = places.min(0), places.max(0)
    on_earth = (np.maximum(-low, high) <= [360, 180]).all()
    if 0 < speed < MIN_TYPICAL_SPEED and on_earth and (high - low).max() < REGION:
        raise InputError(
            f"{file}: columns x, y",
            ", ".join(f"{least:.8g}..{most:.8g}" for least, most in zip(low, high, strict=True)),
            "look like degrees, must be metres in a local frame",
            "Give latitude and longitude to co.read_log, which converts them, or pass any_scale=True.",
        )
    if (abs(np.concatenate([position[:, 2:] for _, position in paths])) > MAX_HEIGHT).any():
        raise InputError(
            f"{file}: column z",
            f"beyond {MAX_HEIGHT:g} m",
            "looks like ECEF, must be height in a local frame",
            "Convert x, y, z to latitude, longitude and height, or pass any_scale=True.",
        )
    if speed > MAX_TYPICAL_SPEED:
        raise InputError(
            f"{file}: columns t, x, y, z",
            f"a typical speed of {speed:.4g} m/s",
            f"must be below {MAX_TYPICAL_SPEED:g} m/s",
            "Check the units (t in s, of days as in spreadsheets scale=t:86400; positions in m) and that no two "
            "vehicles share an id, or pass any_scale=True.",
        )


def check_time(t: Floats, file: str, column: str = "t") -> None:
    """InputError where times (L,) s are beyond any date.

    >>> check_time(np.array([1.7e9]), "drive.csv")
    """
    late = t[abs(t) > 1e11]  # the year 5138
    if len(late):
        raise InputError(
            f"{file}: column {column}",
            f"{late[0]:.15g}",
            "must be seconds: it looks like milliseconds or nanoseconds since 1970",
            "Pass scale=t:1e-3 or t:1e-9 if all files are so, the truth, too; or store seconds or dates.",
        )


def check_size(steps: float, vehicles: int, rows: int, dt: float, file: str) -> None:
    """InputError where a time step asks for many more instants than the file has rows.

    >>> check_size(3.0, 2, 6, 0.1, "drive.csv")
    """
    if not steps * vehicles <= max(MIN_INSTANTS, MAX_INSTANTS_PER_ROW * rows):
        raise InputError(
            f"{file}: column t with dt = {dt:g} s",
            f"{steps:.3g} steps of {vehicles} vehicles for {rows} rows",
            f"must be at most {MAX_INSTANTS_PER_ROW} instants a row",
            "Check that t is in seconds (not nanoseconds or milliseconds) and the same for all numbers of a sample, "
            "correct rows whose clock was not set (of a bag stamps=received), or take a longer dt.",
        )


def _on_stamps(stamps: Floats, column: Ints, numbers: Floats, file: str) -> tuple[Floats, Floats]:
    """Equally spaced grid (T,) and the rows on it (T, N, C): instants without any vehicle are filled in."""
    instants, row_of = np.unique(stamps, return_inverse=True)
    gaps = np.diff(instants) if len(instants) > 1 else np.ones(1)
    step = np.rint((instants - instants[0]) / gaps.min())
    if step[-1] <= 50 * len(step):
        index = step.astype(int)
        grid = np.round(np.linspace(instants[0], instants[-1], index[-1] + 1), 6)
        if abs(grid[index] - instants).max() <= 1e-3 * gaps.min() + 1e-6:
            grid[index] = instants
            table = np.full((len(grid), column.max() + 1, numbers.shape[1]), nan)
            table[index[row_of], column] = numbers
            return grid, table
    raise InputError(
        f"{file}: t",
        f"instants between {gaps.min():g} and {gaps.max():g} s apart",
        "must be equally spaced",
        "Resample: load_fleet(..., dt=0.1), or FILE?dt=0.1 on the command line.",
    )


def nearest(late: Floats, *keys: Ints | Floats) -> Ints:
    """Indices of one measurement per combination of keys, the nearest in time, sorted by these.

    Args:
        late: (M,) s between a measurement and its step.
        keys: (M,) step, and columns of who measures and is measured; what has a negative one is left out.

    >>> nearest(np.array([0.04, 0.01, 0.02]), np.array([3, 3, -1]), np.zeros(3, int), np.ones(3, int))
    array([1])
    """
    names = [*range(len(keys))]
    rows = pd.DataFrame(dict(enumerate(keys))).assign(late=late)
    rows = rows[(rows[names] >= 0).all(axis=1)].sort_values([*names, "late"], kind="stable")
    return np.asarray(rows.drop_duplicates(names).index)


def steps_of(t: Floats, dt: float, steps: int) -> Ints:
    """Step of each time (M,) s after the first step, -1 outside the drive.

    >>> steps_of(np.array([0.21, 9.0]), 0.1, 5)
    array([ 2, -1])
    """
    step = np.rint(t / dt)
    return np.where((step >= 0) & (step < steps), step, -1).astype(int)


def planar_recording(
    ids: Sequence[str],
    t: Floats,
    velocity: Floats,
    yaw_rate: Floats,
    position: Floats,
    table: Floats,
    sensors: Sensors,
    note: str,
) -> Recording:
    """A measured recording of one run, over an ideal channel. Landmarks have their position as a fix at every step and
    send nothing. Of several measurements of a pair in a step the one nearest to the step's time is kept.

    Args:
        ids: of n robots, then of the landmarks.
        t: (T,) s.
        velocity: (T, n, 2) m/s in the robots' frames, forward and left.
        yaw_rate: (T, n) rad/s.
        position: (m, 2) m, of the landmarks.
        table: (L, 5) time s, observer, neighbour, range m, bearing rad; NaN for what was not measured, a negative
            observer or neighbour for what is left out.
        sensors: the noise of all this.
        note: of the recording; that inclinations were not measured is added.
    """
    n = len(ids) - len(position)
    dt = t[1] - t[0]
    step = steps_of(table[:, 0], dt, len(t))
    table = np.column_stack([step, table[:, 1:]])[nearest(abs(table[:, 0] - dt * step), step, *table[:, 1:3].T)]
    table = table[np.lexsort(table[:, [3, 1, 0]].T)]
    links = Links(*table[:, :3].astype(int).T)
    shape = (1, len(t), len(ids), 3)
    gnss, moved, turning = np.full(shape, nan), np.zeros(shape), np.zeros(shape[:3])
    gnss[0, :, n:] = position @ np.eye(2, 3)
    moved[0, :, :n, :2], turning[0, :, :n] = velocity, yaw_rate
    return Recording(
        ids=tuple(ids),
        t=t,
        gnss=gnss,
        velocity=moved,
        links=links,
        relative=np.column_stack([table[:, 3:], np.full(len(table), np.pi / 2)])[None],
        broadcasts=np.broadcast_to(np.arange(len(ids)) < n, shape[1:3]),
        arrival=np.where(links.neighbour < n, links.step, -1)[None],
        sensors=sensors,
        v2x=V2X(max_neighbours=n - 1, radius=np.inf),
        observers=tuple(range(len(ids))),
        notes=(note, "inclination was not measured: pi/2 by the constraint z = 0"),
        body=Body(turning, np.full(turning.shape, nan)),
        landmarks=tuple(range(n, len(ids))),
    )

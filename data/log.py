"""A log of one's own -> Recording: tables of what was measured, NMEA, ROS bags, and truth where there is some."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from coopoc.arrays import Floats
from coopoc.errors import InputError
from coopoc.world.fleet import Fleet
from coopoc.world.recording import Recording
from coopoc.world.sensors import Sensors
from coopoc.world.v2x import V2X

from . import log_sensors
from .bag import is_bag, read_bag
from .geodetic import to_enu
from .kinds import KINDS
from .log_links import linked
from .log_rows import LONG, Rows, check_arrivals, read_rows, stacked
from .log_summary import Summary, Tally
from .log_vehicle import Vehicle, samples, vehicle
from .motion import Signal
from .nmea import read_nmea
from .rows import backward_difference, interpolate
from .scale import check_scale, check_size, check_time

TABLES, NMEA = (".csv", ".parquet", ".xlsx"), (".nmea", ".nme")
OF_FLEETS = {"id", "t", "x", "y", "z", "vx", "vy", "vz"}
"""Columns of a table of drives."""
OF_LOGS = {"kind", "partner", "arrival", *KINDS} - OF_FLEETS - {"speed", "heading", "height"}
"""Columns that no table of drives has."""
TRUTH = "truth"
"""Stem of the file of a folder that holds the truth."""


@dataclass(frozen=True, eq=False)
class Log:
    """What a log holds: `print(log.summary)` first.

    Args:
        recording: one run of real measurements.
        truth: on the steps of the recording, NaN where it is unknown; None if there is none.
        summary: what was read, what was not and why, what is assumed.
        messages: whether messages were logged; if not, a channel may be simulated.
        origin: (latitude deg, longitude deg, height m) of the local frame, None if positions were local.
    """

    recording: Recording
    truth: Fleet | None
    summary: Summary
    messages: bool
    origin: tuple[float, float, float] | None = None


def read_log(
    path: str | Path,
    *,
    dt: float | None = None,
    max_gap: float | None = None,
    columns: Mapping[str, str] | None = None,
    kinds: Mapping[str, str] | None = None,
    ignore: Sequence[str] = (),
    clock: Mapping[str, float] | None = None,
    origin: tuple[float, float, float] | None = None,
    truth: str | Path | None = None,
    sensors: Sensors | None = None,
    any_scale: bool = False,
) -> Log:
    """Read a file or a folder of logged measurements: tables (CSV, Parquet, Excel), NMEA, or a ROS bag.

    docs/your_data.md describes the tables. A file named truth in a folder holds the truth.

    Args:
        path: a file, or a folder whose files belong to one drive.
        dt: s, steps of the recording; None: the median interval of the densest odometry (else of the densest fixes).
        max_gap: s, the longest gap of a vehicle's odometry that is bridged; it is absent in longer ones. None: the
            largest of 5 dt, 0.5 s and 1.5 times its own median interval.
        columns: names in the files, as {"t": "timestamp", "latitude": "lat"}.
        kinds: names in a column kind, as {"uwb": "range"}.
        ignore: kinds that are left out.
        clock: vehicle -> s by which its clock is ahead; it is subtracted from its stamps.
        origin: latitude deg, longitude deg, height m of the local frame; None: the first fix.
        truth: file of the truth, if it is not in the folder under that name.
        sensors: noise that methods may assume; None: the standard deviations in the log, else `Sensors()`.
        any_scale: True accepts positions that do not look like metres and seconds.

    Returns:
        Log: recording, truth, summary.

    Raises:
        InputError: names file, row, column, value, what is allowed and how to mend it.
        MissingLibraryError: pynmeagps or rosbags is not installed, and there is NMEA or a bag.

    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "drive.csv"
    >>> _ = file.write_text("t,vehicle,x,y,vx,vy\\n0,a,0,0,9,0\\n1,a,9,0,9,0\\n2,a,18,0,9,0\\n")
    >>> read_log(file).recording
    Recording(1 runs x 3 steps x 1 vehicles, 0 links, K <= 0)
    """
    path, tally = Path(path), Tally()
    _check_options(dt, max_gap, clock)
    if is_bag(path):
        rows, actual = read_bag(path, tally)
        true = None if truth is None else Path(truth)
    else:
        files, true = _files(path, None if truth is None else Path(truth))
        rows, actual = stacked([_rows_of_file(file, tally, columns, kinds, ignore) for file in files]), None
    if not len(rows):
        raise InputError(path.name, "0 rows", "must hold measurements", "Check that the files are complete.")
    rows = _on_one_clock(rows, clock or {}, path.name)
    check_time(rows.t, path.name)
    check_arrivals(rows)
    actual = _rows_of_file(true, Tally(), columns, kinds, ()) if true else actual
    origin = _origin(rows, origin)
    rows, given = local(rows, origin), log_sensors.stds(rows)
    planar = not (rows.kind == "z").any()
    _check_scale(rows, path.name, any_scale)
    grid = _grid(rows, dt, path.name)
    ids = _ids(rows)
    vehicles = {one: vehicle(one, rows.take(rows.vehicle == one), grid, max_gap, planar, tally) for one in ids}
    found = linked(rows, vehicles, grid, planar, tally)
    noise = log_sensors.assumed(given, sensors, rows, planar, tally)
    most = (
        int(np.bincount(found.links.step * len(ids) + found.links.observer).max(initial=0)) if len(found.links) else 0
    )
    recording = Recording(
        ids=tuple(ids),
        t=grid,
        gnss=np.stack([one.gnss for one in vehicles.values()], axis=1)[None],
        velocity=np.stack([one.velocity for one in vehicles.values()], axis=1)[None],
        links=found.links,
        relative=found.relative[None],
        broadcasts=found.broadcasts,
        arrival=found.arrival[None],
        sensors=noise,
        v2x=V2X(max_neighbours=most, radius=np.inf),
        observers=tuple(range(len(ids))),
        notes=(f"measurements of {path.name}, nothing is simulated", *tally.sentences),
    )
    fleet = None if actual is None else _truth(local(actual, origin), recording, max_gap, path.stem, true)
    return Log(recording, fleet, _summary(path, recording, vehicles, tally), "messages" in tally.read, origin)


def local(rows: Rows, origin: tuple[float, float, float] | None) -> Rows:
    """Rows in SI units, with x, y, z in place of latitude, longitude, height (0 where there is none in the log)."""
    value, kind, std = rows.value.copy(), rows.kind.copy(), rows.std.copy()
    for name in dict.fromkeys(kind.tolist()):
        one, here = KINDS[name], rows.kind == name
        value[here] = one.turn * one.scale * value[here] + one.offset
        if one.name in ("heading", "azimuth", "bearing"):
            value[here] = np.arctan2(np.sin(value[here]), np.cos(value[here]))
        std[here] *= one.scale
        kind[here] = one.name
    rows = replace(rows, value=value, kind=kind, std=std)
    geodetic = np.isin(kind, ["latitude", "longitude", "height"])
    if not geodetic.any() or origin is None:
        return rows
    parts, heights = [rows.take(~geodetic)], bool((kind == "height").any())
    for name in dict.fromkeys(rows.vehicle[geodetic].tolist()):
        mine = rows.take(geodetic & (rows.vehicle == name))
        fixes, first = samples(mine, ("latitude", "longitude", "height"), Tally(), 3 if heights else 2)
        at = fixes.value if heights else np.column_stack([fixes.value[:, :2], np.full(len(fixes.t), origin[2])])
        enu, base = to_enu(at, origin), mine.take(first)
        deviation = _std_of_sample(mine, fixes)
        for axis, kind_ in enumerate("xyz" if heights else "xy"):
            parts.append(
                replace(base, value=enu[:, axis], kind=np.full(len(first), kind_, dtype=object), std=deviation[:, axis])
            )
    return stacked(parts)


def _std_of_sample(rows: Rows, fixes: Signal) -> Floats:
    """(M, 3) m along east, north and up, of fixes in degrees, whose standard deviations are metres."""
    out = np.full((len(fixes.t), 3), np.nan)
    for axis, kind in enumerate(("longitude", "latitude", "height")):
        own = rows.take((rows.kind == kind) & np.isfinite(rows.std))
        if len(own):
            order = np.argsort(own.t, kind="stable")
            place = np.clip(np.searchsorted(own.t[order], fixes.t - 1e-9), 0, len(own) - 1)
            out[:, axis] = own.std[order][place]
    return out


def _rows_of_file(
    file: Path, tally: Tally, columns: Mapping[str, str] | None, kinds: Mapping[str, str] | None, ignore: Sequence[str]
) -> Rows:
    if file.suffix.lower() in NMEA:
        return read_nmea(file, tally)
    return read_rows(file, tally, columns, kinds, ignore)


def log_files(path: Path, columns: Mapping[str, str] | None = None) -> bool:
    """Whether a path is a log: a bag, NMEA, a folder with such files or tables, or a table with a column of a log.

    Args:
        path: of a file or folder.
        columns: names in the file, as `read_log` takes them; a key that only a log has makes it one.

    >>> log_files(Path("drive.nmea")), log_files(Path("drive.parquet"), {"latitude": "lat"})
    (True, True)
    """
    if is_bag(path):
        return True
    if path.is_dir():
        return any(file.suffix.lower() in (*TABLES, *NMEA) for file in path.iterdir())
    if path.suffix.lower() in NMEA:
        return True
    if path.suffix.lower() not in TABLES:
        return False
    return bool(set(columns or ()) & ({*LONG, *KINDS} - OF_FLEETS)) or bool(OF_LOGS & set(_header(path)))


def _header(path: Path) -> list[str]:
    """Column names of a table, none where the file cannot be read (its reader will name the fault)."""
    if path.suffix.lower() == ".parquet":
        from pyarrow import ArrowException
        from pyarrow.parquet import read_schema

        try:
            return [str(name).lower() for name in read_schema(path).names]
        except (OSError, ArrowException):
            return []
    if path.suffix.lower() != ".csv" or not path.is_file():
        return []
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        return [word.strip().strip('"').lower() for word in file.readline(10_000).split(",")]


def _files(path: Path, truth: Path | None) -> tuple[list[Path], Path | None]:
    if not path.exists():
        raise InputError("path", str(path), "must be a file or a folder", "Check the path.")
    if truth is not None and not truth.is_file():
        raise InputError("truth", str(truth), "must be a file", "Check the path.")
    if path.is_file():
        return [path], truth
    found = sorted(file for file in path.iterdir() if file.suffix.lower() in (*TABLES, *NMEA))
    own = [file for file in found if file.stem.lower() == TRUTH]
    files = [file for file in found if file not in own and file != truth]
    if not files:
        endings = ", ".join((*TABLES, *NMEA))
        raise InputError("path", str(path), f"must hold files in {endings}", "Point at the folder of the log.")
    return files, truth or (own[0] if own else None)


def _on_one_clock(rows: Rows, clock: Mapping[str, float], name: str) -> Rows:
    known = sorted(set(rows.vehicle.tolist()))
    for one in clock:
        if one not in known:
            allowed = f"must be a vehicle of {name}, which has {', '.join(known)}"
            raise InputError("clock", repr(one), allowed, "Name the vehicle as in the log.")
    ahead = np.array([clock.get(one, 0.0) for one in rows.vehicle.tolist()])
    partner = np.array([clock.get(one, 0.0) for one in rows.partner.tolist()])
    return replace(rows, t=rows.t - ahead, arrival=rows.arrival - partner)


def _origin(rows: Rows, given: tuple[float, float, float] | None) -> tuple[float, float, float] | None:
    """The origin that is given, or the first fix in degrees."""
    degrees = rows.take(np.isin(rows.kind, ["latitude", "longitude", "height"]))
    if given is not None or not len(degrees):
        return given
    flat = np.flatnonzero(np.isin(rows.kind, ["x", "y"]))
    if len(flat):
        hint = "Pass origin=(latitude, longitude, height) of the local frame, or give all positions in one of the two."
        raise InputError(f"{rows.place(int(flat[0]))}, x", "metres", "stand beside fixes in degrees", hint)
    heights = bool((degrees.kind == "height").any())
    order = np.argsort(degrees.t, kind="stable")
    for k in order.tolist():
        here = degrees.take((degrees.t == degrees.t[k]) & (degrees.vehicle == degrees.vehicle[k]))
        found = dict(zip(here.kind.tolist(), here.value.tolist(), strict=True))
        if {"latitude", "longitude", *(["height"] if heights else [])} <= set(found):
            return found["latitude"], found["longitude"], found.get("height", 0.0)
    raise InputError("latitude, longitude", "never together", "must be given at one time", "Check the columns.")


def _check_scale(rows: Rows, name: str, any_scale: bool) -> None:
    if any_scale:
        return
    parts, begin, t, position = [], 0, [], []
    for one in _ids(rows):
        fixes, _ = samples(rows.take(rows.vehicle == one), ("x", "y"), Tally(), 2)
        parts.append(np.arange(begin, begin + len(fixes.t)))
        begin += len(fixes.t)
        t.append(fixes.t)
        position.append(np.column_stack([fixes.value, 0 * fixes.t]))
    if begin:
        check_scale(np.concatenate(t), np.concatenate(position), parts, name)


def _ids(rows: Rows) -> list[str]:
    """Members that have fixes, in the order of their first row; the others cannot be placed."""
    placed = set(rows.vehicle[rows.kind == "x"].tolist())
    ids = [one for one in dict.fromkeys(rows.vehicle.tolist()) if one in placed]
    if not ids:
        hint = "Give x, y (and z) or latitude, longitude (and height) of every vehicle, at least once."
        raise InputError("fixes", "none", "must be there: a position in the local frame starts from one", hint)
    return ids


def _grid(rows: Rows, dt: float | None, name: str) -> Floats:
    """Steps over all fixes and odometry."""
    intervals: dict[str, list[float]] = {"odometry": [], "fix": []}
    groups = rows.group
    moving = (groups == "odometry") | (groups == "fix")
    of_group = {group: groups == group for group in intervals}
    for one in dict.fromkeys(rows.vehicle.tolist()):
        mine = rows.vehicle == one
        for group, found in intervals.items():
            gaps = np.diff(np.unique(np.round(rows.t[mine & of_group[group]], 6)))
            if len(gaps):
                found.append(float(np.median(gaps)))
    densest = min(intervals["odometry"] or intervals["fix"] or [0.0])
    if dt is None and not densest > 0:
        raise InputError("dt", "unknown", "must be given where no vehicle has two instants", "Pass dt=0.1.")
    step = float(f"{densest:.3g}") if dt is None else dt
    t = rows.t[moving]
    count = (t.max() - t.min()) / step + 1.5
    check_size(count, len(set(rows.vehicle.tolist())), len(rows), step, name)
    if count < 2:
        raise InputError(
            "dt", f"{step:g} s", f"must be well below the {np.ptp(t):g} s of the log", "Take a shorter dt."
        )
    grid: Floats = t.min() + step * np.arange(int(count))
    return grid


def _truth(rows: Rows, recording: Recording, max_gap: float | None, name: str, file: Path | None) -> Fleet:
    """Truth of the members that have one, on the steps of the recording."""
    position = np.full((len(recording.t), len(recording.ids), 3), np.nan)
    known = set(rows.vehicle.tolist())
    if not known & set(recording.ids):
        where = f"{file.name if file else 'truth'}: column vehicle"
        allowed = f"must name vehicles of the log: {', '.join(recording.ids)}"
        raise InputError(where, ", ".join(sorted(known)), allowed, "Rename them, or leave the truth out.")
    planar = not (rows.kind == "z").any()
    for column, one in enumerate(recording.ids):
        true, _ = samples(rows.take(rows.vehicle == one), ("x", "y", "z"), Tally(), 2 if planar else 3)
        if len(true.t) > 1:
            value = np.nan_to_num(true.value)
            gap = max_gap or max(5 * recording.dt, 0.5, 1.5 * true.interval)
            start = recording.t[0]
            position[:, column] = interpolate(true.t - start, value, recording.t - start, gap)
        elif len(true.t) == 1:
            position[:, column] = np.nan_to_num(true.value[0])
    there = np.isfinite(position[..., 0])
    alone = there.copy()
    alone[1:] &= ~there[:-1]
    alone[:-1] &= ~there[1:]
    position[alone] = np.nan
    velocity = backward_difference(recording.t, position, recording.ids)
    return Fleet(recording.ids, recording.t, position, velocity, name=name, source=f"truth of {name}")


def _check_options(dt: float | None, max_gap: float | None, clock: Mapping[str, float] | None) -> None:
    for field, value in (("dt", dt), ("max_gap", max_gap)):
        if value is not None and not (np.isfinite(value) and value > 0):
            raise InputError(field, f"{value} s", "must be > 0", "Give seconds.")
    for one, ahead in (clock or {}).items():
        if not np.isfinite(ahead):
            raise InputError(f"clock[{one!r}]", f"{ahead} s", "must be finite", "Give the seconds that it is ahead.")


def _summary(path: Path, recording: Recording, vehicles: Mapping[str, Vehicle], tally: Tally) -> Summary:
    grid = f"{len(recording.t)} steps of {recording.dt:g} s, {recording.t[-1] - recording.t[0]:.1f} s"
    refused = {why: (number, tally.where.get(why, "")) for why, number in tally.refused.items()}
    texts = {name: one.text for name, one in vehicles.items()}
    return Summary(path.name, grid, texts, dict(tally.read), refused, dict(tally.left), tally.sentences)

"""A log of one's own -> Recording: tables of what was measured, NMEA, ROS bags, and truth where there is some."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from coopoc.arrays import Floats, checked, instance, named, number
from coopoc.errors import InputError
from coopoc.file_names import given_path
from coopoc.plugins import one_of
from coopoc.short_repr import short_repr
from coopoc.world.axes import texts
from coopoc.world.fleet import Fleet
from coopoc.world.recording import Body, Recording
from coopoc.world.sensors import Sensors
from coopoc.world.v2x import V2X

from . import log_sensors
from .bag import is_bag, read_bag
from .log_body import body_vehicle, seen_by_vehicles
from .log_files import check_headers, files_of, rows_of_file
from .log_frame import local, on_one_clock, origin_of
from .log_links import linked
from .log_rows import Rows, check_arrivals, in_order, stacked, stamped
from .log_summary import Summary, Tally
from .log_truth import truth_of
from .log_vehicle import Vehicle, samples, vehicle
from .part import parted
from .scale import check_scale, check_size, check_time

Frame = Literal["world", "body"]


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

    __repr__ = short_repr

    def part(self, since: float | None = None, until: float | None = None) -> Log:
        """The same log from `since` to `until` s after its first step, such as a part to train on and the rest.

        Raises:
            InputError: a part of fewer than two steps.
        """
        truth = parted(self.truth, since, until) if self.truth is not None else None
        return replace(self, recording=parted(self.recording, since, until), truth=truth)


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
    frame: Frame = "world",
) -> Log:
    """Read a file or a folder of logged measurements: tables (CSV, Parquet, Excel), NMEA, or a ROS bag.

    docs/your_data.md describes the tables. A file named truth in a folder holds the truth.

    Args:
        path: a file, or a folder whose files belong to one drive.
        dt: s, steps of the recording; None: the median interval of the densest odometry (else of the densest fixes).
        max_gap: s, the longest gap of a vehicle's odometry that is bridged; it is absent in longer ones. None: the
            largest of 5 dt, 0.5 s and 1.5 times its own median interval.
        columns: names in the files, as {"t": "timestamp", "vehicle": "car|from"}, where tables differ.
        kinds: names in a column kind, as {"uwb": "range"}.
        ignore: kinds that are left out; topics of a bag.
        clock: vehicle -> s by which its clock is ahead; it is subtracted from its stamps.
        origin: latitude deg, longitude deg, height m of the local frame; None: the first fix.
        truth: file of the truth, if it is not in the folder under that name; topic in a bag.
        sensors: noise that methods may assume; None: the standard deviations in the log, else `Sensors()`.
        any_scale: True accepts positions that do not look like metres and seconds.
        frame: "world", or "body" for pose filters: speed, yaw rate, compass and bearings stay as they were measured, a
            vehicle needs no fix, and what has one fix and no odometry is a landmark.

    Returns:
        Log: recording, truth, summary.

    Raises:
        InputError: names file, row, column, value, what is allowed and how to correct it.
        MissingLibraryError: pynmeagps or rosbags is not installed, and there is NMEA or a bag.

    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "drive.csv"
    >>> _ = file.write_text("t,vehicle,x,y,vx,vy\\n0,a,0,0,9,0\\n1,a,9,0,9,0\\n2,a,18,0,9,0\\n")
    >>> read_log(file).recording
    Recording(1 runs x 3 steps x 1 vehicles, 0 links, K <= 0)
    """
    path, tally = given_path(path), Tally()
    options = {"columns": columns, "kinds": kinds, "clock": clock, "ignore": ignore, "origin": origin}
    _check_options(dt, max_gap, frame, any_scale, **options)
    body = frame == "body"
    if is_bag(path):
        if columns or kinds:
            hint = 'Leave out a topic or a kind by ignore=["/car/pose"]; name the truth\'s by truth="/car/pose".'
            raise InputError("columns, kinds", path.name, "are of tables, and this is a bag", hint)
        true = Path(truth) if truth is not None and Path(truth).exists() else None
        rows, actual = read_bag(path, tally, ignore, "" if true or truth is None else str(truth))
    else:
        files, true = files_of(path, None if truth is None else Path(truth))
        check_headers(columns or {}, [*files, *([true] if true else [])], path.name)
        rows, actual = stacked([rows_of_file(file, tally, columns, kinds, ignore) for file in files]), None
    if not len(rows):
        raise InputError(path.name, "0 rows", "must hold measurements", "Check that the files are complete.")
    rows = on_one_clock(stamped(rows), clock or {}, path.name)
    in_order(rows, tally)
    check_time(rows.t, path.name)
    check_arrivals(rows)
    actual = stamped(rows_of_file(true, Tally(), columns, kinds, ())) if true else actual
    origin = origin_of(rows, origin)
    rows, given = local(rows, origin), log_sensors.stds(rows)
    planar = not (rows.kind == "z").any()
    _check_scale(rows, path.name, any_scale)
    ids, make = _ids(rows, body), body_vehicle if body else vehicle
    grid = _grid(rows, dt, path.name)
    vehicles = {one: make(one, rows.take(rows.vehicle == one), grid, max_gap, planar, tally) for one in ids}
    marks = [k for k, one in enumerate(vehicles.values()) if body and one.station]
    rows = seen_by_vehicles(rows, [ids[k] for k in marks], tally)
    found = linked(rows, vehicles, grid, planar, tally)
    noise = log_sensors.assumed(given, sensors, rows, planar, body, tally, float(grid[1] - grid[0]))
    to_landmark = np.isin(found.links.neighbour, marks)
    pairs = (found.links.step * len(ids) + found.links.observer)[~to_landmark]
    recording = Recording(
        ids=tuple(ids),
        t=grid,
        gnss=np.stack([one.gnss for one in vehicles.values()], axis=1)[None],
        velocity=np.stack([one.velocity for one in vehicles.values()], axis=1)[None],
        links=found.links,
        relative=found.relative[None],
        broadcasts=found.broadcasts & ~np.isin(np.arange(len(ids)), marks),
        arrival=np.where(to_landmark, -1, found.arrival)[None],
        sensors=noise,
        v2x=V2X(max_neighbours=int(np.bincount(pairs).max(initial=0)), radius=np.inf),
        observers=tuple(range(len(ids))),
        notes=(f"measurements of {path.name}, nothing is simulated", *tally.sentences),
        body=_body(vehicles) if body else None,
        landmarks=tuple(marks),
    )
    fleet = None if actual is None else truth_of(local(actual, origin), recording, max_gap, path.stem, true)
    return Log(recording, fleet, _summary(path, recording, vehicles, tally), "messages" in tally.read, origin)


def _body(vehicles: Mapping[str, Vehicle]) -> Body:
    both = [(one.yaw_rate, one.compass) for one in vehicles.values()]
    rate, heading = (np.stack([np.asarray(part) for part in parts], axis=1)[None] for parts in zip(*both, strict=True))
    return Body(rate, heading)


def _check_scale(rows: Rows, name: str, any_scale: bool) -> None:
    if any_scale:
        return
    parts, begin, t, position = [], 0, [], []
    for one in _placed(rows):
        fixes, _ = samples(rows.take(rows.vehicle == one), ("x", "y"), Tally(), 2)
        parts.append(np.arange(begin, begin + len(fixes.t)))
        begin += len(fixes.t)
        t.append(fixes.t)
        position.append(np.column_stack([fixes.value, 0 * fixes.t]))
    if begin:
        check_scale(np.concatenate(t), np.concatenate(position), parts, name)


def _placed(rows: Rows) -> list[str]:
    """Members that have fixes, in the order of their first row."""
    placed = set(rows.vehicle[rows.kind == "x"].tolist())
    return [one for one in dict.fromkeys(rows.vehicle.tolist()) if one in placed]


def _ids(rows: Rows, body: bool) -> list[str]:
    """Members that can be placed: by fixes, or in body frames by odometry, too."""
    if body:
        known = set(rows.vehicle[np.isin(rows.kind, ["x", "speed", "yaw_rate"])].tolist())
        if not known:
            hint = "Give speed and yaw_rate of every vehicle, and x, y (and z) of landmarks."
            raise InputError("fixes, odometry", "none", "must be there: a pose is carried on by odometry", hint)
        return [one for one in dict.fromkeys(rows.vehicle.tolist()) if one in known]
    ids = _placed(rows)
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


def _check_options(dt: float | None, max_gap: float | None, frame: str, any_scale: bool, **others: Any) -> None:
    """InputError for an option of another kind; the rest are columns, kinds, clock, ignore and origin."""
    one_of("frame", frame, get_args(Frame))
    instance("any_scale", any_scale, bool, "Give True or False.")
    for field, value in (("dt", dt), ("max_gap", max_gap)):
        if value is not None:
            number(field, value, 1e-12, allowed="> 0 s", hint="Give seconds.")
    for field in ("columns", "kinds", "clock"):
        named(field, others[field] or {}, f"Give {field}={{name: ...}}.")
    for one, ahead in (others["clock"] or {}).items():
        number(f"clock[{one!r}]", ahead, -np.inf, allowed="finite s", hint="Give the seconds that it is ahead.")
    texts("ignore", others["ignore"])
    if others["origin"] is not None:
        checked("origin", others["origin"], "(3,)", (3,))


def _summary(path: Path, recording: Recording, vehicles: Mapping[str, Vehicle], tally: Tally) -> Summary:
    grid = f"{len(recording.t)} steps of {recording.dt:g} s, {recording.t[-1] - recording.t[0]:.1f} s"
    refused = {why: (number, tally.where.get(why, "")) for why, number in tally.refused.items()}
    texts = {name: one.text for name, one in vehicles.items()}
    return Summary(path.name, grid, texts, dict(tally.read), refused, dict(tally.left), tally.sentences)

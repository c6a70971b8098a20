"""A log of one's own -> Recording: what any reader finds in files, on steps, and the truth where there is some."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from numpy import nan
from scipy.interpolate import Akima1DInterpolator

from coopoc import V2X, Body, Fleet, InputError, Recording, Sensors
from coopoc.arrays import Floats, instance, named, one_of, texts
from coopoc.formats.values import read_table as read_rows
from coopoc.paths import given_path
from coopoc.text import short_repr
from coopoc.workers import progress_bar
from coopoc.world.fleet import columns as columns_of
from coopoc.world.links import wrap
from coopoc.world.recording import NOTHING_SIMULATED

from ..assemble import (
    SAME_INSTANT,
    backward_difference,
    check_intervals,
    check_scale,
    check_size,
    check_time,
    covered,
    interpolate,
    longest_gap,
)
from ..bag import TRUE_NAME, read_bag
from ..cells import TABLES, Factors, Names, factors, headers
from ..comma import is_segment, read_segment
from ..graphs import read_pyfg_rows
from ..librsf import is_librsf, read_librsf
from ..nclt import FILE_NAMES, read_nclt
from ..nmea import DAY_S, is_nmea, read_nmea
from ..source import parted
from .frames import ENU, Origin, assumed, check_one_drive, check_origin, fix_factors, local, on_one_clock, unwrapped
from .links import linked, of_vehicles
from .motion import Members, Steps, member, samples, stacked
from .tables import is_log_table, read_log_table
from .units import (
    BELOW,
    KIND_TABLE,
    KINDS,
    QUATERNION,
    Rows,
    Summary,
    check_values,
    distinct,
    fresh,
    in_group,
    not_vague,
    of_kinds,
    only,
    row_of,
    stated_std,
    without_codes,
)

Frame = Literal["world", "body"]
Stamps = Literal["header", "received"]
Arms = Mapping[str, Sequence[float]] | Sequence[float]
"""m forward, left, up, of each vehicle by name, or of all."""
LOST = 0.02
"""Largest share of the fixes that may fall on a step that already has one, and are lost."""
SHORTEST_STEP, LONGEST_STEP = 0.02, 1.0
"""s, of a step that is not given."""
FREQUENT_SHARE = 0.1
"""Share of the measurements of the most frequent kind of a vehicle, or pair, from which one counts for the step."""


def _read_text(file: Path, summary: Summary, **_: Any) -> Rows:
    """Rows of libRSF or NMEA, else of a truth `t x y z qx qy qz qw`, whose orientation is perhaps a camera's."""
    if is_librsf(file):
        return read_librsf(file, summary)
    if is_nmea(file):
        return read_nmea(file, summary)
    lines, table = read_rows(file, "t x y z qx qy qz qw")
    return of_kinds(pd.DataFrame(table[:, :4], lines, [*"txyz"]).assign(vehicle=file.stem), file.name)


READERS: Mapping[str, Callable[..., Rows]] = {
    **dict.fromkeys(TABLES, read_log_table),
    **dict.fromkeys((".nmea", ".nme", ".gga"), read_nmea),
    **dict.fromkeys((".bag", ".mcap", ".db3"), read_bag),
    **dict.fromkeys((".txt", ".tum", ".log"), _read_text),
    ".pt": read_nclt,
    ".pyfg": read_pyfg_rows,
}
"""Ending of a file -> (path, summary, *, columns, kinds, ignore, stamps, ...) -> its rows. A new format is one more
entry."""
SEVERAL = (
    "measurements of one kind of {} come side by side: of several sensors (ignore= leaves out topics of a bag), or one "
    "is the truth, which truth= names"
)
"""What is assumed of two files, or topics, with what one vehicle measures of itself."""
SPARSE_SECONDS = 0.5
"""s between samples of a truth from which straight lines between them are not the path; within so many s of a sample
the curve through all counts as truth."""


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
    origin: Origin | None = None

    __repr__ = short_repr

    def part(self, since: float | None = None, until: float | None = None) -> "Log":
        """The same log from `since` to `until` s after its first step, such as a part to train on and the rest.

        Raises:
            InputError: a part of fewer than two steps.
        """
        return replace(
            self, recording=parted(self.recording, since, until), truth=self.truth and parted(self.truth, since, until)
        )


def is_log(path: Path, columns: Names | None = None) -> bool:
    """Whether a path is a log: a bag, NMEA, libRSF's text, tensors of NCLT, a segment of comma2k19, a folder of such
    files, or a table with a column of a log.

    Args:
        path: of a file or folder.
        columns: names in the file, as `read_log` takes them; a key that only a log has makes it one.

    >>> is_log(Path("drive.nmea")), is_log(Path("drive.parquet"), {"latitude": "lat"})
    (True, True)
    """
    if path.is_dir():
        return _is_bag(path) or is_segment(path) or bool(_files(path))
    return is_log_table(path, columns) if path.suffix.lower() in TABLES else _is_read(path, path.parent)


def read_log(
    path: str | Path,
    *,
    dt: float | None = None,
    max_gap: float | None = None,
    columns: Names | None = None,
    kinds: Names | None = None,
    ignore: Sequence[str] = (),
    scale: Factors | None = None,
    offset: Factors | None = None,
    std: Factors | None = None,
    stamps: Stamps = "header",
    clock: Factors | None = None,
    antenna: Arms | None = None,
    tag: Arms | None = None,
    origin: Origin | None = None,
    truth: str | Path | None = None,
    sensors: Sensors | None = None,
    any_scale: bool = False,
    frame: Frame = "world",
    mutual: bool = True,
) -> Log:
    """Read a file or a folder of logged measurements: tables (CSV, Parquet), NMEA, or a ROS bag.

    docs/your_data.md describes the tables. A file named truth in a folder holds the truth.

    Args:
        path: a file, or a folder whose files belong to one drive.
        dt: s, steps of the recording; None: the median interval of the densest odometry (else fixes), or in the world,
            where it is longer, that at which a pair is measured, 1 s at most.
        max_gap: s, the longest gap of a vehicle's odometry that is bridged; it is absent in longer ones. None: the
            largest of 5 dt, 0.5 s and 1.5 times the interval that nine of ten do not exceed.
        columns: names in the files, as {"t": "timestamp", "vehicle": "car"}.
        kinds: names in a column kind, as {"uwb": "range"}.
        ignore: kinds that are left out; topics of a bag.
        scale: kind, of all or one vehicle, or t -> factor to its unit here, as {"range": 0.001, "t": 1e-3} of mm and
            ms, {"car1.speed": 0.98} of its wheels, if none is logged also of what is the same in another unit.
        offset: kind, of all or one vehicle, or pair, in its unit here -> what these measurements, or the pair's ranges,
            are too large by, as {"range": 0.4, "red-blue": 0.3} of radios whose delays are not calibrated; vx, vy also
            of velocities that are speeds along a heading, as in a current of -vx, -vy.
        std: kind -> standard deviation of all its measurements in its unit (m for degrees of latitude), as
            {"range": 0.15, "latitude": 1.5, "speed_kmh": 0.4}.
        stamps: times of a bag's messages: those of the headers, or those at which they were "received".
        clock: vehicle -> s by which its clock is ahead; it is subtracted from its stamps.
        antenna: m forward, left, up from the reference point of all that move to their antennas, or vehicle -> these,
            as {"car1": (1.2, 0.3, 0.0)}: fixes become those of the reference points (`motion.member`).
        tag: the same of antennas between which ranges are, which pose filters take off (`Recording.tags`); what stands
            has none.
        origin: latitude deg, longitude deg, height m of the local frame; None: the first fix.
        truth: file of the truth, if it is not in the folder under that name; topic in a bag.
        sensors: noise that methods may assume; None: the standard deviations in the log, else `Sensors()`.
        any_scale: True accepts positions that do not look like metres and seconds.
        frame: "world", or "body" for pose filters: speed, yaw rate, compass and bearings stay as they were measured, a
            vehicle needs no fix, and what has one fix and no odometry is a landmark.
        mutual: whether a range is known to both ends, as of two-way ranging; in body frames to who logged it.

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
    path, body = given_path(path), frame == "body"
    summary, offset = Summary(path.name), named("offset", offset or {}, "Give offset={name: number}.")
    one_of("frame", frame, Frame)
    one_of("stamps", stamps, Stamps)
    texts("ignore", ignore)
    instance("any_scale", any_scale, bool, "Give True or False.")
    instance("mutual", mutual, bool, "Give True or False.")
    check_intervals(dt=dt, max_gap=max_gap)
    if origin is not None:
        check_origin(origin)
    options = {
        "columns": named("columns", columns or {}, "Give columns={name: header}."),
        "kinds": named("kinds", kinds or {}, "Give kinds={word: kind}."),
        "ignore": ignore,
        "stamps": stamps,
    }
    rows = _rows(path, truth, summary, options)
    groups = rows.groupby(["vehicle", "partner", "kind"], sort=False, dropna=False)
    vehicle, partner, kind = (groups.head(1)[name] for name in ("vehicle", "partner", "kind"))
    own, quantity = vehicle + "." + kind, kind.map(KIND_TABLE["name"])
    of_one, names = vehicle + "." + quantity, {*kind, *own}
    factor = factors(scale, sorted({"t", *names, *quantity, *of_one}))
    by_kind = pd.Series(1.0, kind.index)
    for logged, like in ((kind, quantity), (own, of_one)):
        for key in (like.mask(like.isin(logged)), logged):
            by_kind = key.map(factor).fillna(by_kind)
    key = kind.mask(own.isin(offset), own)
    for pair in (vehicle + "-" + partner, partner + "-" + vehicle):
        key = key.mask((kind == "range") & pair.isin(offset), pair)
    names |= {*key, "vx", "vy", *(vehicle + ".vx"), *(vehicle + ".vy")}
    less = key.map(factors(offset, sorted(names), "offset")).fillna(0.0)
    by_kind, less = (each.iloc[groups.ngroup()].set_axis(rows.index) for each in (by_kind, less))
    rows = rows.assign(value=by_kind * rows["value"], std=by_kind.abs() * rows["std"])
    rows[["t", "arrival"]] *= factor.get("t", 1.0)
    rows = without_codes(unwrapped(rows, summary), summary)
    rows = rows.assign(value=rows["value"] - less)
    check_values(rows)
    for column in ("t", "arrival"):
        for file, times in rows[column].where(np.isfinite).groupby(rows["file"]):
            check_time(times.to_numpy(), str(file), column)
    if origin is not None and not rows["kind"].isin(ENU).any():
        summary.assume("origin= has no effect: no fix is in degrees")
    measured = rows["true"] == 0
    summary.rows = int(measured.sum())
    summary.logged = rows.groupby("vehicle")["kind"].unique().to_dict()
    rows, true_rows = on_one_clock(not_vague(rows[measured], summary), clock), rows[~measured]
    check_one_drive(rows, path.name)
    rows, origin = local(rows, origin, summary)
    alone = rows[in_group(rows, "fix", "odometry", "heading")]
    spans = alone.groupby(["vehicle", "kind", "file"])["t"].agg(["min", "max"]).reset_index().sort_values("min")
    for (name, _), parts in spans.groupby(["vehicle", "kind"]):
        if (parts["min"] < parts["max"].cummax().shift()).any():
            summary.assume(SEVERAL, f"{name} ({', '.join(sorted(parts['file']))})")
    deviations = factors(std, sorted({*kind, *rows["kind"]} - {"message"}), "std")
    stated = {ENU.get(name, KINDS[name].name): abs(KINDS[name].scale) * each for name, each in deviations.items()}
    rows = fresh(distinct(rows.assign(std=rows["kind"].map(stated).fillna(rows["std"])), summary), summary)
    paths = [samples(group, ("x", "y", "z"), Summary(), 2) for _, group in rows.groupby("vehicle", sort=False)]
    if not any_scale and any(len(t) for t, _ in paths):
        check_scale(paths, path.name, np.nan_to_num(stated_std(rows, "x", "y"), nan=Sensors().gnss_std[0]))
    ids = _ids(rows, body, summary)
    carried = in_group(rows, "odometry", "heading") & ~rows["vehicle"].isin(ids)
    summary.refuse("odometry and headings of vehicles without a position", rows[carried])
    height = only(rows, "z")["value"].median()
    steps = Steps(_grid(rows, dt, body, summary), max_gap, height, body, summary, offset)
    arms, tags = (each if isinstance(each, Mapping) else dict.fromkeys(ids, each) for each in (antenna, tag))
    for option, each in (("antenna", arms), ("tag", tags)):
        columns_of(option, [*named(option, each, f"Give {option}={{name: (forward, left, up)}}.")], ids)
    members = {
        name: member(name, rows[rows["vehicle"] == name], steps, arms.get(name))
        for name in progress_bar(ids, "read", delay=2.0)
    }
    if tag is not None:
        summary.assume("ranges are between tags, which only pose filters (frame=body) take off")
    at: Any = [np.zeros(3) if part.stands or tags.get(name) is None else tags[name] for name, part in members.items()]
    recording = replace(_recording(rows, members, steps, mutual and not body, sensors), tags=at)
    summary.grid, summary.vehicles = steps_in_words(recording), {name: part.text for name, part in members.items()}
    fleet = None
    if len(true_rows):
        true_rows = local(true_rows, origin, Summary())[0]
        true_rows = true_rows[~(steps.planar & (true_rows["kind"] == "z"))]
        fleet = _truth(distinct(true_rows, Summary()), recording, max_gap, path.stem, summary)
        for name, share in zip(ids, np.isfinite(fleet.position[..., 0]).mean(0), strict=True):
            summary.vehicles[name] += f", truth {share:.0%}"
    return Log(recording, fleet, summary, "messages" in summary.read, origin)


def _recording(rows: Rows, members: Members, steps: Steps, mutual: bool, sensors: Sensors | None) -> Recording:
    """One run of what vehicles, and landmarks in body frames, have measured on steps."""
    ids, body, summary = tuple(members), steps.body, steps.summary
    stands = stacked(members, "stands")
    marks = np.flatnonzero(stands & body).tolist()
    rows = of_vehicles(rows, [ids[k] for k in marks], summary)
    links, relative, broadcasts, arrival = linked(rows, members, steps, mutual)
    to_landmark = np.isin(links.neighbour, marks)
    pairs = (links.step * len(ids) + links.observer)[~to_landmark]
    names = ("gnss", "velocity", "yaw_rate", "compass")
    gnss, velocity, yaw_rate, compass = (stacked(members, name)[None] for name in names)
    factor = np.empty(0) if body or sensors else fix_factors(rows, ids, steps)
    wander = stacked(members, "wander")
    least = float(wander[:, ~stands].min(initial=wander.max()))
    uncertain = (wander - least).clip(0.0) if wander.max() > least and not sensors else np.empty(0)
    sensors = sensors or assumed(rows, steps, [*members.values()], least)
    return Recording(
        ids=ids,
        t=steps.grid,
        gnss=gnss,
        velocity=velocity,
        links=links,
        relative=relative[None],
        broadcasts=broadcasts & ~np.isin(np.arange(len(ids)), marks),
        arrival=np.where(to_landmark, -1, arrival)[None],
        sensors=sensors,
        v2x=V2X(max_neighbours=int(np.bincount(pairs).max(initial=0)), radius=np.inf),
        observers=tuple(range(len(ids))),
        notes=(f"measurements of {summary.name}, {NOTHING_SIMULATED}", *summary.sentences),
        body=Body(yaw_rate, compass) if body else None,
        landmarks=tuple(marks),
        fix_factor=factor,
        motion_variance=uncertain,
        shown=tuple(np.flatnonzero(stacked(members, "shown"))),
    )


def steps_in_words(recording: Recording) -> str:
    """The line of a summary on the steps of a recording."""
    t = recording.t
    return f"{len(t)} steps of {recording.dt:g} s, {t[-1] - t[0]:.1f} s"


def _is_bag(path: Path) -> bool:
    return (path / "metadata.yaml").is_file() or READERS.get(path.suffix.lower()) is read_bag


def _is_read(file: Path, path: Path) -> bool:
    ending = file.suffix.lower()
    if ending == ".pt":
        return file.name in FILE_NAMES
    if READERS.get(ending) is _read_text and file.is_file():
        return is_librsf(file) or is_nmea(file) or _is_true(file, path)
    return ending in READERS


def _rows(path: Path, truth: str | Path | None, summary: Summary, options: dict[str, Any]) -> Rows:
    """Rows of a file or a folder, with those of the truth: of the file that is named, of `truth.*`, or of a topic."""
    true_files = [given_path(truth)] if truth is not None else []
    if _is_bag(path):
        if not (true_files and true_files[0].exists()):
            options, true_files = {**options, "truth": str(truth or "")}, []
        parts = [read_bag(path, summary, **options)]
    elif is_segment(path):
        parts, true_files = [read_segment(path, summary)], []
    else:
        if true_files and not true_files[0].is_file():
            raise InputError("truth", str(truth), "must be a file", "Check the path.")
        files = _files(path) if path.is_dir() else [path]
        below = {file.relative_to(path).parts[0] for file in {*_every_file(path)} - {*files, *true_files}}
        if below:
            summary.assume(f"{BELOW}: {', '.join(sorted(below))}. Move the files into folders, too, or name one")
        strange = sorted(file.name for file in path.glob("[!.]*") if file.is_file() and not _is_read(file, path))
        summary.refuse("files of kinds that are not read", len(strange), ", ".join(strange))
        true_by_name = [f for f in files if _is_true(f, path)]
        true_files = true_files or true_by_name
        files = [f for f in files if f not in (*true_files, *true_by_name)]
        if not files:
            raise InputError(
                "path", str(path), f"must hold files in {', '.join(READERS)}", "Point at the folder of the log."
            )
        tables = [file for file in (*files, *true_files) if options["columns"] and file.suffix.lower() in TABLES]
        names = {header for file in tables for header in headers(file)}
        for key, header in options["columns"].items() if len(names) > 1 else ():  # else there is no table
            one_of(f"{path.name}: columns[{key!r}], a header", header, sorted(names))
        parts = [_read_file(file, path, summary, **options) for file in files]
    if not any(map(len, parts)):
        raise InputError(path.name, "0 rows", "must hold measurements", "Check that the files are complete.")
    ignore, options = options["ignore"], {**options, "ignore": (), "truth": ""}
    parts += [_read_file(file, path, Summary(), **options).assign(true=1.0) for file in true_files]
    rows = pd.concat(parts, ignore_index=True)
    kind = rows["kind"].replace(QUATERNION, "heading")
    left = kind.isin(ignore) & (rows["true"] == 0)
    summary.unused.update("kind " + kind[left] + ", as ignore= asks")
    for word in ignore:
        if f" {word}" not in " ".join(summary.unused):
            summary.assume(f"ignore={word} has no effect: nothing of that name was logged")
    return rows[~left]


def _read_file(file: Path, path: Path, summary: Summary, **options: Any) -> Rows:
    """Rows of a file of a log; what names no vehicle in a folder below, but one of the truth, is of the vehicle of that
    folder."""
    read: Callable[..., Rows] = READERS.get(file.suffix.lower(), read_log_table)
    rows = read(file, summary, **options)
    if path not in file.parents or file.parent == path:
        return rows
    rows, parts = rows.assign(file=str(file.relative_to(path))), file.relative_to(path).with_suffix("").parts
    named_after = next((part for part in parts if not TRUE_NAME.search(part)), file.stem)
    return rows.assign(vehicle=named_after) if rows["vehicle"].eq(file.stem).all() else rows


def _every_file(path: Path) -> list[Path]:
    return [file for file in path.rglob("[!.]*") if _is_read(file, path)]


def _is_true(file: Path, path: Path) -> bool:
    """Whether a file, or a folder of the log that it is in, is named as a truth."""
    return file != path and any(map(TRUE_NAME.search, file.relative_to(path).with_suffix("").parts))


def _files(path: Path) -> list[Path]:
    """Files of a folder, those of the truth, and those of a folder per vehicle where it has none itself."""
    every = _every_file(path)
    bare = not any(_is_bag(file) or (file.parent == path and not _is_true(file, path)) for file in every)
    bare = bare and any(map(is_log, every))
    return sorted(file for file in every if bare or file.parent == path or _is_true(file, path))


def _ids(rows: Rows, body: bool, summary: Summary) -> list[str]:
    """Members that can be placed, in the order of their first row: by fixes, or in body frames by odometry, too."""
    placed = rows["kind"].isin(["x", "speed", "yaw_rate"] if body else ["x"])
    names, moving = (set(rows["vehicle"][which]) for which in (placed, in_group(rows, "odometry")))
    if names and (not moving or names & moving):
        return [name for name in rows["vehicle"].unique() if name in names]
    if body:
        raise InputError(
            "fixes, odometry",
            "none",
            "are needed: a pose filter predicts by odometry",
            f"Give speed and yaw_rate of every vehicle, and x, y (and z) of landmarks. {summary.unread}".rstrip(),
        )
    hint = "Give x, y (and z) or latitude, longitude (and height) of every vehicle, at least once; where ranges to "
    raise InputError(
        "fixes",
        f"of {', '.join(sorted(names))}, not of {', '.join(sorted(moving))}" if names else "none",
        "needs at least one to place it in the local frame",
        f'{hint}anchors place it, read frame="body". Where files are named after sensors, give them a column vehicle, '
        f"or a folder that is named after it; of a bag, ignore= leaves out other topics. {summary.unread}".rstrip(),
    )


def _grid(rows: Rows, dt: float | None, body: bool, summary: Summary) -> Floats:
    """(T,) s, steps over all fixes and odometry."""

    def densest(group: str) -> float:
        times = rows[in_group(rows, group)].sort_values("t").groupby(["vehicle", "partner", "kind"])["t"]
        return float(times.agg(lambda t: t.diff().median())[times.size() >= FREQUENT_SHARE * times.size().max()].min())

    moves, fixes, pairs = map(densest, ("odometry", "fix", "relative"))
    t, summary.odometry = rows["t"][in_group(rows, "odometry", "fix")], max(0.0, moves)
    begin = float(t.min())
    span = t.max() - begin
    if not span:
        raise InputError(
            f"{summary.name}: t",
            f"{begin:.10g} s throughout",
            "must hold two instants or more",
            f"Is the file complete? {summary.unread}".rstrip(),
        )
    step = dt or float(f"{max(summary.odometry or fixes, SHORTEST_STEP):.3g}")
    if not step > 0:
        raise InputError("dt", "unknown", "must be given where no vehicle has two instants", "Pass dt=0.1.")
    if dt is None:
        dense = float(f"{max(np.nanmin([fixes, pairs, step]), SHORTEST_STEP):.3g}")
        if dense < step:
            summary.assume(
                f"steps of {dense:g} s, as fixes or pairs are measured; odometry every {step:g} s is interpolated, "
                "which looks as far ahead"
            )
            step = dense
        seldom = float(f"{min(pairs, fixes, LONGEST_STEP):.3g}")  # unknown where there are no pairs
        if not body and pairs > step and seldom > step:
            summary.assume(
                f"steps of {seldom:g} s, as fixes and pairs are measured; odometry every {step:g} s is averaged"
            )
            step = seldom
        at = only(rows, "x")

        def lost(step: float) -> float:
            steps = at.assign(t=((at["t"] - begin + SAME_INSTANT) / step).round())
            return max(float(steps.duplicated(["vehicle", "t"]).mean()), LOST)

        parts = min((1, 2, 3, 4, 5), key=lambda n: lost(step / n))
        if parts > 1:
            step = float(f"{step / parts:.3g}")
            summary.assume(f"steps of {step:g} s, since fixes come at two rates or more")
    far: Any = (t - t.median()).abs().idxmax()
    check_size(
        span / step + 1.5,
        rows["vehicle"].nunique(),
        len(rows),
        step,
        f"{row_of(rows.loc[[far]])}, t = {t[far]:.10g} s, farthest from the median",
    )
    if span / step < 0.5:
        raise InputError("dt", f"{step:g} s", f"must be well below the {span:g} s of the log", "Take a shorter dt.")
    return begin + step * np.arange(int(span / step + 1.5))


def _truth(rows: Rows, recording: Recording, max_gap: float | None, name: str, summary: Summary) -> Fleet:
    """Truth of the members that have one, on the steps of the recording; a file that names none is that of the only
    one, else of whom its name has beside the truth."""
    ids, steps, file = recording.ids, recording.t, rows["file"].iloc[0]
    bare = {(stem := Path(each).stem): TRUE_NAME.sub("", stem).strip("_ -") or stem for each in rows["file"].unique()}
    if len(ids) == 1 and rows["vehicle"].isin(bare).all():
        bare = dict.fromkeys(bare, ids[0])
    rows = rows.replace({"vehicle": bare})
    vehicles = sorted(rows["vehicle"].unique())
    if not set(vehicles) & set(ids):
        raise InputError(
            f"{file}: column vehicle",
            ", ".join(vehicles),
            f"must name vehicles of the log: {', '.join(ids)}",
            "Rename them, or leave the truth out: its file, or by ignore= its topic.",
        )
    stamps = rows["t"]
    if stamps.max() < 2 * DAY_S:  # seconds of the day, as of NMEA without a date, are of the day of the log
        rows = rows.assign(t=stamps + DAY_S * round((steps.mean() - stamps.mean()) / DAY_S))
    axes = 3 if (rows["kind"] == "z").any() else 2
    heights = pd.DataFrame(recording.gnss[0, ..., 2])
    heights = heights.rolling(round(20.0 / recording.dt) + 1, 1, center=True).mean().interpolate(limit_direction="both")
    if axes == 2 and heights.abs().gt(0.0).to_numpy().any():
        summary.assume("the truth has no heights: 20 s means of the fixes' heights replace them, and hide their errors")
    poses = np.full((len(steps), len(ids), 4), nan)
    for column, vehicle in enumerate(ids):
        own_rows = rows[rows["vehicle"] == vehicle]
        true, heading = samples(own_rows, ("x", "y", "z"), Summary(), axes), samples(own_rows, ("heading",), Summary())
        for first, t, value in (
            (0, true.t, np.nan_to_num(true.value)),
            (3, heading.t, np.unwrap(heading.value, axis=0)),
        ):
            out = poses[:, column, first : first + 3]
            since, grid = t - steps[0], steps - steps[0]
            if len(t) > 1:
                out[:] = interpolate(since, value, grid, longest_gap(t, recording.dt, max_gap))
                if np.median(np.diff(t)) > SPARSE_SECONDS and len(t) > 2:
                    summary.assume(
                        f"a low-rate truth counts within {SPARSE_SECONDS:g} s of its samples, by Akima's interpolation"
                    )
                    near = covered(t, steps, 0.0, SPARSE_SECONDS)[:, None] & np.isfinite(out)
                    out[:] = np.where(near, Akima1DInterpolator(since, value)(grid), nan)
            elif len(t) and not first:
                out[:] = value[0]
    position, angle = poses[..., :3], poses[..., 3]
    there = np.isfinite(position[..., 0])
    if not there.any():
        raise InputError(
            f"{file}: column t",
            f"{stamps.min():.10g} to {stamps.max():.10g} s",
            f"must overlap the log, from {steps[0]:.10g} to {steps[-1]:.10g} s",
            "Does its clock or its date differ? scale=t: is of both.",
        )
    if axes == 2:
        position[..., 2] = heights.fillna(0.0).where(there)
    there = np.pad(there, ((1, 1), (0, 0)))
    position[~(there[2:] | there[:-2])] = nan
    velocity = backward_difference(steps, position, ids, file)
    turned = wrap(angle) if np.isfinite(angle).any() else None
    return Fleet(ids, steps, position, velocity, name=name, source=f"truth of {name}", heading=turned)

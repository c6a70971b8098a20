"""coopoc data list | show | check | make | convert."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

from coopoc.errors import InputError
from coopoc.one_file import in_file
from coopoc.plugins import names, unknown

from .cards import neighbour_statistics, speed_statistics
from .registry import DATASETS, convert, kind_of, list_datasets, load_fleet, load_log
from .source import split


def list_() -> None:
    """List the bundled fleets, one line each.

    Example: coopoc data list
    """
    from tabulate import tabulate

    print(tabulate(list_datasets(), headers="keys", tablefmt="github"))


def show(name: tyro.conf.Positional[str]) -> None:
    """Show the card of a bundled fleet, or statistics of a file of drives: speeds, neighbours, heights.

    Example: coopoc data show town10

    Args:
        name: a bundled fleet, or a path as in --data.
    """
    if name in DATASETS:
        print(DATASETS[name].card().render())
        return
    path = Path(split(name)[0])
    if not path.exists() and not in_file(name) and name not in names("coopoc.datasets"):
        raise unknown("fleet", name, DATASETS, "Or give the path of a file.")
    if kind_of(name) in ("log", "recording"):
        log = load_log(name)
        print(log.summary)
        if log.truth is None:
            return
    fleet = load_fleet(name)
    speed, near = speed_statistics(fleet), neighbour_statistics(fleet)
    z = fleet.position[..., 2]
    present = fleet.present.mean(axis=0)
    print(fleet.name)
    for what, text in (("source", fleet.source), ("licence", fleet.licence)):
        print(f"  {what:<13}{text or '(not stated)'}")
    print(f"  sha256       {fleet.digest}")
    print(f"  size         {len(fleet.ids)} vehicles x {len(fleet.t)} steps of {fleet.dt:g} s")
    print(f"  there        {present.min():.0%} to {present.max():.0%} of the time")
    print("  speed        {min:g}..{max:g} m/s, mean {mean:g}, 5..95 %: {p05:g}..{p95:g}".format(**speed))
    print(
        "  neighbours   mean {mean:g} within {radius:g} m (cap {cap:g}), some in {any:.0%} of the steps".format(**near)
    )
    print(f"  height       {np.nanmin(z):g}..{np.nanmax(z):g} m")


def check(
    path: tyro.conf.Positional[str],
    *,
    dt: float | None = None,
    max_gap: float | None = None,
    columns: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=HEADER ...")] = (),
    kinds: Annotated[tuple[str, ...], tyro.conf.arg(metavar="WORD=KIND ...")] = (),
    origin: Annotated[tuple[float, float, float] | None, tyro.conf.arg(metavar="LATITUDE LONGITUDE HEIGHT")] = None,
    clock: Annotated[tuple[str, ...], tyro.conf.arg(metavar="VEHICLE=SECONDS ...")] = (),
    ignore: Annotated[tuple[str, ...], tyro.conf.arg(metavar="KIND ...")] = (),
    truth: Path | None = None,
    frame: Literal["world", "body"] = "world",
    picture: Path | None = None,
) -> None:
    """Check a log of your own: what was read, what was not and why, innovation statistics, and a picture.

    Example: coopoc data check mylog --columns t=timestamp vehicle=car

    Args:
        path: a file or a folder: tables, NMEA, a ROS bag, PyFG, MR.CLAM; see docs/your_data.md.
        dt: s, steps of the recording.
        max_gap: s, longest gap of a vehicle's odometry that is bridged.
        columns: names in the files, where they differ from the standard ones.
        kinds: words in a column kind, or headers, where they differ from the standard ones.
        origin: degrees, degrees and m, of the local frame; default: the first fix.
        clock: seconds by which clocks are ahead.
        ignore: kinds of measurements that are left out.
        truth: file of the truth, if it is not named truth in the folder.
        frame: body for pose filters: speed, yaw rate, compass and bearings stay as they were measured.
        picture: its file; default: the log's name with -check.png, in the working folder.
    """
    from tabulate import tabulate

    from .log_check import check as checked
    from .log_picture import draw
    from .log_pose_picture import draw_poses
    from .log_poses import PoseCheck, check_poses

    given = {
        "dt": dt,
        "max_gap": max_gap,
        "columns": _pairs("--columns", columns),
        "kinds": _pairs("--kinds", kinds),
        "origin": origin,
        "clock": {name: _seconds(name, text) for name, text in _pairs("--clock", clock).items()},
        "ignore": ignore,
        "truth": truth,
        "frame": "" if frame == "world" else frame,
    }
    log = load_log(path, **{name: value for name, value in given.items() if value not in (None, (), {}, "")})
    print(log.summary)
    try:
        found = checked(log) if log.recording.body is None else check_poses(log)
    except InputError as error:
        print(f"\ncheck: no filter follows it, no picture is drawn: {error}")
        return
    against = "innovations against a solo Kalman filter"
    if isinstance(found, PoseCheck):
        against = f"residuals of the fleet's pose filter, {found.span}"
    for title, rows in (("Fixes", found.vehicles), ("Relative measurements", found.measurements)):
        if rows:
            print(f"\n{title}: {against}")
            print(tabulate(rows, headers="keys", tablefmt="github", floatfmt=".3g"))
    print()
    for warning in found.warnings or ("nothing looks wrong",):
        print(f"check: {warning}")
    out = picture or Path(f"{Path(split(path)[0]).resolve().stem}-check.png")
    drawn = draw_poses(found, out) if isinstance(found, PoseCheck) else draw(log, found, out)
    print(f"picture: {drawn}", file=sys.stderr)


def make(
    recipe: tyro.conf.Positional[str],
    *,
    maps: Path,
    out: Path = Path("fleets"),
    seed: int | None = None,
    tries: int = 1,
    map: str | None = None,
    vehicles: int | None = None,
    cutoff: float | None = None,
) -> None:
    """Make a fleet with SUMO from an OpenDRIVE map: the same seed gives the same bytes.

    Example: coopoc data make town10 --maps carla_maps

    Args:
        recipe: name of a bundled fleet, or FILE.py:NAME of a Recipe of your own.
        maps: folder with the .xodr files of CARLA.
        out: folder for the fleet and its card.
        seed: seed instead of the recipe's.
        tries: number of seeds to try until all vehicles drive and none jumps.
        map: file in the folder of maps, instead of the recipe's.
        vehicles: number of vehicles, instead of the recipe's.
        cutoff: cutoff of the smoother in Hz, instead of the recipe's.
    """
    from .generate import make as generate

    given = {"map": map, "vehicles": vehicles, "cutoff": cutoff}
    changes = {name: value for name, value in given.items() if value is not None}
    card = generate(recipe, maps, out, seed, tries=tries, **changes)
    print(card.render())
    print(f"written to {out}. Use it: --data {out / f'{card.name}.npz'}", file=sys.stderr)


def convert_(
    source: tyro.conf.Positional[str],
    out: tyro.conf.Positional[Path],
    *,
    dt: float | None = None,
    max_gap: float | None = None,
    columns: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=HEADER ...")] = (),
    format: str | None = None,
) -> None:
    """Convert a drive to CSV, Parquet or a folder of TUM files, and a log in body frames to a factor graph.

    Example: coopoc data convert fcd.xml drive.csv --dt 0.1; coopoc data convert "mylog?frame=body" drive.pyfg

    Args:
        source: name or path of the drive.
        out: file in .csv or .parquet, or a folder for TUM files; of a log a .pyfg or .g2o file.
        dt: step in s to resample to.
        max_gap: longest gap of a vehicle in s that resampling bridges.
        columns: headers in the file that differ from id, t, x, y, z, vx, vy, vz.
        format: format of the source, if it is not detected.
    """
    given = {"max_gap": max_gap, "columns": _pairs("--columns", columns)}
    options = {name: value for name, value in given.items() if value}
    if out.suffix in (".pyfg", ".g2o"):
        from .recording_graph import write_log_graph

        log = load_log(source, **options, **({} if dt is None else {"dt": dt}))
        print(f"{write_log_graph(log, out)!r} written to {out}", file=sys.stderr)
        return
    print(f"{convert(source, out, dt, format=format, **options)!r} written to {out}", file=sys.stderr)


def _pairs(option: str, texts: Sequence[str]) -> dict[str, str]:
    pairs = [text.partition("=") for text in texts]
    for text, (name, equals, value) in zip(texts, pairs, strict=True):
        if not (name and equals and value):
            raise InputError(option, repr(text), "must be name=value", f"Write for example: {option} t=timestamp.")
    return {name: value for name, _, value in pairs}


def _seconds(name: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(f"--clock {name}", repr(text), "must be seconds", f"Write --clock {name}=0.35.") from None


COMMANDS: Mapping[str, Callable[..., None]] = {
    "list": list_,
    "show": show,
    "check": check,
    "make": make,
    "convert": convert_,
}

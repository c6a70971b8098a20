"""load_log: measurements of one's own, of whatever format -> Log; recorder: the same for studies."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from coopoc.errors import InputError
from coopoc.formats.pyfg import read_pyfg
from coopoc.plugins import suggestion, unknown
from coopoc.world.recording import Recording
from coopoc.world.storage import is_recording, read_recording
from coopoc.world.v2x import V2X

from .log import Log, read_log
from .log_files import log_files
from .log_links import under
from .log_summary import Summary
from .mrclam import read_mrclam
from .mrclam_recording import recording
from .part import parted
from .pyfg_recording import graph_recording
from .source import split


def load_log(name_or_path: str | Path, **options: Any) -> Log:
    """Log of a file or folder of measurements.

    Args:
        name_or_path: tables and NMEA (`read_log`), an MR.CLAM folder, a PyFG file (in body frames), an .npz of
            `save_recording`; options may stand behind a question mark, as in "drive?dt=0.1".
        options: of the reader; of all, since and until, s after the first step, of the part that is kept.

    Raises:
        InputError: no such path, an unknown option, or a file with a fault.
    """
    word, given = split(name_or_path)
    path, options = Path(word), {**given, **options}
    part = {name: options.pop(name, None) for name in ("since", "until")}
    read: Callable[..., Log] = read_log
    if path.suffix == ".npz" and is_recording(path):
        read = _of_file
    elif path.suffix == ".pyfg":
        read = _of_pyfg
    elif (path / "Barcodes.dat").is_file():
        read = _of_mrclam
    found: Log = _with(read, path, options)
    return found.part(**part)


def format_of(path: Path, columns: Mapping[str, str] | None = None) -> str:
    """ "log" or "recording" for measurements, "" for anything else; MR.CLAM is found before."""
    if path.suffix == ".npz":
        return "recording" if is_recording(path) else ""
    return "log" if path.suffix == ".pyfg" or log_files(path, columns) else ""


def recorder(name_or_path: str | Path, format: str) -> Callable[..., Recording]:
    """(v2x, *, runs, seed) -> Recording of real measurements.

    Args:
        name_or_path: as in `load_log`.
        format: mrclam, log or recording.
    """
    word, options = split(name_or_path)
    if format == "mrclam":
        part = {name: options.pop(name, None) for name in ("since", "until")}
        log_of_all = _with(read_mrclam, Path(word), options)
        return lambda *args, **draws: parted(recording(log_of_all, *args, **draws), **part)
    log = load_log(name_or_path)
    return partial(under, log.recording, logged=log.messages)


def _of_mrclam(path: Path, *, dt: float = 0.1, max_gap: float = 0.5) -> Log:
    log = read_mrclam(path, dt=dt, max_gap=max_gap)
    seen = recording(log, V2X(max_neighbours=max(len(log.fleet.ids) - 1, 0), radius=float("inf")))
    grid = f"{len(seen.t)} steps of {seen.dt:g} s, {seen.t[-1]:.1f} s"
    counts = {
        "landmarks (coopoc run real takes them)": len(log.sightings),
        "robots without odometry, measurements or truth": log.absent,
        "barcodes in no list": log.unknown,
    }
    refused = {f"measurements of {what}": (number, "") for what, number in counts.items() if number}
    vehicles = dict.fromkeys(log.fleet.ids, "wheel odometry, range and bearing, Vicon")
    read = {"measurements between robots": len(log.range)}
    return Log(seen, log.fleet, Summary(path.name, grid, vehicles, read, refused, {}, seen.notes), False)


def _of_pyfg(path: Path, *, dt: float = 0.1) -> Log:
    graph = read_pyfg(path)
    seen, truth = graph_recording(graph, dt=dt)
    grid = f"{len(seen.t)} steps of {seen.dt:g} s, {seen.t[-1] - seen.t[0]:.1f} s"
    vehicles = {name: "landmark" if k in seen.landmarks else "odometry" for k, name in enumerate(seen.ids)}
    number = {"ranges": len(seen.links), "bearings": int(np.isfinite(seen.relative[0, :, 1]).sum())}
    chained = sum(len(places) - 1 for places in graph.robots.values())
    edges = (graph.ranges, graph.relative_point, graph.relative_pose)
    left = {
        "edges outside the steps that all robots share, beside another of the same pair and step, between points, or "
        "between poses of one robot": sum(map(len, edges)) - chained - len(seen.links),
        "priors": len(graph.pose_prior) + len(graph.point_prior),
    }
    read = {what: count for what, count in number.items() if count}
    refused = {what: (count, "") for what, count in left.items() if count}
    return Log(seen, truth, Summary(path.name, grid, vehicles, read, refused, {}, seen.notes), True)


def _of_file(path: Path) -> Log:
    seen, truth = read_recording(path)
    grid = f"{len(seen.t)} steps of {seen.dt:g} s, {seen.t[-1] - seen.t[0]:.1f} s, {seen.runs} runs"
    read = {"links": len(seen.links)}
    return Log(
        seen, truth, Summary(path.name, grid, dict.fromkeys(seen.ids, "recorded"), read, {}, {}, seen.notes), True
    )


def _with(read: Callable[..., Any], path: Path, options: dict[str, Any]) -> Any:
    """What a reader returns; InputError for an option that it does not have."""
    known = [name for name in inspect.signature(read).parameters if name not in ("path", "folder")]
    for name in options:
        if name not in known:
            raise unknown("option", name, known or ["(none)"], suggestion(name, known, "Leave it out."))
    if not path.exists():
        raise InputError("data", str(path), "must be the path of a file or folder", "Check the path.")
    return read(path, **options)

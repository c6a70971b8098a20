"""load_fleet, read_log: a bundled name, a file or a folder -> Fleet or Log, by the registry of formats."""

import inspect
import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial, wraps
from pathlib import Path
from typing import Any

from coopoc import Fleet, InputError
from coopoc.arrays import instance
from coopoc.errors import unknown
from coopoc.plugins import find, in_file, names
from coopoc.world.storage import read_recording

from .bag import TRUE_NAME
from .cells import TABLES, Names
from .fetch import bring
from .fleet_files import read_fcd, read_table, read_tum, tum_files
from .log import read as logs
from .log.read import Log, is_log, steps_in_words
from .log.units import Summary
from .mrclam import MAX_GAP, read_mrclam
from .source import parted, split, there

FLEETS = Path(__file__).parent / "fleets"


def card(name: str) -> dict[str, Any]:
    """The card of a bundled fleet: name, map, map_licence, command, sumo (version), recipe, statistics, and
    `words`, these in texts.

    >>> card("town10")["neighbours"]["mean"] > 5
    True
    """
    return dict(json.loads((FLEETS / f"{name}.json").read_text("utf-8")))


def bundled(name: str) -> Fleet:
    """A bundled fleet, with name, source and licence of its card.

    >>> bundled("town10")
    Fleet(town10: 60 vehicles x 900 steps, dt 0.1 s)
    """
    made = card(name)
    source = f"simulated with SUMO {made['sumo']} on CARLA's {made['map']}, seed {made['recipe']['seed']}, smoothed"
    return replace(read_table(FLEETS / f"{name}.parquet"), source=source, licence=made["map_licence"])


DATASETS = {  # written out: `coopoc list` reads the names without an import
    "town04": partial(bundled, "town04"),
    "town10": partial(bundled, "town10"),
    "town10-clients": partial(bundled, "town10-clients"),
    "town10-validation": partial(bundled, "town10-validation"),
}
"""Bundled fleets; the names are written out so that a list of them imports nothing."""


def _stored_log(path: Path) -> Log:
    recording, truth = read_recording(path)
    vehicles, grid = dict.fromkeys(recording.ids, "recorded"), f"{steps_in_words(recording)}, {recording.runs} runs"
    return Log(recording, truth, Summary(path.name, grid, vehicles, {"links": len(recording.links)}), True)


@wraps(logs.read_log)
def _graph_log(path: Path, **options: Any) -> Log:
    """In body frames; a factor graph states all its noise, so that no error lasts."""
    log = logs.read_log(path, **{"frame": "body", "dt": 0.1, **options})
    whole = replace(log.recording.sensors, range_offset_std=0.0, speed_scale_std=0.0, yaw_rate_bias_std=0.0)
    return replace(log, recording=replace(log.recording, sensors=whole))


LOGS: Mapping[str, Callable[..., Log]] = {"pyfg": _graph_log, "recording": _stored_log, "log": logs.read_log}
"""Formats of real measurements -> reader; one of several files or endings belongs to `log.read.READERS`."""
DRIVES: Mapping[str, Callable[..., Fleet]] = {
    "table": read_table,
    "tum": read_tum,
    "fcd": read_fcd,
    "mrclam": lambda path, dt=0.1, max_gap=MAX_GAP: read_mrclam(path, dt=dt, max_gap=max_gap).fleet,
}
"""Formats of drives -> reader; of MR.CLAM Vicon's truth, whose measurements `coopoc run real` takes."""
MEASURED = {".npz": "recording", ".pyfg": "pyfg"}
ENDINGS = {**dict.fromkeys(TABLES, "table"), ".xml": "fcd", ".tum": "tum", ".txt": "tum"}


def load_fleet(name_or_path: str | Path, **options: Any) -> Fleet:
    """Fleet of a bundled dataset or of a file or folder.

    Args:
        name_or_path: a key of DATASETS, a name under which an installed distribution registers one (entry points
            `coopoc.datasets`: a Fleet, or what makes one), "folder/mine.py:NAME" for the same in a file, or a path:
            CSV or Parquet, TUM, SUMO FCD, MR.CLAM folder, or a log with a truth (`read_log`). Options may stand behind
            a question mark, as in "drive.csv?dt=0.1&columns=t:time".
        options: of the reader, for example dt (s), max_gap (s), columns, vehicle_length, scale; of all, since and
            until, s after the first step, of the part that is kept, and format, one of DRIVES or LOGS, instead of the
            one found from name and contents.

    Raises:
        InputError: an unknown name (the message lists all), an unknown format or option, or a file with a fault.

    >>> load_fleet("town10-clients").present.sum(axis=0)
    array([1550, 4600, 1450, 1420])
    """
    name, options, part = _split(name_or_path, options)
    chosen = options.pop("format", None)
    if chosen is None and (in_file(name) or name in names("coopoc.datasets")):
        if options:
            raise InputError("options", sorted(options), f"{name} is bundled and takes none", "Leave them out.")
        registered = find("coopoc.datasets", name)
        made = registered if isinstance(registered, Fleet) else registered()
        return parted(instance(f"what data {name!r} gives", made, Fleet, "Return coopoc.Fleet(...)."), **part)
    there(name)
    path = Path(name)
    chosen = chosen or detect(path, options.get("columns"))
    readers = {**DRIVES, **LOGS}
    if chosen not in readers:
        raise unknown("format", chosen, readers, "Or leave it out.")
    read = _read(readers[chosen], path, options)
    truth: Fleet | None = read if chosen in DRIVES else read.truth
    if truth is None:
        raise InputError(
            path.name,
            "no truth",
            "is a log without one: there is nothing to score against",
            "Add a table truth.csv to its folder, pass truth=, or take co.read_log.",
        )
    return parted(truth, **part)


def read_log(name_or_path: str | Path, **options: Any) -> Log:
    """Log of a file or folder of measurements.

    Args:
        name_or_path: tables, NMEA and bags, a PyFG file (in body frames), an .npz of `save_recording`, a public data
            set that has been fetched; options may stand behind a question mark, as in "drive?dt=0.1".
        options: of the reader, see `coopoc.data.log.read.read_log`; of all, since and until, s after the first step, of
            the part that is kept.

    Raises:
        InputError: no such path, an unknown option, or a file with a fault.
    """
    name, options, part = _split(name_or_path, options)
    kind = _real(Path(name))
    if kind == "mrclam":
        raise InputError(
            "data",
            name,
            "is a folder of MR.CLAM, whose noise has to be calibrated first",
            "Take coopoc run real, or read_mrclam, calibrate and pose_recording of coopoc.data.mrclam.",
        )
    log: Log = _read(LOGS.get(kind, logs.read_log), Path(name), options)
    return log.part(**part)


def kind_of(name_or_path: str | Path) -> str:
    """Format of a name or path, "" for a name and for what is made by code.

    >>> kind_of("town10")
    ''
    """
    name, options = split(name_or_path)
    if name in DATASETS or not (Path(name).is_file() or Path(name).is_dir()):
        return ""
    return str(options.get("format") or detect(Path(name), options.get("columns")))


def detect(path: Path, columns: Names | None = None) -> str:
    """Format of a file or folder by its name and, for tables and folders, by its contents.

    Args:
        path: of the file or folder.
        columns: names in the file; a key that only a log has makes it one.

    >>> detect(Path("drive.parquet"))
    'table'
    """
    kind = _real(path, columns) or ("tum" if path.is_dir() and tum_files(path) else ENDINGS.get(path.suffix.lower()))
    if kind is None:
        raise InputError(
            "data",
            str(path),
            "must end in .csv, .parquet, .tum, .txt, .xml, .nmea, .bag, .pyfg or .npz, or be a folder of TUM, MR.CLAM "
            "or log files",
            f"Pass format= one of {', '.join((*DRIVES, *LOGS))}.",
        )
    return kind


def _real(path: Path, columns: Names | None = None) -> str:
    """Format of measurements, "" for anything else."""
    if (path / "Barcodes.dat").is_file():
        return "mrclam"
    if kind := MEASURED.get(path.suffix.lower()):
        return kind
    return "log" if all(TRUE_NAME.search(file.stem) for file in path.glob("*.tum")) and is_log(path, columns) else ""


def _split(name_or_path: str | Path, options: dict[str, Any]) -> tuple[str, dict[str, Any], dict[str, Any]]:
    """Name, options of the reader, and the part that is kept."""
    name, stated = split(name_or_path)
    options = stated | options
    return name, options, {key: options.pop(key, None) for key in ("since", "until")}


def _read(read: Callable[..., Any], path: Path, options: dict[str, Any]) -> Any:
    """What a reader returns; InputError for an option that it does not have."""
    accepted = [name for name in inspect.signature(read).parameters if name != "path"]
    if "options" in accepted:
        accepted[accepted.index("options") :] = ["dt", "max_gap", "any_scale"]
    accepted += ["since", "until"]
    for name in options:
        if name not in accepted:
            raise unknown("option", name, accepted, "Leave it out.")
    if not (path.is_file() or path.is_dir()):
        raise InputError("data", str(path), "must be the path of a file or folder", bring(path, "Check the path."))
    for each in (path, *path.rglob("*")):
        if str(each).encode(errors="replace").decode() != str(each):
            raise InputError("data", ascii(str(each)), "must have a name in UTF-8", "Rename it.")
    return read(path, **options)

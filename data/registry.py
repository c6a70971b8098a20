"""load: a bundled name or a path -> Fleet. The core finds it through the entry point group `coopoc.datasets`."""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from coopoc.errors import InputError
from coopoc.file_names import given_path
from coopoc.one_file import in_file
from coopoc.plugins import find, names, suggestion, unknown
from coopoc.world.fleet import Fleet
from coopoc.world.recording import Recording

from . import store
from .cards import Card
from .carla import read_carla
from .fcd import read_fcd
from .log import Log
from .mrclam import read_mrclam
from .part import parted
from .recordings import format_of
from .recordings import load_log as load_log
from .recordings import recorder as real_recorder
from .rows import assemble
from .source import split
from .table import NEEDED, VELOCITY, read_table, write_table
from .tum import read_tum, tum_files, write_tum


@dataclass(frozen=True)
class Dataset:
    """A bundled fleet: its file and its card.

    >>> DATASETS["town10"].load()
    Fleet(town10: 60 vehicles x 900 steps, dt 0.1 s)
    """

    path: Path

    def card(self) -> Card:
        """Provenance and statistics."""
        return Card(**json.loads(self.path.with_suffix(".json").read_text()))

    def load(self) -> Fleet:
        """The fleet, with name, source and licence of its card."""
        card = self.card()
        fleet = store.load(self.path)
        return replace(fleet, name=card.name, source=card.source, licence=card.map_licence)


REAL = ("mrclam", "log", "recording")
"""Formats that hold real measurements."""
FLEETS = Path(__file__).parent / "fleets"
DATASETS: Mapping[str, Dataset] = {
    "town04": Dataset(FLEETS / "town04.npz"),
    "town10": Dataset(FLEETS / "town10.npz"),
    "town10-clients": Dataset(FLEETS / "town10-clients.npz"),
    "town10-validation": Dataset(FLEETS / "town10-validation.npz"),
}
"""Bundled fleets; the names are written out so that a list of them imports nothing."""

READERS: Mapping[str, Callable[..., Fleet]] = {
    "table": read_table,
    "tum": read_tum,
    "fcd": read_fcd,
    "carla": read_carla,
    "mrclam": lambda path, **options: read_mrclam(path, **options).fleet,
    "fleet": lambda path: store.load(path, path.stem),
    "log": lambda path, **options: _truth(path, load_log(path, **options)),
    "recording": lambda path: _truth(path, load_log(path)),
}


def load_fleet(name_or_path: str | Path, *, format: str | None = None, **options: Any) -> Fleet:
    """Fleet of a bundled dataset or of a file or folder.

    Args:
        name_or_path: a key of DATASETS, a name under which an installed distribution registers one (entry points
            `coopoc.datasets`: a Fleet, or what makes one), "folder/mine.py:NAME" for the same in a file, or a path:
            CSV, Parquet, TUM, SUMO FCD, CARLA table, MR.CLAM folder, .npz of `coopoc data make`, or a log with a truth
            (`load_log`). Options may stand behind a question mark, as in "drive.csv?dt=0.1&columns=t:time".
        format: one of READERS, instead of the one found from name and contents.
        options: of the reader, for example dt (s), max_gap (s), columns, vehicle_length, handedness; of all, since and
            until, s after the first step, of the part that is kept.

    Raises:
        InputError: an unknown name (the message lists all), an unknown format or option, or a file with a fault.

    >>> load_fleet("town10-clients").present.sum(axis=0)
    array([1550, 4600, 1450, 1420])
    """
    name, given = split(name_or_path)
    options = {**given, **options}
    part = {option: options.pop(option, None) for option in ("since", "until")}
    fleet: Fleet = parted(_whole(name, options.pop("format", format), options), **part)
    return fleet


def _whole(name: str, format: str | None, options: dict[str, Any]) -> Fleet:
    """The fleet of a name, from its first step to its last."""
    if format is None and (in_file(name) or name in names("coopoc.datasets")):
        return _resampled(_made(find("coopoc.datasets", name), name), **options)
    path = Path(name)
    if not path.exists():
        raise InputError(
            "data",
            repr(name),
            f"must be one of {', '.join(names('coopoc.datasets'))} or the path of a file or folder",
            suggestion(
                name,
                names("coopoc.datasets"),
                "List the bundled fleets with coopoc data list, or check the path.",
            ),
        )
    chosen = detect(path, options.get("columns")) if format is None else format
    if chosen not in READERS:
        raise unknown("format", chosen, READERS, "Or leave it out.")
    try:
        return READERS[chosen](path, **options)
    except TypeError as error:
        if "unexpected keyword argument" not in str(error):
            raise
        reader = read_mrclam if chosen == "mrclam" else READERS[chosen]
        known = list(inspect.signature(reader).parameters)[1:]
        wrong = next((name for name in options if name not in known), "")
        hint = suggestion(wrong, known, str(error))
        raise InputError("options", sorted(options), f"not all known to the {chosen} reader", hint) from None


def _made(found: Any, name: str) -> Fleet:
    """A Fleet, what loads one as a Dataset does, or what makes one when it is called."""
    fleet = found if isinstance(found, Fleet) else found.load() if hasattr(found, "load") else found()
    if not isinstance(fleet, Fleet):
        raise InputError("data", repr(name), f"gives a {type(fleet).__name__}, no Fleet", "Return coopoc.Fleet(...).")
    return fleet


def kind_of(name_or_path: str | Path) -> str:
    """Format of a name or path, "" for a name and for what is made by code.

    >>> kind_of("town10")
    ''
    """
    name, options = split(name_or_path)
    if name in DATASETS or in_file(name) or not Path(name).exists():
        return ""
    return str(options.get("format") or detect(Path(name), options.get("columns")))


def _truth(path: Path, log: Log) -> Fleet:
    if log.truth is None:
        raise InputError(
            path.name,
            "no truth",
            "is a log without one: there is nothing to score against",
            "Add a table truth.csv to its folder, pass truth=, or take co.load_recording.",
        )
    return log.truth


def recorder(name_or_path: str | Path, *, format: str | None = None) -> Callable[..., Recording] | None:
    """For data with real measurements: (v2x, *, runs, seed) -> Recording; None where `observe` has to simulate them.

    >>> recorder("town10") is None
    True
    """
    chosen = format or kind_of(name_or_path)
    return real_recorder(name_or_path, chosen) if chosen in REAL else None


def detect(path: Path, columns: Mapping[str, str] | None = None) -> str:
    """Format of a file or folder by its name and, for CSV and folders, by its contents.

    A CSV file is CARLA's if it has yaw and velocities, whose frame must be found out, or many columns of other names.

    Args:
        path: of the file or folder.
        columns: names in the file; a key that only a log has makes it one.

    >>> detect(Path("drive.parquet"))
    'table'
    """
    if path.is_dir():
        if (path / "Barcodes.dat").is_file():
            return "mrclam"
        if format_of(path) and not any(path.glob("*.tum")):
            return "log"
        if tum_files(path):
            return "tum"
    if path.suffix == ".npz":
        return format_of(path) or "fleet"
    if format_of(path, columns):
        return "log"
    known = {".parquet": "table", ".xml": "fcd", ".xlsx": "carla", ".tum": "tum", ".txt": "tum"}
    if path.suffix == ".csv":
        with path.open(encoding="utf-8-sig", errors="replace") as file:
            header = [word.strip().strip('"').lower() for word in file.readline().split(",")]
        framed = {"yaw", *VELOCITY} <= set(header) or (len(header) >= 14 and not set(NEEDED) <= set(header))
        return "carla" if framed else "table"
    if path.suffix not in known:
        raise InputError(
            "data",
            path.name,
            "must end in .csv, .parquet, .tum, .txt, .xml, .xlsx, .nmea, .bag, .pyfg or .npz, or be a folder of TUM, "
            "MR.CLAM or log files",
            f"Pass format= one of {', '.join(READERS)}.",
        )
    return known[path.suffix]


def list_datasets() -> list[dict[str, Any]]:
    """One row per bundled fleet: name, vehicles, steps, dt_s, mean speed, neighbours, licence, sha256.

    >>> [row["name"] for row in list_datasets()][:2]
    ['town04', 'town10']
    """
    cards = [dataset.card() for dataset in DATASETS.values()]
    return [
        {
            "name": card.name,
            "map": card.map,
            "vehicles": card.vehicles,
            "steps": card.steps,
            "dt_s": card.dt,
            "mean_speed_m_s": card.speed["mean"],
            "mean_neighbours": card.neighbours["mean"],
            "licence": card.map_licence,
            "sha256": card.sha256,
        }
        for card in cards
    ]


def convert(
    name_or_path: str | Path, out: str | Path, dt: float | None = None, *, format: str | None = None, **options: Any
) -> Fleet:
    """Load a fleet, resample it if dt is given, write it, and return it as it was written.

    Args:
        name_or_path: as in `load_fleet`.
        out: .csv or .parquet file, or a folder (no suffix) for one TUM file per vehicle.
        dt: s, resample.
        format: of the source, if it is not detected.
        options: of the reader.

    Raises:
        InputError: as `load_fleet`, another ending of `out`, or ids that are no file names for TUM.
    """
    path = given_path(out)
    if path.suffix not in (".csv", ".parquet", ""):
        raise InputError("out", path.name, "must end in .csv or .parquet, or be a folder for TUM files", "Rename it.")
    fleet = load_fleet(name_or_path, format=format, **options, **({} if dt is None else {"dt": dt}))
    path.parent.mkdir(parents=True, exist_ok=True)
    (write_table if path.suffix else write_tum)(fleet, path)
    return fleet


def _resampled(fleet: Fleet, dt: float | None = None, **others: Any) -> Fleet:
    if others:
        raise InputError("options", sorted(others), f"{fleet.name} is bundled and takes dt only", "Leave them out.")
    if dt is None:
        return fleet
    step, column = np.nonzero(fleet.present)
    return assemble(
        [fleet.ids[c] for c in column],
        fleet.t[step],
        fleet.position[step, column],
        dt=dt,
        file=fleet.name,
        name=fleet.name,
        source=f"{fleet.source}, resampled at {dt:g} s",
        licence=fleet.licence,
    )

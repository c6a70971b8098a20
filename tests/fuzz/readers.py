"""The text readers: for each its good files, from which fuzzing starts, and a call that reads a folder of them."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
from safetensors.torch import save as to_bytes

from coopoc import read_graph
from coopoc.data.log.read import read_log
from coopoc.data.registry import load_fleet
from coopoc.data.registry import read_log as load_log
from coopoc.formats.seals import UNSEALED, sealed
from coopoc.learned.checkpoint import load
from coopoc.learned.nets.okf import NoiseParameters
from coopoc.study import publish, reference
from coopoc.study.results import Results
from coopoc.study.tables import FORMATS

from . import good_files as good


class Reader(NamedTuple):
    """Good files of a reader, name -> text, and the call that reads the folder which holds them."""

    files: Mapping[str, str]
    read: Callable[[Path], Any]


def _views(folder: Path) -> None:
    (folder / "manifest.json").write_text(good.MANIFEST)
    for form in FORMATS:
        publish.tables(folder, form)


def _reference(folder: Path) -> None:
    frame = pd.DataFrame({"method": ["kalman"] * 4, "run": range(4), "ego": "a", "rt_le_m": [1.0, 2.0, 1.0, 2.0]})
    known = reference.Reference.load(folder / "made.json")
    found = Results(known.study, "", ("method",), known.settings, frame, pd.DataFrame(), 0, {})
    reference.table(reference.check(found, known, {"rt_le_m": "lower"}))


def _card(folder: Path) -> None:
    """A checkpoint with this card and the weights of the smallest net."""
    text = (folder / "card.json").read_bytes().decode("utf-8", "replace")
    content = to_bytes(NoiseParameters().state_dict(), metadata={"card": text, "checksum": UNSEALED})
    (folder / "net.safetensors").write_bytes(sealed(content))
    load(folder / "net.safetensors")


NAMES = {"t": "time", "latitude": "lat", "longitude": "lon", "height": "alt"}
READERS: Mapping[str, Reader] = {
    "csv": Reader({"a.csv": good.TABLE}, lambda d: load_fleet(d / "a.csv")),
    "csv resampled": Reader({"a.csv": good.TABLE}, lambda d: load_fleet(d / "a.csv", dt=0.1)),
    "fcd": Reader({"a.xml": good.FCD}, lambda d: load_fleet(d / "a.xml")),
    "tum": Reader({"a.tum": good.TUM}, lambda d: load_fleet(d / "a.tum")),
    "g2o": Reader({"a.g2o": good.G2O}, lambda d: read_graph(d / "a.g2o")),
    "pyfg": Reader({"a.pyfg": good.PYFG}, lambda d: read_graph(d / "a.pyfg")),
    "pyfg recording": Reader({"a.pyfg": good.ROBOTS}, lambda d: load_log(d / "a.pyfg")),
    "mrclam": Reader(good.MRCLAM, load_fleet),
    "librsf": Reader(good.LIBRSF, lambda d: read_log(d, frame="body", any_scale=True)),
    "log": Reader({"log.csv": good.LOG}, lambda d: read_log(d / "log.csv", any_scale=True)),
    "wide log": Reader({"car.csv": good.WIDE}, lambda d: read_log(d / "car.csv", columns=NAMES)),
    "nmea": Reader({"car.nmea": good.NMEA}, lambda d: read_log(d / "car.nmea")),
    "manifest": Reader({"manifest.json": good.MANIFEST}, Results.load),
    "views": Reader({"views.json": good.VIEWS}, _views),
    "reference": Reader({"made.json": good.REFERENCE}, _reference),
    "card": Reader({"card.json": good.CARD}, _card),
}

MARK = b"@@ "
"""Begins the line that names a file where several are one."""


def packed(files: Mapping[str, bytes]) -> bytes:
    """The files of a folder as one text: the only file as it is, several under lines that name them.

    >>> packed({"a": b"1\\n", "b": b"2"})
    b'@@ a\\n1\\n@@ b\\n2'
    """
    if len(files) == 1:
        return next(iter(files.values()))
    return b"".join(MARK + name.encode() + b"\n" + text for name, text in files.items())


def unpacked(text: bytes, names: Mapping[str, Any]) -> dict[str, bytes]:
    """The files of a packed text: known names only, so that nothing is written elsewhere."""
    if len(names) == 1:
        return {next(iter(names)): text}
    parts = [part.partition(b"\n") for part in (b"\n" + text).split(b"\n" + MARK)[1:]]
    known = {name.encode(): name for name in names}
    return {known[name]: body + b"\n" for name, _, body in parts if name in known}

"""A Recording, and its truth if there is one, as an .npz file: numbers and names only, nothing in it is ever run."""

import hashlib
import json
import zipfile
from dataclasses import asdict
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from ..arrays import AnyArray, instance
from ..errors import InputError, said
from ..paths import given_path, write
from .fleet import Fleet, same_drive
from .links import Links
from .recording import Body, Recording
from .sensors import Fault, Outliers, Sensors
from .v2x import V2X

ARRAYS = (
    "t",
    "gnss",
    "velocity",
    "relative",
    "broadcasts",
    "arrival",
    "observers",
    "landmarks",
    "fix_factor",
    "motion_variance",
    "shown",
    "tags",
)
LINKS = ("step", "observer", "neighbour")
BODY = ("yaw_rate", "heading")
FORMAT_NAME = "coopoc_recording"
FIELD_NAMES = (
    *ARRAYS,
    *BODY,
    *(f"links_{name}" for name in LINKS),
    *(f"truth_{n}" for n in ("position", "velocity", BODY[1])),
)
MAX_BYTES, MAX_INFLATION = 2**31, 1032
"""Bytes of one unpacked file, and of each of its own: no deflated stream unpacks to more."""


def save_recording(recording: Recording, path: str | Path, truth: Fleet | None = None) -> None:
    """Write a recording; the same one gives the same bytes.

    Args:
        recording: in any number of runs.
        path: .npz file, which is replaced whole; its folder is made.
        truth: of the same vehicles at the same steps.

    Raises:
        InputError: no recording, a truth of other vehicles or steps, or a path that does not end in .npz.
    """
    instance("recording", recording, Recording)
    if (path := given_path(path)).suffix != ".npz":
        raise InputError("path", str(path), "must end in .npz", "NumPy would append it.")
    if truth is not None:
        same_drive(truth, recording.ids, recording.t)
    settings = {"sensors": asdict(recording.sensors), "v2x": asdict(recording.v2x)}
    words = {"ids": recording.ids, "notes": recording.notes, **settings}
    arrays = _arrays(recording)
    if truth is not None:
        words["truth"] = {"name": truth.name, "source": truth.source, "licence": truth.licence}
        arrays |= {"truth_position": truth.position, "truth_velocity": truth.velocity}
        if truth.heading is not None:
            arrays["truth_heading"] = truth.heading
    named = {FORMAT_NAME: np.array(json.dumps(words)), **arrays}
    write(path, lambda file: np.savez_compressed(file, **named))


def unpacked(path: Path) -> dict[str, AnyArray]:
    """Arrays of an .npz file by name; ValueError for more than `MAX_BYTES` bytes, and what zipfile and NumPy raise."""
    with zipfile.ZipFile(path) as packed:
        if (size := sum(part.file_size for part in packed.infolist())) > MAX_BYTES:
            raise ValueError("more than 2 GB unpacked (too many runs?)")
        if size > MAX_INFLATION * path.stat().st_size:
            raise ValueError(f"{size} bytes unpacked, more than {MAX_INFLATION} times those of the file")
        _check_shapes(packed)
    with np.load(path, allow_pickle=False) as stored:
        return dict(stored)


def _check_shapes(packed: zipfile.ZipFile) -> None:
    """ValueError for arrays of other names, for more numbers than their bytes hold, and for arrays larger than those of
    a recording with these fixes and links, by their headers alone."""
    shapes = {}
    for part in packed.infolist():
        with packed.open(part) as file:
            major, _ = npy.read_magic(file)
            read = npy.read_array_header_1_0 if major == 1 else npy.read_array_header_2_0
            shape, _, dtype = read(file)
        name = part.filename.removesuffix(".npy")
        if name in shapes or name not in (FORMAT_NAME, *FIELD_NAMES) or prod(shape) * dtype.itemsize > part.file_size:
            raise ValueError(f"an array {name[:60]} of shape {shape} and dtype {dtype}")
        shapes[name] = shape
    runs, steps, vehicles, _ = shapes["gnss"]
    most = 3 * runs * max(steps * vehicles, *shapes["links_step"])
    if shapes["t"] != (steps,) or any(prod(shape) > most for shape in shapes.values()):
        raise ValueError(f"arrays of shapes {shapes}")


def read_recording(path: str | Path) -> tuple[Recording, Fleet | None]:
    """What `save_recording` wrote, bit by bit.

    Raises:
        InputError: a file that is damaged, too large, or no recording.
    """
    path = given_path(path)
    try:
        arrays = unpacked(path)
        return _recording(json.loads(str(arrays.pop(FORMAT_NAME))), arrays)
    except Exception as error:  # of zipfile, zlib and NumPy: a damaged file meets them all
        cause = said(error)
    raise InputError(path.name, cause, "must be a recording in .npz", "Write it again with save_recording.")


def digest(recording: Recording) -> str:
    """SHA-256 of all that a recording holds.

    >>> from coopoc import Fleet, Sensors, observe
    >>> fleet = Fleet(("a",), [0, 0.1], np.zeros((2, 1, 3)), np.zeros((2, 1, 3)))
    >>> digest(observe(fleet, Sensors(), seed=1)) == digest(observe(fleet, Sensors(), seed=2))
    False
    """
    sha = hashlib.sha256(repr((recording.ids, recording.notes, recording.sensors, recording.v2x)).encode())
    for array in _arrays(recording).values():
        sha.update(array.tobytes())
    return sha.hexdigest()


def _arrays(recording: Recording) -> dict[str, Any]:
    """All arrays of a recording by their names in a file, in a fixed order."""
    arrays = {name: np.asarray(getattr(recording, name)) for name in ARRAYS}
    arrays |= {f"links_{name}": getattr(recording.links, name) for name in LINKS}
    return arrays | ({} if recording.body is None else {name: getattr(recording.body, name) for name in BODY})


def _recording(words: dict[str, Any], arrays: dict[str, Any]) -> tuple[Recording, Fleet | None]:
    noise: dict[str, Any] = {name: tuple(v) if isinstance(v, list) else v for name, v in words["sensors"].items()}
    if noise.get("outliers"):
        noise["outliers"] = Outliers(**{kind: Fault(**fault) for kind, fault in noise["outliers"].items()})
    ids, t = tuple(words["ids"]), arrays["t"]
    recording = Recording(
        ids=ids,
        links=Links(*(arrays[f"links_{name}"] for name in LINKS)),
        sensors=Sensors(**noise),
        v2x=V2X(**words["v2x"]),
        notes=tuple(words["notes"]),
        body=Body(arrays["yaw_rate"], arrays["heading"]) if "yaw_rate" in arrays else None,
        **{name: arrays[name] for name in ARRAYS if name in arrays},
    )
    if "truth" not in words:
        return recording, None
    heading = arrays.get("truth_heading")
    truth = Fleet(ids, t, arrays["truth_position"], arrays["truth_velocity"], heading=heading, **words["truth"])
    return recording, truth

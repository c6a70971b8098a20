"""Readers of drives: tables, TUM trajectories, SUMO's floating-car data."""

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from coopoc import Fleet, InputError
from coopoc.formats.values import read_table as read_rows

from .assemble import assemble
from .cells import Factors, Names, factors, named_columns, numeric, read_frame, seconds, words

NEEDED, VELOCITY = ("id", "t", "x", "y", "z"), ("vx", "vy", "vz")
FCD = {"id": "", "x": "", "y": "", "z": "0", "angle": "", "slope": "0", "speed": ""}
"""Attributes of a vehicle in SUMO's file, and what stands for one that is not there; an empty one is refused."""


def read_table(path: Path, *, columns: Names | None = None, scale: Factors | None = None, **options: Any) -> Fleet:
    """Fleet of a CSV or Parquet file; without vx, vy, vz the velocity is the backward difference.

    Args:
        path: s, m, m/s in a local east-north-up frame; a missing row means absent.
        columns: names in the file, as {"id": "vehicle"}, where they differ from id, t, x, y, z, vx, vy, vz.
        scale: column -> its factor to SI units: {"y": -1, "vy": -1} for the left-handed tables of CARLA.
        options: dt (s, resample; None keeps the stamps), max_gap and any_scale, as of `assemble`.

    Raises:
        InputError: a missing column, text or NaN in a cell (with its row, the header not counted), stamps that no
            filter can use.
    """
    names = dict(columns or {})
    frame = read_frame(path, names.get("id", "id"))
    has_velocity = bool({*VELOCITY} & {*names, *frame})
    used = NEEDED + has_velocity * VELOCITY
    frame = named_columns(frame, names, (*NEEDED, *VELOCITY), used, path.name)
    source = f"table {path.name}" + ("" if has_velocity else ", velocity by backward difference")
    factor = factors(scale, (*NEEDED[1:], *VELOCITY))
    t, *numbers = (
        factor.get(name, 1.0) * (seconds if name == "t" else numeric)(frame, name, path.name) for name in used[1:]
    )
    ids = [re.sub("^'(?=[=+@-])", "", name) for name in words(frame, "id", path.name)]  # of `spreadsheet`
    return assemble(ids, t, np.column_stack(numbers), **options, path=path, source=source)


def tum_files(path: Path) -> list[Path]:
    """The file itself, or the .tum (else .txt) files of a folder by name."""
    if path.is_file():
        return [path]
    return sorted(path.glob("*.tum")) or sorted(path.glob("*.txt"))


def read_tum(path: Path, **options: Any) -> Fleet:
    """Fleet of a TUM file or a folder of them; ids are file names, velocity is the backward difference.

    Args:
        path: file or folder; `t x y z qx qy qz qw`, s and m; the orientation is not kept.
        options: dt (s, resample: needed when the vehicles' stamps differ), max_gap and any_scale, as of `assemble`.

    Raises:
        InputError: no file; with the line, another number of words, one that is no finite number; what `assemble`
            raises.
    """
    files = tum_files(path)
    if not files:
        raise InputError("path", path, "must be a TUM file or a folder with .tum or .txt files", "Check the path.")
    tables = [read_rows(file, "t x y z qx qy qz qw")[1] for file in files]
    ids = [file.stem for file, table in zip(files, tables, strict=True) for _ in table]
    t, *x = np.concatenate(tables)[:, :4].T
    source = f"TUM {path.name}, velocity by backward difference"
    return assemble(ids, t, np.stack(x, 1), **options, path=path, source=source)


def read_fcd(path: Path, *, vehicle_length: float = 5.0, **options: Any) -> Fleet:
    """Fleet of a SUMO FCD file: positions are moved from the front bumper to the middle of the vehicle.

    centre = front - length/2 (sin a cos s, cos a cos s, sin s), with the angle a in degrees clockwise from north
    and the slope s in degrees; velocity = speed along the same direction.

    Args:
        path: XML with id, x, y, angle, speed, and z and slope if the network has elevation.
        vehicle_length: m, of every vehicle (5.0 is SUMO's default; the file does not hold it).
        options: dt (s, resample; None keeps SUMO's steps), max_gap and any_scale, as of `assemble`.

    Raises:
        InputError: no XML, an attribute that is missing or no finite number (with the vehicle's row, counted through
            the file), or what Fleet refuses.
    """
    rows = []
    now = ""
    try:
        for event, element in ElementTree.iterparse(path, events=("start", "end")):
            if event == "start" and element.tag == "timestep":
                now = element.get("time", "")
            elif event == "end" and element.tag == "vehicle":
                rows.append([element.get(name, default) for name, default in FCD.items()] + [now])
            elif event == "end" and element.tag == "timestep":
                element.clear()
    except ElementTree.ParseError as error:
        raise InputError(path.name, error, "must be XML of sumo --fcd-output", "Write the file again.") from None
    frame = pd.DataFrame(rows, columns=[*FCD, "t"], index=range(1, len(rows) + 1))
    t, x, y, z, angle, incline, speed = (numeric(frame, name, path.name) for name in ("t", *FCD) if name != "id")
    angle, incline = np.radians([angle, incline])
    ahead = np.column_stack([np.sin(angle) * np.cos(incline), np.cos(angle) * np.cos(incline), np.sin(incline)])
    centre, velocity = np.column_stack([x, y, z]) - 0.5 * vehicle_length * ahead, speed[:, None] * ahead
    source = f"SUMO FCD {path.name}, centres of vehicles {vehicle_length:g} m long"
    numbers = np.hstack([centre, velocity])
    return assemble(words(frame, "id", path.name), t, numbers, **options, path=path, source=source)

"""Reader of SUMO's floating-car data (`sumo --fcd-output`)."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from coopoc.arrays import Floats
from coopoc.errors import InputError
from coopoc.formats.values import LARGEST
from coopoc.world.fleet import Fleet

from .rows import assemble


def read_fcd(
    path: Path,
    *,
    dt: float | None = None,
    max_gap: float | None = None,
    any_scale: bool = False,
    vehicle_length: float = 5.0,
) -> Fleet:
    """Fleet of a SUMO FCD file: positions are moved from the front bumper to the middle of the vehicle.

    centre = front - length/2 (sin a cos s, cos a cos s, sin s), with the angle a in degrees clockwise from north
    and the slope s in degrees; velocity = speed along the same direction.

    Args:
        path: XML with id, x, y, angle, speed, and z and slope if the network has elevation.
        dt: s, resample; None keeps SUMO's steps.
        max_gap: s, as in `assemble`.
        any_scale: True accepts positions that do not look like metres and seconds.
        vehicle_length: m, of every vehicle (5.0 is SUMO's default; the file does not hold it).

    Raises:
        InputError: no XML, an attribute missing or no finite number, or what Fleet refuses.
    """
    vehicle, t, numbers = _rows(path)
    position, velocity = centre(numbers, vehicle_length)
    return assemble(
        vehicle,
        t,
        position,
        velocity,
        dt=dt,
        max_gap=max_gap,
        any_scale=any_scale,
        file=path.name,
        name=path.stem,
        source=f"SUMO FCD {path.name}, centres of vehicles {vehicle_length:g} m long",
    )


def centre(numbers: Floats, vehicle_length: float) -> tuple[Floats, Floats]:
    """(L, 3) centre m and (L, 3) velocity m/s of rows (x, y, z, angle deg, slope deg, speed m/s).

    >>> centre(np.array([[0.0, 0, 0, 90, 0, 3]]), 4.0)[0].round(9) + 0.0
    array([[-2.,  0.,  0.]])
    """
    angle, slope = np.radians(numbers[:, 3:5]).T
    ahead = np.column_stack([np.sin(angle) * np.cos(slope), np.cos(angle) * np.cos(slope), np.sin(slope)])
    return numbers[:, :3] - 0.5 * vehicle_length * ahead, numbers[:, 5:6] * ahead


def _finite(row: Sequence[str | int], place: str) -> tuple[float, ...]:
    try:
        numbers = tuple(float(word) if str(word).isascii() and "_" not in str(word) else np.nan for word in row)
    except ValueError:
        numbers = (np.nan,)
    if not (np.abs(numbers) <= LARGEST).all():
        allowed = "must be seven finite numbers: time, x, y, z, angle, slope, speed"
        raise InputError(place, " ".join(map(str, row)), allowed, "Mend the numbers or remove the vehicle.")
    return numbers


def _rows(path: Path) -> tuple[list[str], Floats, Floats]:
    vehicle: list[str] = []
    rows: list[tuple[float, ...]] = []
    now = "0"
    try:
        for event, element in ElementTree.iterparse(path, events=("start", "end")):
            if event == "start" and element.tag == "timestep":
                now = element.attrib["time"]
            elif event == "end" and element.tag == "vehicle":
                a = element.attrib
                vehicle.append(a["id"])
                row = (now, a["x"], a["y"], a.get("z", 0), a["angle"], a.get("slope", 0), a["speed"])
                rows.append(_finite(row, f"{path.name}: vehicle {a['id']} at time {now} s"))
            elif event == "end" and element.tag == "timestep":
                element.clear()
    except ElementTree.ParseError as error:
        raise InputError(path.name, error, "must be XML of sumo --fcd-output", "Write the file again.") from None
    except KeyError as error:
        raise InputError(
            f"{path.name}: attribute {error}",
            "missing",
            f"every vehicle needs it (time {now} s)",
            "Run sumo with --fcd-output.attributes x,y,z,angle,slope,speed.",
        ) from None
    table = np.array(rows).reshape(-1, 7)
    return vehicle, table[:, 0], table[:, 1:]

"""Kinds of measurements in a log, and what their units are in SI."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

DEGREE = float(np.pi / 180)


class Kind(NamedTuple):
    """What a number of this kind means.

    Attributes:
        group: fix, odometry, heading, relative or message.
        name: of the same quantity in SI units.
        scale: factor that makes it so.
        turn: an angle becomes turn * scale * value + offset.
        offset: rad.
        limit: largest |value| in its own unit that can be meant; beyond it another unit is.
    """

    group: str
    name: str
    scale: float = 1.0
    turn: float = 1.0
    offset: float = 0.0
    limit: float = np.inf


QUARTER = float(np.pi / 2)
KINDS: dict[str, Kind] = {
    "x": Kind("fix", "x"),
    "y": Kind("fix", "y"),
    "z": Kind("fix", "z"),
    "latitude": Kind("fix", "latitude", limit=90.0),
    "longitude": Kind("fix", "longitude", limit=180.0),
    "height": Kind("fix", "height"),
    "vx": Kind("odometry", "vx", limit=500.0),
    "vy": Kind("odometry", "vy", limit=500.0),
    "vz": Kind("odometry", "vz", limit=500.0),
    "speed": Kind("odometry", "speed", limit=500.0),
    "speed_kmh": Kind("odometry", "speed", 1 / 3.6, limit=1800.0),
    "yaw_rate": Kind("odometry", "yaw_rate", limit=35.0),
    "yaw_rate_deg": Kind("odometry", "yaw_rate", DEGREE, limit=2000.0),
    "heading": Kind("heading", "heading", limit=2 * np.pi + 1e-3),
    "heading_deg": Kind("heading", "heading", DEGREE, limit=360.1),
    "compass_deg": Kind("heading", "heading", DEGREE, -1.0, QUARTER, limit=360.1),
    "range": Kind("relative", "range"),
    "azimuth": Kind("relative", "azimuth", limit=2 * np.pi + 1e-3),
    "azimuth_deg": Kind("relative", "azimuth", DEGREE, limit=360.1),
    "bearing": Kind("relative", "bearing", limit=2 * np.pi + 1e-3),
    "bearing_deg": Kind("relative", "bearing", DEGREE, limit=360.1),
    "inclination": Kind("relative", "inclination", limit=np.pi + 1e-3),
    "inclination_deg": Kind("relative", "inclination", DEGREE, limit=180.1),
    "elevation": Kind("relative", "inclination", 1.0, -1.0, QUARTER, limit=np.pi / 2 + 1e-3),
    "elevation_deg": Kind("relative", "inclination", DEGREE, -1.0, QUARTER, limit=90.1),
    "message": Kind("message", "message"),
}
"""Azimuth and heading are anticlockwise from +x (east), compass_deg clockwise from north, bearing anticlockwise from
the observer's heading, inclination from +z, elevation above the horizon. A unit that is not SI is in the name."""
ANGLES = ("heading", "azimuth", "bearing", "inclination")
GROUPS = ("fix", "odometry", "heading", "relative", "message")


def si(kind: str, value: float) -> float:
    """A value of a kind in SI units and in the angle of the same name.

    >>> si("compass_deg", 90.0), round(si("speed_kmh", 36.0), 9)
    (0.0, 10.0)
    """
    k = KINDS[kind]
    return k.turn * k.scale * value + k.offset

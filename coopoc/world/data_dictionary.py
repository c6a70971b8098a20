"""Data elements of ETSI TS 102 894-2 that CAMs and CPMs share: places, headings, confidences, in integers."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from ..arrays import Floats, Ints
from ..errors import InputError

AXIS, FLATTENING = 6378137.0, 1 / 298.257223563
"""m, and none: WGS84."""
ELLIPSE, LINE = 2.4477, 1.96
"""Standard deviations that hold 95 % in the plane and on a line."""
HEIGHTS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0)
"""m, the classes of an altitude's confidence, and their names."""
CLASSES = tuple("alt-{:03d}-{:02d}".format(*divmod(round(100 * height), 100)) for height in HEIGHTS)
NO_PLACE, LEAST_PLACE = np.array([900000001, 1800000001, 800001]), np.array([-900000000, -1800000000, -100000])
"""Latitude, longitude and altitude: unavailable, and the least of each."""
NO_HEADING = np.array(3601)
Origin = tuple[float, float, float]
"""Latitude and longitude in degrees, and height in m, of the local frame."""


@contextmanager
def coding(field: str, value: object, wrong: str, hint: str) -> Iterator[None]:
    """Errors of a codec, which may be of any class, as an InputError that names the field."""
    try:
        yield
    except Exception as error:
        raise InputError(field, value, f"{wrong} ({error})", hint) from None


def whole(exact: Floats, least: Ints, unavailable: Ints) -> Ints:
    """The nearest integers in the range of an element, which ends before that for unavailable.

    Args:
        exact: in units of the element, NaN where unavailable.
        least: of the range.
        unavailable: that stands for NaN.
    """
    clipped = np.clip(np.rint(exact), least, unavailable - 1)
    return np.where(np.isnan(exact), unavailable, clipped).astype(np.int64)


def exact(elements: Ints, unavailable: Ints) -> Floats:
    """The numbers of elements, NaN where unavailable."""
    return np.where(elements == unavailable, np.nan, elements)


def place_of(position: Floats, origin: Origin) -> Ints:
    """Latitude and longitude in 1e-7 degrees and altitude in cm, of positions (..., 3) m east, north, up of an origin.

    >>> place_of(np.array([10.0, 20.0, 0.5]), (47, 8, 400)).tolist()
    [470001799, 80001315, 40050]
    """
    unit, start = _units(origin)
    return whole(position[..., [1, 0, 2]] / unit + start, LEAST_PLACE, NO_PLACE)


def position_of(place: Ints, origin: Origin) -> Floats:
    """Positions (..., 3) m east, north, up of an origin."""
    unit, start = _units(origin)
    return ((exact(place, NO_PLACE) - start) * unit)[..., [1, 0, 2]]


def heading_of(course: Floats) -> Ints:
    """Headings in 0.1 degrees clockwise from north, of courses in rad from +x, anticlockwise."""
    return whole(np.mod(np.rint(10.0 * (90.0 - np.rad2deg(course))), 3600.0), np.array(0), NO_HEADING)


def course_of(heading: Ints) -> Floats:
    """Courses in rad from +x, anticlockwise, in [-pi, pi)."""
    course: Floats = np.deg2rad(np.mod(270.0 - exact(heading, NO_HEADING) / 10.0, 360.0) - 180.0)
    return course


def confidence(std: tuple[float, float, float]) -> tuple[int, int]:
    """Semi-axis in cm of the ellipse that holds 95 % of the fixes, and class of the height that holds 95 %.

    Args:
        std: m, of a fix.
    """
    axis = min(int(np.ceil(100 * ELLIPSE * max(std[:2]))), 4094)
    return axis, int(np.searchsorted(HEIGHTS, LINE * std[2]))


def received_std(std: tuple[float, float, float]) -> tuple[float, float, float]:
    """Standard deviations of a fix, m, as the receiver gets them by its confidences.

    Args:
        std: m, as the sender has them.

    >>> [round(value, 3) for value in received_std((1.5, 1.5, 1.5))]
    [1.503, 1.503, 2.551]
    """
    axis, place = confidence(std)
    plane = axis / 100 / ELLIPSE
    return plane, plane, float(HEIGHTS[min(place, len(HEIGHTS) - 1)] / LINE)


def reference_position(place: Ints, std: tuple[float, float, float]) -> dict[str, Any]:
    """The ReferencePosition of a place (3,) and of the standard deviations of its fix, m."""
    latitude, longitude, altitude = place.tolist()
    axis, height = confidence(std)
    ellipse = {"semiMajorConfidence": axis, "semiMinorConfidence": axis, "semiMajorOrientation": 0}
    return {
        "latitude": latitude,
        "longitude": longitude,
        "positionConfidenceEllipse": ellipse,
        "altitude": {"altitudeValue": altitude, "altitudeConfidence": [*CLASSES, "outOfRange"][height]},
    }


def referenced_place(position: dict[str, Any]) -> Ints:
    """Place (3,) of a ReferencePosition."""
    return np.array([position["latitude"], position["longitude"], position["altitude"]["altitudeValue"]])


def _units(origin: Origin) -> tuple[Floats, Floats]:
    """m of a unit of latitude, longitude and altitude at an origin, and the origin in these units."""
    latitude, longitude, height = origin
    sine, eccentric = np.sin(np.deg2rad(latitude)), FLATTENING * (2 - FLATTENING)
    across = AXIS / np.sqrt(1 - eccentric * sine * sine)
    along = across * (1 - eccentric) / (1 - eccentric * sine * sine)
    radii = height + np.array([along, across])
    metres = np.deg2rad(1e-7) * radii * [1.0, np.cos(np.deg2rad(latitude))]
    unit = np.append(metres, 0.01)
    return unit, np.array([latitude * 1e7, longitude * 1e7, height * 100.0])

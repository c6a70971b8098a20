"""Cooperative Awareness Messages (ETSI EN 302 637-2): data elements, PER unaligned by pycrate (extra `etsi`), sizes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ..arrays import Floats, Ints
from ..errors import InputError, MissingLibraryError
from .cam_structure import DIRECTIONS, HEIGHTS, Elements, structure
from .v2x import FIX_AND_VELOCITY, V2X

AXIS, FLATTENING = 6378137.0, 1 / 298.257223563
"""m, and none: WGS84."""
ELLIPSE, LINE = 2.4477, 1.96
"""Standard deviations that hold 95 % in the plane and on a line."""
HEADERS, DIGEST, CERTIFICATE = 44, 96, 220
"""Bytes around a message: BTP-B and GeoNetworking single hop (EN 302 636), security (TS 103 097) with a digest of the
sender's certificate or, once a second, with the certificate."""
Origin = tuple[float, float, float]
"""Latitude and longitude in degrees, and height in m, of the local frame."""


UNAVAILABLE = Elements(
    np.array([900000001, 1800000001, 800001]), np.array(3601), np.array(16383), np.array(32767), np.array(2)
)
LEAST = Elements(np.array([-900000000, -1800000000, -100000]), np.array(0), np.array(0), np.array(-32766), np.array(0))


def to_elements(position: Floats, course: Floats, speed: Floats, yaw_rate: Floats, origin: Origin) -> Elements:
    """Data elements of states.

    Args:
        position: (..., 3) m, east, north, up; NaN where it is unavailable, also below.
        course: (...) rad from +x, anticlockwise.
        speed: (...) m/s, negative in reverse.
        yaw_rate: (...) rad/s, anticlockwise.
        origin: of the local frame.

    >>> found = to_elements(np.array([10.0, 20.0, 0.5]), np.array(0.1), np.array(12.344), np.array(0.0), (47, 8, 400))
    >>> found.place.tolist(), int(found.heading), int(found.speed)
    ([470001799, 80001315, 40050], 843, 1234)
    """
    unit, start = _units(origin)
    heading = np.mod(np.rint(10.0 * (90.0 - np.rad2deg(course))), 3600.0)
    back = np.where(np.isnan(speed), np.nan, np.less(speed, 0))
    place, rate = position[..., [1, 0, 2]] / unit + start, 100.0 * np.rad2deg(yaw_rate)
    exact = (place, heading, 100.0 * np.abs(speed), rate, back)
    return Elements(*map(_whole, exact, LEAST, UNAVAILABLE))


def from_elements(elements: Elements, origin: Origin) -> tuple[Floats, Floats, Floats, Floats]:
    """Position (..., 3) m, course rad, signed speed m/s and yaw rate rad/s as a receiver reads them; NaN: unavailable.

    >>> elements = to_elements(np.zeros(3), np.array(0.1), np.array(1.0), np.array(np.nan), (47, 8, 400))
    >>> [float(np.round(one, 4)) for one in from_elements(elements, (47, 8, 400))[1:]]
    [0.0995, 1.0, nan]
    """
    place, heading, speed, rate, back = (
        np.where(one == missing, np.nan, one) for one, missing in zip(elements, UNAVAILABLE, strict=True)
    )
    unit, start = _units(origin)
    position = ((place - start) * unit)[..., [1, 0, 2]]
    course = np.deg2rad(np.mod(270.0 - heading / 10.0, 360.0) - 180.0)
    return position, course, (1.0 - 2.0 * np.nan_to_num(back)) * speed / 100.0, np.deg2rad(rate / 100.0)


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


def encode(elements: Elements, std: tuple[float, float, float], instant: float = 0.0, path: int = 0) -> bytes:
    """One CAM of a passenger car in PER unaligned.

    Args:
        elements: of one state.
        std: m, of its fix.
        instant: s.
        path: points, up to 40, of a path history in a low-frequency container, which is due every half second; 0: none.

    Raises:
        InputError: numbers that a CAM cannot hold.
        MissingLibraryError: pycrate is not installed.

    >>> state = to_elements(np.array([10.0, 20.0, 0.5]), np.array(0.1), np.array(12.3), np.array(0.0), (47, 8, 400))
    >>> len(encode(state, (1.5, 1.5, 1.5))), len(encode(state, (1.5, 1.5, 1.5), path=10))
    (41, 129)
    """
    codec = _codec()
    try:
        codec.set_val(structure(elements, confidence(std), instant, path))
        return bytes(codec.to_uper())
    except Exception as error:
        raise InputError("elements", elements, f"cannot be encoded ({error})", "Take those of to_elements.") from None


def decode(message: bytes) -> Elements:
    """Data elements of a CAM.

    Args:
        message: in PER unaligned.

    Raises:
        InputError: no CAM.
        MissingLibraryError: pycrate is not installed.

    >>> state = to_elements(np.array([10.0, 20.0, 0.5]), np.array(0.1), np.array(12.3), np.array(0.0), (47, 8, 400))
    >>> decode(encode(state, (1.5, 1.5, 1.5))).place.tolist() == state.place.tolist()
    True
    """
    codec = _codec()
    try:
        codec.from_uper(message)
        content = codec.get_val()["cam"]["camParameters"]
        place, fast = content["basicContainer"]["referencePosition"], content["highFrequencyContainer"][1]
        where = [place["latitude"], place["longitude"], place["altitude"]["altitudeValue"]]
        heading, speed = fast["heading"]["headingValue"], fast["speed"]["speedValue"]
        rate, direction = fast["yawRate"]["yawRateValue"], DIRECTIONS.index(fast["driveDirection"])
    except Exception as error:
        raise InputError("message", f"{len(message)} bytes", f"is no CAM ({error})", "Give PER unaligned.") from None
    return Elements(np.array(where), np.array(heading), np.array(speed), np.array(rate), np.array(direction))


def mean_size(rate: float, path: int = 10) -> float:
    """Mean bytes on air of a car's CAMs at a rate, in Hz, with low-frequency containers and certificates when due."""
    state = to_elements(np.zeros(3), np.array(0.0), np.array(10.0), np.array(0.0), (47.0, 8.0, 400.0))
    short, long = (len(encode(state, (1.5, 1.5, 1.5), path=points)) for points in (0, path))
    slow, signed = min(1.0, 2.0 / rate), min(1.0, 1.0 / rate)
    return HEADERS + short + slow * (long - short) + DIGEST + signed * (CERTIFICATE - DIGEST)


def cam_encoded(max_neighbours: int = 6) -> V2X:
    """`V2X.cam` with the size of an encoded CAM, which holds a fix and a velocity; what a method adds comes on top.

    >>> cam_encoded(6).overhead
    285
    """
    plain = V2X.cam(max_neighbours)
    assert plain.rate is not None
    return replace(plain, overhead=round(mean_size(plain.rate)) - FIX_AND_VELOCITY.payload)


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


def _whole(exact: Floats, least: Ints, unavailable: Ints) -> Ints:
    """The nearest integers in the range of an element, which ends before that for unavailable."""
    clipped = np.clip(np.rint(exact), least, unavailable - 1)
    return np.where(np.isnan(exact), unavailable, clipped).astype(np.int64)


def _codec() -> Any:
    try:
        from pycrate_asn1dir import ITS_CAM_2
    except ImportError:
        raise MissingLibraryError("pycrate", "encoding of CAMs", "'coopoc[etsi]'") from None
    return ITS_CAM_2.CAM_PDU_Descriptions.CAM

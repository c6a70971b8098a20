"""Cooperative Awareness Messages (ETSI EN 302 637-2): data elements, PER unaligned by pycrate (extra `etsi`)."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..arrays import Floats
from ..errors import MissingLibraryError
from .cam_structure import DIRECTIONS, Elements, structure
from .data_dictionary import (
    Origin,
    coding,
    course_of,
    exact,
    heading_of,
    place_of,
    position_of,
    referenced_place,
    whole,
)

NO_SPEED, NO_YAW_RATE, NO_DIRECTION = np.array(16383), np.array(32767), np.array(2)
"""Unavailable."""


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
    back = np.where(np.isnan(speed), np.nan, np.less(speed, 0))
    return Elements(
        place_of(position, origin),
        heading_of(course),
        whole(100.0 * np.abs(speed), np.array(0), NO_SPEED),
        whole(100.0 * np.rad2deg(yaw_rate), np.array(-32766), NO_YAW_RATE),
        whole(back, np.array(0), NO_DIRECTION),
    )


def from_elements(elements: Elements, origin: Origin) -> tuple[Floats, Floats, Floats, Floats]:
    """Position (..., 3) m, course rad, signed speed m/s and yaw rate rad/s as a receiver reads them; NaN: unavailable.

    >>> elements = to_elements(np.zeros(3), np.array(0.1), np.array(1.0), np.array(np.nan), (47, 8, 400))
    >>> [float(np.round(one, 4)) for one in from_elements(elements, (47, 8, 400))[1:]]
    [0.0995, 1.0, nan]
    """
    back = np.nan_to_num(exact(elements.direction, NO_DIRECTION))
    speed = (1.0 - 2.0 * back) * exact(elements.speed, NO_SPEED) / 100.0
    rate = np.deg2rad(exact(elements.yaw_rate, NO_YAW_RATE) / 100.0)
    return position_of(elements.place, origin), course_of(elements.heading), speed, rate


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
    with coding("elements", elements, "cannot be encoded", "Take those of to_elements."):
        codec.set_val(structure(elements, std, instant, path))
        return bytes(codec.to_uper())


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
    with coding("message", f"{len(message)} bytes", "is no CAM", "Give PER unaligned."):
        codec.from_uper(message)
        content = codec.get_val()["cam"]["camParameters"]
        place = referenced_place(content["basicContainer"]["referencePosition"])
        fast = content["highFrequencyContainer"][1]
        heading, speed = fast["heading"]["headingValue"], fast["speed"]["speedValue"]
        rate, direction = fast["yawRate"]["yawRateValue"], DIRECTIONS.index(fast["driveDirection"])
    return Elements(place, np.array(heading), np.array(speed), np.array(rate), np.array(direction))


def _codec() -> Any:
    try:
        from pycrate_asn1dir import ITS_CAM_2
    except ImportError:
        raise MissingLibraryError("pycrate", "encoding of CAMs", "'coopoc[etsi]'") from None
    return ITS_CAM_2.CAM_PDU_Descriptions.CAM

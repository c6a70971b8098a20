"""Collective Perception Messages (ETSI TS 103 324): data elements, PER unaligned by asn1tools (extra `etsi`)."""

from __future__ import annotations

from functools import cache, partial
from importlib.resources import files
from typing import Any

import numpy as np

from ..arrays import Floats, Ints
from ..errors import MissingLibraryError
from .cpm_structure import ABSENT, CPM, OBJECTS, RADAR, SENSORS, VEHICLE, Elements, coordinates, left_out, perceived
from .data_dictionary import (
    LINE,
    NO_HEADING,
    Origin,
    coding,
    course_of,
    heading_of,
    place_of,
    position_of,
    reference_position,
    referenced_place,
    whole,
)

LEAST, NO_CONFIDENCE = np.array(-131072), np.array(4096)


def to_elements(
    position: Floats, course: Floats, identifiers: Ints, vectors: Floats, std: Floats, origin: Origin
) -> Elements:
    """Data elements of what a vehicle perceives.

    Args:
        position: (..., 3) m, east, north, up, of the sender; NaN where it is unavailable, also below.
        course: (...) rad from +x, anticlockwise, of the sender.
        identifiers: (..., n) of the objects.
        vectors: (..., n, 3) m, east, north, up, from the sender to the objects, up to 1,310 m each; NaN for an up that
            was not measured.
        std: (..., n, 3) m, of the vectors' components.
        origin: of the local frame.

    >>> place = np.array([10.0, 20.0, 0.5])
    >>> vectors, std = np.array([[3.004, -4.0, np.nan]]), np.full((1, 3), 0.5)
    >>> found = to_elements(place, np.array(0.1), np.array([7]), vectors, std, (47, 8, 400))
    >>> found.vectors.tolist(), found.confidence.tolist()
    ([[300, -400, 131072]], [[98, 98, 4096]])
    """
    bound = np.clip(np.ceil(100.0 * LINE * np.where(np.isnan(vectors), np.nan, std)), 1, NO_CONFIDENCE - 1)
    return Elements(
        place_of(position, origin),
        heading_of(course),
        identifiers,
        whole(100.0 * vectors, LEAST, np.array(ABSENT)),
        np.where(np.isnan(bound), NO_CONFIDENCE, bound).astype(np.int64),
    )


def from_elements(elements: Elements, origin: Origin) -> tuple[Floats, Floats, Floats, Floats]:
    """Position (..., 3) m and course rad of the sender, vectors (..., n, 3) m to the objects and their standard
    deviations (..., n, 3) m as a receiver reads them; NaN: unavailable or out of range.

    >>> std = np.full((1, 3), 0.5)
    >>> sent = to_elements(np.zeros(3), np.array(0.1), np.array([7]), np.array([[3.004, -4, 0]]), std, (47, 8, 400))
    >>> [np.round(one, 4).tolist() for one in from_elements(sent, (47, 8, 400))[1:]]
    [0.0995, [[3.0, -4.0, 0.0]], [[0.5, 0.5, 0.5]]]
    """
    outside = (elements.vectors <= LEAST) | (elements.vectors >= ABSENT - 1)
    vectors = np.where(outside, np.nan, elements.vectors / 100.0)
    std = np.where(elements.confidence >= NO_CONFIDENCE - 1, np.nan, elements.confidence / (100.0 * LINE))
    return position_of(elements.place, origin), course_of(elements.orientation), vectors, std


def encode(
    elements: Elements,
    std: tuple[float, float, float],
    instant: float = 0.0,
    described: bool = False,
    sensors: bool = False,
) -> bytes:
    """One CPM of a car in PER unaligned.

    Args:
        elements: of one message.
        std: m, of the sender's fix.
        instant: s since 2004.
        described: whether each object has the optional velocity, angle, dimensions, age, quality and class.
        sensors: whether the container of sensors, which is due once a second, is in it.

    Raises:
        InputError: numbers that a CPM cannot hold.
        MissingLibraryError: asn1tools is not installed.

    >>> std = np.full((2, 3), 0.5)
    >>> two = to_elements(np.zeros(3), np.array(0.1), np.arange(2), np.ones((2, 3)), std, (47, 8, 400))
    >>> len(encode(two, (1.5, 1.5, 1.5))), len(encode(two, (1.5, 1.5, 1.5), described=True))
    (70, 110)
    """
    pack = partial(_codec().encode, check_constraints=True)
    with coding("elements", elements, "cannot be encoded", "Take those of to_elements."):
        angle = {"value": int(elements.orientation), "confidence": 127}
        containers = [(VEHICLE, pack("OriginatingVehicleContainer", {"orientationAngle": angle}))]
        if sensors:
            containers.append((SENSORS, pack("SensorInformationContainer", [RADAR])))
        if len(elements.identifiers):
            containers.append((OBJECTS, pack("PerceivedObjectContainer", perceived(elements, described))))
        management = {
            "referenceTime": round(1000 * instant),
            "referencePosition": reference_position(elements.place, std),
        }
        wrapped = [{"containerId": one, "containerData": data} for one, data in containers]
        message = {
            "header": {"protocolVersion": 2, "messageId": CPM, "stationId": 1},
            "payload": {"managementContainer": management, "cpmContainers": wrapped},
        }
        return bytes(pack("CollectivePerceptionMessage", message))


def decode(message: bytes) -> Elements:
    """Data elements of a CPM.

    Args:
        message: in PER unaligned.

    Raises:
        InputError: no CPM, or one with a trailer, correlations, positions on a map, pedestrians or clusters.
        MissingLibraryError: asn1tools is not installed.

    >>> std = np.full((2, 3), 0.5)
    >>> two = to_elements(np.zeros(3), np.array(0.1), np.arange(2), np.ones((2, 3)), std, (47, 8, 400))
    >>> decode(encode(two, (1.5, 1.5, 1.5))).vectors.tolist()
    [[100, 100, 100], [100, 100, 100]]
    """
    codec = _codec()
    with coding("message", f"{len(message)} bytes", "is no CPM", "Give PER unaligned."):
        found = codec.decode("CollectivePerceptionMessage", message)
        if found["header"]["messageId"] != CPM:
            raise ValueError(f"messageId {found['header']['messageId']}")
        payload = found["payload"]
        data = {one["containerId"]: one["containerData"] for one in payload["cpmContainers"]}
        vehicle = codec.decode("OriginatingVehicleContainer", data[VEHICLE]) if VEHICLE in data else {}
        container = codec.decode("PerceivedObjectContainer", data[OBJECTS]) if OBJECTS in data else {}
        if left_out([vehicle, container]):
            raise ValueError("it holds fields that are not read here")
        objects = container.get("perceivedObjects", [])
        vectors, confidence = (
            np.array([coordinates(one["position"], part, missing) for one in objects], dtype=np.int64).reshape(-1, 3)
            for part, missing in (("value", ABSENT), ("confidence", int(NO_CONFIDENCE)))
        )
        return Elements(
            referenced_place(payload["managementContainer"]["referencePosition"]),
            np.array(vehicle.get("orientationAngle", {"value": int(NO_HEADING)})["value"]),
            np.array([one["objectId"] for one in objects], dtype=np.int64),
            vectors,
            confidence,
        )


@cache
def _codec() -> Any:
    """The codec of `cpm.asn`."""
    try:
        import asn1tools
    except ImportError:
        raise MissingLibraryError("asn1tools", "encoding of CPMs", "'coopoc[etsi]'") from None
    return asn1tools.compile_string((files(__package__) / "cpm.asn").read_text(encoding="utf-8"), "uper")

"""Data elements of a CPM, and the fields of a car's containers as `cpm.asn` names them."""

from __future__ import annotations

from typing import Any, NamedTuple

from ..arrays import Ints

CPM = 14
"""Identifier of the message."""
VEHICLE, SENSORS, OBJECTS = 1, 3, 5
"""Identifiers of the containers: the vehicle that sends, its sensors, what it perceives."""
ABSENT = 131072
"""Of a z coordinate that is not sent; one more than a coordinate can be."""
RADAR = {
    "sensorId": 1,
    "sensorType": 1,
    "perceptionRegionShape": (
        "radial",
        {"range": 300, "stationaryHorizontalOpeningAngleStart": 0, "stationaryHorizontalOpeningAngleEnd": 3599},
    ),
    "shadowingApplies": True,
}
"""A sensor that sees 30 m all around."""
DIMENSION, ANGLE, COMPONENT = (
    {"value": value, "confidence": size} for value, size in ((256, 32), (3601, 127), (16383, 127))
)
DESCRIPTION: dict[str, Any] = {
    "velocity": ("cartesianVelocity", {"xVelocity": COMPONENT, "yVelocity": COMPONENT, "zVelocity": COMPONENT}),
    "angles": {"zAngle": ANGLE},
    "objectDimensionZ": DIMENSION,
    "objectDimensionY": DIMENSION,
    "objectDimensionX": DIMENSION,
    "objectAge": 1500,
    "objectPerceptionQuality": 0,
    "classification": [{"objectClass": ("vehicleSubClass", 5), "confidence": 101}],
}
"""What a car may add to an object, unavailable here: it takes the same bits whatever it holds."""


class Elements(NamedTuple):
    """Data elements of a CPM that a localization method may use, integers in the units of ETSI TS 102 894-2.

    Attributes:
        place: of the sender: latitude and longitude in 1e-7 degrees, altitude in cm; 900000001, 1800000001, 800001:
            unavailable.
        orientation: of the sender, 0.1 degrees clockwise from north, 3601: unavailable.
        identifiers: (n,) of the objects, 0..65535.
        vectors: (n, 3) cm east, north and up from the sender to the object; a third of 131072 is not sent.
        confidence: (n, 3) cm that hold 95 %, 4095: more, 4096: unavailable.
    """

    place: Ints
    orientation: Ints
    identifiers: Ints
    vectors: Ints
    confidence: Ints


def perceived(elements: Elements, described: bool) -> dict[str, Any]:
    """The container of perceived objects.

    Args:
        elements: of one message.
        described: whether each object has velocity, angle, dimensions, age, quality and class, too.
    """
    rows = zip(elements.identifiers.tolist(), elements.vectors.tolist(), elements.confidence.tolist(), strict=True)
    objects = [
        {"objectId": name, "measurementDeltaTime": 0, "position": _position(vector, confidence)}
        | (DESCRIPTION if described else {})
        for name, vector, confidence in rows
    ]
    return {"numberOfPerceivedObjects": len(objects), "perceivedObjects": objects}


def _position(vector: list[int], confidence: list[int]) -> dict[str, Any]:
    """A position with its confidences, without z where that is ABSENT."""
    axes = zip("xyz", vector, confidence, strict=True)
    return {f"{axis}Coordinate": {"value": n, "confidence": c} for axis, n, c in axes if axis != "z" or n != ABSENT}


def coordinates(position: dict[str, Any], part: str, missing: int) -> list[int]:
    """`value` or `confidence` of the coordinates of a position.

    Args:
        position: of an object.
        part: which of the two.
        missing: stands for a z that was not sent.
    """
    return [position.get(f"{axis}Coordinate", {part: missing})[part] for axis in "xyz"]


def left_out(value: Any) -> bool:
    """Whether a decoded value holds a field whose type `cpm.asn` leaves out."""
    if isinstance(value, dict):
        return any(map(left_out, value.values()))
    if isinstance(value, list | tuple):
        return any(map(left_out, value))
    return value is None

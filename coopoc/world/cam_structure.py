"""Data elements of a CAM, and the fields of that of a passenger car as pycrate takes them."""

from __future__ import annotations

from typing import Any, NamedTuple

from ..arrays import Ints

POINT = {"pathPosition": {"deltaLatitude": 500, "deltaLongitude": 500, "deltaAltitude": 0}, "pathDeltaTime": 50}
"""Of a path history; a point takes the same bits whatever it holds."""


HEIGHTS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0)
"""m, the classes of an altitude's confidence, and their names."""
CLASSES = tuple("alt-{:03d}-{:02d}".format(*divmod(round(100 * height), 100)) for height in HEIGHTS)
DIRECTIONS = ("forward", "backward", "unavailable")
"""Of the drive; a speed has no sign."""


class Elements(NamedTuple):
    """Data elements of a CAM that a localization method may use, integers in the units of ETSI TS 102 894-2.

    Attributes:
        place: latitude and longitude in 1e-7 degrees, altitude in cm; 900000001, 1800000001, 800001: unavailable.
        heading: 0.1 degrees clockwise from north, 3601: unavailable.
        speed: cm/s, 16383: unavailable.
        yaw_rate: 0.01 degrees/s anticlockwise, 32767: unavailable.
        direction: of the drive, 0 forward, 1 backward, 2: unavailable.
    """

    place: Ints
    heading: Ints
    speed: Ints
    yaw_rate: Ints
    direction: Ints


def structure(elements: Elements, confidence: tuple[int, int], instant: float, path: int) -> dict[str, Any]:
    """The message; what no localization method uses is unavailable.

    Args:
        elements: of one state.
        confidence: semi-axis in cm, and class of the altitude.
        instant: s.
        path: points of a path history, 0 for no low-frequency container.
    """
    parameters: dict[str, Any] = {
        "basicContainer": {"stationType": 5, "referencePosition": _place(elements, *confidence)},
        "highFrequencyContainer": ("basicVehicleContainerHighFrequency", _fast(elements)),
    }
    if path:
        slow = {"vehicleRole": "default", "exteriorLights": (0, 8), "pathHistory": [POINT] * path}
        parameters["lowFrequencyContainer"] = ("basicVehicleContainerLowFrequency", slow)
    return {
        "header": {"protocolVersion": 2, "messageID": 2, "stationID": 1},
        "cam": {"generationDeltaTime": round(1000 * instant) % 65536, "camParameters": parameters},
    }


def _place(elements: Elements, axis: int, height: int) -> dict[str, Any]:
    latitude, longitude, altitude = elements.place.tolist()
    return {
        "latitude": latitude,
        "longitude": longitude,
        "positionConfidenceEllipse": {
            "semiMajorConfidence": axis,
            "semiMinorConfidence": axis,
            "semiMajorOrientation": 0,
        },
        "altitude": {"altitudeValue": altitude, "altitudeConfidence": [*CLASSES, "outOfRange"][height]},
    }


def _fast(elements: Elements) -> dict[str, Any]:
    return {
        "heading": {"headingValue": int(elements.heading), "headingConfidence": 127},
        "speed": {"speedValue": int(elements.speed), "speedConfidence": 127},
        "driveDirection": DIRECTIONS[int(elements.direction)],
        "vehicleLength": {"vehicleLengthValue": 45, "vehicleLengthConfidenceIndication": "noTrailerPresent"},
        "vehicleWidth": 18,
        "longitudinalAcceleration": {
            "longitudinalAccelerationValue": 161,
            "longitudinalAccelerationConfidence": 102,
        },
        "curvature": {"curvatureValue": 1023, "curvatureConfidence": "unavailable"},
        "curvatureCalculationMode": "yawRateUsed",
        "yawRate": {"yawRateValue": int(elements.yaw_rate), "yawRateConfidence": "unavailable"},
    }

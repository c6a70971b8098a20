"""Data elements of a CAM, and the fields of that of a passenger car as pycrate takes them."""

from __future__ import annotations

from typing import Any, NamedTuple

from ..arrays import Ints
from .data_dictionary import reference_position

POINT = {"pathPosition": {"deltaLatitude": 500, "deltaLongitude": 500, "deltaAltitude": 0}, "pathDeltaTime": 50}
"""Of a path history; a point takes the same bits whatever it holds."""

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


def structure(elements: Elements, std: tuple[float, float, float], instant: float, path: int) -> dict[str, Any]:
    """The message; what no localization method uses is unavailable.

    Args:
        elements: of one state.
        std: m, of its fix.
        instant: s.
        path: points of a path history, 0 for no low-frequency container.
    """
    parameters: dict[str, Any] = {
        "basicContainer": {"stationType": 5, "referencePosition": reference_position(elements.place, std)},
        "highFrequencyContainer": ("basicVehicleContainerHighFrequency", _fast(elements)),
    }
    if path:
        slow = {"vehicleRole": "default", "exteriorLights": (0, 8), "pathHistory": [POINT] * path}
        parameters["lowFrequencyContainer"] = ("basicVehicleContainerLowFrequency", slow)
    return {
        "header": {"protocolVersion": 2, "messageID": 2, "stationID": 1},
        "cam": {"generationDeltaTime": round(1000 * instant) % 65536, "camParameters": parameters},
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

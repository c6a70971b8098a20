"""Values and covariances of JRL files as GTSAM orders them: poses, points, numbers, and the types of measurements."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ..arrays import Floats
from ..errors import InputError
from .check import NAME
from .edges import ENDS
from .lines import LARGEST

TURN_FIRST = np.array([3, 4, 5, 0, 1, 2])
"""Where x, y, z and the rotation vector stand in a covariance of GTSAM's Pose3."""
NAMES = {"Pose2": ("x", "y", "theta"), "Point2": ("x", "y"), "Point3": ("x", "y", "z")}


class Type(NamedTuple):
    """A type of measurement.

    Attributes:
        kind: as in `ENDS`.
        dimension: 2 or 3.
        ends: what its vertices are.
        measured: type of the value that it measures, Scalar for a number.
    """

    kind: str
    dimension: int
    ends: tuple[str, ...]
    measured: str


TYPES = {
    tag: Type(kind, d, ends, measured)
    for d in (2, 3)
    for tag, kind, ends, measured in (
        (f"PriorFactorPose{d}", "pose_prior", ENDS["pose_prior"], f"Pose{d}"),
        (f"PriorFactorPoint{d}", "point_prior", ENDS["point_prior"], f"Point{d}"),
        (f"BetweenFactorPose{d}", "relative_pose", ENDS["relative_pose"], f"Pose{d}"),
        (f"RangeFactorPose{d}", "ranges", ("pose", "pose"), "Scalar"),
        (f"RangeFactor{d}D", "ranges", ("pose", "point"), "Scalar"),
    )
}


def get(place: str, item: Any, name: str) -> Any:
    """A member of an object; InputError if there is none."""
    if not isinstance(item, dict) or name not in item:
        raise InputError(
            place, "an object" if isinstance(item, dict) else f"{item!r:.40}", f"must have {name!r}", "Add it."
        )
    return item[name]


def read_value(place: str, measured: str, value: Any) -> Floats:
    """(C,) numbers of a value: x y theta, x y z qx qy qz qw, x y, x y z or a distance."""
    if measured == "Scalar":
        return numbers(place, [get(place, value, "value") if isinstance(value, dict) else value], 1)
    if measured == "Pose3":
        turn = numbers(place, get(place, value, "rotation"), 4)
        return np.concatenate([numbers(place, get(place, value, "translation"), 3), np.roll(turn, -1)])
    return numbers(place, [get(place, value, name) for name in NAMES[measured]], len(NAMES[measured]))


def write_value(measured: str, value: Floats) -> dict[str, Any]:
    """The inverse of `read_value`."""
    if measured == "Scalar":
        return {"type": measured, "value": float(value[0])}
    if measured == "Pose3":
        return {"type": measured, "translation": value[:3].tolist(), "rotation": np.roll(value[3:], 1).tolist()}
    return {"type": measured, **dict(zip(NAMES[measured], value.tolist(), strict=True))}


def read_covariance(place: str, measured: str, value: Any) -> Floats:
    """(D, D) of x, y, theta or x, y, z and the rotation vector, m and rad."""
    size = {"Scalar": 1, "Pose3": 6}.get(measured) or len(NAMES[measured])
    matrix = numbers(place, value, size * size).reshape(size, size)
    return matrix[np.ix_(TURN_FIRST, TURN_FIRST)] if size == 6 else matrix


def write_covariance(covariance: Floats) -> list[float]:
    """The inverse of `read_covariance`, row by row."""
    turned = covariance[np.ix_(TURN_FIRST, TURN_FIRST)] if len(covariance) == 6 else covariance
    return list(map(float, turned.ravel()))


def numbers(place: str, value: Any, count: int) -> Floats:
    """(count,) finite numbers; InputError otherwise."""
    good = isinstance(value, list) and len(value) == count
    if not good or not all(isinstance(v, int | float) and not isinstance(v, bool) and abs(v) <= LARGEST for v in value):
        raise InputError(place, f"{value!r:.60}", f"must be {count} finite numbers", "Mend or remove the measurement.")
    return np.array(value, dtype=np.float64)


def name_of(place: str, key: Any) -> str:
    """Name of a vertex by GTSAM's symbol key, letter * 2^56 + number.

    >>> name_of("a.jrl", (97 << 56) + 5)
    'a5'
    """
    whole = isinstance(key, int) and not isinstance(key, bool) and 0 <= key < 1 << 64
    letter, number = divmod(key, 1 << 56) if whole else (0, 0)
    if not NAME.fullmatch(name := f"{chr(letter)}{number}"):
        raise InputError(place, f"key {key!r:.40}", "must be letter * 2^56 + number", "Use GTSAM's symbols.")
    return name


def key_of(name: str) -> int:
    """The inverse of `name_of`."""
    return (ord(name[0]) << 56) + int(name[1:])

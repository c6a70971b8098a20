"""JRL files (JSON Robot Log): multi-robot graphs by robot and time, as COSMO-Bench distributes them; read only."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..arrays import Floats
from ..errors import InputError, suggestion
from ..file_names import given_path
from .graph import ENDS, NAME, Graph, edges_of
from .values import LARGEST

VALUES = ("groundtruth", "initialization")
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


class _Row(NamedTuple):
    """A measurement."""

    place: str
    names: tuple[str, ...]
    value: Floats
    covariance: Floats
    stamp: float


@dataclass
class _Log:
    """What is read of a file: rows by kind; vertices' roles, stamps and values; where each dimension came first."""

    rows: dict[str, list[_Row]] = field(default_factory=dict)
    roles: dict[str, str] = field(default_factory=dict)
    stamps: dict[str, float] = field(default_factory=dict)
    values: dict[str, Floats] = field(default_factory=dict)
    dimensions: dict[int, str] = field(default_factory=dict)


def read_jrl(path: str | Path, unit: float = 1.0) -> Graph:
    """Graph of a JRL file; the letters of GTSAM's symbols are robots.

    Vertices hold the ground truth, else the initialization, else NaN. A pose has the stamp of its robot's first entry
    that ends at it, or else of the first measurement of it. Known and potential outliers are read as any measurement.

    Args:
        path: an object of measurements by robot, entries {stamp, measurements} whose types are PriorFactor of Pose2,
            Pose3, Point2 and Point3, BetweenFactor of Pose2 and Pose3, RangeFactor of Pose2, Pose3, 2D and 3D; and
            groundtruth and initialization by robot; m and rad.
        unit: s of one unit of the stamps, which are whole numbers: 1e-9 of nanoseconds.

    Raises:
        InputError: no JSON, another type of measurement, what is missing or no finite number, with robot, entry and
            measurement; 2-D beside 3-D; or what `Graph` refuses.

    Source: DATASET_FORMAT.md, MEASUREMENT_FORMAT.md and VALUE_FORMAT.md of github.com/DanMcGann/jrl, and its Parser.

    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "two.jrl"
    >>> near = {"type": "RangeFactorPose2", "key1": 97 << 56, "key2": 98 << 56, "measurement": 2.0, "covariance": [1.0]}
    >>> _ = file.write_text(json.dumps({"measurements": {"a": [{"stamp": 3, "measurements": [near]}]}}))
    >>> read_jrl(file)
    Graph(2-D: 2 poses of 2 robots, 0 points; 1 ranges)
    """
    path, log = given_path(path), _Log()
    whole = _parsed(path)
    for place, robot, stamp, measurement in _measurements(path.name, whole):
        _measure(log, place, robot, unit * stamp, measurement)
    if len(log.dimensions) != 1:
        given = " and ".join(f"{d}-D at {place}" for d, place in log.dimensions.items()) or "0 measurements"
        raise InputError(path.name, given, "must be measurements of one dimension", "Keep 2-D and 3-D apart.")
    (d,) = log.dimensions
    for place, value in _values(path.name, whole):
        name, tag = name_of(place, get(place, value, "key")), str(get(place, value, "type"))
        if tag in (f"Pose{d}", f"Point{d}") and name not in log.values:
            role = log.roles.setdefault(name, tag[:-1].lower())
            if tag[:-1].lower() != role:
                raise InputError(
                    place, f"type {tag}", f"must be a {role}, as measurements of {name} have it", "Mend it."
                )
            log.values[name] = read_value(place, tag, value)
    return _graph(path.name, d, log)


def _measure(log: _Log, place: str, robot: str, stamp: float, measurement: Any) -> None:
    """Add a measurement to the log."""
    known = TYPES.get(tag := str(get(place, measurement, "type")))
    if known is None:
        hint = suggestion(tag, TYPES, "Convert or remove the measurement.")
        raise InputError(place, f"type {tag}", f"must be one of {', '.join(TYPES)}", hint)
    log.dimensions.setdefault(known.dimension, place)
    prior = len(known.ends) == 1
    keys = [get(place, measurement, name) for name in (("key",) if prior else ("key1", "key2"))]
    names = tuple(name_of(place, key) for key in keys)
    for name, role in zip(names, known.ends, strict=True):
        log.roles.setdefault(name, role)
    if names[-1][0] == robot and known.ends[-1] == "pose":
        log.stamps.setdefault(names[-1], stamp)
    value = read_value(place, known.measured, get(place, measurement, "prior" if prior else "measurement"))
    covariance = read_covariance(place, known.measured, get(place, measurement, "covariance"))
    log.rows.setdefault(known.kind, []).append(_Row(place, names, value, covariance, stamp))


def _graph(file: str, d: int, log: _Log) -> Graph:
    names = sorted(log.roles, key=lambda name: (name[0], int(name[1:])))
    poses = [log.roles[name] == "pose" for name in names]
    for rows in log.rows.values():
        for row in rows:
            for name in row.names:
                log.stamps.setdefault(name, row.stamp)
    still = np.zeros(1) if d == 2 else np.eye(4)[3]
    vertices = np.full((len(names), d + len(still)), np.nan)
    for vertex, name, pose in zip(vertices, names, poses, strict=True):
        if not pose:
            vertex[d:] = still
        if name in log.values:
            vertex[: None if pose else d] = log.values[name]
    stamps = [log.stamps.get(name, np.nan) if pose else np.nan for name, pose in zip(names, poses, strict=True)]
    number = {name: row for row, name in enumerate(names)}
    edges: dict[str, Any] = {}
    for kind, rows in log.rows.items():
        nodes = [[number[name] for name in row.names] for row in rows]
        values, covariance = np.array([row.value for row in rows]), np.array([row.covariance for row in rows])
        edges[kind] = edges_of(kind, nodes, values, covariance, [row.stamp for row in rows])

    def origin(kind: str, row: int) -> str:
        return log.rows[kind][row].place if kind in log.rows else f"{file}: vertex {names[row]}"

    position, orientation = vertices[:, :d], vertices[:, d:]
    return Graph(d, tuple(names), np.array(poses), position, orientation, np.array(stamps), **edges, place=origin)


def _parsed(path: Path) -> Mapping[str, Any]:
    if not path.is_file():
        raise InputError("path", path, "must be a file", "Check the path.")
    try:
        whole = json.loads(path.read_text("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise InputError(path.name, error, "must be JSON", "Check that this is the file you meant.") from None
    for name in ("measurements", *VALUES):
        by_robot = get(path.name, whole, name) if name == "measurements" else whole.get(name) or {}
        parts = by_robot.values() if isinstance(by_robot, dict) else [0]
        if not all(isinstance(part, list | dict | None) for part in parts):
            raise InputError(f"{path.name}: {name}", f"{by_robot!r:.40}", "must be lists by robot", "See read_jrl.")
    return dict(whole)


def _measurements(file: str, whole: Mapping[str, Any]) -> Iterator[tuple[str, str, int, Any]]:
    """(place, robot, stamp, measurement) of all entries; a robot without any may have null."""
    for robot, entries in whole["measurements"].items():
        for k, entry in enumerate(entries or []):
            place = f"{file}: robot {robot}, entry {k}"
            stamp = get(place, entry, "stamp")
            if not isinstance(stamp, int) or isinstance(stamp, bool) or not 0 <= stamp < 1 << 64:
                raise InputError(place, f"stamp {stamp!r:.40}", "must be a whole number >= 0", "Mend the stamp.")
            for m, measurement in enumerate(entry.get("measurements") or []):
                yield f"{place}, measurement {m}", robot, stamp, measurement


def _values(file: str, whole: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """(place, value) of the ground truth, then of the initialization: lists, or maps from key to value."""
    for source in VALUES:
        for robot, values in (whole.get(source) or {}).items():
            place = f"{file}: {source} of {robot}"
            if isinstance(values, dict):
                values = [{**value, "key": int(key)} for key, value in values.items() if key.isdecimal()]
            for k, value in enumerate(values or []):
                yield f"{place}, value {k}", value


def get(place: str, item: Any, name: str) -> Any:
    """A member of an object; InputError if there is none."""
    if not isinstance(item, dict) or name not in item:
        given = "an object" if isinstance(item, dict) else f"{item!r:.40}"
        raise InputError(place, given, f"must have {name!r}", "Add it.")
    return item[name]


def read_value(place: str, measured: str, value: Any) -> Floats:
    """(C,) numbers of a value: x y theta, x y z qx qy qz qw, x y, x y z or a distance."""
    if measured == "Scalar":
        return numbers(place, [get(place, value, "value") if isinstance(value, dict) else value], 1)
    if measured == "Pose3":
        turn = numbers(place, get(place, value, "rotation"), 4)
        return np.concatenate([numbers(place, get(place, value, "translation"), 3), np.roll(turn, -1)])
    return numbers(place, [get(place, value, name) for name in NAMES[measured]], len(NAMES[measured]))


def read_covariance(place: str, measured: str, value: Any) -> Floats:
    """(D, D) of x, y, theta or x, y, z and the rotation vector, m and rad."""
    size = {"Scalar": 1, "Pose3": 6}.get(measured) or len(NAMES[measured])
    matrix = numbers(place, value, size * size).reshape(size, size)
    return matrix[np.ix_(TURN_FIRST, TURN_FIRST)] if size == 6 else matrix


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

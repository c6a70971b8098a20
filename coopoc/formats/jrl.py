"""JRL files (JSON Robot Log): multi-robot graphs by robot and time, as COSMO-Bench distributes them."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..arrays import Floats
from ..errors import InputError
from ..file_names import given_path
from ..plugins import suggestion
from .edges import PointEdges, PoseEdges, RangeEdges
from .graph import Graph
from .jrl_values import TYPES, get, name_of, read_covariance, read_value

VALUES = ("groundtruth", "initialization")


@dataclass
class _Rows:
    """What is read of one kind."""

    places: list[str] = field(default_factory=list)
    names: list[tuple[str, ...]] = field(default_factory=list)
    values: list[Floats] = field(default_factory=list)
    covariance: list[Floats] = field(default_factory=list)
    stamps: list[float] = field(default_factory=list)


@dataclass
class _Log:
    """What is read of a file: rows by kind; vertices' roles, stamps and values; where each dimension came first."""

    rows: dict[str, _Rows] = field(default_factory=dict)
    roles: dict[str, str] = field(default_factory=dict)
    stamps: dict[str, float] = field(default_factory=dict)
    at: dict[str, Floats] = field(default_factory=dict)
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
    for place, robot, stamp, one in _measurements(path.name, whole):
        _measure(log, place, robot, unit * stamp, one)
    if len(log.dimensions) != 1:
        given = " and ".join(f"{d}-D at {place}" for d, place in log.dimensions.items()) or "0 measurements"
        raise InputError(path.name, given, "must be measurements of one dimension", "Keep 2-D and 3-D apart.")
    (d,) = log.dimensions
    for place, value in _values(path.name, whole):
        name, tag = name_of(place, get(place, value, "key")), str(get(place, value, "type"))
        if tag in (f"Pose{d}", f"Point{d}") and name not in log.at:
            log.at[name] = read_value(place, tag, value)
            log.roles.setdefault(name, tag[:-1].lower())
    return _graph(path.name, d, log)


def _measure(log: _Log, place: str, robot: str, stamp: float, one: Any) -> None:
    """Add a measurement to the log."""
    known = TYPES.get(tag := str(get(place, one, "type")))
    if known is None:
        hint = suggestion(tag, TYPES, "Convert or remove the measurement.")
        raise InputError(place, f"type {tag}", f"must be one of {', '.join(TYPES)}", hint)
    log.dimensions.setdefault(known.dimension, place)
    keys = [get(place, one, name) for name in (("key",) if len(known.ends) == 1 else ("key1", "key2"))]
    names = tuple(name_of(place, key) for key in keys)
    for name, role in zip(names, known.ends, strict=True):
        log.roles.setdefault(name, role)
    if names[-1][0] == robot and known.ends[-1] == "pose":
        log.stamps.setdefault(names[-1], stamp)
    rows = log.rows.setdefault(known.kind, _Rows())
    rows.places.append(place)
    rows.names.append(names)
    rows.values.append(
        read_value(place, known.measured, get(place, one, "prior" if len(names) == 1 else "measurement"))
    )
    rows.covariance.append(read_covariance(place, known.measured, get(place, one, "covariance")))
    rows.stamps.append(stamp)


def _graph(file: str, d: int, log: _Log) -> Graph:
    names = sorted(log.roles, key=lambda name: (name[0], int(name[1:])))
    poses = [log.roles[name] == "pose" for name in names]
    for rows in log.rows.values():
        for ends, stamp in zip(rows.names, rows.stamps, strict=True):
            for name in ends:
                log.stamps.setdefault(name, stamp)
    still = np.zeros(1) if d == 2 else np.eye(4)[3]
    full = np.full((len(names), d + len(still)), np.nan)
    for row, (name, pose) in enumerate(zip(names, poses, strict=True)):
        value = log.at.get(name, full[row, : None if pose else d])
        full[row] = value if pose else np.append(value, still)
    stamps = [log.stamps.get(name, np.nan) if pose else np.nan for name, pose in zip(names, poses, strict=True)]
    number = {name: row for row, name in enumerate(names)}
    edges: dict[str, Any] = {}
    for kind, rows in log.rows.items():
        nodes, values = [[number[name] for name in ends] for ends in rows.names], np.array(rows.values)
        covariance = np.array(rows.covariance)
        if kind == "ranges":
            edges[kind] = RangeEdges(nodes, values[:, 0], covariance[:, 0, 0], rows.stamps)  # type: ignore[arg-type]
        elif "point" in kind:
            edges[kind] = PointEdges(nodes, values, covariance, rows.stamps)  # type: ignore[arg-type]
        else:
            edges[kind] = PoseEdges(nodes, values[:, :d], values[:, d:], covariance, rows.stamps)  # type: ignore[arg-type]

    def origin(kind: str, row: int) -> str:
        return log.rows[kind].places[row] if kind in log.rows else f"{file}: vertex {names[row]}"

    return Graph(d, tuple(names), poses, full[:, :d], full[:, d:], stamps, place=origin, **edges)  # type: ignore[arg-type]


def _parsed(path: Path) -> Mapping[str, Any]:
    if not path.is_file():
        raise InputError("path", path, "must be a file", "Check the path.")
    try:
        whole = json.loads(path.read_text("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise InputError(path.name, error, "must be JSON", "Check that this is the file you meant.") from None
    for name in ("measurements", *VALUES):
        by_robot = get(path.name, whole, name) if name == "measurements" else whole.get(name) or {}
        if not isinstance(by_robot, dict) or not all(
            isinstance(part, list | dict | None) for part in by_robot.values()
        ):
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
            for m, one in enumerate(entry.get("measurements") or []):
                yield f"{place}, measurement {m}", robot, stamp, one


def _values(file: str, whole: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """(place, value) of the ground truth, then of the initialization: lists, or maps from key to value."""
    for source in VALUES:
        for robot, values in (whole.get(source) or {}).items():
            place = f"{file}: {source} of {robot}"
            if isinstance(values, dict):
                values = [{**value, "key": int(key)} for key, value in values.items() if key.isdecimal()]
            for k, value in enumerate(values or []):
                yield f"{place}, value {k}", value

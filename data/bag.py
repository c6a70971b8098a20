"""ROS 1 and 2 bags as rows of a log: NavSatFix, Odometry, Imu and PoseStamped, one namespace per vehicle."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from coopoc.errors import InputError, MissingLibraryError
from coopoc.plugins import unknown

from .log_rows import Rows, rows_of
from .log_summary import Tally

SUFFIXES = (".bag", ".mcap", ".db3")
READ = {
    "sensor_msgs/msg/NavSatFix": "fix",
    "nav_msgs/msg/Odometry": "odometry",
    "sensor_msgs/msg/Imu": "imu",
    "geometry_msgs/msg/PoseStamped": "pose",
}
POSES = ("nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped")
TRUTH = ("truth", "ground_truth", "groundtruth")
Row = tuple[float, str, str, float, float]
"""Time s, vehicle, kind, value and standard deviation of a number."""


def is_bag(path: Path) -> bool:
    """Whether a path is a bag: a file of ROS 1 or MCAP, or a folder of ROS 2.

    >>> is_bag(Path("drive.bag"))
    True
    """
    return path.suffix.lower() in SUFFIXES or (path / "metadata.yaml").is_file()


def read_bag(path: Path, tally: Tally, ignore: Sequence[str] = (), truth: str = "") -> tuple[Rows, Rows | None]:
    """Rows of the measurements in a bag, and those of the truth, if a topic is named after it.

    The first part of a topic names the vehicle (/car1/fix), the bag's own name where there is only one part. NavSatFix
    gives latitude, longitude, height; Odometry the speed and yaw rate of its twist (its pose has a frame of its own and
    is not used); Imu the yaw of its orientation as heading and the yaw rate, which goes before that of Odometry;
    PoseStamped x, y, z in the frame of the map. The truth is the poses of PoseStamped or Odometry where the topic is
    `truth`, or a part of it is truth or ground_truth. Times are those of the headers, deviations those of the
    covariances.

    Args:
        path: of the bag.
        tally: counts what is not read.
        ignore: topics and kinds that are left out.
        truth: topic of the truth.

    Raises:
        InputError: no bag, none of these messages, or no such topic.
        MissingLibraryError: rosbags is not installed.
    """
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise MissingLibraryError("rosbags", "reading a ROS bag", "'coopoc[ros]'") from None
    rows: list[Row] = []
    true: list[Row] = []
    folder = path.parent if path.suffix == ".db3" else path
    try:
        with AnyReader([folder], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            topics = sorted({c.topic for c in reader.connections})
            for topic in filter(None, [truth, *(one for one in ignore if one.startswith("/"))]):
                if topic not in topics:
                    raise unknown(f"{path.name}: topic", topic, topics)
            wanted = [c for c in reader.connections if c.msgtype in READ and c.topic not in ignore]
            for connection in reader.connections:
                if connection not in wanted:
                    tally.unused(f"{path.name}: topic {connection.topic} ({connection.msgtype})", connection.msgcount)
            for connection, _, raw in reader.messages(connections=wanted) if wanted else ():
                parts = connection.topic.strip("/").split("/")
                name = parts[0] if len(parts) > 1 else path.stem
                message: Any = reader.deserialize(raw, connection.msgtype)
                actual = connection.topic == truth or any(part.lower() in TRUTH for part in parts)
                kind = "actual" if actual and connection.msgtype in POSES else READ[connection.msgtype]
                found = _rows(kind, name, message, tally, f"{path.name}: {connection.topic}")
                (true if actual else rows).extend(row for row in found if row[2].partition(" of ")[0] not in ignore)
    except InputError:
        raise
    except (AnyReaderError, OSError, ValueError, KeyError, AssertionError) as error:
        found_text = next(iter(str(error).splitlines()), type(error).__name__)[:200]
        raise InputError(path.name, found_text, "must be a ROS bag", "Record it again, or reindex it.") from None
    if not rows:
        kinds = ", ".join(kind.rpartition("/")[2] for kind in READ)
        raise InputError(path.name, "0 messages", f"must hold {kinds}", "Check the topics with: ros2 bag info.")
    return _as_rows(path, _one_yaw_rate(rows)), _as_rows(path, true) if true else None


def _rows(kind: str, name: str, m: Any, tally: Tally, place: str) -> list[Row]:
    t = m.header.stamp.sec + m.header.stamp.nanosec * 1e-9
    if kind == "fix":
        if m.status.status < 0 or not np.isfinite([m.latitude, m.longitude]).all():
            tally.refuse("fixes that the receiver calls invalid", 1, place)
            return []
        std = _deviations(m.position_covariance, 3) if m.position_covariance_type else np.full(3, np.nan)
        values = [("latitude", m.latitude, std[1]), ("longitude", m.longitude, std[0])]
        values += [("height", m.altitude, std[2])] if np.isfinite(m.altitude) else []
        return [(t, name, what, float(value), float(s)) for what, value, s in values]
    if kind == "odometry":
        std = _deviations(m.twist.covariance, 6)
        twist = m.twist.twist
        speed, turn = twist.linear.x, twist.angular.z
        return [(t, name, "speed", float(speed), std[0]), (t, name, "yaw_rate of odometry", float(turn), std[5])]
    if kind == "imu":
        std, turn = _deviations(m.orientation_covariance, 3), _deviations(m.angular_velocity_covariance, 3)
        out = (
            [(t, name, "yaw_rate", float(m.angular_velocity.z), turn[2])]
            if m.angular_velocity_covariance[0] >= 0
            else []
        )
        if m.orientation_covariance[0] >= 0 and _yaw(m.orientation) is not None:
            out.append((t, name, "heading", float(_yaw(m.orientation) or 0.0), std[2]))
        return out
    pose = getattr(m.pose, "pose", m.pose)
    p, yaw = pose.position, _yaw(pose.orientation) if kind == "actual" else None
    headings = [] if yaw is None else [(t, name, "heading", yaw, np.nan)]
    return [
        (t, name, axis, float(value), np.nan) for axis, value in zip("xyz", (p.x, p.y, p.z), strict=True)
    ] + headings


def _one_yaw_rate(rows: list[Row]) -> list[Row]:
    """The yaw rate of an Imu goes before that of the same vehicle's odometry."""
    gyros = {name for _, name, kind, _, _ in rows if kind == "yaw_rate"}
    kept = [row for row in rows if row[2] != "yaw_rate of odometry" or row[1] not in gyros]
    return [(t, name, kind.partition(" of ")[0], value, std) for t, name, kind, value, std in kept]


def _as_rows(path: Path, rows: list[Row]) -> Rows:
    t, name, kind, value, std = zip(*rows, strict=True)
    deviation = np.where(np.array(std) > 0, np.array(std, dtype=float), np.nan)
    number = np.arange(1, len(rows) + 1)
    return rows_of(path.name, np.array(t), list(name), list(kind), np.array(value), number, std=deviation)


def _deviations(covariance: Any, size: int) -> Any:
    """Square roots of the diagonal, NaN where it is not positive: zeros mean unknown."""
    diagonal = np.asarray(covariance, dtype=float).reshape(size, size).diagonal()
    return np.sqrt(np.where(diagonal > 0, diagonal, np.nan))


def _yaw(q: Any) -> float | None:
    """Rotation about z, rad; None for a quaternion that is none."""
    length = q.x**2 + q.y**2 + q.z**2 + q.w**2
    if not abs(length - 1) < 0.02:
        return None
    return float(np.arctan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y**2 + q.z**2)))

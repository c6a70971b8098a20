"""ROS 1 and 2 bags as rows of a log: NavSatFix, Odometry, Imu and PoseStamped, one namespace per vehicle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from coopoc.arrays import one_of
from coopoc.errors import InputError, MissingLibraryError, said, unknown

from .cells import numeric
from .log.units import Rows, Summary, rows_of

READ = {
    "sensor_msgs/msg/NavSatFix": "fix",
    "nav_msgs/msg/Odometry": "odometry",
    "sensor_msgs/msg/Imu": "imu",
    "geometry_msgs/msg/PoseStamped": "pose",
}
TRUTH = ("truth", "ground_truth", "groundtruth")
WHEELS = "yaw_rate of odometry"
STAMP = "header.stamp.sec"
"""Column of a topic that was written as a table."""
FIELDS = {
    "latitude": "latitude",
    "longitude": "longitude",
    "altitude": "height",
    "twist.twist.linear.x": "speed",
    "twist.twist.angular.z": "yaw_rate",
    "angular_velocity.z": "yaw_rate",
    **{f"pose.position.{axis}": axis for axis in "xyz"},
}
"""Column of a topic -> kind; deviations of others than fixes are given with std=."""
VARIANCES = {
    f"position_covariance{form.format(k)}": f"{kind}_std"
    for form in ("[{}]", "_{}")
    for k, kind in ((0, "longitude"), (4, "latitude"), (8, "height"))
}
"""Column of a topic, as several programs call it -> deviation; zeros mean unknown."""
Number = tuple[str, float, float]
"""Kind, value and standard deviation."""


def read_bag(
    path: Path,
    summary: Summary,
    *,
    columns: Mapping[str, str],
    kinds: Mapping[str, str],
    ignore: Sequence[str],
    stamps: str = "header",
    truth: str = "",
) -> Rows:
    """Rows of the measurements in a bag.

    The first part of a topic names the vehicle (/car1/fix), the bag's own name where there is only one part. NavSatFix
    gives latitude, longitude, height; Odometry the speed and yaw rate of its twist (its pose has a frame of its own and
    is not used); Imu the yaw of its orientation as heading and the yaw rate, which goes before that of Odometry;
    PoseStamped x, y, z in the frame of the map. The truth is the poses of PoseStamped or Odometry where the topic is
    `truth`, or a part of it is truth or ground_truth. Deviations are those of the covariances.

    Args:
        path: of the bag.
        summary: counts what is not read.
        columns: of tables, as is `kinds`: refused.
        kinds: of tables.
        ignore: topics and kinds that are left out.
        stamps: times, those of the headers or those at which messages were "received".
        truth: topic of the truth, whose rows are marked as true.

    Raises:
        InputError: no bag, none of these messages, or no such topic.
        MissingLibraryError: rosbags is not installed.
    """
    if columns or kinds:
        hint = 'Leave out a topic or a kind by ignore=["/car/pose"]; name the truth\'s by truth="/car/pose".'
        raise InputError("columns, kinds", path.name, "are of tables, and this is a bag", hint)
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise MissingLibraryError("rosbags", "reading a ROS bag", "'coopoc[ros]'") from None
    one_of("stamps", stamps, ("header", "received"))
    rows, behind = list[tuple[Any, ...]](), list[float]()
    folder = path.parent if path.suffix == ".db3" else path
    try:
        with AnyReader([folder], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            topics = {c.topic: c.msgtype in READ and c.topic not in ignore for c in reader.connections}
            for topic in filter(None, [truth, *(name for name in ignore if name.startswith("/"))]):
                if topic not in topics:
                    raise unknown(f"{path.name}: topic", topic, sorted(topics))
            wanted = [c for c in reader.connections if topics[c.topic]]
            for c in reader.connections:
                if not topics[c.topic]:
                    summary.leave(f"{path.name}: topic {c.topic} ({c.msgtype})", c.msgcount)
            for c, received, raw in reader.messages(connections=wanted) if wanted else ():
                parts = c.topic.strip("/").split("/")
                true = c.topic == truth or any(part.lower() in TRUTH for part in parts)
                message: Any = reader.deserialize(raw, c.msgtype)
                numbers = _numbers(READ[c.msgtype], message, true)
                if not numbers and READ[c.msgtype] == "fix":
                    summary.refuse("fixes that the receiver calls invalid", 1, f"{path.name}: {c.topic}")
                t, late = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9, received * 1e-9
                behind.append(late - t)
                t = t if stamps == "header" else late
                name = parts[0] if len(parts) > 1 else path.stem
                for kind, value, std in numbers:
                    if kind.partition(" of ")[0] not in ignore:
                        rows.append((true, t, name, kind, value, std if std > 0 else np.nan))
    except InputError:
        raise
    except Exception as error:  # of rosbags: a damaged file meets them all
        raise InputError(path.name, said(error), "must be a ROS bag", "Record it again, or reindex it.") from None
    if behind:
        other = "received" if stamps == "header" else "header"
        spread = f"between {min(behind):.3g} and {max(behind):.3g} s before they were received"
        summary.assume(f"times are those of stamps={stamps}; headers are {spread} (stamps={other}: by the other)")
    gyros = {row[2] for row in rows if row[3] == "yaw_rate"}
    rows = [row for row in rows if row[3] != WHEELS or row[2] not in gyros]
    frame = pd.DataFrame(rows, columns=["true", "t", "vehicle", "kind", "value", "std"]).replace({WHEELS: "yaw_rate"})
    if frame["true"].all():
        kinds_read = ", ".join(kind.rpartition("/")[2] for kind in READ)
        raise InputError(path.name, "0 messages", f"must hold {kinds_read}", "Check the topics with: ros2 bag info.")
    frame.index = frame.groupby("true").cumcount() + 1
    return rows_of(frame, path.name)


def _numbers(kind: str, m: Any, true: bool) -> list[Number]:
    """What a message holds; its pose where it is the truth's."""
    if kind == "pose" or (kind == "odometry" and true):
        pose = getattr(m.pose, "pose", m.pose)
        numbers = [(axis, float(getattr(pose.position, axis)), np.nan) for axis in "xyz"]
        return numbers + _heading(pose.orientation, np.nan) * true
    if kind == "fix":
        if m.status.status < 0 or not np.isfinite([m.latitude, m.longitude]).all():
            return []
        east, north, up = _deviations(m.position_covariance, 3) if m.position_covariance_type else np.full(3, np.nan)
        values = (("latitude", m.latitude, north), ("longitude", m.longitude, east), ("height", m.altitude, up))
        return [(what, float(value), float(std)) for what, value, std in values if np.isfinite(value)]
    if kind == "odometry":
        std, twist = _deviations(m.twist.covariance, 6), m.twist.twist
        return [("speed", float(twist.linear.x), std[0]), (WHEELS, float(twist.angular.z), std[5])]
    numbers = []
    if m.angular_velocity_covariance[0] >= 0:
        numbers.append(("yaw_rate", float(m.angular_velocity.z), _deviations(m.angular_velocity_covariance, 3)[2]))
    if m.orientation_covariance[0] >= 0:
        numbers += _heading(m.orientation, _deviations(m.orientation_covariance, 3)[2])
    return numbers


def of_topic(frame: pd.DataFrame, file: str, summary: Summary, true: bool) -> pd.DataFrame:
    """A topic that was written as a table, a column per field of the message, as a wide table of a log."""
    nano = next((name for name in ("header.stamp.nanosec", "header.stamp.nsec") if name in frame), None)
    t = numeric(frame, STAMP, file) + (1e-9 * numeric(frame, nano, file) if nano else 0.0)
    if "status.status" in frame:
        invalid = numeric(frame, "status.status", file) < 0
        summary.refuse("fixes that the receiver calls invalid", int(invalid.sum()), file)
        frame, t = frame[~invalid], t[~invalid]
    made = {"t": t}
    if true:
        frame = frame.rename(columns=lambda name: name.replace("pose.pose.", "pose."))
    made |= {kind: numeric(frame, name, file) for name, kind in FIELDS.items() if name in frame}
    for name in filter(frame.__contains__, VARIANCES):
        variance = numeric(frame, name, file)
        made[VARIANCES[name]] = np.sqrt(np.where(variance > 0, variance, np.nan))
    turn = "pose.orientation" if true else "orientation"
    if {f"{turn}.{axis}" for axis in "xyzw"} <= {*frame}:
        made["heading"] = _yaw(*(numeric(frame, f"{turn}.{axis}", file) for axis in "xyzw"))
    return pd.DataFrame(made, index=frame.index)


def _deviations(covariance: Any, size: int) -> Any:
    """Square roots of the diagonal, NaN where it is not positive: zeros mean unknown."""
    diagonal = np.asarray(covariance, dtype=float).reshape(size, size).diagonal()
    return np.sqrt(np.where(diagonal > 0, diagonal, np.nan))


def _heading(q: Any, std: float) -> list[Number]:
    yaw = float(_yaw(q.x, q.y, q.z, q.w))
    return [("heading", yaw, std)] if np.isfinite(yaw) else []


def _yaw(x: Any, y: Any, z: Any, w: Any) -> Any:
    """Rotation about z, rad; NaN for a quaternion that is none."""
    whole = np.abs(x * x + y * y + z * z + w * w - 1) < 0.02
    return np.where(whole, np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)), np.nan)

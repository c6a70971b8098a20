"""ROS 1 and 2 bags as rows of a log: NavSatFix, Odometry, Imu, PoseStamped and Range, one namespace per vehicle."""

import re
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
    "sensor_msgs/msg/Range": "range",
}
INVALID = {
    "fix": "fixes that the receiver calls invalid",
    "range": "ranges outside of what the sensor says it can measure",
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

    The first part of a topic names the vehicle (/car1/fix), the bag's own name where there is only one part; of several
    topics of PoseStamped the first part that differs, as in /vrpn_client_node/robot1/pose of motion capture. NavSatFix
    gives latitude, longitude, height; Odometry the speed and yaw rate of its twist (its pose has a frame of its own and
    is not used); Imu the yaw of its orientation as heading and the yaw rate, which goes before that of Odometry;
    PoseStamped x, y, z in the frame of the map; Range, of topics that differ in two parts, the range from the first to
    the second (/uwb/n_1/n_2/distance), which are the vehicles of the same numbers where none has their names. The truth
    is the poses of PoseStamped or Odometry where the topic is `truth`, or a part of it is truth or ground_truth.
    Deviations are those of the covariances.

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
        raise InputError(
            "columns, kinds",
            path.name,
            "are of tables, and this is a bag",
            'Leave out a topic or a kind by ignore=["/car/pose"]; name the truth\'s by truth="/car/pose".',
        )
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
            of = _vehicles({c.topic: READ[c.msgtype] for c in wanted}, truth, path.stem)
            for c in reader.connections:
                if not topics[c.topic]:
                    summary.leave(f"{path.name}: topic {c.topic} ({c.msgtype})", c.msgcount)
            for c, received, raw in reader.messages(connections=wanted) if wanted else ():
                (name, partner), true = of[c.topic]
                message: Any = reader.deserialize(raw, c.msgtype)
                what, stamp, arrived = READ[c.msgtype], message.header.stamp, received * 1e-9
                numbers = _numbers(what, message, true)
                if not numbers and what in INVALID:
                    summary.refuse(INVALID[what], 1, f"{path.name}: {c.topic}")
                sent = stamp.sec + stamp.nanosec * 1e-9
                behind.append(arrived - sent)
                t = sent if stamps == "header" else arrived
                for kind, value, std in numbers:
                    if kind.partition(" of ")[0] not in ignore:
                        rows.append((true, t, name, partner, kind, value, std))
    except InputError:
        raise
    except Exception as error:  # of rosbags: a damaged file meets them all
        raise InputError(path.name, said(error), "must be a ROS bag", "Record it again, or reindex it.") from None
    if behind:
        other = "received" if stamps == "header" else "header"
        spread = f"between {min(behind):.3g} and {max(behind):.3g} s before they were received"
        summary.assume(f"times are those of stamps={stamps}; headers are {spread} (stamps={other}: by the other)")
    frame = pd.DataFrame(rows, columns=["true", "t", "vehicle", "partner", "kind", "value", "std"])
    gyros = frame["vehicle"][frame["kind"] == "yaw_rate"]
    frame = frame[(frame["kind"] != WHEELS) | ~frame["vehicle"].isin(gyros)].replace({WHEELS: "yaw_rate"})
    frame = _by_number(frame, summary)
    if frame["true"].all():
        kinds_read = ", ".join(kind.rpartition("/")[2] for kind in READ)
        raise InputError(path.name, "0 messages", f"must hold {kinds_read}", "Check the topics with: ros2 bag info.")
    frame.index = frame.groupby("true").cumcount() + 1
    return rows_of(frame, path.name)


def _vehicles(kinds: Mapping[str, str], truth: str, bag: str) -> dict[str, tuple[tuple[str, str], bool]]:
    """Topic -> the vehicle and the partner that it names, and whether it is of the truth.

    >>> topics = {"/mocap/red/pose": "pose", "/mocap/blue/pose": "pose", "/red/odom": "odometry"}
    >>> [names for names, _ in _vehicles(topics, "", "drive").values()]
    [('red', ''), ('blue', ''), ('red', '')]
    """
    parts = {topic: topic.strip("/").split("/") for topic in kinds}
    true = {topic: topic == truth or any(part.lower() in TRUTH for part in of) for topic, of in parts.items()}
    names = {}
    for topic, of in parts.items():
        kind = kinds[topic]
        alike = [parts[other] for other in parts if (kinds[other], true[other]) == (kind, true[topic])]
        differ = [k for k, part in enumerate(zip(*alike, strict=False)) if len(set(part)) > 1]
        if kind == "range":
            ends = (of[differ[0]], of[differ[1]]) if len(differ) > 1 else (of[0], of[-1])
        else:
            ends = of[differ[0] if differ and kind == "pose" else 0] if len(of) > 1 else bag, ""
        names[topic] = ends, true[topic]
    return names


def _by_number(frame: pd.DataFrame, summary: Summary) -> pd.DataFrame:
    """Rows whose ranges are between vehicles of the same numbers where none has the names of their ends."""
    ranges = frame["kind"] == "range"
    numbered = {re.sub(r"\D", "", name): name for name in frame["vehicle"][~ranges].unique()}
    ends = {*frame["vehicle"][ranges], *frame["partner"][ranges]} - {*numbered.values()}
    same = {
        name: numbered[number] for name in sorted(ends) if (number := re.sub(r"\D", "", name)) in numbered and number
    }
    if same:
        summary.assume(f"ends of ranges by their numbers: {', '.join(f'{a} is {b}' for a, b in same.items())}")
    return frame.replace({"vehicle": same, "partner": same})


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
    if kind == "range":
        most = m.max_range if m.max_range > 0 else np.finfo(float).max  # 0: not stated
        valid = max(m.min_range, 0.0) <= m.range <= most
        return [("range", float(m.range), np.nan)] if valid else []
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
        summary.refuse(INVALID["fix"], int(invalid.sum()), file)
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

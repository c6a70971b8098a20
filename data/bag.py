"""ROS 1 and 2 bags as rows of a log: NavSatFix, Odometry, Imu, PoseStamped and Range, one namespace per vehicle."""

import os
import re
from collections.abc import Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from coopoc.arrays import one_of
from coopoc.errors import InputError, MissingLibraryError, said

from .cells import Names
from .log.units import BODY, QUATERNION, Rows, Summary, of_kinds

READ = {
    "sensor_msgs/msg/NavSatFix": "fix latitude longitude altitude status.status position_covariance_type \
position_covariance",
    "nav_msgs/msg/Odometry": "odometry twist.twist.linear.x twist.twist.linear.y twist.twist.linear.z \
twist.twist.angular.z twist.covariance child_frame_id header.frame_id pose.pose.position.x pose.pose.position.y \
pose.pose.position.z pose.pose.orientation.x pose.pose.orientation.y pose.pose.orientation.z pose.pose.orientation.w",
    "sensor_msgs/msg/Imu": "imu angular_velocity.z angular_velocity_covariance orientation.x orientation.y \
orientation.z orientation.w orientation_covariance",
    "geometry_msgs/msg/PoseStamped": "pose pose.position.x pose.position.y pose.position.z pose.orientation.x \
pose.orientation.y pose.orientation.z pose.orientation.w",
    "sensor_msgs/msg/Range": "range range min_range max_range",
}
"""Type of a message -> what it is, and its fields that are read."""
TRUE_NAME = re.compile(r"(^|[_ -])(ground[_ -]?)?(truth|gt)(?=$|[_ -])", re.IGNORECASE)
"""In the stem of a file, or part of a topic, that holds a truth, as truth, span_truth, groundtruth_car1 or robot_GT."""
KINDS_OF_FIELDS = "altitude=height position_covariance_0=longitude_std position_covariance_4=latitude_std \
position_covariance_8=height_std linear.x=speed linear.y=vy_body linear.z=vz_body angular.z=yaw_rate \
twist.covariance_0=speed_std twist.covariance_7=vy_body_std twist.covariance_14=vz_body_std \
twist.covariance_35=yaw_rate_std angular_velocity.z=yaw_rate angular_velocity_covariance_8=yaw_rate_std \
orientation_covariance_8=qw_std orientation.x=qx orientation.y=qy orientation.z=qz orientation.w=qw position.x=x \
position.y=y position.z=z"
"""Field, with the index in it and without twist.twist and pose -> kind, or the deviation whose variance it is; zeros
mean unknown."""
UNMEASURED = {"angular_velocity_covariance_0": ["yaw_rate"], "orientation_covariance_0": QUATERNION}
"""Field -> kinds that are not measured where it is negative."""


def read_bag(
    path: Path,
    summary: Summary,
    *,
    columns: Names,
    kinds: Names,
    ignore: Sequence[str],
    stamps: str = "header",
    truth: str = "",
) -> Rows:
    """Rows of the measurements in a bag.

    The vehicle is the part in which topics of one kind differ (/fleet/car1/fix, /fleet/car2/fix); topics without such a
    part are of one vehicle, named by their common first part, else as the bag. NavSatFix gives latitude, longitude,
    height; Odometry the velocity and yaw rate of its twist, in the body, or in the local frame where child_frame_id is
    frame_id (its pose has a frame of its own and is not used); Imu the yaw of its orientation as heading and the yaw
    rate, which goes before that of Odometry; PoseStamped x, y, z in the frame of the map; Range the range between the
    two vehicles of its topic (/car1/uwb/car2), or those of the same numbers where it has no name of one
    (/uwb/n_1/n_2/distance). The truth is the poses of PoseStamped or Odometry where the topic is `truth`, or differs
    from it in the vehicle alone, or a part of it is named truth, ground_truth or gt. Deviations are those of the
    covariances.

    Args:
        path: of the bag.
        summary: counts what is not read.
        columns: of tables, as is `kinds`: refused.
        kinds: of tables.
        ignore: topics and kinds that are left out.
        stamps: times, those of the headers or those at which messages were "received".
        truth: topic of the truth of one vehicle, whose rows are marked as true, as are those of the others.

    Raises:
        InputError: no bag, none of these messages, or no such topic.
        MissingLibraryError: rosbags is not installed.
    """
    file = path.name
    if columns or kinds:
        raise InputError(
            "columns, kinds",
            file,
            "apply to tables, and this is a bag",
            'Leave out a topic or a kind by ignore=["/car/pose"]; name the truth\'s by truth="/car/pose".',
        )
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise MissingLibraryError("rosbags", "reading a ROS bag", "'coopoc[ros]'") from None
    messages, behind, parts = dict[str, list[Any]](), list[float](), dict[str, Rows]()
    folder = path.parent if path.suffix == ".db3" else path
    try:
        with AnyReader([folder], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            for topic in filter(None, [truth, *(name for name in ignore if name.startswith("/"))]):
                one_of(f"{file}: topic", topic, sorted({c.topic for c in reader.connections}))
            what, fields = {}, {}
            for c in reader.connections:
                if c.msgtype in READ and c.topic not in ignore:
                    what[c.topic], *fields[c.topic] = READ[c.msgtype].split()
                else:
                    summary.unused[f"{file}: topic {c.topic} ({c.msgtype})"] += c.msgcount
            wanted, of = [c for c in reader.connections if c.topic in what], _vehicles(what, truth, path.stem, summary)
            for number, (c, received, raw) in enumerate(reader.messages(connections=wanted) if wanted else (), 1):
                message: Any = reader.deserialize(raw, c.msgtype)
                stamp, arrived = message.header.stamp, received * 1e-9
                sent = stamp.sec + stamp.nanosec * 1e-9
                behind.append(arrived - sent)
                values = attrgetter(*fields[c.topic])(message)
                messages.setdefault(c.topic, []).append((number, sent if stamps == "header" else arrived, *values))
        for topic, table in messages.items():
            frame = pd.DataFrame(table, columns=["number", "t", *fields[topic]]).set_index("number")
            for field in frame.columns[frame.columns.str.endswith("covariance")]:
                frame = frame.join(
                    pd.DataFrame(np.stack(frame.pop(field).tolist()), frame.index).add_prefix(f"{field}_")
                )
            (vehicle, partner, true), where = of[topic], f"{file}: {topic}"
            kinds_read = kinds_of(frame, true, summary, where)
            parts[topic] = of_kinds(kinds_read.assign(vehicle=vehicle, partner=partner, true=true), where)
    except InputError:
        raise
    except Exception as error:  # of rosbags and pandas: a damaged file meets them all
        raise InputError(file, said(error), "must be a ROS bag", "Record it again, or reindex it.") from None
    if behind:
        summary.assume(
            f"times are by stamps={stamps}; headers are between {min(behind):.3g} and {max(behind):.3g} s before they "
            f"were received (stamps={'received' if stamps == 'header' else 'header'} takes the other)"
        )
    if all(rows["true"].all() for rows in parts.values()):
        allowed = f"must hold {', '.join(name.rpartition('/')[2] for name in READ)}"
        raise InputError(file, "0 messages", allowed, "Check the topics with: ros2 bag info.")
    rows = pd.concat(parts).sort_values("row", kind="stable")
    by, turns = rows.index.get_level_values(0).map(what), rows["kind"] == "yaw_rate"
    return rows[~(turns & (by == "odometry") & rows["vehicle"].isin(rows["vehicle"][turns & (by == "imu")]))]


def _vehicles(kinds: Names, truth: str, bag: str, summary: Summary) -> dict[str, tuple[str, str, bool]]:
    """Topic -> the vehicle and the partner that it names, and whether it is of the truth.

    Words in which topics of one kind differ name vehicles if a range has one, or most other topics of their namespace,
    and another kind two, unless they are of fixes; else they are sensors of one vehicle.

    >>> one = {"/gps/fix": "fix"} | dict.fromkeys(["/gps/odom", "/wheel/odom", "/ground_truth/odom"], "odometry")
    >>> set(_vehicles(one, "", "drive", Summary()).values()) == {("drive", "", False), ("drive", "", True)}
    True
    >>> one = {"/car/front/fix": "fix", "/car/rear/fix": "fix", "/car/imu": "imu", "/vicon/car/pose": "pose"}
    >>> set(_vehicles(one, "/vicon/car/pose", "drive", Summary()).values()) == {("car", "", False), ("car", "", True)}
    True
    >>> two = {f"/fleet/{name}/{what}": what for name in ("red", "blue") for what in ("fix", "odometry", "imu")}
    >>> two |= {"/red/uwb/blue": "range", "/red/sonar": "range", "/vicon/red/pose": "pose", "/vicon/blue/pose": "pose"}
    >>> for topic, names in _vehicles(two, "/vicon/red/pose", "drive", Summary()).items():
    ...     print(topic, *names)
    /fleet/red/fix red  False
    /fleet/red/odometry red  False
    /fleet/red/imu red  False
    /fleet/blue/fix blue  False
    /fleet/blue/odometry blue  False
    /fleet/blue/imu blue  False
    /red/uwb/blue red blue False
    /red/sonar drive red False
    /vicon/red/pose red  True
    /vicon/blue/pose blue  True
    >>> anchors = {"/bot/odom": "odometry", "/a/pose": "pose", "/b/pose": "pose", "/uwb/a": "range", "/uwb/b": "range"}
    >>> _vehicles(anchors, "", "drive", Summary())["/uwb/b"]
    ('bot', 'b', False)
    """
    parts = {topic: topic.strip("/").split("/") for topic in kinds}
    true = {topic for topic, of in parts.items() if topic == truth or any(map(TRUE_NAME.search, of))}
    own = {topic: of for topic, of in parts.items() if topic not in true and kinds[topic] != "range"}
    names, ranged = set[str](), {part for topic, of in parts.items() if kinds[topic] == "range" for part in of}
    for kind in {*kinds.values()}:
        alike = [of for topic, of in own.items() if kinds[topic] == kind]
        shared = os.path.commonprefix(alike)  # noqa: RUF071  (of words, not characters)
        words = {of[len(shared)] for of in alike if len(of) > len(shared) + (kind != "pose")}
        met = [
            (kinds[topic], words.intersection(of))
            for topic, of in own.items()
            if kinds[topic] != kind and of[: len(shared)] == shared
        ]
        named = {(other, word) for other, named in met for word in named}
        fleet = kind == "fix" or len(named) > len(dict(named))  # another kind that names two
        most = sum(bool(named) for _, named in met) > len(met) / 2
        if words & ranged or (fleet and most if met else len(words) > 1):
            names |= words
    spaces = {(of[:-1] or [bag])[0] for of in own.values() if names.isdisjoint(of)}
    rest = spaces.pop() if len(spaces) == 1 else bag
    numbered = {number: name for name in sorted(names) if (number := re.sub(r"\D", "", name))}
    names |= {rest}
    vehicles, roles = {}, {topic: [part for part in of if part not in names] for topic, of in parts.items()}
    for topic, of in parts.items():
        known, partner = [part for part in of if part in names], ""
        vehicle = [rest, *known][-1]
        if kinds[topic] == "range":
            for part in of if not known else ():
                if name := numbered.get(re.sub(r"\D", "", part)):
                    summary.assume("ranges name vehicles by their number: {}", f"{part} is {name}")
                    known.append(name)
            vehicle, partner, *_ = known if len(known) > 1 else dict.fromkeys([rest, *known, topic])
        vehicles[topic] = vehicle, partner, topic in true or roles[topic] == roles.get(truth)
    return vehicles


def kinds_of(topic: pd.DataFrame, true: bool, summary: Summary, where: str) -> pd.DataFrame:
    """The times t, kinds and deviations, in columns, of a topic with a column per field; NaN where there is none.

    >>> topic = pd.DataFrame({"t": [0.0], "twist.twist.linear.x": 3.0, "twist.twist.linear.y": 4.0})
    >>> kinds_of(topic, False, Summary(), "/odom").to_dict("records")
    [{'t': 0.0, 'speed': 3.0, 'vy_body': 4.0}]
    >>> frames = {"child_frame_id": "map", "header.frame_id": "map"}
    >>> kinds_of(topic.assign(**frames), False, Summary(), "/odom")["vy"].item()
    4.0
    """
    topic = topic.filter(regex="^(?!twist|child|header)" if true else r"^(?!pose\.(pose|orientation))")
    frames = {*topic.filter(like="frame_id").to_numpy().ravel()}
    kinds = dict(pair.split("=") for pair in KINDS_OF_FIELDS.split())
    topic = topic.rename(columns=lambda name: kinds.get(re.sub(r"^(twist\.twist|pose(\.pose)?)\.", "", name), name))
    for name, unmeasured in UNMEASURED.items():
        if name in topic:
            topic.loc[topic[name] < 0, unmeasured] = np.nan
    reason = "poses that are not finite"
    valid = topic.filter(regex="^(l.*itude|[xyz])$").abs().lt(np.inf).all(axis=1)
    if "status.status" in topic:
        reason, valid = "fixes that the receiver calls invalid", valid & (topic["status.status"] >= 0)
    elif "min_range" in topic:
        most = topic["max_range"].where(topic["max_range"] > 0, np.finfo(float).max)  # 0: not stated
        valid = topic["range"].between(topic["min_range"].clip(0), most)
        reason = "ranges outside the sensor's stated limits"
    summary.refuse(reason, int((~valid).sum()), where)
    variances = topic.filter(regex="_std$").mul(topic.get("position_covariance_type", 1) != 0, axis=0)  # 0: unknown
    topic[variances.columns] = variances.where(variances > 0) ** 0.5
    if len(frames) == 1 and all(frames):
        summary.assume("twists of {}, in the frame of their poses, are velocities in the local frame", where)
        topic = topic.rename(columns=lambda name: name.replace("speed", "vx").replace("_body", ""))
    return topic.loc[valid, topic.any() | ~topic.columns.isin([*BODY[1:], "vz"])]  # zero throughout: not measured

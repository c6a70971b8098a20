"""Inputs of pose methods: egos, first poses, the noise that is assumed, and arguments of the kernel."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ...arrays import Bools, Floats, Ints, checked
from ...errors import InputError
from ...kernels.stars.messages import FORGOTTEN
from ...world.plausible import radians
from ...world.recording import Body, Recording
from ...world.sensors import Sensors
from ...world.v2x import Message

if TYPE_CHECKING:
    from ...kernels.poses.ekf import PoseMeasurements
    from ...kernels.poses.scalar_update import PoseNoise

POSE = Message("pose and covariance", 16)
"""Position and heading (4), covariance (10), id and time (2)."""
UPLOAD = Message("fix, compass, odometry and relative measurements", 10, per_neighbour=4)
"""Fix (3), compass (1), velocity (3), yaw rate (1), id and time (2); of each other vehicle range, angles and id (4)."""
SPREAD = (0.5, 0.5, 0.5, 0.15)
"""m and rad, standard deviations of poses at the first step that are given; of robots that range landmarks 90 % of
those of `pose_start` err by less."""
LEAST_HEADING_STD, LEAST_YAW_RATE_STD = 1e-6, 1e-5
"""rad and rad/s: a filter needs some noise, however exact its sensors are."""
MOST_PAIRS = 200
"""Pairs whose offset of ranges is a state."""


def body_of(recording: Recording) -> Body:
    """Yaw rates and headings of a recording in body frames."""
    assert recording.body is not None
    return recording.body


def present(recording: Recording) -> Bools:
    """(T, N) whether a vehicle is there; landmarks are not."""
    there = recording.present
    there[:, list(recording.landmarks)] = False
    return there


def fleet_members(recording: Recording) -> list[int]:
    """Columns of all vehicles that are there at some step."""
    return np.flatnonzero(present(recording).any(0)).tolist()


def to_landmarks(recording: Recording, links: Ints) -> Ints:
    """Those of some links that measure a landmark."""
    return links[np.isin(recording.links.neighbour[links], recording.landmarks)]


def first_poses(recording: Recording, begin: Floats | None, columns: Sequence[int]) -> Floats:
    """Poses (R, N, 4) m and rad at the first step that were given, NaN where a fix and a compass take their place.

    Args:
        recording: in body frames.
        begin: (N, 4) or (R, N, 4), or None.
        columns: of vehicles whose pose must be known by one of the two.

    Raises:
        InputError: another shape, or an unknown pose.
    """
    shape = (recording.runs, len(recording.ids), 4)
    begin_poses = np.full(shape[1:], np.nan) if begin is None else checked("begin", begin)
    if begin_poses.shape not in (shape, shape[1:]):
        raise InputError(
            "begin",
            f"shape {begin_poses.shape}",
            f"must have shape {shape[1:]} or {shape}",
            "Give one pose per vehicle.",
        )
    radians("headings of begin", begin_poses[..., 3])
    poses = np.ascontiguousarray(np.broadcast_to(begin_poses, shape))
    first = np.concatenate([recording.gnss[:, 0], body_of(recording).heading[:, 0, :, None]], 2)
    lacking = np.isnan(first) & np.isnan(poses) & np.isfinite(recording.velocity[:, 0, :, :1])
    for column in columns:
        if lacking[:, column].any():
            what = f"no {'position' if lacking[:, column, :3].any() else 'heading'} of {recording.ids[column]}"
            hint = "Give begin=, or that of co.pose_start(recording)."
            raise InputError("begin", what, "must be known at the start", hint)
    return poses


def pose_noise(sensors: Sensors, dt: float, gate: float, lasting: bool = True) -> "PoseNoise":
    """What a pose filter assumes of its sensors.

    Args:
        sensors: that a method may know.
        dt: s.
        gate: standard deviations of an innovation beyond which a measurement is left out.
        lasting: whether errors that last are states, where the sensors have any.
    """
    from ...kernels.poses.scalar_update import PoseNoise

    x, y, z = (float(std * std) for std in sensors.fix_std)
    compass = max(float(np.hypot(sensors.heading_std, sensors.heading_bias_std)), LEAST_HEADING_STD)
    a, b, c = (float(std * std) for std in sensors.relative_std)
    lasts = sensors.speed_scale_std, sensors.yaw_rate_bias_std, sensors.range_offset_std, sensors.velocity_bias_std
    scale, bias, offset, slow = (std**2 * lasting for std in lasts)
    return PoseNoise(
        fix=(x, y, z),
        heading=compass**2,
        relative=(a, b, c),
        odometer=sensors.motion_noise(1.0),
        yaw_rate=max(sensors.yaw_rate_std, LEAST_YAW_RATE_STD) ** 2,
        lasting=(scale, bias, offset, slow, slow, slow),
        longer=float(offset > 0),
        keep=float(np.exp(-dt / sensors.odometry_error_time)),
        flat=FORGOTTEN,
        gate=float(gate) * float(gate),
    )


def pose_measurements(
    recording: Recording, members: Sequence[int], links: Ints, kept: Bools | None = None, landmark: Floats | None = None
) -> "PoseMeasurements":
    """Arguments of the kernel.

    Args:
        recording: in body frames.
        members: columns.
        links: indices of their relative measurements.
        kept: (R, links) whether a measurement counts in a run; None for all.
        landmark: (links, 3) m, of what is measured and no member; None: landmarks stand at their fix.
    """
    from ...kernels.poses.ekf import PoseMeasurements

    body, table, number = body_of(recording), recording.links, np.full(len(recording.ids), -1)
    number[list(members)] = np.arange(len(members))
    own = [recording.gnss, body.heading[..., None], recording.velocity, body.yaw_rate[..., None]]
    relative, ends = recording.relative[:, links], number[[table.observer[links], table.neighbour[links]]]
    low, high = np.sort(ends, 0)
    pair = high * (high - 1) // 2 + low + 1
    fixed = np.isfinite(recording.gnss[:, :, members, 0]).max(axis=(0, 1))  # fixes of both show it
    pair *= fixed[ends].all(0) & (low >= 0) & (pair <= MOST_PAIRS)
    return PoseMeasurements(
        np.ascontiguousarray(np.concatenate([values[:, :, members] for values in own], 3)),
        np.ascontiguousarray(present(recording)[:, members]),
        np.column_stack([*ends, pair]),
        np.searchsorted(table.step[links], np.arange(len(recording.t) + 1)),
        recording.gnss[0, 0, table.neighbour[links]] if landmark is None else landmark,
        np.ascontiguousarray(relative if kept is None else np.where(kept[..., None], relative, np.nan)),
        recording.dt,
        np.array([*recording.tags[list(members)], [0.0] * 3]),
    )

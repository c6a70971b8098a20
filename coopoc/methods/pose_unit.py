"""What one unit of a pose filter measures and receives: a vehicle alone, the star of an ego, or the whole fleet."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..arrays import AnyArray, Bools, Floats, Ints
from ..world.inbox import Inbox
from ..world.recording import Recording
from ..world.sensors import Sensors
from ..world.v2x import Message
from .star import ACCELERATION_STD, FORGOTTEN

if TYPE_CHECKING:
    from ..kernels.poses.pose_filter import PoseMemory
    from ..kernels.poses.pose_members import PoseSeen
    from ..kernels.poses.pose_motion import PoseNoise

ODOMETRY = Message("fix, compass, velocity and yaw rate", 10)
"""Fix (3), compass (1), velocity (3), yaw rate (1), id and time (2)."""
POSE = Message("pose and covariance", 16)
"""Position and heading (4), covariance (10), id and time (2)."""
UPLOAD = Message("fix, compass, odometry and relative measurements", 10, per_neighbour=4)
LEAST_HEADING_STD, LEAST_YAW_RATE_STD = 1e-6, 1e-5
"""rad and rad/s: a filter needs some noise, however exact its sensors are."""


class Members(NamedTuple):
    """Members of a unit at all steps.

    Attributes:
        column: (M,) of the recording.
        start: (T+1,) first member of each step.
        newest: (R, M) step of the newest message held, -1 for none.
        fresh: (R, M) whether it is new.
    """

    column: Ints
    start: Ints
    newest: Ints
    fresh: Bools


def alone(recording: Recording, ego: int) -> Members:
    """The ego and what it measures itself."""
    steps = np.arange(len(recording.t))
    newest = np.tile(steps, (recording.runs, 1))
    return Members(np.full(len(steps), ego), np.append(steps, len(steps)), newest, np.ones(newest.shape, dtype=bool))


def star(recording: Recording, ego: int, box: Inbox) -> Members:
    """The ego, and its neighbours with the newest message of each; landmarks are no members."""
    vehicle = ~np.isin(recording.links.neighbour[box.link], recording.landmarks)
    link, own = box.link[vehicle], alone(recording, ego)
    step = np.concatenate([np.arange(len(recording.t)), recording.links.step[link]])
    order = np.argsort(step, kind="stable")
    column = np.concatenate([own.column, recording.links.neighbour[link]])
    newest, fresh = (
        np.concatenate([mine, theirs[:, vehicle]], axis=1)
        for mine, theirs in ((own.newest, box.newest), (own.fresh, box.fresh))
    )
    return _by_step(recording, step[order], column[order], newest[:, order], fresh[:, order])


def fleet(recording: Recording) -> Members:
    """All vehicles that are there, each with what it measures at the step."""
    there = np.isfinite(recording.velocity[0, :, :, 0])
    there[:, list(recording.landmarks)] = False
    step, column = np.nonzero(there)
    newest = np.tile(step, (recording.runs, 1))
    return _by_step(recording, step, column, newest, np.ones(newest.shape, dtype=bool))


def seen(
    recording: Recording, members: Members, links: Ints, kept: Bools | None = None, place: Floats | None = None
) -> PoseSeen:
    """Arguments of the kernel.

    Args:
        recording: in body frames.
        members: of the unit.
        links: indices of the relative measurements of its members.
        kept: (R, links) whether a measurement counts in a run; None for all.
        place: (links, 3) m, of what is measured and no member; None: landmarks stand at their fix.
    """
    from ..kernels.poses.pose_members import PoseSeen

    step = recording.links.step[links]
    relative = recording.relative[:, links]
    if kept is not None:
        relative = np.where(kept[..., None], relative, np.nan)
    observer = _place(recording, members, step, recording.links.observer[links])
    other = _place(recording, members, step, recording.links.neighbour[links])
    body = recording.body
    assert body is not None
    return PoseSeen(
        np.concatenate([recording.gnss, body.heading[..., None], recording.velocity, body.yaw_rate[..., None]], axis=3),
        _packed(members.column),
        _packed(members.start),
        _packed(members.newest),
        _packed(members.fresh),
        _packed(np.stack([observer, other], axis=1)),
        np.searchsorted(step, np.arange(len(recording.t) + 1)),
        np.ascontiguousarray(recording.gnss[0, 0, recording.links.neighbour[links]] if place is None else place),
        np.ascontiguousarray(relative),
        recording.dt,
    )


def memory(most: int, d: int) -> PoseMemory:
    """Room for the state of `most` members of d numbers."""
    from ..kernels.poses.pose_filter import PoseMemory
    from ..kernels.poses.pose_update import new_poses

    return PoseMemory(new_poses(max(most, 2) * d), np.zeros(2 * most))


def grown(kept: PoseMemory, most: int, d: int) -> PoseMemory:
    """The same memory with room for `most` members, itself where there is room."""
    half = len(kept.uses) // 2
    if most <= half:
        return kept
    found, size = memory(2 * most, d), half * d
    found.poses.vector[:3, :size] = kept.poses.vector[:3, :size]
    found.poses.vector[3, :2] = kept.poses.vector[3, :2]
    found.poses.cov[:size, :size] = kept.poses.cov[:size, :size]
    found.uses[:half], found.uses[2 * most : 2 * most + half] = kept.uses[:half], kept.uses[half:]
    return found


def pose_noise(sensors: Sensors, dt: float, gate: float) -> PoseNoise:
    """What a pose filter assumes of its sensors.

    Args:
        sensors: that a method may know.
        dt: s.
        gate: standard deviations of an innovation beyond which a measurement is left out.
    """
    from ..kernels.poses.pose_motion import PoseNoise

    x, y, z = (std * std for std in sensors.fix_std)
    compass = max(float(np.hypot(sensors.heading_std, sensors.heading_bias_std)), LEAST_HEADING_STD)
    a, b, c = (float(std * std) for std in sensors.relative_std)
    of_speed = float(sensors.velocity_reading == "speed")
    return PoseNoise(
        (x, y, z),
        compass**2,
        (a, b, c),
        (sensors.velocity_std_ratio, sensors.velocity_floor, of_speed),
        max(sensors.yaw_rate_std, LEAST_YAW_RATE_STD) ** 2,
        (sensors.speed_scale_std**2, sensors.yaw_rate_bias_std**2),
        float(np.exp(-dt / sensors.odometry_error_time)),
        FORGOTTEN,
        ACCELERATION_STD,
        float(gate),
    )


def _by_step(recording: Recording, step: Ints, column: Ints, newest: Ints, fresh: Bools) -> Members:
    return Members(column, np.searchsorted(step, np.arange(len(recording.t) + 1)), newest, fresh)


def _place(recording: Recording, members: Members, step: Ints, column: Ints) -> Ints:
    """Place of columns among the members of their step, -1 for those that are none."""
    at = np.repeat(np.arange(len(recording.t)), np.diff(members.start))
    found = np.full((len(recording.t), len(recording.ids)), -1, dtype=np.int64)
    found[at, members.column] = np.arange(len(at)) - members.start[at]
    return np.asarray(found[step, column])


def _packed(numbers: AnyArray) -> AnyArray:
    return np.ascontiguousarray(numbers, dtype=bool if numbers.dtype == bool else np.int64)


def places_of(members: Members, column: int) -> Ints:
    """Indices of one member over the drive."""
    return np.flatnonzero(members.column == column)

"""The posterior Cramer-Rao bound of poses: position, heading, and the odometry's errors that last."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from ..arrays import Floats, Ints, instance
from ..errors import InputError
from ..methods.drift_state import require_white
from ..plugins import unknown
from ..world.axes import columns
from ..world.fleet import Fleet
from ..world.frames import body_motion, midway, true_heading, turned
from ..world.links import Links
from ..world.sensing import find_links
from ..world.sensors import Sensors
from ..world.v2x import V2X
from .bounds import checked_noise
from .recursion import Stage, covariances, diagonal, edge_information, steps_of

UNKNOWN_HEADING = 3.0 / np.pi**2
"""rad^-2, information that belongs to the variance of an angle uniform over a turn."""


def pose_bound(
    fleet: Fleet,
    sensors: Sensors,
    ego: int | str,
    v2x: V2X | None = None,
    *,
    information: Literal["star", "fleet"] = "star",
    landmarks: Sequence[int | str] = (),
) -> Floats:
    """Bound covariance of the ego's (x, y, z, heading, ...) at every step, filtering, (T, d, d) m and rad.

    J_t = (F_t J_{t-1}^-1 F_t^T + G_t Q_t G_t^T)^-1 + H_t^T R^-1 H_t (Tichavsky, Muravchik, Nehorai 1998) with the
    derivatives of `PoseFilter`'s motion and measurements at the truth. An error that lasts and acts is one number more,
    in this order: the speed's scale, the yaw rate's bias, the compass's bias. Nothing is known of first positions, of
    first headings that they lie within a turn.

    Args:
        fleet: truth.
        sensors: the noise that acts.
        ego: column or id.
        v2x: K and radius, not loss; None or K = 0: a vehicle alone with its landmarks.
        information: "star": the ego's relative measurements, fixes, compasses and odometry of its neighbours; "fleet":
            all that any vehicle measures.
        landmarks: columns or ids of vehicles that stand at known positions.

    Raises:
        InputError: an acting std of zero, for which the bound is zero; drifting fixes; an ego that is unknown,
            absent or a landmark.

    >>> fleet = Fleet(("a",), [0, 0.1], np.zeros((2, 1, 3)), np.zeros((2, 1, 3)))
    >>> bound = pose_bound(fleet, Sensors(heading_std=0.2), 0)  # at first little is known but one compass
    >>> bool(abs(bound[0, 3, 3] - 1 / (1 / 0.2**2 + 3 / np.pi**2)) < 1e-12)
    True
    """
    if not isinstance(information, str) or information not in ("star", "fleet"):
        raise unknown("information", information, ("star", "fleet"), "For a vehicle alone give K = 0.")
    instance("fleet", fleet, Fleet)
    column = fleet.index(ego)
    if not fleet.present[:, column].all():
        raise InputError("ego", fleet.ids[column], "is absent at some steps", "Choose another or cut the drive.")
    marks = columns("landmarks", landmarks, fleet.ids)
    if column in marks:
        raise InputError("ego", fleet.ids[column], "is a landmark", "Its position is known.")
    if information == "fleet":
        return fleet_pose_bound(fleet, sensors, v2x, landmarks=landmarks)[:, column]
    v2x = checked_noise(fleet, sensors, v2x, bool(marks))
    links = find_links(fleet, [column], v2x.max_neighbours, v2x.radius, sensors.min_range, marks)
    near = links.neighbour[~np.isin(links.neighbour, marks)]
    step = links.step[~np.isin(links.neighbour, marks)]
    members = [np.append(column, near[step == t]) for t in range(len(fleet.t))]
    stages, d = pose_stages(fleet, sensors, links, members)
    return np.stack([cov[:d, :d] for _, cov in covariances(stages, smoothing=False)])


def fleet_pose_bound(
    fleet: Fleet, sensors: Sensors, v2x: V2X | None = None, *, landmarks: Sequence[int | str] = ()
) -> Floats:
    """Bound covariances (T, N, d, d) of all vehicles from all that any measures; NaN where absent and for landmarks.

    Args and errors: as in `pose_bound`.

    >>> fleet = Fleet(("a", "b"), [0, 0.1], np.zeros((2, 2, 3)) + [[[0, 0, 0], [9, 0, 0]]], np.zeros((2, 2, 3)))
    >>> alone, together = (fleet_pose_bound(fleet, Sensors(compass=False), V2X(k))[0, 0, 3, 3] for k in (0, 1))
    >>> bool(together < 0.1 * alone)  # a bearing of a neighbour with a fix gives a heading
    True
    """
    marks = columns("landmarks", landmarks, instance("fleet", fleet, Fleet).ids)
    v2x = checked_noise(fleet, sensors, v2x, bool(marks))
    links = find_links(fleet, range(len(fleet.ids)), v2x.max_neighbours, v2x.radius, sensors.min_range, marks)
    members = [np.setdiff1d(np.flatnonzero(row), marks) for row in fleet.present]
    stages, d = pose_stages(fleet, sensors, links, members)
    out = np.full((*fleet.position.shape[:2], d, d), np.nan)
    for t, cov in covariances(stages, smoothing=False):
        n = len(members[t])
        out[t, members[t]] = cov.reshape(n, d, n, d)[np.arange(n), :, np.arange(n)]
    return out


def pose_stages(fleet: Fleet, sensors: Sensors, links: Links, members: list[Ints]) -> tuple[list[Stage], int]:
    """Every step of the poses of vehicles (columns) that are members of it, and how many numbers a pose has.

    Raises:
        InputError: an exact compass, or fixes whose errors drift.
    """
    require_white(sensors, "the bound of poses")
    if sensors.compass and sensors.heading_std <= 0:
        raise InputError("heading_std", sensors.heading_std, "must be > 0", "Give a small one, or compass=False.")
    acting = (sensors.speed_scale_std, sensors.yaw_rate_bias_std, sensors.heading_bias_std * sensors.compass)
    lasting = [kind for kind, std in enumerate(acting) if std > 0]
    own, d = _own(sensors, lasting), 4 + len(lasting)
    prior = np.concatenate([[0, 0, 0, UNKNOWN_HEADING], 1.0 / np.square([acting[kind] for kind in lasting])])
    motion, process = _motion(fleet, sensors, lasting)
    stages: list[Stage] = []
    for now, previous, edges in steps_of(fleet, links, members):
        t, n = len(stages), len(now)
        gained = edge_information(edges, (n, d), sensors.relative_std) + diagonal(np.tile(own, (n, 1, 1)))
        stages.append(Stage(now, previous, motion[t, now], process[t, now], prior, gained))
    return stages, d


def _own(sensors: Sensors, lasting: list[int]) -> Floats:
    """Information (d, d) of a fix and a compass, which measures its bias with the heading."""
    rows = np.zeros((4, 4 + len(lasting)))
    rows[:4, :4] = np.eye(4)
    if 2 in lasting:
        rows[3, 4 + lasting.index(2)] = 1.0
    weight = np.append(1.0 / np.square(sensors.fix_std), sensors.heading_std**-2.0 if sensors.compass else 0.0)
    return np.asarray((rows.T * weight) @ rows)


def _motion(fleet: Fleet, sensors: Sensors, lasting: list[int]) -> tuple[Floats, Floats]:
    """Derivatives F (T, N, d, d) of th' = th + dt (w - b), p' = p + dt R(th + dt (w - b) / 2) u / (1 + s) at the truth,
    and the covariance Q (T, N, d, d) of its noise."""
    (forward, _), dt, d = body_motion(fleet), fleet.dt, 4 + len(lasting)
    heading = midway(true_heading(fleet))
    moved, shape = dt * turned(forward, heading), heading.shape
    aside = np.stack([-moved[..., 1], moved[..., 0], np.zeros(shape)], axis=-1)
    motion, noise = np.zeros((*shape, d, d)), np.zeros((*shape, d, d))
    motion[...] = np.eye(d)
    motion[..., :3, 3] = aside
    std = sensors.velocity_std(forward)
    for axis, unit in enumerate(np.eye(3)):
        noise[..., :3, axis] = dt * turned(std[..., axis, None] * unit, heading)
    noise[..., :3, 3], noise[..., 3, 3] = 0.5 * dt * sensors.yaw_rate_std * aside, dt * sensors.yaw_rate_std
    keep = float(np.exp(-dt / sensors.odometry_error_time))
    for place, kind in enumerate(lasting, 4):
        if kind == 0:
            motion[..., :3, place] = -moved
        elif kind == 1:
            motion[..., :3, place], motion[..., 3, place] = -0.5 * dt * aside, -dt
        if kind < 2:
            fresh = (sensors.speed_scale_std, sensors.yaw_rate_bias_std)[kind] * np.sqrt(1.0 - keep**2)
            motion[..., place, place], noise[..., place, place] = keep, fresh
    return motion, noise @ noise.swapaxes(-1, -2)

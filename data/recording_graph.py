"""Recording in body frames -> factor graph of the plane, which PyFG and g2o files hold."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from coopoc.arrays import Floats, Ints
from coopoc.errors import InputError
from coopoc.formats import write_graph
from coopoc.formats.graph import Graph, PointEdges, PoseEdges, RangeEdges
from coopoc.world.frames import turned
from coopoc.world.recording import Recording, check_recording

from .log import Log
from .log_poses import check_poses, together

LETTERS = "ABCDEFGHIJKMNOPQRSTUVWXYZ"
"""Of robots; L is that of landmarks."""
UNKNOWN = 1e4
"""rad^2, of a heading that was not measured."""
LEAST = 1e-4
"""m and rad, of odometry and headings, so that no covariance is singular."""


def write_log_graph(log: Log, path: str | Path) -> Graph:
    """Write a log in body frames as .pyfg or .g2o, where all its vehicles are there; vertices hold the truth, else what
    the whole fleet's pose filter estimates.

    Raises:
        InputError: as `recording_graph` and `check_poses`.
    """
    check_recording(log.recording, body=True)
    log, _ = together(log)
    rec, truth = log.recording, log.truth
    moving = [k for k in range(len(rec.ids)) if k not in rec.landmarks]
    poses = np.full((len(rec.t), len(rec.ids), 3), np.nan)
    if truth is not None and truth.heading is not None:
        poses = np.concatenate([truth.position[..., :2], truth.heading[..., None]], axis=2)
    if not np.isfinite(poses[:, moving]).all():
        track = check_poses(log).track
        assert track.heading is not None
        poses[:, moving] = np.concatenate([track.x[0, ..., :2], track.heading[0, ..., None]], axis=2)
    graph = recording_graph(rec, poses)
    write_graph(graph if Path(path).suffix == ".pyfg" else graph.stamped(np.nan), path)
    return graph


def recording_graph(recording: Recording, poses: Floats) -> Graph:
    """Graph of the first run: a pose per vehicle and step, and edges of odometry, relative measurements and fixes.

    Odometry is (v dt) turned by w dt / 2, and w dt. Range and bearing of a landmark are a point in the observer's
    frame, of a vehicle a pose whose rotation is unknown; a range alone is a range. A fix is a prior of a pose. Robots
    are A, B, ... in the order of the ids, landmarks L0, L1, ...; heights are left out.

    Args:
        recording: in body frames, all vehicles there throughout.
        poses: (T, N, 3) m, m, rad, what the vertices hold.

    Raises:
        InputError: a recording in the world frame, more than 25 vehicles, one that is absent at times, or a bearing
            without a range, for which the files have no record.
    """
    rec = check_recording(recording, body=True)
    steps, marks = len(rec.t), list(rec.landmarks)
    moving = [k for k in range(len(rec.ids)) if k not in marks]
    _check(rec, moving)
    place = np.full((steps, len(rec.ids)), -1)
    place[:, moving] = np.arange(len(moving)) * steps + np.arange(steps)[:, None]
    place[:, marks] = len(moving) * steps + np.arange(len(marks))
    robots = [f"{LETTERS[k]}{step}" for k in range(len(moving)) for step in range(steps)]
    of_robots = np.concatenate([poses[:, k] for k in moving])
    seen, points, ranges = _relative(rec, place)
    return Graph(
        2,
        (*robots, *(f"L{k}" for k in range(len(marks)))),
        np.arange(len(robots) + len(marks)) < len(robots),
        np.concatenate([of_robots[:, :2], rec.gnss[0, 0, marks, :2]]),
        np.append(of_robots[:, 2], np.zeros(len(marks)))[:, None],
        np.append(np.tile(rec.t, len(moving)), np.full(len(marks), np.nan)),
        relative_pose=_joined([*(_odometry(rec, k, place[:, k]) for k in moving), seen]),
        relative_point=points,
        ranges=ranges,
        pose_prior=_joined([_fixes(rec, k, place[:, k]) for k in moving]),
    )


def _check(recording: Recording, moving: list[int]) -> None:
    if len(moving) > len(LETTERS):
        hint = f"A robot is a letter there: leave out all but {len(LETTERS)}."
        raise InputError("recording", f"{len(moving)} vehicles", f"must hold at most {len(LETTERS)}", hint)
    for k in moving:
        if not np.isfinite(recording.velocity[0, :, k]).all():
            raise InputError("recording", recording.ids[k], "is absent at some steps", "Take recording.between().")
    alone = np.isfinite(recording.relative[0, :, 1]) & np.isnan(recording.relative[0, :, 0])
    if alone.any():
        allowed = "must have ranges: PyFG and g2o have no record for a bearing"
        raise InputError(
            "recording", f"{alone.sum()} bearings without a range", allowed, 'Read with ignore=["bearing"].'
        )


def _odometry(rec: Recording, k: int, place: Ints) -> PoseEdges:
    """Relative poses of a vehicle from step to step."""
    assert rec.body is not None
    rate, u = rec.body.yaw_rate[0, 1:, k], rec.velocity[0, 1:, k]
    move = turned(rec.dt * u, rec.dt * rate / 2)[:, :2]
    std = rec.dt * np.column_stack([rec.sensors.assumed_velocity_std(u)[:, :2], 0 * rate + rec.sensors.yaw_rate_std])
    nodes = np.column_stack([place[:-1], place[1:]])
    return PoseEdges(nodes, move, (rec.dt * rate)[:, None], _diagonal(np.maximum(std, LEAST) ** 2), rec.t[:-1])


def _relative(rec: Recording, place: Ints) -> tuple[PoseEdges, PointEdges, RangeEdges]:
    """Range and bearing of vehicles, of landmarks, and ranges alone."""
    links, (r, bearing) = rec.links, rec.relative[0, :, :2].T
    nodes = np.column_stack([place[links.step, links.observer], place[links.step, links.neighbour]])
    ahead, stamps, noise = np.column_stack([np.cos(bearing), np.sin(bearing)]), rec.t[links.step], rec.sensors
    aside = np.column_stack([-ahead[:, 1], ahead[:, 0]])
    along, across = (v[:, :, None] * v[:, None, :] for v in (ahead, aside))
    covariance = noise.range_std**2 * along + np.square(r * noise.azimuth_std)[:, None, None] * across
    whole, mark = np.isfinite(r + bearing), np.isin(links.neighbour, rec.landmarks)
    one, other, alone = whole & ~mark, whole & mark, np.isfinite(r) & np.isnan(bearing)
    with_heading = _diagonal(np.full((int(one.sum()), 3), UNKNOWN))
    with_heading[:, :2, :2] = covariance[one]
    vector = r[:, None] * ahead
    return (
        PoseEdges(nodes[one], vector[one], np.zeros((int(one.sum()), 1)), with_heading, stamps[one]),
        PointEdges(nodes[other], vector[other], covariance[other], stamps[other]),
        RangeEdges(nodes[alone], r[alone], np.full(int(alone.sum()), noise.range_std**2), stamps[alone]),
    )


def _fixes(rec: Recording, k: int, place: Ints) -> PoseEdges:
    """Priors of the poses at which a vehicle has a fix, of unknown heading where there is no compass."""
    assert rec.body is not None
    at = np.flatnonzero(np.isfinite(rec.gnss[0, :, k, 0]))
    heading = rec.body.heading[0, at, k]
    turn = np.where(np.isfinite(heading), max(rec.sensors.heading_std, LEAST) ** 2, UNKNOWN)
    variance = np.column_stack([np.tile(np.square(rec.sensors.fix_std[:2]), (len(at), 1)), turn])
    return PoseEdges(
        place[at, None], rec.gnss[0, at, k, :2], np.nan_to_num(heading)[:, None], _diagonal(variance), rec.t[at]
    )


def _joined(parts: list[PoseEdges]) -> PoseEdges:
    names = ("nodes", "position", "orientation", "covariance", "stamps")
    return PoseEdges(*(np.concatenate([getattr(part, name) for part in parts if len(part)] or [()]) for name in names))


def _diagonal(variance: Floats) -> Floats:
    """(M, 3, 3) of (M, 3)."""
    found: Floats = variance[:, :, None] * np.eye(3)
    return found

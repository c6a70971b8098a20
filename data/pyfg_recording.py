"""PyFG -> Recording in body frames: odometry and ranges of several robots, on equal steps, with the file's truth."""

from __future__ import annotations

import numpy as np

from coopoc.arrays import Floats, Ints
from coopoc.errors import InputError
from coopoc.formats.graph import Graph, PointEdges
from coopoc.world.fleet import Fleet
from coopoc.world.frames import midway, turned
from coopoc.world.recording import Recording
from coopoc.world.sensors import Sensors
from coopoc.world.v2x import V2X

from .nearest import nearest, steps_of
from .planar import planar_recording
from .rows import backward_difference

FLAT = 0.01
"""m and rad, of heights and inclinations in a plane, and m/s, least noise of a velocity."""


def graph_recording(graph: Graph, *, dt: float = 0.1) -> tuple[Recording, Fleet]:
    """Recording of the robots of a graph in the plane, in one run, and the truth that its vertices hold.

    Odometry is chained and differenced over steps; a range belongs to the nearest step, and to the robot that is named
    first, and so does a measured point or pose of another robot, as range and bearing. Standard deviations are those of
    the file, for one step. Points are landmarks; messages arrive at once.

    Args:
        graph: of `read_pyfg`, with stamps.
        dt: s, of a step.

    Raises:
        InputError: a graph in space, poses without stamps, a robot whose odometry has a gap, robots that share no time.
    """
    if graph.dimension != 2 or np.isnan(graph.stamps[graph.is_pose]).any():
        raise InputError(
            "graph", repr(graph), "must be in the plane, with stamps", "Take formats and solve for others."
        )
    stamps = {name: graph.stamps[places] for name, places in graph.robots.items()}
    begin, end = max(t[0] for t in stamps.values()), min(t[-1] for t in stamps.values())
    if not end - begin >= 2 * dt:
        raise InputError("graph", repr(graph), "must hold robots that share two steps", "Give a smaller dt.")
    t = dt * np.arange(int((end - begin) / dt) + 1)
    poses = [np.column_stack([graph.position[p], np.unwrap(graph.orientation[p, 0])]) for p in graph.robots.values()]
    path, truth = (
        np.stack([_at(t + begin, s, each) for s, each in zip(stamps.values(), found, strict=True)], axis=1)
        for found in ([_chained(graph, name) for name in stamps], poses)
    )
    marks = np.flatnonzero(~graph.is_pose & np.isfinite(graph.position).all(axis=1))
    ids = (*stamps, *(graph.names[k] for k in marks))
    moved = np.diff(path, axis=0, prepend=path[:1]) / dt
    flat = np.concatenate([moved[..., :2], 0 * moved[..., :1]], axis=2)
    recording = planar_recording(
        ids,
        t,
        (turned(flat, -midway(path[..., 2]))[..., :2], moved[..., 2]),
        graph.position[marks],
        _relative(graph, (marks, len(stamps)), begin, t),
        _sensors(graph, dt),
        V2X(max_neighbours=len(stamps) - 1, radius=float("inf")),
        ("odometry and relative measurements are real; no fix, no compass",),
    )
    return recording, _truth(ids, t, truth, graph.position[marks])


def _truth(ids: tuple[str, ...], t: Floats, poses: Floats, marks: Floats) -> Fleet:
    """Of the robots' poses (T, n, 3) m, m, rad, and of landmarks (m, 2) m, which stand."""
    place = np.broadcast_to(np.column_stack([marks, 0 * marks[:, :1]]), (len(t), len(marks), 3))
    position = np.concatenate([np.append(poses[..., :2], 0 * poses[..., :1], axis=2), place], axis=1)
    heading = np.concatenate([poses[..., 2], 0 * place[..., 0]], axis=1)
    return Fleet(ids, t, position, backward_difference(t, position, ids), name="pyfg", heading=heading)


def _chained(graph: Graph, robot: str) -> Floats:
    """(n, 3) m, m, rad, poses of a robot by its odometry, the first at the origin."""
    places, edges = graph.robots[robot], graph.relative_pose
    after = {int(a): k for k, (a, b) in enumerate(edges.nodes.tolist()) if graph.names[a][0] == graph.names[b][0]}
    path = np.zeros((len(places), 3))
    for n, (place, then) in enumerate(zip(places[:-1].tolist(), places[1:].tolist(), strict=True)):
        k = after.get(place, -1)
        if k < 0 or edges.nodes[k, 1] != then:
            given = f"no odometry from {graph.names[place]} to {graph.names[then]}"
            raise InputError("graph", given, "must join all poses of a robot", "Cut the file at the gap.")
        (x, y, heading), (dx, dy), turn = path[n], edges.position[k], edges.orientation[k, 0]
        c, s = np.cos(heading), np.sin(heading)
        path[n + 1] = x + c * dx - s * dy, y + s * dx + c * dy, heading + turn
    return path


def _at(t: Floats, stamps: Floats, values: Floats) -> Floats:
    return np.column_stack([np.interp(t, stamps, column) for column in values.T])


def _relative(graph: Graph, who: tuple[Ints, int], begin: float, t: Floats) -> Floats:
    """(L, 5) step, observer, neighbour, range m, bearing rad or NaN; of several of a pair at a step the nearest in
    time."""
    marks, robots = who
    column = np.full(len(graph.names), -1)
    for k, places in enumerate(graph.robots.values()):
        column[places] = k
    column[marks] = robots + np.arange(len(marks))
    points, ranges = _vectors(graph), graph.ranges
    ends = column[np.concatenate([points.nodes, ranges.nodes])]
    ends = np.where((ends[:, :1] >= robots) & (ends[:, :1] > ends[:, 1:]), ends[:, ::-1], ends)  # a robot observes
    value = np.column_stack(
        [
            np.concatenate([np.hypot(*points.position.T), ranges.distance]),
            np.append(np.arctan2(*points.position.T[::-1]), np.full(len(ranges), np.nan)),
        ]
    )
    step, late = steps_of(np.append(points.stamps, ranges.stamps) - begin, t[1] - t[0], len(t))
    order = nearest(late, step, np.where(ends[:, 0] < robots, ends[:, 0], -1), ends[:, 1])
    return np.asarray(np.column_stack([step, ends, value])[order])


def _vectors(graph: Graph) -> PointEdges:
    """Points that were measured, and poses of other robots as points."""
    points, poses = graph.relative_point, graph.relative_pose
    other = np.array([graph.names[a][0] != graph.names[b][0] for a, b in poses.nodes.tolist()], dtype=bool)
    return PointEdges(
        np.concatenate([points.nodes, poses.nodes[other]]),
        np.concatenate([points.position, poses.position[other]]),
        np.concatenate([points.covariance, poses.covariance[other, :2, :2]]),
        np.append(points.stamps, poses.stamps[other]),
    )


def _sensors(graph: Graph, dt: float) -> Sensors:
    """Noise that the file states; that of an odometry edge is white, so that its variance grows with its time."""
    edges, stamps = graph.relative_pose, graph.stamps
    lasts = stamps[edges.nodes[:, 1]] - stamps[edges.nodes[:, 0]]
    one = (lasts > 0) & np.array([graph.names[a][0] == graph.names[b][0] for a, b in edges.nodes.tolist()])
    share = dt / lasts[one]
    move, turn = (np.mean(share * edges.covariance[one, k, k]) for k in (0, 2))
    points = _vectors(graph)
    square = np.square(points.position).sum(axis=1)
    ahead = points.position / np.sqrt(np.maximum(square, FLAT**2))[:, None]
    along, whole = np.einsum("mi,mij,mj->m", ahead, points.covariance, ahead), np.trace(points.covariance.T)
    bearing = (whole - along) / np.maximum(square, whole)
    along = np.append(along, graph.ranges.variance)
    return Sensors(
        gnss_std=(1.0, 1.0, FLAT),
        velocity_std_ratio=0.0,
        velocity_floor=max(float(np.sqrt(move)) / dt, FLAT),
        yaw_rate_std=float(np.sqrt(turn)) / dt,
        range_std=float(np.sqrt(np.mean(along))) if len(along) else 1.0,
        azimuth_std=float(np.sqrt(np.mean(bearing))) if len(bearing) else Sensors().azimuth_std,
        inclination_std=FLAT,
        compass=False,
        min_range=0.0,
    )

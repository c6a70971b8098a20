"""PyFG -> Recording in body frames: odometry and ranges of several robots, on equal steps, with the file's truth."""

from itertools import pairwise
from pathlib import Path

import numpy as np

from coopoc import Fleet, InputError, Recording, Sensors
from coopoc.arrays import Bools, Floats, Ints
from coopoc.formats.graph import Graph, PointEdges
from coopoc.formats.pyfg import read_pyfg
from coopoc.world.body_frames import midway, turned

from .assemble import backward_difference, planar_recording
from .log.read import Log, steps_in_words
from .log.units import Summary

FLAT = 0.01
"""m and rad, of heights and inclinations in a plane, and m/s, least noise of a velocity."""


def read_graph_log(path: Path, *, dt: float = 0.1) -> Log:
    """Log of a PyFG file: `graph_recording`, with the counts of what its file holds."""
    graph = read_pyfg(path)
    recording, truth = graph_recording(graph, dt=dt)
    vehicles = {name: "landmark" if k in recording.landmarks else "odometry" for k, name in enumerate(recording.ids)}
    summary = Summary(path.name, steps_in_words(recording), vehicles)
    summary.count("ranges", len(recording.links))
    summary.count("bearings", int(np.isfinite(recording.relative[0, :, 1]).sum()))
    where = "outside the steps that all robots share, beside another of the same pair and step, or between points"
    summary.refuse(f"edges {where}", len(graph.ranges) + len(_vectors(graph)) - len(recording.links))
    summary.refuse("priors", len(graph.pose_prior) + len(graph.point_prior))
    return Log(recording, truth, summary, True)


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
    robots, n = graph.robots, len(graph.robots)
    begin = max(graph.stamps[places[0]] for places in robots.values())
    end = min(graph.stamps[places[-1]] for places in robots.values())
    if not end - begin >= 2 * dt:
        raise InputError("graph", repr(graph), "must hold robots that share two steps", "Give a smaller dt.")
    t = dt * np.arange(int((end - begin) / dt) + 1)

    def on_steps(places: Ints, values: Floats) -> Floats:
        return np.column_stack([np.interp(t + begin, graph.stamps[places], column) for column in values.T])

    path = np.stack([on_steps(places, _chained(graph, places)) for places in robots.values()], axis=1)
    marks = np.flatnonzero(~graph.is_pose & np.isfinite(graph.position).all(axis=1))
    truth, column = np.zeros((len(t), n + len(marks), 4)), np.full(len(graph.names), -1)
    for k, places in enumerate(robots.values()):
        pose = np.column_stack([graph.position[places], np.unwrap(graph.orientation[places, 0])])
        truth[:, k, [0, 1, 3]] = on_steps(places, pose)
        column[places] = k
    truth[:, n:, :2] = graph.position[marks]
    ids = (*robots, *(graph.names[k] for k in marks))
    moved = np.diff(path, axis=0, prepend=path[:1]) / dt
    velocity = turned(moved * [1.0, 1.0, 0.0], -midway(path[..., 2]))[..., :2]
    column[marks] = n + np.arange(len(marks))
    recording = planar_recording(
        ids,
        t,
        velocity,
        moved[..., 2],
        graph.position[marks],
        _relative(graph, column, n, begin),
        _sensors(graph, dt),
        "odometry and relative measurements are real; no fix, no compass",
    )
    position = truth[..., :3]
    return recording, Fleet(ids, t, position, backward_difference(t, position, ids), name="pyfg", heading=truth[..., 3])


def _chained(graph: Graph, places: Ints) -> Floats:
    """(n, 3) m, m, rad, poses of a robot by its odometry, the first at the origin."""
    edges = graph.relative_pose
    edge_of = {(a, b): k for k, (a, b) in enumerate(edges.nodes.tolist())}
    steps = list(pairwise(places.tolist()))
    for first, second in steps:
        if (first, second) not in edge_of:
            raise InputError(
                "graph",
                f"no odometry from {graph.names[first]} to {graph.names[second]}",
                "must join all poses of a robot",
                "Cut the file at the gap.",
            )
    index = [edge_of[step] for step in steps]
    heading = np.concatenate([[0.0], np.cumsum(edges.orientation[index, 0])])
    moved = turned(np.pad(edges.position[index], ((0, 0), (0, 1))), heading[:-1])[:, :2]
    return np.column_stack([np.vstack([np.zeros(2), np.cumsum(moved, axis=0)]), heading])


def _others(graph: Graph) -> Bools:
    """(M,) True for relative poses of another robot."""
    pairs = graph.relative_pose.nodes.tolist()
    return np.array([graph.names[a][0] != graph.names[b][0] for a, b in pairs], dtype=bool)


def _vectors(graph: Graph) -> PointEdges:
    """Points that were measured, and poses of other robots as points."""
    points, poses, other = graph.relative_point, graph.relative_pose, _others(graph)
    return PointEdges(
        np.concatenate([points.nodes, poses.nodes[other]]),
        np.concatenate([points.position, poses.position[other]]),
        np.concatenate([points.covariance, poses.covariance[other, :2, :2]]),
        np.append(points.stamps, poses.stamps[other]),
    )


def _relative(graph: Graph, column: Ints, robots: int, begin: float) -> Floats:
    """(L, 5) s, observer (-1 between points), neighbour, range m, bearing rad or NaN."""
    points, ranges = _vectors(graph), graph.ranges
    ends = column[np.concatenate([points.nodes, ranges.nodes])]
    ends = np.where((ends[:, :1] >= robots) & (ends[:, :1] > ends[:, 1:]), ends[:, ::-1], ends)  # a robot observes
    reach = np.append(np.hypot(*points.position.T), ranges.distance)
    bearing = np.append(np.arctan2(*points.position.T[::-1]), np.full(len(ranges), np.nan))
    observer = np.where(ends[:, 0] < robots, ends[:, 0], -1)
    return np.column_stack([np.append(points.stamps, ranges.stamps) - begin, observer, ends[:, 1], reach, bearing])


def _sensors(graph: Graph, dt: float) -> Sensors:
    """Noise that the file states; that of an odometry edge is white, so that its variance grows with its time, that of
    a point as wide along as across."""
    edges, stamps = graph.relative_pose, graph.stamps
    lasts = stamps[edges.nodes[:, 1]] - stamps[edges.nodes[:, 0]]
    own = (lasts > 0) & ~_others(graph)
    move, turn = (np.sqrt(np.mean(dt / lasts[own] * edges.covariance[own, k, k])) / dt for k in (0, 2))
    points = _vectors(graph)
    square = np.square(points.position).sum(axis=1)
    half = np.trace(points.covariance.T) / 2.0
    bearing, along = half / np.maximum(square, half), np.append(half, graph.ranges.variance)
    return Sensors(
        gnss_std=(1.0, 1.0, FLAT),
        velocity_std_ratio=0.0,
        velocity_floor=max(float(move), FLAT),
        yaw_rate_std=float(turn),
        range_std=float(np.sqrt(np.mean(along))) if len(along) else 1.0,
        azimuth_std=float(np.sqrt(np.mean(bearing))) if len(bearing) else Sensors().azimuth_std,
        inclination_std=FLAT,
        compass=False,
        min_range=0.0,
    )

"""PyFG -> Recording in body frames: odometry and ranges of several robots, on equal steps, with the file's truth."""

from itertools import pairwise
from pathlib import Path

import numpy as np

from coopoc import Fleet, InputError, Recording, Sensors
from coopoc.arrays import Bools, Floats, Ints
from coopoc.formats.graph import Graph
from coopoc.formats.pyfg import read_pyfg
from coopoc.world.body_frames import midway, turned

from .assemble import backward_difference, planar_recording
from .log.read import Log, steps_in_words
from .log.units import Summary

FLAT = 0.01
"""m and rad, of heights and inclinations in a plane, and m/s, least noise of a velocity."""


def read_graph_log(path: Path, *, dt: float = 0.1) -> Log:
    """Log of the robots of a PyFG file in the plane, in one run, with the truth that its vertices hold.

    Odometry is chained and differenced over steps; a range belongs to the nearest step, and to the robot that is named
    first. Standard deviations are those of the file, for one step. Points are landmarks; messages arrive at once.
    Points and poses of other robots that were measured are counted, not used.

    Args:
        path: of the file, with stamps.
        dt: s, of a step.

    Raises:
        InputError: a graph in space, poses without stamps, a robot whose odometry has a gap, robots that share no time.
    """
    graph = read_pyfg(path)
    if graph.dimension != 2 or np.isnan(graph.stamps[graph.is_pose]).any():
        raise InputError(
            "graph", repr(graph), "must be in the plane, with stamps", "Take formats and solve for others."
        )
    robots = graph.robots
    begin = max(graph.stamps[places[0]] for places in robots.values())
    end = min(graph.stamps[places[-1]] for places in robots.values())
    if not end - begin >= 2 * dt:
        raise InputError("graph", repr(graph), "must hold robots that share two steps", "Give a smaller dt.")
    t = dt * np.arange(int((end - begin) / dt) + 1)

    def on_steps(places: Ints, values: Floats) -> Floats:
        return np.column_stack([np.interp(t + begin, graph.stamps[places], column) for column in values.T])

    chained = [on_steps(places, _chained(graph, places)) for places in robots.values()]
    recording, own = _recording(graph, t, begin, np.stack(chained, axis=1))
    ids, poses = recording.ids, np.zeros((len(t), len(recording.ids), 4))
    for k, places in enumerate(robots.values()):
        pose = np.column_stack([graph.position[places], np.unwrap(graph.orientation[places, 0])])
        poses[:, k, [0, 1, 3]] = on_steps(places, pose)
    poses[:, len(robots) :] = np.pad(recording.gnss[0, :, len(robots) :], ((0, 0), (0, 0), (0, 1)))
    position, heading = poses[..., :3], poses[..., 3]
    truth = Fleet(ids, t, position, backward_difference(t, position, ids), name="pyfg", heading=heading)
    vehicles = {name: "landmark" if k in recording.landmarks else "odometry" for k, name in enumerate(ids)}
    summary = Summary(path.name, steps_in_words(recording), vehicles, {"ranges": len(recording.links)})
    where = "outside the steps that all robots share, beside another of the same pair and step, or between points"
    summary.refuse(f"edges {where}", len(graph.ranges) - len(recording.links))
    summary.refuse("measured points and poses of other robots", len(graph.relative_point) + int((~own).sum()))
    summary.refuse("priors", len(graph.pose_prior) + len(graph.point_prior))
    return Log(recording, truth, summary, True)


def _recording(graph: Graph, t: Floats, begin: float, path: Floats) -> tuple[Recording, Bools]:
    """Recording of robots on chained paths (T, n, 3) m, m, rad, and which relative poses are of one robot.

    The noise of an odometry edge is white, so that its variance grows with its time."""
    edges, ranges, dt, n = graph.relative_pose, graph.ranges, t[1] - t[0], path.shape[1]
    marks = np.flatnonzero(~graph.is_pose & np.isfinite(graph.position).all(axis=1))
    column = np.full(len(graph.names), -1)
    for k, places in enumerate(graph.robots.values()):
        column[places] = k
    own = np.equal(*column[edges.nodes].T)
    column[marks] = n + np.arange(len(marks))
    moved = np.diff(path, axis=0, prepend=path[:1]) / dt
    velocity = turned(moved * [1.0, 1.0, 0.0], -midway(path[..., 2]))[..., :2]
    ends = column[ranges.nodes]
    ends = np.where((ends[:, :1] >= n) & (ends[:, :1] > ends[:, 1:]), ends[:, ::-1], ends)  # a robot observes
    observer, none = np.where(ends[:, 0] < n, ends[:, 0], -1), np.full(len(ranges), np.nan)
    lasts = np.diff(graph.stamps[edges.nodes], axis=1)[:, 0]
    used = (lasts > 0) & own
    move, turn = (np.sqrt(np.mean(dt / lasts[used] * edges.covariance[used, k, k])) / dt for k in (0, 2))
    sensors = Sensors(
        gnss_std=(1.0, 1.0, FLAT),
        velocity_std_ratio=0.0,
        velocity_floor=max(float(move), FLAT),
        yaw_rate_std=float(turn),
        range_std=float(np.sqrt(np.mean(ranges.variance))) if len(ranges) else 1.0,
        inclination_std=FLAT,
        compass=False,
        min_range=0.0,
    )
    recording = planar_recording(
        (*graph.robots, *(graph.names[k] for k in marks)),
        t,
        velocity,
        moved[..., 2],
        graph.position[marks],
        np.column_stack([ranges.stamps - begin, observer, ends[:, 1], ranges.distance, none]),
        sensors,
        "odometry and relative measurements are real; no fix, no compass",
    )
    return recording, own


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

"""PyFG in the plane as rows of a log: odometry and ranges of several robots, points, and the poses that are true."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from coopoc import InputError
from coopoc.formats.pyfg import read_pyfg
from coopoc.world.body_frames import turned
from coopoc.world.links import wrap

from .log.units import Rows, Summary, of_kinds

MIN_STD, SAMPLE = 1e-3, 0.1
"""m/s and rad/s, least noise of odometry, and s from one sample of it to the next."""


def read_pyfg_rows(path: Path, summary: Summary, **_: Any) -> Rows:
    """Rows speed and yaw_rate of a robot that moves forward along the edges between its poses, means over equal times;
    range; the places of points; and the truth, which the vertices hold.

    Args:
        path: of the file.
        summary: counts what else was measured.

    Raises:
        InputError: a graph in space, poses without stamps, a robot whose odometry has a gap.
    """
    graph = read_pyfg(path)
    if graph.dimension != 2 or np.isnan(graph.stamps[graph.is_pose]).any():
        raise InputError(
            "graph", repr(graph), "must be in the plane, with stamps", "Take formats and solve for others."
        )
    edges, ranges, marks = graph.relative_pose, graph.ranges, ~graph.is_pose & np.isfinite(graph.position).all(axis=1)
    edge_of, names = {pair: k for k, pair in enumerate(map(tuple, edges.nodes.tolist()))}, [*graph.names]
    parts, used = [], 0
    for robot, places in graph.robots.items():
        index = [edge_of.get(pair, -1) for pair in pairwise(places.tolist())]
        if -1 in index:
            first, second = places[index.index(-1) :][:2]
            raise InputError(
                "graph",
                f"no odometry from {names[first]} to {names[second]}",
                "must join all poses of a robot",
                "Cut the file at the gap.",
            )
        used += len(index)
        for pose in places:
            names[pose] = robot
        turn, stamps = wrap(edges.orientation[index, 0]), graph.stamps[places]
        moved, lasts = turned(np.pad(edges.position[index], ((0, 0), (0, 1))), -0.5 * turn)[:, 0], np.diff(stamps)
        t = np.arange(stamps[0] + SAMPLE, stamps[-1], SAMPLE)  # steps half of it before are there, and have a truth
        for kind, k, each in (("speed", 0, moved), ("yaw_rate", 2, turn)):
            rate = np.diff(np.interp(t, stamps, np.append(0.0, np.cumsum(each)))) / SAMPLE
            std = np.sqrt(np.mean(edges.covariance[index, k, k][lasts > 0] / lasts[lasts > 0]) / SAMPLE)
            parts.append({"t": t[1:] - SAMPLE / 2, "vehicle": robot, kind: rate, f"{kind}_std": max(std, MIN_STD)})
    who, position = np.array(names, object), graph.position
    one, other = who[ranges.nodes.T]
    measured = {"range": ranges.distance, "range_std": np.sqrt(ranges.variance)}
    parts.append({"t": ranges.stamps, "vehicle": one, "partner": other, **measured})
    for rows, more in ((marks, {}), (graph.is_pose, {"heading": graph.orientation[graph.is_pose, 0], "true": 1.0})):
        x, y = position[rows, :2].T
        parts.append({"vehicle": who[rows], "t": graph.stamps[rows], "x": x, "y": y, **more})
    others = (graph.relative_point, graph.pose_prior, graph.point_prior, edges)
    summary.refuse("measured points and poses other than odometry", sum(map(len, others)) - used)
    return of_kinds(pd.concat(map(pd.DataFrame, parts), ignore_index=True), path.name)

"""Real graphs that GTSAM brings: read, solved and added up by GTSAM itself."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest

import coopoc as co
from coopoc.optimize import Status

ALIKE = 1e-3
"""Share by which costs may differ: GTSAM measures the difference of two poses of the plane by (R^T t, theta), not by
its logarithm, and a landmark by bearing and range, not by its place."""
DATA = Path(gtsam.__file__).parent / "Data"


def least(graph: Any, values: Any, first: Any) -> float:
    """Cost of GTSAM's Levenberg-Marquardt with the first pose where the file has it."""
    d = 3 if isinstance(first[1], gtsam.Pose3) else 2
    all_of_it = gtsam.noiseModel.Constrained.All(3 * (d - 1))
    graph.add(getattr(gtsam, f"PriorFactorPose{d}")(*first, all_of_it))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-12)
    parameters.setAbsoluteErrorTol(1e-12)
    return float(graph.error(gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()))


@pytest.mark.parametrize("name", ["goats_15", "goats_16"])
def test_acoustic_ranges_of_an_underwater_vehicle_end_where_gtsam_does(name: str) -> None:
    """Oracle: GTSAM's factors, made here from the lines of the file."""
    lines = [line.split() for line in (DATA / f"{name}.pyfg").read_text().splitlines()]
    graph, values, keys = gtsam.NonlinearFactorGraph(), gtsam.Values(), {}
    for words in lines:
        if words[0].startswith("VERTEX"):
            node = words[2] if words[0] == "VERTEX_SE2" else words[1]
            keys[node] = gtsam.symbol(node[0], int(node[1:]))
        numbers = np.array([float(w) for w in words[4:]]) if words[0].startswith("EDGE") else np.empty(0)
        if words[0] == "VERTEX_SE2":
            values.insert(keys[node], gtsam.Pose2(*map(float, words[3:6])))
        elif words[0] == "VERTEX_XY":
            values.insert(keys[node], gtsam.Point2(*map(float, words[2:4])))
        elif words[0] == "EDGE_SE2":
            i, j, upper = keys[words[2]], keys[words[3]], numbers[3:]
            cov = np.array([upper[[0, 1, 2]], upper[[1, 3, 4]], upper[[2, 4, 5]]])
            noise = gtsam.noiseModel.Gaussian.Covariance(cov)
            graph.add(gtsam.BetweenFactorPose2(i, j, gtsam.Pose2(*numbers[:3]), noise))
        elif words[0] == "EDGE_RANGE":
            noise = gtsam.noiseModel.Isotropic.Variance(1, numbers[1])
            graph.add(gtsam.RangeFactor2D(keys[words[2]], keys[words[3]], numbers[0], noise))
    first = next(words[2] for words in lines if words[0] == "VERTEX_SE2")
    solution, found = co.solve(co.read_graph(DATA / f"{name}.pyfg", objective="geodesic")), gtsam.Values()
    for node, x in zip(solution.names, solution.x, strict=True):
        pose = gtsam.Pose2(x[0], x[1], np.arctan2(x[4], x[2]))
        found.insert(keys[node], gtsam.Point2(x[0], x[1]) if node[0] == "L" else pose)
    still = keys[first], values.atPose2(keys[first])
    assert solution.cost == pytest.approx(least(graph.clone(), found, still), rel=ALIKE)
    assert solution.cost <= least(graph, values, still) * (1 + ALIKE)  # of goats_16 GTSAM stays at six times the cost


@pytest.mark.parametrize("name", ["known_landmark_localization_3.g2o", "Klaus3.g2o", "toyExample.g2o", "w100.graph"])
def test_graphs_that_gtsam_reads_end_where_gtsam_does(name: str, tmp_path: Path) -> None:
    """Oracle: GTSAM's own reader and optimiser."""
    file, planar = DATA / name, name.endswith("graph")
    graph, values = (gtsam.load2D if planar else gtsam.load3D)(str(file))
    if planar:
        file = tmp_path / "w100.g2o"
        gtsam.writeG2o(graph, values, str(file))
    solution = co.solve(co.read_graph(file, objective="geodesic"))
    first = min(values.keys())
    pose = values.atPose2(first) if planar else values.atPose3(first)
    assert solution.status is Status.SOLVED
    assert solution.cost == pytest.approx(least(graph, values, (first, pose)), rel=ALIKE, abs=1e-9)

"""Real factor graphs by us and by plain GTSAM on the same chordal objective: cost, error against truth, seconds.

Run:  python benchmarks/graphs.py ../shared/data/pyfg            (all four, some minutes)
      python benchmarks/graphs.py ../shared/data/pyfg mrclam5a   (one)

GTSAM gets what a user would write: Pose2 variables, FrobeniusBetweenFactorPose2, RangeFactor, Levenberg-Marquardt.
It has no factor for a landmark's position in a pose's frame with our weights, so that landmarks are poses whose
rotation is not measured. CORA's own logs give 75.28 (mrclam5a) and 3152.35 (mrclam6) after rounding.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from pathlib import Path

import gtsam
import numpy as np
from tabulate import tabulate

from coopoc.evaluate.alignment import absolute_error
from coopoc.formats import load_graph
from coopoc.formats.graph import Graph
from coopoc.optimize import Problem, solve
from coopoc.optimize.convex import staircase
from coopoc.optimize.graphs import from_graph

RELAXED = ("mrclam5a", "mrclam6")
"""The staircase of tiers and plaza1 takes more than five minutes."""
UNMEASURED = 1e6
"""Standard deviation of a rotation that a landmark does not have."""


def plain_gtsam(problem: Problem) -> tuple[np.ndarray, float]:
    """Positions (n, 2) and seconds of GTSAM's Levenberg-Marquardt with its own factors."""
    began = time.perf_counter()
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    x0 = problem.x0
    for k, row in enumerate(x0):
        values.insert(k, gtsam.Pose2(row[0], row[1], float(np.arctan2(row[4], row[2]))))
    first = problem.fixed[0]
    graph.add(gtsam.PriorFactorPose2(first, values.atPose2(first), gtsam.noiseModel.Constrained.All(3)))
    for k in set(range(len(x0))) - set(problem.poses):
        graph.add(
            gtsam.PriorFactorPose2(
                k, values.atPose2(k), gtsam.noiseModel.Diagonal.Sigmas([UNMEASURED, UNMEASURED, 1.0])
            )
        )
    for factor in problem.factors:
        std = np.broadcast_to(factor.std, (len(factor.nodes), factor.size))
        for (i, j), z, s in zip(factor.nodes.tolist(), factor.z, std, strict=True):
            if factor.kind == "range":
                graph.add(gtsam.RangeFactorPose2(i, j, z[0], gtsam.noiseModel.Isotropic.Sigma(1, s[0])))
                continue
            landmark = factor.kind == "relative_position"
            turn, angle = (UNMEASURED, 0.0) if landmark else (s[2], float(np.arctan2(z[4], z[2])))
            sigmas = [turn, turn, UNMEASURED, turn, turn, UNMEASURED, s[0], s[1], UNMEASURED]
            model = gtsam.noiseModel.Diagonal.Sigmas(np.array(sigmas))
            graph.add(gtsam.FrobeniusBetweenFactorPose2(i, j, gtsam.Pose2(z[0], z[1], angle), model))
    found = gtsam.LevenbergMarquardtOptimizer(graph, values, gtsam.LevenbergMarquardtParams()).optimize()
    seconds = time.perf_counter() - began
    poses = [found.atPose2(k) for k in range(len(x0))]
    x = np.array(
        [[p.x(), p.y(), np.cos(p.theta()), -np.sin(p.theta()), np.sin(p.theta()), np.cos(p.theta())] for p in poses]
    )
    x[[k for k in range(len(x0)) if k not in set(problem.poses)], 2:] = [1.0, 0.0, 0.0, 1.0]
    return x, seconds


def error(graph: Graph, position: np.ndarray) -> float:
    """ATE: rms of the poses after SE(2) alignment, m."""
    return float(absolute_error(position[graph.is_pose], graph.position[graph.is_pose]).rmse)


def rows(path: Path) -> Iterator[list[object]]:
    """One row per solver: ours and GTSAM's from chained odometry, and ours from a relaxation that needs no start."""
    graph = load_graph(path)
    problem = from_graph(graph)
    size = str(len(problem.names))
    ours = solve(problem, throw=False)
    seconds = ours.build_seconds + ours.solve_seconds
    yield [path.stem, size, "coopoc", ours.status.name, ours.cost, None, error(graph, ours.position), seconds]
    x, seconds = plain_gtsam(problem)
    yield [path.stem, size, "GTSAM LM", "-", problem.cost(x), None, error(graph, x[:, :2]), seconds]
    if path.stem not in RELAXED:
        return
    found = staircase(from_graph(graph, start="apart"))
    assert found.solution is not None
    yield [
        path.stem,
        size,
        "coopoc staircase, robots apart",
        found.solution.status.name,
        found.solution.cost,
        found.lower_bound,
        error(graph, found.solution.position),
        found.seconds,
    ]


def main(folder: str, *names: str) -> None:
    """Print the table."""
    found = [
        row
        for name in names or ("mrclam5a", "mrclam6", "tiers", "plaza1")
        for row in rows(Path(folder) / f"{name}.pyfg")
    ]
    header = ["graph", "nodes", "solver", "status", "cost", "lower bound", "ATE [m]", "seconds"]
    print(tabulate(found, header, tablefmt="github", floatfmt=("", "", "", "", ".2f", ".2f", ".3f", ".1f")))


if __name__ == "__main__":
    main(*sys.argv[1:])

"""Wrong loop closures of a long drive: GNC, and GTSAM's.

    OMP_NUM_THREADS=1 python benchmarks/outliers.py            # a minute; with --gtsam three more a row
    OMP_NUM_THREADS=1 python benchmarks/outliers.py --fleets   # robots that only doubtful measurements join

3,500 poses in streets, 2,000 loops, a share of which is anything; odometry is known. Missed and false count wrong loops
that stay and right ones that go; ATE is that of the poses after alignment.
"""

import argparse
import time

import gtsam
import numpy as np
from tabulate import tabulate
from unseen_graphs import alignment_error, joined, lost, manhattan, world, wrong

from coopoc.formats.graph import Graph
from coopoc.optimize import solve_gnc
from coopoc.optimize.graph_problems import from_graph, loop_closures

SHARES = (0.1, 0.3, 0.5, 0.8)


def by_gtsam(graph: Graph, start: np.ndarray, loops: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Weights of the loops and positions by GTSAM's own GNC, truncated least squares at 0.99."""
    edges, factors, values = graph.relative_pose, gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, x in enumerate(start):
        values.insert(k, gtsam.Pose2(x[0], x[1], np.arctan2(x[4], x[2])))
    factors.add(gtsam.PriorFactorPose2(0, values.atPose2(0), gtsam.noiseModel.Isotropic.Sigma(3, 1e-4)))
    turn = np.arctan2(edges.rotation[:, 1, 0], edges.rotation[:, 0, 0])
    for (i, j), at, angle, cov in zip(edges.nodes.tolist(), edges.position, turn, edges.covariance, strict=True):
        model = gtsam.noiseModel.Gaussian.Covariance(cov)
        factors.add(gtsam.BetweenFactorPose2(i, j, gtsam.Pose2(*at, angle), model))
    options = gtsam.GncLMParams(gtsam.LevenbergMarquardtParams())
    doubtful = set(loops)
    options.setKnownInliers([0] + [k + 1 for k in range(len(edges)) if k not in doubtful])
    options.setLossType(gtsam.GncLossType.TLS)
    optimizer = gtsam.GncLMOptimizer(factors, values, options)
    optimizer.setInlierCostThresholdsAtProbability(0.99)
    found = optimizer.optimize()
    positions = np.array([found.atPose2(k).translation() for k in range(len(start))])
    return np.array(optimizer.getWeights())[1:][loops], positions


def rows(share: float, ways: list[str]) -> list[list[object]]:
    """A row per way."""
    graph = manhattan(1.0, share)(0)
    problem = from_graph(graph, start="odometry")
    ((factor, loops),) = loop_closures(problem)
    bad = wrong(graph)[loops]
    found = []
    for way in ways:
        began = time.process_time()
        if way == "gtsam":
            weights, position = by_gtsam(graph, problem.x0, loops)
        else:
            solution = solve_gnc(problem, [(factor, loops)], throw=False)
            weights, position = solution.extras["weights"], solution.position
        spent, out = time.process_time() - began, weights < 0.5
        error = alignment_error(position, graph.position)
        found.append([share, int(bad.sum()), way, int((bad & ~out).sum()), int((~bad & out).sum()), error, spent])
    return found


def fleet(seed: int, d: int, robots: int, share: float) -> list[object]:
    """What happens to the measurements between robots whose frames are unknown: a row."""
    drives = world(seed, d, robots, 200)
    between = drives.relative(drives.near(120, 8.0, others=True), 0.1, 0.03, wrong=share)
    graph = drives.graph(relative_pose=joined(drives.relative(drives.chain(), 0.05, 0.02), between))
    bad = wrong(graph)[-len(between) :]
    problem = from_graph(lost(graph), start="odometry")
    began = time.process_time()
    solution = solve_gnc(problem, loop_closures(problem), throw=False)
    out = solution.extras["weights"] < 0.5
    error = alignment_error(solution.position, drives.position)
    spent = time.process_time() - began
    return [
        f"{d}-D, {robots} robots",
        share,
        int(bad.sum()),
        int((bad & ~out).sum()),
        int((~bad & out).sum()),
        error,
        spent,
    ]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--gtsam", action="store_true", help="GTSAM's GNC, too")
    parser.add_argument("--fleets", action="store_true", help="robots that only doubtful measurements join, four seeds")
    given = parser.parse_args()
    if given.fleets:
        kinds = [(d, robots, share) for d, robots in ((2, 5), (3, 3)) for share in (0.1, 0.3, 0.6)]
        each = [[fleet(seed, *kind) for seed in range(4)] for kind in kinds]
        columns = [list(zip(*some, strict=True)) for some in each]
        table = [[c[0][0], c[1][0], *(", ".join(f"{v:.3g}" for v in column) for column in c[2:])] for c in columns]
        print(tabulate(table, ["", "share", "wrong", "missed", "false", "ATE m", "CPU s"], tablefmt="github"))
        return
    ways = ["coopoc", *["gtsam"] * given.gtsam]
    table = [row for share in SHARES for row in rows(share, ways)]
    header = ["share", "wrong", "by", "missed", "false", "ATE m", "CPU s"]
    print(tabulate(table, header, tablefmt="github", floatfmt=".3g"))


if __name__ == "__main__":
    main()

"""Factor graphs by us and by plain GTSAM on the same chordal objective: status, cost, iterations and CPU seconds.

Run:  python benchmarks/graphs.py                            (every PyFG file in ../shared/data/pyfg, if it is there)
      python benchmarks/graphs.py ../shared/data/pyfg mrclam5a           (one)
      python benchmarks/graphs.py folder --hard              (any folder of PyFG and g2o files, with hard variants)
      python benchmarks/graphs.py --unseen 1                 (kinds of graphs that no file holds; so many seeds)
      python benchmarks/graphs.py --sizes                    (how time grows with them)

GTSAM gets what a user would write: Pose2 or Pose3 variables, FrobeniusBetweenFactor, RangeFactor, Levenberg-Marquardt
as it comes, from chained odometry. It has no factor for a landmark's position in a pose's frame with our weights, so
that landmarks are poses whose rotation is not measured. Ours is `solve` with start="auto", and from chained odometry;
its seconds contain the search for the start, the checks and all marginals, GTSAM's the building of its graph. From
chained odometry both take 100 steps at most, GTSAM's default.
"""

import argparse
import os
import resource
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import gtsam
import numpy as np
from hard_graphs import VARIANTS
from tabulate import tabulate
from unseen_graphs import FAMILIES, SIZES, alignment_error

from coopoc.errors import InputError
from coopoc.formats import GRAPHS, load_graph
from coopoc.formats.graph import Graph
from coopoc.optimize import Problem, solve
from coopoc.optimize.backends.gtsam import pose_of
from coopoc.optimize.graph_problems import from_graph

FOLDER = Path(__file__).resolve().parents[1] / "../shared/data/pyfg"
UNMEASURED = 1e6
"""Standard deviation of a rotation that a landmark does not have."""


def plain_gtsam(problem: Problem) -> tuple[np.ndarray, int]:
    """Nodes (n, ambient) and iterations of GTSAM's Levenberg-Marquardt with its own factors."""
    d, space, noise = problem.dimension, problem.space, gtsam.noiseModel
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, row in enumerate(problem.x0):
        values.insert(k, pose_of(d, row))
    prior = getattr(gtsam, f"PriorFactorPose{d}")
    for k in problem.fixed:
        graph.add(prior(k, pose_of(d, problem.x0[k]), noise.Constrained.All(space.dof)))
    free = np.full(space.dof, UNMEASURED)
    free[: d * (d - 1) // 2] = 1.0
    free = free if d == 3 else free[::-1]
    for k in set(range(len(problem.names))) - set(problem.poses):
        graph.add(prior(k, pose_of(d, problem.x0[k]), noise.Diagonal.Sigmas(free)))
    chord, ranged = getattr(gtsam, f"FrobeniusBetweenFactorPose{d}"), getattr(gtsam, f"RangeFactorPose{d}")
    fix, place = getattr(gtsam, f"FrobeniusPriorPose{d}"), getattr(gtsam, f"PoseTranslationPrior{d}D")
    for factor in problem.factors:
        std = np.broadcast_to(factor.std, (len(factor.nodes), factor.size))
        for nodes, z, s in zip(factor.nodes.tolist(), factor.z, std, strict=True):
            turn = s[d] if factor.kind.endswith("chordal") else UNMEASURED
            sigmas = np.array([*([turn] * d + [UNMEASURED]) * d, *s[:d], UNMEASURED]) if len(s) >= d else s
            model = noise.Diagonal.Sigmas(sigmas)
            if factor.kind == "range":
                graph.add(ranged(*nodes, z[0], model))
            elif factor.kind == "position":
                graph.add(place(nodes[0], z, noise.Diagonal.Sigmas(s)))
            elif factor.kind == "pose_chordal":
                graph.add(fix(nodes[0], pose_of(d, z).matrix(), model))
            else:
                full = z if len(z) > d else space.join(z)
                graph.add(chord(*nodes, pose_of(d, full), model))
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, gtsam.LevenbergMarquardtParams())
    found = optimizer.optimize()
    poses = [getattr(found, f"atPose{d}")(k) for k in range(len(problem.names))]
    x = np.array([space.join(p.translation(), p.rotation().matrix()) for p in poses])
    x[[k for k in range(len(x)) if k not in set(problem.poses)], d:] = np.eye(d).ravel()
    return x, optimizer.iterations()


def error(graph: Graph, position: np.ndarray) -> float:
    """ATE: rms of the poses after alignment, m; NaN where the file's vertices are no trajectory to align with."""
    truth = graph.position[graph.is_pose]
    if len(truth) <= graph.dimension or not np.isfinite(truth).all():
        return np.nan
    return alignment_error(position[graph.is_pose], truth)


def row(name: str, graph: Graph) -> list[object]:
    """Of one graph: ours from the automatic start, ours from chained odometry, and GTSAM's from there."""
    cells: list[object] = [name, len(graph.names)]
    limits: dict[str, Any] = {"auto": {}, "odometry": {"max_iterations": 100}}
    for start, limit in limits.items():
        began = time.process_time()
        problem = from_graph(graph, start=start)
        found = solve(problem, throw=False, **limit)
        cells += [found.status.name, found.cost, found.iterations, time.process_time() - began]
        if start == "auto":
            cells.insert(2, found.extras["start"])
            cells.append(error(graph, found.position))
    began = time.process_time()
    if problem.poses:
        x, iterations = plain_gtsam(problem)
    else:
        own = solve(problem, "gtsam", throw=False)
        x, iterations = own.x, own.iterations
    return [*cells, problem.cost(x), iterations, time.process_time() - began, error(graph, x[:, : graph.dimension])]


def unseen(families: dict[str, Callable[[int], Graph]], seeds: int) -> Iterator[list[object]]:
    """A row per family and seed."""
    row("warm", FAMILIES["marine"](0))
    for name, make in families.items():
        for seed in range(seeds):
            yield row(f"{name}, seed {seed}", make(seed))


HEADER = (
    "graph nodes start auto cost iterations seconds ATE odometry cost iterations seconds GTSAM iterations seconds ATE"
)


STATUS, COST, SECONDS, FROM_ODOMETRY, GTSAM_COST, GTSAM_SECONDS = 3, 4, 6, 11, 12, 14
"""Places in a row."""


def rows(files: list[Path], hard: bool) -> Iterator[list[object]]:
    """A row per file and variant; of a file that cannot be read or solved its name and the reason."""
    cold = True  # the first solve of a process also loads libraries
    for file in files:
        try:
            graph = load_graph(file)
            if cold:
                row("warm", graph)
            cold = False
            for variant, make in VARIANTS.items() if hard else [("", lambda graph: graph)]:
                yield row(f"{file.stem} {variant}".strip(), make(graph))
        except InputError as reason:
            yield [file.name, str(reason)]


def shown(each: Iterator[list[object]]) -> list[list[object]]:
    """All rows, each printed to stderr when it is there: large graphs take GTSAM many minutes."""
    found = []
    for cells in each:
        print(*(f"{cell:.6g}" if isinstance(cell, float) else cell for cell in cells), file=sys.stderr, flush=True)
        found.append(cells)
    return found


def main() -> None:
    """Print the table, and the totals."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", nargs="?", type=Path, default=FOLDER, help="of .pyfg and .g2o files")
    parser.add_argument("names", nargs="*", help="files, without their suffixes; all of them by default")
    parser.add_argument("--hard", action="store_true", help="worse variants of each file, too")
    parser.add_argument("--unseen", type=int, metavar="SEEDS", help="graphs that no file holds, of so many seeds")
    parser.add_argument("--sizes", action="store_true", help="the same of growing size")
    given = parser.parse_args()
    if given.unseen or given.sizes:
        found = shown(unseen(SIZES if given.sizes else FAMILIES, given.unseen or 1))
    elif not given.folder.is_dir():
        parser.error(f"no folder {given.folder}")
    else:
        files = sorted(f for f in given.folder.rglob("*") if f.suffix in GRAPHS)
        found = shown(rows([f for f in files if not given.names or f.stem in given.names], given.hard))
    ended = [r for r in found if len(r) > 2]
    total: list[object] = ["total", *[""] * 15]
    for column in (SECONDS, FROM_ODOMETRY, GTSAM_SECONDS):
        total[column] = sum(r[column] for r in ended)  # type: ignore[misc]
    print(tabulate([*ended, total], HEADER.split(), tablefmt="github", floatfmt=".6g"))
    print("".join(f"{name}: {reason}\n" for name, reason in (r for r in found if len(r) == 2)), end="")
    behind = [
        r[0]
        for r in ended
        if not (r[STATUS] == "SOLVED" and r[COST] <= r[GTSAM_COST] * (1 + 1e-9) + 1e-9)  # type: ignore[operator]
    ]
    slow = [r[0] for r in ended if r[SECONDS] > 0.5 * r[GTSAM_SECONDS]]  # type: ignore[operator]
    print(f"not SOLVED, or above GTSAM: {behind}; slower than half of GTSAM: {slow}")
    print(f"largest memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:.2f} GB")


if __name__ == "__main__":
    main()

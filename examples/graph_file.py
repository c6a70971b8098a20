"""From a factor-graph file to a picture of its trajectories: five lines to solve it, the rest to draw it.

The file's vertices are the truth; the solver sees only what was measured, with each robot's odometry chained from its
first vertex. Positions are compared after SE(2) alignment, as usual for trajectories (ATE).

Run:  python examples/graph_file.py ../shared/data/pyfg/mrclam5a.pyfg trajectories.png
"""

import sys
from pathlib import Path

import matplotlib
import numpy as np

from coopoc.formats import load_graph
from coopoc.formats.graph import Graph
from coopoc.optimize import Solution, solve
from coopoc.optimize.graph_problems import from_graph


def main(path: str, picture: str | None = None) -> Solution:
    """Solve the file, say how good it is, and draw it if a file name is given."""
    graph = load_graph(path)
    problem = from_graph(graph)
    before = ate(graph, problem.x0[:, :2])
    solution = solve(problem)
    after = ate(graph, solution.position)
    print(problem)
    print(f"cost {problem.cost(problem.x0):.1f} -> {solution.cost:.2f} in {solution.solve_seconds:.1f} s")
    print(f"ATE {before:.3f} m (odometry) -> {after:.3f} m")
    if picture is not None:
        draw(graph, solution, Path(picture))
    return solution


def aligned(graph: Graph, position: np.ndarray) -> np.ndarray:
    """Positions (n, 2) m after the motion of SE(2) that brings the poses nearest to the truth."""
    center, true_center = position[graph.is_pose].mean(axis=0), graph.position[graph.is_pose].mean(axis=0)
    z, true_z = ((x - x0) @ [1, 1j] for x, x0 in ((position, center), (graph.position, true_center)))
    turn = np.vdot(z[graph.is_pose], true_z[graph.is_pose])
    z = z * turn / abs(turn)
    return np.stack([z.real, z.imag], axis=1) + true_center


def ate(graph: Graph, position: np.ndarray) -> float:
    """Root mean square m of the poses' errors after the alignment."""
    error = (aligned(graph, position) - graph.position)[graph.is_pose]
    return float(np.sqrt((error**2).sum(axis=1).mean()))


def draw(graph: Graph, solution: Solution, picture: Path) -> None:
    """Estimates over truth, one colour per robot."""
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    where = aligned(graph, solution.position)
    figure, axes = plt.subplots(figsize=(6.0, 5.0), layout="constrained")
    for colour, (robot, places) in zip(plt.cm.tab10.colors, graph.robots.items(), strict=False):
        axes.plot(*graph.position[places].T, color="0.75", lw=2.5, zorder=1)
        axes.plot(*where[places].T, color=colour, lw=1.0, label=f"robot {robot}")
    axes.plot([], [], color="0.75", lw=2.5, label="truth")
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    figure.savefig(picture, dpi=150, bbox_inches="tight")
    print(f"picture: {picture}")


if __name__ == "__main__":
    main(*sys.argv[1:])

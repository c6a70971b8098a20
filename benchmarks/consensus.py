"""Graphs solved by their robots: cost above the central minimum against the bytes that the robots send.

Run:  python benchmarks/consensus.py                      (mrclam5a and tiers of ../shared/data/pyfg, and five robots)
      python benchmarks/consensus.py docs/distributed.png (and the figure)

The mark on each curve is what sending every other robot's measurements to the first, and the answers back, would take.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from tabulate import tabulate
from unseen_graphs import five_robots

from coopoc.formats import load_graph
from coopoc.formats.graph import Graph
from coopoc.optimize import solve
from coopoc.optimize.distributed import BYTES, Distributed, makers, owners, solve_distributed
from coopoc.optimize.graph_problems import from_graph

FOLDER = Path(__file__).resolve().parents[1] / "../shared/data/pyfg"
ROUNDS = 200
LOSS = 0.3
SHOWN = (0, 1, 3, 10, 30, 100, 200)


def graphs() -> dict[str, Graph]:
    """By name; files where they are there."""
    files = [path for name in ("mrclam5a", "tiers") if (path := FOLDER / f"{name}.pyfg").is_file()]
    return {path.stem: load_graph(path) for path in files} | {"five robots": five_robots(0)}


def central_bytes(graph: Graph) -> int:
    """Of every measurement that another robot than the first made (its value and two variances or one), and of their
    poses on the way back."""
    problem = from_graph(graph, start="odometry")
    label = np.array(owners(problem))
    sizes = {"relative_pose_chordal": 5, "pose_chordal": 5, "relative_position": 3, "position": 3, "range": 2}
    away = [(label[by] != label[0]).sum() for by in makers(problem, tuple(label))]
    there = sum(int(count) * sizes[f.kind] for count, f in zip(away, problem.factors, strict=True))
    return BYTES * (there + 3 * int((label[list(problem.poses)] != label[0]).sum()))


def main(*arguments: str) -> None:
    """Print the table; draw the figure if a path is given."""
    rows, curves = [], {}
    for name, graph in graphs().items():
        problem = from_graph(graph, start="odometry")
        best = solve(problem, throw=False).cost
        for loss in (0.0, LOSS):
            found = solve_distributed(problem, rounds=ROUNDS, loss=loss)
            gap = found.cost / best - 1.0
            curves[name, loss] = found, gap
            shown = [f"{gap[k]:.1e}" for k in SHOWN]
            rows.append([name, loss, *shown, found.sent_bytes[1] / 1e3, central_bytes(graph) / 1e3])
    header = ["graph", "lost", *(f"{k} rounds" for k in SHOWN), "kB a round", "central kB"]
    print(tabulate(rows, header, tablefmt="github", floatfmt=".4g"))
    if arguments:
        draw(curves, {name: central_bytes(graph) for name, graph in graphs().items()}, Path(arguments[0]))


def draw(
    curves: dict[tuple[str, float], tuple[Distributed, np.ndarray]], central: dict[str, int], target: Path
) -> None:
    """The gap against the bytes, a colour per graph."""
    import matplotlib.pyplot as plt

    from coopoc.world.pictures import COLORS

    figure, ax = plt.subplots(figsize=(6.4, 3.8), layout="constrained")
    for k, name in enumerate(central):
        for loss, style in ((0.0, "-"), (LOSS, ":")):
            found, gap = curves[name, loss]
            label = name if not loss else f"{name}, {loss:.0%} lost"
            ax.loglog(found.sent_bytes[1:] / 1e3, np.abs(gap[1:]), style, color=COLORS[k], label=label)
        found, gap = curves[name, 0.0]
        at = np.interp(central[name], found.sent_bytes, np.abs(gap))
        ax.plot(central[name] / 1e3, at, "o", color=COLORS[k])
    ax.set(xlabel="Sent by all robots [kB]", ylabel="Cost above the central minimum")
    ax.grid(alpha=0.3)
    ax.legend(fontsize=8)
    figure.savefig(target, dpi=150)


if __name__ == "__main__":
    main(*sys.argv[1:])

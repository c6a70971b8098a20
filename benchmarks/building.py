"""Building a graph: one `add` after the other, all in one array, and the same by GTSAM.

    OMP_NUM_THREADS=1 python benchmarks/building.py            # a Markdown table on stdout, some seconds

Relative poses of the plane along a drive, microseconds per factor, the Problem's final check in it. A Problem is
immutable, so that each `add` copies the arrays of its factors: beyond ten thousand of them add them in one array, which
is what the readers do. Right: the same cost as GTSAM's graph at the same poses.
"""

from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np
from timing import medians, report, rows_of, timed

import coopoc as co

ROUNDS, COUNT = 3, 10_000
STD = (0.1, 0.1, 0.02)


def drive(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poses (count + 1, 6) to begin at, and measured steps: position (count, 2) m and turn (count,) rad."""
    rng = np.random.default_rng(seed)
    step, turn = rng.normal([1.0, 0.0], 0.1, (count, 2)), rng.normal(0.0, 0.1, count)
    heading = np.concatenate([[0.0], np.cumsum(turn + rng.normal(0.0, 0.02, count))])
    position = np.concatenate([np.zeros((1, 2)), np.cumsum(rng.normal(0.5, 0.5, (count, 2)), axis=0)])
    return co.pose(position, heading), step, turn


def one_by_one(count: int) -> co.Problem:
    """A factor at a time."""
    x0, step, turn = drive(count)
    problem = empty(x0)
    for k in range(count):
        z = co.pose(step[k], turn[k])
        problem = problem.add("relative_pose_log", (f"p{k}", f"p{k + 1}"), z, std=STD)
    return problem


def at_once(count: int) -> co.Problem:
    """In one array."""
    x0, step, turn = drive(count)
    pairs = [(f"p{k}", f"p{k + 1}") for k in range(count)]
    return empty(x0).add("relative_pose_log", pairs, co.pose(step, turn), std=STD)


def empty(x0: np.ndarray) -> co.Problem:
    """The poses alone."""
    names = tuple(f"p{k}" for k in range(len(x0)))
    return co.Problem(names, x0=x0, poses=range(len(x0)), dimension=2)


def by_gtsam(count: int) -> tuple[Any, Any]:
    """Graph and values."""
    x0, step, turn = drive(count)
    graph, values, noise = gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.noiseModel.Diagonal.Sigmas(np.array(STD))
    for k, x in enumerate(x0):
        values.insert(k, gtsam.Pose2(x[0], x[1], np.arctan2(x[4], x[2])))
    for k in range(count):
        z = gtsam.Pose2(step[k, 0], step[k, 1], turn[k])
        graph.add(gtsam.BetweenFactorPose2(k, k + 1, z, noise))
    return graph, values


def cost(problem: co.Problem) -> float:
    """1/2 |r|^2 where it begins."""
    return float(np.sum(problem.cost(problem.x0)))


GTSAM = "GTSAM, a factor at a time"


def ways(count: int) -> dict[str, tuple[Callable[[int], Any], int]]:
    """Row -> what builds, and how many factors."""
    return {
        GTSAM: (by_gtsam, count),
        "ours, a factor at a time": (one_by_one, count),
        "ours, in one array": (at_once, count),
    }


def measured(rounds: int = ROUNDS, count: int = COUNT) -> list[dict[str, Any]]:
    """Rows: microseconds per factor, and the ratio to GTSAM's."""
    made = ways(count)
    graph, values = by_gtsam(count)
    wanted = graph.error(values)
    right = {way: way is by_gtsam or abs(cost(way(count)) - wanted) < 1e-6 * wanted for way, _ in made.values()}
    spent = medians({name: (lambda way=way, n=n: timed(lambda: way(n)) / n) for name, (way, n) in made.items()}, rounds)
    return rows_of("", spent, GTSAM, {name: right[made[name][0]] for name in made})


if __name__ == "__main__":
    print(report(measured()))

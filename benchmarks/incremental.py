"""A robot that ranges landmarks live, by `co.incremental` and by GTSAM called directly.

Run:  python benchmarks/incremental.py 5000     (steps)
"""

import sys
from time import process_time

import gtsam
import numpy as np

import coopoc as co


def drive(steps: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Landmarks (20, 2), relative poses (steps, 3), which landmark is ranged and its range (steps,)."""
    rng = np.random.default_rng(seed)
    beside, at, course = rng.uniform(-40, 40, (20, 2)), np.zeros(2), 0.0
    moved, which, ranges = np.zeros((steps, 3)), rng.integers(0, 20, steps), np.zeros(steps)
    for k in range(steps):
        turn = 0.1 * np.sin(np.arctan2(-at[1], -at[0]) - course)
        at, course = at + np.array([np.cos(course), np.sin(course)]), course + turn
        moved[k] = np.array([1.0, 0.0, turn]) + rng.normal(0.0, [0.02, 0.02, 0.005])
        ranges[k] = np.linalg.norm(beside[which[k]] - at) + rng.normal(0.0, 0.1)
    return beside, moved, which, ranges


def ours(beside: np.ndarray, moved: np.ndarray, which: np.ndarray, ranges: np.ndarray) -> np.ndarray:
    """(2,) the last place."""
    start = co.Problem(("x0",), dimension=2, poses=(0,), x0=co.pose(np.zeros((1, 2))))
    live = co.incremental(start.add("pose", "x0", co.pose(np.zeros(2)), std=0.01))
    for k, (step, j, far) in enumerate(zip(moved, which.tolist(), ranges, strict=True)):
        here, there, mark = f"x{k}", f"x{k + 1}", f"l{j}"
        last, relative = live[here], co.pose(step[:2], step[2])
        guess = np.r_[
            last[:2] + last[2:].reshape(2, 2) @ step[:2], (last[2:].reshape(2, 2) @ relative[2:].reshape(2, 2)).ravel()
        ]
        new = {there: guess} | ({mark: beside[j] + 0.5} if mark not in live else {})
        live.add(
            [("relative_pose_log", (here, there), relative, [0.02, 0.02, 0.005]), ("range", (there, mark), far, 0.1)],
            new,
        )
    return live[f"x{len(moved)}"][:2]


def direct(beside: np.ndarray, moved: np.ndarray, which: np.ndarray, ranges: np.ndarray) -> np.ndarray:
    """(2,) the last place."""
    isam = gtsam.ISAM2(gtsam.ISAM2Params())
    graph, guess = gtsam.NonlinearFactorGraph(), gtsam.Values()
    sigma, loose = gtsam.noiseModel.Diagonal.Sigmas, gtsam.noiseModel.Isotropic.Sigma(2, 100.0)
    odometry, ranging = sigma(np.array([0.02, 0.02, 0.005])), sigma(np.array([0.1]))
    graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(), sigma(np.full(3, 0.01))))
    guess.insert(0, gtsam.Pose2())
    isam.update(graph, guess)
    known = set[int]()
    for k, (step, j, far) in enumerate(zip(moved, which.tolist(), ranges, strict=True)):
        graph, guess, relative = gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.Pose2(*step)
        graph.add(gtsam.BetweenFactorPose2(k, k + 1, relative, odometry))
        graph.add(gtsam.RangeFactor2D(k + 1, 10**6 + j, far, ranging))
        guess.insert(k + 1, isam.calculateEstimatePose2(k).compose(relative))
        if j not in known:
            guess.insert(10**6 + j, beside[j] + 0.5)
            graph.add(gtsam.PriorFactorPoint2(10**6 + j, beside[j] + 0.5, loose))
            known.add(j)
        isam.update(graph, guess)
    found = isam.calculateEstimatePose2(len(moved))
    return np.array([found.x(), found.y()])


def main() -> None:
    """Print the seconds of each and how far apart they end."""
    given = drive(int(sys.argv[1]) if len(sys.argv) > 1 else 5000)
    took, ends = [], []
    for run in (direct, ours):
        began = process_time()
        ends.append(run(*given))
        took.append(process_time() - began)
    apart, ratio = np.linalg.norm(ends[1] - ends[0]), took[1] / took[0]
    print(f"{len(given[1])} steps: GTSAM {took[0]:.2f} s, ours {took[1]:.2f} s ({ratio:.2f}); {apart:.1e} m apart")


if __name__ == "__main__":
    main()

"""How often is the semidefinite relaxation tight? A Markdown table over noise, geometry and kinds of measurement.

Run:  python benchmarks/tightness.py [seeds]      (about a minute for 30)
"""

import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from tqdm import tqdm

from coopoc.arrays import Floats
from coopoc.optimize import Problem, Status, pose, solve
from coopoc.optimize.convex.relaxation import Relaxation, shor
from coopoc.optimize.model.problem import Search

Case = Callable[[int], Problem]


def ranged(
    seed: int,
    vehicles: int = 7,
    d: int = 3,
    gnss_std: float = 3.5,
    range_std: float = 1.0,
    stretch: float = 1.0,
    shape: str = "volume",
    mesh: bool = False,
) -> Problem:
    """Fixes of all vehicles, and the ranges of a star around the first or of all pairs.

    Args:
        stretch: of the fixes' std along the last axis.
        shape: "volume", "street" (a tenth as high as wide), "line".
    """
    rng = np.random.default_rng(seed)
    spread = {"volume": np.ones(d), "street": np.array([*np.ones(d - 1), 0.1]), "line": np.eye(d)[0]}[shape]
    truth = rng.uniform(-20, 20, (vehicles, d)) * spread
    std = gnss_std * np.array([*np.ones(d - 1), stretch])
    problem = Problem(tuple(f"v{k}" for k in range(vehicles)), dimension=d)
    problem = problem.add("position", list(range(vehicles)), truth + std * rng.standard_normal(truth.shape), std)
    return with_ranges(problem, truth, rng, range_std, star=not mesh)


def anchored(seed: int, anchors: int, vehicles: int, d: int, range_std: float, line: bool = False) -> Problem:
    """Surveyed anchors (0.3 m), vehicles without a fix, ranges to and between them; anchors on a line or not."""
    rng = np.random.default_rng(seed)
    truth = rng.uniform(-20, 20, (anchors + vehicles, d))
    truth[:anchors, 1:] *= not line
    problem = Problem(tuple(f"n{k}" for k in range(len(truth))), dimension=d)
    problem = problem.add(
        "position", list(range(anchors)), truth[:anchors] + 0.3 * rng.standard_normal((anchors, d)), 0.3
    )
    return with_ranges(problem, truth, rng, range_std, first=anchors)


def with_ranges(
    problem: Problem, truth: Floats, rng: np.random.Generator, std: float, star: bool = False, first: int = 1
) -> Problem:
    """Ranges of pairs (i, j), j >= first; of a star only those of node 0."""
    n = len(truth)
    pairs = [(i, j) for i in range(n) for j in range(max(i + 1, first), n) if not star or i == 0]
    ranges = [np.linalg.norm(truth[i] - truth[j]) + std * rng.standard_normal() for i, j in pairs]
    return problem.add("range", pairs, np.maximum(np.abs(ranges), 0.1)[:, None], std)


def observed_poses(
    seed: int, d: int = 2, vehicles: int = 5, gnss_std: float = 3.5, std: float = 1.0, chain: bool = False
) -> Problem:
    """Vehicles of unknown heading that see each other by range and bearing (the vector d u with one std), and fixes.

    chain: vehicle k sees k + 1 only; else all see all.
    """
    rng = np.random.default_rng(seed)
    at = rng.uniform(-20, 20, (vehicles, d))
    truth = pose(at, rng.uniform(-np.pi, np.pi, vehicles) if d == 2 else rng.normal(0, 1, (vehicles, 3)))
    turned = truth[:, d:].reshape(-1, d, d)
    start = pose(
        at + gnss_std * rng.standard_normal(at.shape), np.zeros(vehicles) if d == 2 else np.zeros((vehicles, 3))
    )
    nodes = list(range(vehicles))
    problem = Problem(tuple(f"v{k}" for k in nodes), x0=start, dimension=d, poses=tuple(nodes))
    problem = problem.add("position", nodes, start[:, :d], gnss_std)
    pairs = [(i, j) for i in nodes for j in nodes if i != j and (not chain or abs(i - j) == 1)]
    seen = [turned[i].T @ (at[j] - at[i]) + std * rng.standard_normal(d) for i, j in pairs]
    return problem.add("relative_position", pairs, seen, std)


def driven(seed: int, noise: float, steps: int = 6) -> Problem:
    """Two robots' chordal odometry in the plane and ranges between them, UWB-like; nothing in the world's frame."""
    rng = np.random.default_rng(seed)
    turn = np.cumsum(rng.normal(0, 0.5, (2, steps)), axis=1)
    move = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    at = np.cumsum(move, axis=1).reshape(-1, 2) + np.repeat(rng.uniform(-6, 6, (2, 2)), steps, axis=0)
    truth = pose(at, turn.ravel())
    turned = truth[:, 2:].reshape(-1, 2, 2)
    names = tuple(f"{robot}{k}" for robot in "AB" for k in range(steps))
    problem = Problem(names, x0=truth, dimension=2, poses=tuple(range(2 * steps)), fixed=(0,))
    pairs = [(k, k + 1) for k in range(2 * steps - 1) if k != steps - 1]
    z = np.array([np.append(turned[i].T @ (at[j] - at[i]), turned[i].T @ turned[j]) for i, j in pairs])
    z[:, :2] += 0.02 * noise * rng.standard_normal((len(z), 2))
    problem = problem.add("relative_pose_chordal", pairs, z, [0.02] * 2 + [0.01] * 4)
    across = [(i, j) for i in range(steps) for j in range(steps, 2 * steps)]
    ranges = [np.linalg.norm(at[i] - at[j]) + 0.1 * noise * rng.standard_normal() for i, j in across]
    return problem.add("range", across, np.maximum(np.abs(ranges), 0.05)[:, None], 0.1)


CASES: dict[str, Case] = {
    "range-only star, 3-D, 3 neighbours": partial(ranged, vehicles=4),
    "range-only star, 3-D, 6 neighbours": ranged,
    "range-only star, 3-D, 10 neighbours": partial(ranged, vehicles=11),
    "star of 6, range std 0.1 m": partial(ranged, range_std=0.1),
    "star of 6, GNSS std 10 m": partial(ranged, gnss_std=10.0),
    "star of 6, a street (z a tenth)": partial(ranged, shape="street"),
    "star of 6, collinear": partial(ranged, shape="line"),
    "star of 6, GNSS vertical std doubled (anisotropic)": partial(ranged, stretch=2.0),
    "star of 6, GNSS vertical std halved (anisotropic)": partial(ranged, stretch=0.5),
    "mesh of 5, 3-D": partial(ranged, vehicles=5, mesh=True),
    "mesh of 5, 3-D, GNSS std 10 m": partial(ranged, vehicles=5, mesh=True, gnss_std=10.0),
    "mesh of 5, 3-D, range std 0.1 m": partial(ranged, vehicles=5, mesh=True, range_std=0.1),
    "mesh of 5, plane": partial(ranged, vehicles=5, mesh=True, d=2),
    "mesh of 5, collinear": partial(ranged, vehicles=5, mesh=True, shape="line"),
    "mesh of 5, GNSS vertical std doubled (anisotropic)": partial(ranged, vehicles=5, mesh=True, stretch=2.0),
    "mesh of 5, GNSS vertical std halved (anisotropic)": partial(ranged, vehicles=5, mesh=True, stretch=0.5),
    "4 anchors, 1 vehicle without fix, plane": partial(anchored, anchors=4, vehicles=1, d=2, range_std=0.1),
    "4 collinear anchors, 1 vehicle without fix, plane": partial(
        anchored, anchors=4, vehicles=1, d=2, range_std=0.1, line=True
    ),
    "4 anchors, 3 vehicles without fix, plane": partial(anchored, anchors=4, vehicles=3, d=2, range_std=0.1),
    "4 anchors, 3 vehicles, range std 1 m": partial(anchored, anchors=4, vehicles=3, d=2, range_std=1.0),
    "5 anchors, 1 vehicle without fix, 3-D": partial(anchored, anchors=5, vehicles=1, d=3, range_std=0.1),
    "5 anchors, 3 vehicles without fix, 3-D": partial(anchored, anchors=5, vehicles=3, d=3, range_std=0.1),
    "range + bearing, unknown headings, mesh of 5, plane": observed_poses,
    "range + bearing, mesh of 5, std 5 m": partial(observed_poses, std=5.0),
    "range + bearing, chain of 5, plane": partial(observed_poses, chain=True),
    "range + bearing, chain of 5, std 5 m": partial(observed_poses, chain=True, std=5.0),
    "range + bearing, mesh of 4, 3-D": partial(observed_poses, vehicles=4, d=3),
    "odometry + ranges, two robots, noise as modelled": partial(driven, noise=1.0),
    "odometry + ranges, two robots, noise 0.1": partial(driven, noise=0.1),
    "odometry + ranges, two robots, noise 5": partial(driven, noise=5.0),
}


def row(name: str, case: Case, seeds: int) -> str:
    """Share of tight relaxations, gaps as a share of the cost, how often Gauss-Newton alone finds as good a point."""
    relaxed: list[Relaxation] = []
    alone = 0
    for seed in range(seeds):
        problem = case(seed)
        relaxed.append(shor(problem))
        best = relaxed[-1].solution
        assert best is not None
        start = problem.x0 if problem.x0 is not None and not problem.fixed else _blind(problem, seed)
        found = solve(replace(problem, x0=start, search=Search("alone", x0=start)), throw=False)
        alone += found.status is Status.SOLVED and found.cost <= best.cost * (1 + 1e-6) + 1e-9
    gaps = np.array([r.gap / max(r.lower_bound + r.gap, 1e-12) for r in relaxed])
    tight = sum(r.tight for r in relaxed)
    spent = 1e3 * float(np.median([r.seconds for r in relaxed]))
    return (
        f"| {name} | {tight}/{seeds} | {np.median(gaps):.0e} | {gaps.max():.0e} | "
        f"{np.median([r.rank_gap for r in relaxed]):.0e} | {alone}/{seeds} | {spent:.0f} |"
    )


def _blind(problem: Problem, seed: int) -> Floats | None:
    """Where a local solver would start: None (the converted solution) if every node has a fix, else anywhere."""
    fixes = [f for f in problem.factors if f.kind == "position"]
    if fixes and len(fixes[0].nodes) == len(problem.names):
        return None
    rng, n, d = np.random.default_rng([seed, 1]), len(problem.names), problem.dimension
    at = rng.uniform(-20, 20, (n, d))
    if not problem.poses:
        return at
    start = pose(at, rng.uniform(-np.pi, np.pi, n))
    assert problem.x0 is not None
    start[list(problem.fixed)] = problem.x0[list(problem.fixed)]
    return start


def main(seeds: int = 30) -> None:
    """Print the table."""
    print(f"{seeds} seeds per row. Tight: the refined point's cost is within 1e-6 of the bound, so a global optimum.\n")
    print("| problem | tight | median gap | largest gap | median rank gap | Gauss-Newton alone as good | ms |")
    print("|---|---|---|---|---|---|---|")
    for name, case in tqdm(CASES.items(), desc="tightness", delay=2.0):
        print(row(name, case, seeds), flush=True)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:2]))

"""Graphs that no file holds: kinds of problems that users bring, drawn anew for every seed.

Run:  python benchmarks/unseen_graphs.py 1000 100     (small graphs of so many seeds from the first on, by `solve`, and
                                                      by GTSAM from the truth and from 50 random starts)
"""

import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from hard_graphs import worse_odometry

from coopoc.formats.graph import Graph, PointEdges, PoseEdges, RangeEdges
from coopoc.formats.values import to_orientation
from coopoc.optimize import Solution, solve
from coopoc.optimize.backends.gtsam import forms, graph_of, values, which_turn
from coopoc.optimize.graph_problems import from_graph
from coopoc.optimize.model.problem import Search
from coopoc.optimize.model.space import exp


def alignment_error(estimate: np.ndarray, truth: np.ndarray) -> float:
    """ATE: root mean square m of positions (T, d) after the motion of SE(d) that brings them nearest (Kabsch's)."""
    x, y = estimate - estimate.mean(axis=0), truth - truth.mean(axis=0)
    u, _, vh = np.linalg.svd(x.T @ y)
    u[:, -1] *= np.sign(np.linalg.det(u @ vh))  # a turn, and no reflection
    return float(np.sqrt(np.square(x @ u @ vh - y).sum(axis=-1).mean()))


@dataclass(frozen=True, eq=False)
class World:
    """True poses of robots, one after the other, then points; `steps` poses each."""

    rng: np.random.Generator
    position: np.ndarray
    rotation: np.ndarray
    robots: int
    steps: int

    @property
    def d(self) -> int:
        """2 or 3."""
        return self.position.shape[1]

    @property
    def poses(self) -> int:
        """How many."""
        return self.robots * self.steps

    def chain(self) -> np.ndarray:
        """(M, 2) consecutive poses."""
        k = np.arange(self.poses - 1)
        k = k[(k + 1) % self.steps > 0]
        return np.stack([k, k + 1], axis=1)

    def near(self, count: int, reach: float, others: bool = False) -> np.ndarray:
        """(count, 2) poses within `reach` m of each other and ten steps apart, or of two robots each."""
        from scipy.spatial import cKDTree

        pairs = cKDTree(self.position[: self.poses]).query_pairs(reach, output_type="ndarray")
        own = pairs[:, 0] // self.steps == pairs[:, 1] // self.steps
        pairs = pairs[~own if others else own & (np.abs(pairs[:, 0] - pairs[:, 1]) > 10)]
        return self.rng.permutation(pairs)[:count]

    def to_points(self, count: int) -> np.ndarray:
        """(count, 2) a pose and a point each, every point four times at least."""
        points = np.arange(self.poses, len(self.position))
        which = np.concatenate([np.tile(points, 4), self.rng.choice(points, max(count - 4 * len(points), 0))])
        pose = np.concatenate([self.rng.choice(self.poses, len(which), replace=len(which) > self.poses)])
        return np.unique(np.stack([pose, which], axis=1), axis=0)

    def relative(self, pairs: np.ndarray, std: float, turn: float, wrong: float = 0.0) -> PoseEdges:
        """Relative poses with noise of `std` m and `turn` rad; a share `wrong` is anything."""
        d, noise = self.d, self.rng.normal(size=(len(pairs), 1 if self.d == 2 else 3))
        rotation = np.swapaxes(self.rotation[pairs[:, 0]], 1, 2) @ self.rotation[pairs[:, 1]] @ exp(turn * noise)
        bad = self.rng.random(len(pairs)) < wrong
        rotation[bad] = self.rng.permutation(rotation[bad])
        moved = self.seen(pairs, std).position
        moved = np.where(bad[:, None], moved + self.rng.normal(0, 10.0, moved.shape), moved)
        cov = np.diag(np.r_[np.full(d, std**2), np.full(noise.shape[1], turn**2)])
        return PoseEdges(pairs, moved, to_orientation(rotation), np.tile(cov, (len(pairs), 1, 1)))

    def seen(self, pairs: np.ndarray, std: float) -> PointEdges:
        """Points in the frames of poses."""
        gap = self.position[pairs[:, 1]] - self.position[pairs[:, 0]]
        z = np.einsum("mji,mj->mi", self.rotation[pairs[:, 0]], gap) + std * self.rng.normal(size=gap.shape)
        return PointEdges(pairs, z, np.tile(std**2 * np.eye(self.d), (len(pairs), 1, 1)))

    def ranged(self, pairs: np.ndarray, std: float) -> RangeEdges:
        """Distances."""
        gap = np.linalg.norm(self.position[pairs[:, 1]] - self.position[pairs[:, 0]], axis=1)
        return RangeEdges(pairs, np.abs(gap + std * self.rng.normal(size=len(pairs))), np.full(len(pairs), std**2))

    def priors(self, std: float) -> PointEdges:
        """Of all points."""
        points = np.arange(self.poses, len(self.position))[:, None]
        z = self.position[self.poses :] + std * self.rng.normal(size=(len(points), self.d))
        return PointEdges(points, z, np.tile(std**2 * np.eye(self.d), (len(points), 1, 1)))

    def graph(self, **edges: PoseEdges | PointEdges | RangeEdges) -> Graph:
        """With the truth in its vertices."""
        count, points = self.poses, len(self.position) - self.poses
        names = [f"{'ABCDEFGH'[r]}{k}" for r in range(self.robots) for k in range(self.steps)]
        names += [f"L{k}" for k in range(points)]
        return Graph(
            self.d,
            tuple(names),
            np.arange(len(names)) < count,
            self.position,
            to_orientation(self.rotation),
            **edges,  # type: ignore[arg-type]
        )


def world(seed: int, d: int, robots: int, steps: int, points: int = 0, size: float = 40.0) -> World:
    """Drives of 1 m steps that turn at random and back to the middle within `size` m, and points among them."""
    rng, found, turned = np.random.default_rng(seed), [], []
    for _ in range(robots):
        at, course, bend = rng.uniform(-size / 2, size / 2, d), rng.uniform(-np.pi, np.pi), 0.0
        climb = 0.0
        for _ in range(steps):
            home = np.arctan2(-at[1], -at[0]) - course
            bend = 0.8 * bend + 0.08 * rng.normal()
            course += bend + 0.1 * np.sin(home) * max(0.0, np.hypot(at[0], at[1]) / size - 0.4)
            turn = exp(np.array([course])) if d == 2 else exp(np.array([0.0, 0.0, course]))
            if d == 3:
                climb = 0.95 * climb - 0.001 * at[2] + 0.03 * rng.normal()
                turn = turn @ exp(np.array([0.05 * rng.normal(), -climb, 0.0]))
            found.append(at.copy())
            turned.append(turn)
            at = at + turn[:, 0]
    beside = rng.uniform(-size, size, (points, d)) * np.r_[1, 1, np.full(d - 2, 0.3)]
    rotation = np.concatenate([np.array(turned), np.tile(np.eye(d), (points, 1, 1))])
    return World(rng, np.concatenate([np.array(found), beside]), rotation, robots, steps)


def blocks(seed: int, steps: int, size: int = 20) -> World:
    """A drive of 1 m steps along the streets of a Manhattan grid of 5 m blocks."""
    rng, at, course, found = np.random.default_rng(seed), np.zeros(2), 0, []
    for k in range(steps):
        if k % 5 == 0:
            course += int(rng.choice([-1, 0, 0, 1]))
            ahead = at + 5 * np.round([np.cos(course * np.pi / 2), np.sin(course * np.pi / 2)])
            course += 2 if np.abs(ahead).max() > size else 0
        found.append([*at, course * np.pi / 2])
        at = at + np.round([np.cos(course * np.pi / 2), np.sin(course * np.pi / 2)])
    table = np.array(found)
    return World(rng, table[:, :2], exp(table[:, 2:]), 1, steps)


def surface(seed: int, rings: int, around: int, shape: str) -> tuple[World, np.ndarray]:
    """A drive round a sphere, a torus or through a lattice, and the pairs that close its loops."""
    rng, k = np.random.default_rng(seed), np.arange(rings * around)
    u, v = 2 * np.pi * (k % around) / around, (k // around) / rings
    if shape == "lattice":
        side = around
        layer, row, column = k // (side * side), (k // side) % side, k % side
        column = np.where(row % 2 == 1, side - 1 - column, column)
        row = np.where(layer % 2 == 1, side - 1 - row, row)
        p = 2.0 * np.stack([column, row, layer], axis=1).astype(float)
        joined = np.array([(a, b) for a, b in _neighbours(p, 2.1) if b - a > 1])
    else:
        turn = u + 2 * np.pi * v / rings
        wide = 50 * np.sin(np.pi * (0.05 + 0.9 * v)) if shape == "sphere" else 30 + 10 * np.cos(2 * np.pi * v)
        high = -50 * np.cos(np.pi * (0.05 + 0.9 * v)) if shape == "sphere" else 10 * np.sin(2 * np.pi * v)
        p = np.stack([wide * np.cos(turn), wide * np.sin(turn), high], axis=1)
        joined = np.stack([k[:-around], k[around:]], axis=1)
    ahead = np.diff(p, axis=0, append=p[-1:] + (p[-1:] - p[-2:-1]))
    course = np.arctan2(ahead[:, 1], ahead[:, 0])
    rotation = exp(course[:, None] * np.array([0.0, 0.0, 1.0])) @ exp(0.1 * rng.normal(size=(len(k), 3)))
    return World(rng, p, rotation, 1, len(k)), joined


def _neighbours(p: np.ndarray, reach: float) -> np.ndarray:
    from scipy.spatial import cKDTree

    return cKDTree(p).query_pairs(reach, output_type="ndarray")


def joined(*parts: PoseEdges) -> PoseEdges:
    """Relative poses of several kinds as one."""
    names = ("nodes", "position", "orientation", "covariance")
    return PoseEdges(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def wrong(graph: Graph) -> np.ndarray:
    """(M,) relative poses that are 8 standard deviations and more off the vertices, which hold the truth."""
    edges = graph.relative_pose
    i, j = edges.nodes.T
    gap = np.einsum("mji,mj->mi", graph.rotation[i], graph.position[j] - graph.position[i])
    return np.asarray(np.linalg.norm(gap - edges.position, axis=1) > 8 * np.sqrt(edges.covariance[:, 0, 0]))


def lost(graph: Graph) -> Graph:
    """The graph without what its vertices hold."""
    return replace(graph, position=np.full_like(graph.position, np.nan))


def range_aided(seed: int) -> Graph:
    """One robot of 4,095 poses, 1,807 ranges to four landmarks, no loops."""
    w = world(seed, 2, 1, 4095, 4)
    return w.graph(relative_pose=w.relative(w.chain(), 0.03, 0.01), ranges=w.ranged(w.to_points(1807), 0.3))


def drone(seed: int) -> Graph:
    """One robot in space, ranges to five landmarks, noisy odometry."""
    w = world(seed, 3, 1, 1750, 5)
    return w.graph(relative_pose=w.relative(w.chain(), 0.05, 0.02), ranges=w.ranged(w.to_points(1500), 0.5))


def five_robots(seed: int) -> Graph:
    """Five robots of 1,260 poses, loops of their own and between them."""
    w = world(seed, 2, 5, 1260, size=80.0)
    loops = np.concatenate([w.near(100, 8.0), w.near(300, 8.0, others=True)])
    return w.graph(relative_pose=joined(w.relative(w.chain(), 0.05, 0.03), w.relative(loops, 0.1, 0.03)))


def ranging_robots(seed: int) -> Graph:
    """Four robots of 1,000 poses with nothing but odometry and ranges between them."""
    w = world(seed, 2, 4, 1000)
    ranges = w.ranged(w.near(3000, 30.0, others=True), 0.2)
    return w.graph(relative_pose=w.relative(w.chain(), 0.03, 0.01), ranges=ranges)


def marine(seed: int) -> Graph:
    """Two robots, landmarks with priors that are seen and ranged."""
    w = world(seed, 2, 2, 800, 8)
    return w.graph(
        relative_pose=w.relative(w.chain(), 0.05, 0.03),
        relative_point=w.seen(w.to_points(60), 0.5),
        ranges=w.ranged(w.to_points(200), 0.5),
        point_prior=w.priors(0.5),
    )


def two_anchors(seed: int) -> Graph:
    """Ranges to two anchors at known places, and odometry."""
    w = world(seed, 2, 1, 1000, 2)
    return w.graph(
        relative_pose=w.relative(w.chain(), 0.05, 0.02),
        ranges=w.ranged(w.to_points(400), 0.3),
        point_prior=w.priors(0.1),
    )


def round_surface(shape: str, rings: int, around: int, turn: float) -> Callable[[int], Graph]:
    """A graph in space of loops between neighbours."""

    def made(seed: int) -> Graph:
        w, loops = surface(seed, rings, around, shape)
        return w.graph(relative_pose=joined(w.relative(w.chain(), 0.1, turn), w.relative(loops, 0.1, turn)))

    return made


def manhattan(factor: float, wrong: float = 0.0, steps: int = 3500) -> Callable[[int], Graph]:
    """Streets, loops where the drive crosses itself, odometry `factor` times as bad, a share `wrong` of loops that are
    outliers."""

    def made(seed: int) -> Graph:
        w = blocks(seed, steps, int(20 * (steps / 3500) ** 0.5))
        edges = joined(w.relative(w.chain(), 0.02, 0.01), w.relative(w.near(4 * steps // 7, 1.5), 0.02, 0.01, wrong))
        graph = w.graph(relative_pose=edges)
        return worse_odometry(graph, factor) if factor > 1 else graph

    return made


def random_ranges(steps: int) -> Callable[[int], Graph]:
    """Bad odometry, and twice as many ranges as poses between any of them."""

    def made(seed: int) -> Graph:
        w = world(seed, 2, 1, steps)
        pairs = np.sort(w.rng.integers(0, steps, (2 * steps, 2)), axis=1)
        ranges = w.ranged(pairs[pairs[:, 1] - pairs[:, 0] > 1], 0.1)
        return w.graph(relative_pose=w.relative(w.chain(), 0.1, 0.05), ranges=ranges)

    return made


def hidden_frames(seed: int) -> Graph:
    """Four robots of which nothing is known but what they measure of one another."""
    return lost(five_robots(seed))


def weights(seed: int) -> Graph:
    """Standard deviations between 0.001 and 1 of the same noise: weights six orders apart."""
    w = world(seed, 2, 2, 800)
    loops = np.concatenate([w.near(300, 5.0), w.near(50, 8.0, others=True)])
    edges = joined(w.relative(w.chain(), 0.02, 0.01), w.relative(loops, 0.02, 0.01))
    scale = 10.0 ** w.rng.uniform(-1.5, 1.5, len(edges))
    return w.graph(relative_pose=replace(edges, covariance=edges.covariance * (scale**2)[:, None, None]))


def zero_ranges(seed: int) -> Graph:
    """Two robots whose ranges are often zero: one rides on the other for a while."""
    w = world(seed, 2, 2, 300)
    position, rotation = w.position.copy(), w.rotation.copy()
    position[300:], rotation[300:] = position[:300], rotation[:300]
    w = replace(w, position=position, rotation=rotation)
    pairs = np.stack([np.arange(0, 300, 3), np.arange(300, 600, 3)], axis=1)
    ranges = replace(w.ranged(pairs, 0.1), distance=np.zeros(len(pairs)))
    return w.graph(relative_pose=w.relative(w.chain(), 0.02, 0.01), ranges=ranges)


def two_parts(seed: int) -> Graph:
    """Two robots that never meet."""
    w = world(seed, 2, 2, 500)
    return w.graph(relative_pose=joined(w.relative(w.chain(), 0.05, 0.02), w.relative(w.near(50, 5.0), 0.05, 0.02)))


def seen_once(seed: int) -> Graph:
    """Landmarks that one measurement holds each: a place where it was seen, a circle where it was ranged."""
    w = world(seed, 2, 1, 500, 6)
    pairs = np.stack([np.arange(0, 300, 50), np.arange(500, 506)], axis=1)
    return w.graph(
        relative_pose=joined(w.relative(w.chain(), 0.05, 0.02), w.relative(w.near(50, 5.0), 0.05, 0.02)),
        relative_point=w.seen(pairs[:3], 0.3),
        ranges=w.ranged(pairs[3:], 0.3),
    )


FAMILIES: dict[str, Callable[[int], Graph]] = {
    "range-aided 4095": range_aided,
    "range-aided odometry x 3": lambda seed: worse_odometry(range_aided(seed), 3.0),
    "drone": drone,
    "five robots": five_robots,
    "ranging robots": ranging_robots,
    "marine": marine,
    "two anchors": two_anchors,
    "sphere": round_surface("sphere", 50, 50, 0.05),
    "sphere, turns of 0.2": round_surface("sphere", 50, 50, 0.2),
    "torus": round_surface("torus", 50, 60, 0.05),
    "lattice": round_surface("lattice", 11 * 11, 11, 0.05),
    "Manhattan": manhattan(1.0),
    "Manhattan odometry x 3": manhattan(3.0),
    "Manhattan odometry x 10": manhattan(10.0),
    "hidden frames": hidden_frames,
    "weights": weights,
    "zero ranges": zero_ranges,
    "two parts": two_parts,
    "seen once": seen_once,
}
"""Name -> seed -> graph."""
SIZES: dict[str, Callable[[int], Graph]] = {
    "random ranges 1500": random_ranges(1500),
    "random ranges 3300": random_ranges(3300),
    "Manhattan 10000": manhattan(1.0, steps=10_000),
    "Manhattan 30000": manhattan(1.0, steps=30_000),
    "Manhattan 100000": manhattan(1.0, steps=100_000),
    "sphere 2200, turns of 0.3": round_surface("sphere", 44, 50, 0.3),
}
"""The same, by size."""


def ranged_drives(seed: int) -> Graph:
    """Small drives, in the plane or nearly so in space, of one to three robots, whose landmarks are ranged."""
    rng = np.random.default_rng(seed)
    d, robots, steps = int(rng.integers(2, 4)), int(rng.integers(1, 4)), int(rng.integers(15, 50))
    w = world(seed, d, robots, steps, int(rng.integers(1, 5)), size=20.0)
    if d == 3:
        w = replace(w, position=w.position * np.r_[1.0, 1.0, 10.0 ** rng.uniform(-2, 0)])
    drift, noise = 10.0 ** rng.uniform(-2, -0.7), 10.0 ** rng.uniform(-1, 0)
    pairs = w.to_points(int(rng.integers(8, 60)))
    if robots > 1:
        pairs = np.concatenate([pairs, w.near(60, 25.0, others=True)])
    return w.graph(relative_pose=w.relative(w.chain(), drift, 0.5 * drift), ranges=w.ranged(pairs, noise))


def restarted(graph: Graph, restarts: int = 50, seed: int = 0) -> tuple[list[Solution], float]:
    """Answers from the automatic start and from an x0 in the truth, and the least cost that GTSAM's own
    Levenberg-Marquardt reaches from the truth and from random starts."""
    import gtsam

    problem, truth = from_graph(graph), np.asarray(from_graph(graph, start="file").x0)
    answers = [solve(p, throw=False) for p in (problem, problem.replace_unchecked(x0=truth, search=Search()))]
    rng, space, posed, starts = np.random.default_rng(seed), problem.space, which_turn(problem), [truth]
    wide, points, still = np.ptp(graph.position, axis=0).max(), ~graph.is_pose, list(problem.fixed)
    for k in range(restarts):  # landmarks anywhere where odometry leads or beside the truth, or all anywhere
        turned = exp(np.pi * rng.normal(size=(len(truth), 1 if graph.dimension == 2 else 3)))
        x = space.join(rng.uniform(-wide, wide, (len(truth), graph.dimension)), turned)
        if k % 3:
            x = np.where(points[:, None], x, (truth, np.asarray(problem.x0))[k % 3 - 1])
        x[still] = truth[still]
        starts.append(x)
    native, params, costs = graph_of(problem, forms(problem)), gtsam.LevenbergMarquardtParams(), [np.inf]
    params.setRelativeErrorTol(1e-8)
    for x in starts:
        optimizer = gtsam.LevenbergMarquardtOptimizer(native, values(space, posed, x), params)
        with suppress(RuntimeError):  # a singular system
            optimizer.optimize()
            costs.append(optimizer.error())
    return answers, min(costs)


def main() -> None:
    """Print how many answers to small graphs are within 1e-4 of the best of GTSAM's, with and without a note."""
    first, count = (int(each) for each in (*sys.argv[1:], "1000", "100")[:2])
    worse, silent = 0, 0
    for seed in range(first, first + count):
        answers, best = restarted(ranged_drives(seed))
        for start, found in zip(("auto", "truth"), answers, strict=True):
            if found.cost > best * (1 + 1e-4) + 1e-9:
                worse, silent = worse + 1, silent + (not found.notes)
                print(f"seed {seed}, {start}: {found.cost:.6g}, GTSAM {best:.6g}: {found.notes or 'WITHOUT A NOTE'}")
    print(f"{2 * count - worse} of {2 * count} as good, {worse - silent} worse with a note, {silent} without one")


if __name__ == "__main__":
    main()

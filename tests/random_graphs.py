"""Random factor graphs: robots that drive about with odometry, loops, landmarks and ranges, and stars."""

import numpy as np
from scipy.spatial.transform import Rotation

from coopoc.formats.graph import Graph, PointEdges, PoseEdges, RangeEdges
from coopoc.formats.values import to_orientation
from coopoc.optimize import Loss, Problem
from coopoc.optimize.model.space import exp

REACH = 12.0
"""m within which robots see one another and landmarks."""


def random_graph(
    seed: int,
    dimension: int = 2,
    robots: int = 2,
    steps: int = 60,
    landmarks: int = 6,
    loops: int = 10,
    ranges: int = 80,
    seen: int = 40,
    turn_std: float = 0.01,
    step_std: float = 0.05,
    range_std: float = 0.1,
    priors: bool = False,
) -> Graph:
    """Robots A, B, ... of `steps` poses 1 m apart within 40 m, whose vertices hold the truth.

    Args:
        loops: relative poses between poses that are near each other, other than the odometry.
        ranges: distances between poses and landmarks or other robots, at least five to each landmark if at all.
        seen: landmarks' positions in the body of a pose.
        turn_std: rad, of odometry and loops; step_std: m.
        priors: landmarks have one each, of 0.1 m.
    """
    rng, d = np.random.default_rng(seed), dimension
    p, turned = _paths(rng, d, robots, steps)
    beside = rng.normal(0, 5, (landmarks, d)) * np.r_[1, 1, np.full(d - 2, 0.4)]
    world = np.concatenate([p, p[rng.integers(0, len(p), landmarks)] + beside])
    names = tuple(f"{chr(65 + r)}{k}" for r in range(robots) for k in range(steps))
    names += tuple(f"L{k}" for k in range(landmarks))
    count = robots * steps
    odometry = np.array([(r * steps + k, r * steps + k + 1) for r in range(robots) for k in range(steps - 1)])
    far = np.linalg.norm(world[:, None] - world[None], axis=-1)
    near = np.argwhere(np.triu(far[:count, :count] < REACH, 3))
    loop = near[rng.permutation(len(near))[:loops]]
    pairs = np.concatenate([odometry, loop.reshape(-1, 2)])
    to_mark = np.argwhere(far[:count, count:] < 2 * REACH) + np.array([0, count])
    other = np.argwhere(far[:count, :count] < 2 * REACH)
    other = other[np.diff(other // steps)[:, 0] > 0]
    to_mark = to_mark[rng.permutation(len(to_mark))]
    marks = range(count, count + landmarks)
    enough = np.concatenate([to_mark[:0], *(to_mark[to_mark[:, 1] == mark][:5] for mark in marks)])
    ranged = np.concatenate([to_mark, other])
    ranged = np.concatenate([enough, ranged[rng.permutation(len(ranged))]])[: ranges or None]
    ranged = ranged[np.sort(np.unique(ranged, axis=0, return_index=True)[1])]
    bodies = to_mark[rng.permutation(len(to_mark))[:seen]]
    rotation = np.concatenate([turned, np.tile(np.eye(d), (landmarks, 1, 1))])
    angles = 2 * d - 3
    cov = np.diag(np.r_[np.full(d, step_std**2), np.full(angles, turn_std**2)])

    def local(nodes: np.ndarray, std: float) -> np.ndarray:
        i, j = nodes.T
        return np.einsum("mji,mj->mi", turned[i], world[j] - world[i]) + std * rng.normal(size=(len(nodes), d))

    relative = np.einsum("mji,mjk->mik", *(turned[ends] for ends in pairs.T))
    relative = relative @ exp(turn_std * rng.normal(size=(len(pairs), angles)))
    moved = local(pairs, step_std)
    distance = far[*ranged.T] + range_std * rng.normal(size=len(ranged))
    marked = np.arange(count, count + landmarks)[:, None]
    return Graph(
        d,
        names,
        np.arange(len(names)) < count,
        world,
        to_orientation(rotation),
        relative_pose=PoseEdges(pairs, moved, to_orientation(relative), np.tile(cov, (len(pairs), 1, 1))),
        relative_point=PointEdges(bodies, local(bodies, 0.2), np.tile(0.04 * np.eye(d), (len(bodies), 1, 1))),
        ranges=RangeEdges(ranged, np.maximum(distance, 0.1), np.full(len(ranged), range_std**2)),
        point_prior=PointEdges(
            marked, world[count:] + 0.1 * rng.normal(size=(landmarks, d)), np.tile(0.01 * np.eye(d), (landmarks, 1, 1))
        )
        if priors
        else PointEdges(),
    )


def _paths(rng: np.random.Generator, d: int, robots: int, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions (robots * steps, d) and rotations of drives that turn back towards the middle."""
    positions, turned = [], []
    for _ in range(robots):
        at, course, bend = rng.uniform(-10, 10, d) * np.r_[1, 1, np.full(d - 2, 0.2)], rng.uniform(-np.pi, np.pi), 0.0
        for _ in range(steps):
            home = np.arctan2(-at[1], -at[0]) - course
            homing = 0.1 * np.sin(home) * max(0.0, np.hypot(at[0], at[1]) / 20.0 - 0.3)
            bend = 0.8 * bend + 0.08 * rng.normal()
            course += bend + homing
            tilt = [] if d == 2 else [0.1 * rng.normal(), 0.1 * rng.normal()]
            positions.append(at.copy())
            turned.append(
                exp(np.array([course])) if d == 2 else Rotation.from_euler("zyx", [course, *tilt]).as_matrix()
            )
            at += np.array(turned[-1])[:, 0]
    return np.array(positions), np.array(turned)


def star(
    kind: str,
    seed: int,
    neighbours: int = 6,
    fix_std: float = 2.0,
    height: float = 0.2,
    loss: Loss | None = None,
    wrong: int = 0,
) -> Problem:
    """An ego with ranges to, or azimuths of, its neighbours, the first `wrong` 40 m or rad too large, and fixes."""
    rng = np.random.default_rng(seed)
    truth = np.concatenate([np.zeros((1, 3)), rng.uniform(-25, 25, (neighbours, 3)) * [1, 1, height]])
    names = ("ego", *(f"v{j}" for j in range(1, neighbours + 1)))
    fixes = truth + rng.normal(0, fix_std, truth.shape)
    problem = Problem(names, separator=(0,)).add("position", names, fixes, std=fix_std)
    v, std = truth[1:], 0.5 if kind == "range" else 0.05
    z = np.linalg.norm(v, axis=1) if kind == "range" else np.arctan2(v[:, 1], v[:, 0])
    z = z + rng.normal(0, std, neighbours) + 40.0 * (np.arange(neighbours) < wrong)
    return problem.add(kind, [("ego", n) for n in names[1:]], z[:, None], std=std, loss=loss)

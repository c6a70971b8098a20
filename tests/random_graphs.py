"""Random factor graphs: robots that drive about with odometry, loops, landmarks and ranges, and stars."""

from functools import partial
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from unseen_graphs import joined, world

from coopoc.formats.graph import PointEdges, RangeEdges
from coopoc.optimize import Problem

AB = "a", "b"
PAIR = Problem(AB).add("position", ["a", "b"], [[0, 0, 0], [9, 0, 0]], std=1.0)
"""Two points with fixes."""


def torn(loss=None):
    """A point that two displacements from a held one place 140 m apart."""
    held = Problem([*"oa"], x0=np.eye(2, 3), fixed=(0,))
    return held.add("displacement", [(0, 1)] * 2, [[-40] * 3, [40] * 3], std=1.0, loss=loss)


def moved(problem, x, v):
    """x after a step of the numbers that can move; in the plane a derivative there is one by v."""
    step = np.zeros(problem.movable.shape)
    step[problem.movable] = v
    return problem.space.retract(x, step)


def scipys(problem, start, **options: Any):
    """SciPy's least squares over the numbers that can move, from nodes (n, ambient), with our derivatives."""
    free = np.flatnonzero(problem.movable)

    def at(v):
        return problem.whiten(moved(problem, start, v))

    return least_squares(lambda v: at(v)[0], np.zeros(len(free)), lambda v: at(v)[1][:, free].toarray(), **options)


def random_graph(
    seed,
    dimension=2,
    robots=2,
    steps=60,
    landmarks=6,
    loops=10,
    ranges=80,
    seen=40,
    turn_std=0.01,
    step_std=0.05,
    priors=False,
):
    """Robots A, B, ... of `steps` poses 1 m apart within 40 m, whose vertices hold the truth.

    Args:
        loops: relative poses of a robot between poses that are near each other, and as many between robots.
        ranges: distances between poses and landmarks, at least four to each landmark, and as many between robots.
        seen: landmarks' positions in the body of a pose.
        turn_std: rad, of odometry and loops; step_std: m.
        priors: landmarks have one each, of 0.1 m.
    """
    w = world(seed, dimension, robots, steps, landmarks)
    near = [w.near(loops, 12.0, others) for others in (False, True)]
    poses = joined(*(w.relative(pairs, step_std, turn_std) for pairs in (w.chain(), *near)))
    ranged = [w.near(ranges, 24.0, others=True), *([w.to_points(ranges)] if ranges and landmarks else [])]
    return w.graph(
        relative_pose=poses,
        relative_point=w.seen(w.to_points(seen), 0.2) if seen and landmarks else PointEdges(),
        ranges=w.ranged(np.concatenate(ranged), 0.1) if ranges else RangeEdges(),
        point_prior=w.priors(0.1) if priors else PointEdges(),
    )


random_drive = partial(random_graph, robots=1, landmarks=0, ranges=0)
"""Odometry and loops of one robot."""


def star(kind, seed, neighbours=6, fix_std=2.0, height=0.2):
    """An ego with ranges to, or azimuths of, its neighbours, and fixes."""
    rng = np.random.default_rng(seed)
    truth = np.concatenate([np.zeros((1, 3)), rng.uniform(-25, 25, (neighbours, 3)) * [1, 1, height]])
    names = ("ego", *(f"v{j}" for j in range(1, neighbours + 1)))
    problem = Problem(names).add("position", names, truth + rng.normal(0, fix_std, truth.shape), std=fix_std)
    v, std = truth[1:], 0.5 if kind == "range" else 0.05
    z = np.linalg.norm(v, axis=1) if kind == "range" else np.arctan2(v[:, 1], v[:, 0])
    z = z + rng.normal(0, std, neighbours)
    return problem.add(kind, [("ego", n) for n in names[1:]], z[:, None], std=std)

"""Where to start: the linear least-squares solution of the converted measurements; of poses without an x0 the graph of
what is measured, along which they hang together.
"""

from collections import defaultdict
from typing import Any

import numpy as np

from ...arrays import Floats, Ints
from ...errors import InputError
from ...formats.graph import NAME, Graph, edges_of
from ...formats.values import to_orientation
from ..algebra.sparse import sparse
from ..assess.assess import largest
from ..model.derivatives import linearise
from ..model.factor import Factor, as_factor, bounded, stacked
from ..model.measurements import converted_rows
from ..model.problem import Problem
from .graph_starts import parts, walk, with_points

NUDGE_STD = 0.1
"""m or rad, standard deviation of such a move."""
PARALLEL = 1e-6
"""Sum of squared sines between bearings from which they cross."""
RIDGE = 1e-13
"""Share of its information that every point has of where it is, above rounding: what nothing places stays there."""
RIDGE_STEPS = 3
"""After which points that are placed, by measurements however weak beside others, hardly feel it."""


def initial_guess(problem: Problem) -> Floats:
    """(n, ambient): x0 if the problem has one, else the linear solution of vectors, see `converted_rows`.

    Raises:
        InputError: poses without an x0.
    """
    return guessed(problem)[0]


def guessed(problem: Problem) -> tuple[Floats, bool]:
    """`initial_guess`, and whether anything places every node in it."""
    if problem.x0 is not None:
        return problem.x0.copy(), True
    if problem.poses:
        raise InputError("x0", "none", "is needed where there are poses", "Give coopoc.optimize.pose(position, angle).")
    return converted(problem, np.zeros((len(problem.names), problem.dimension)))


def converted(problem: Problem, x: Floats) -> tuple[Floats, bool]:
    """Points (n, d) where vectors put them, from any x, and whether these touch all that can move."""
    system = sparse(problem)
    values = system.quadratic(x, "converted")[2]
    own = values[system.entries.diagonal]
    scale = largest(problem, own)
    values[system.entries.diagonal] = own + RIDGE * scale + (scale == 0.0)
    for _ in range(RIDGE_STEPS * system.cholesky.factor(values)):
        x = system.retract(x, -system.cholesky.solve(system.quadratic(x, "converted")[1]))
    return x, own.min(initial=np.inf) > 0.0


def directed(problem: Problem, x: Floats) -> Floats:
    """Nodes x (n, ambient) with those moved at random at which a measurement has no derivative."""
    rng, movable = np.random.default_rng(0), problem.movable
    for _ in range(5):
        lost = [nodes for _, nodes in undirected(problem, x)]
        if not lost:
            break
        step = np.zeros(movable.shape)
        nodes = np.unique(stacked(each.ravel() for each in lost))
        step[nodes] = NUDGE_STD * rng.normal(size=(len(nodes), movable.shape[1]))
        x = problem.space.retract(x, step * movable)
    return x


def crossed(problem: Problem, x: Floats) -> Floats:
    """Nodes x (n, ambient) in the plane, with points of which only bearings are measured where these cross: with the
    least sum of squared distances from their lines.

    >>> seen = Problem(("a", "b", "mark"), dimension=2, poses=(0, 1))
    >>> seen = seen.add("bearing", [("a", "mark"), ("b", "mark")], [[np.pi / 4], [3 * np.pi / 4]], std=0.1)
    >>> crossed(seen, np.array([[0.0, 0, 1, 0, 0, 1], [2, 0, 1, 0, 0, 1], [9, 9, 1, 0, 0, 1]]))[2, :2].round(6)
    array([1., 1.])
    """
    seen = [factor for factor in problem.factors if factor.kind == "bearing" and problem.dimension == 2]
    placed = [factor.nodes.ravel() for factor in problem.factors if factor not in seen]
    squares, sums = np.zeros((len(x), 2, 2)), np.zeros((len(x), 2, 1))
    for factor in seen:
        i, j = factor.nodes.T
        angle = to_orientation(problem.space.rotation(x[i]))[:, 0] + factor.z[:, 0]
        across = np.stack([-np.sin(angle), np.cos(angle)], axis=-1)
        square = across[:, :, None] * across[:, None]
        np.add.at(squares, j, square)
        np.add.at(sums, j, square @ x[i, :2, None])
    squares[np.concatenate([*placed, problem.poses, problem.fixed]).astype(int)] = 0.0
    known = np.linalg.eigvalsh(squares)[:, 0] > PARALLEL
    x[known, :2] = np.linalg.solve(squares[known], sums[known])[..., 0]
    return x


def undirected(problem: Problem, x: Floats) -> list[tuple[Factor, Ints]]:
    """Measurements and bounds without a derivative at x (n, ambient), and the nodes (K, arity) of such rows."""
    if not problem.constraints and np.isfinite(sparse(problem).quadratic(x, "gauss-newton")[1]).all():
        return []
    items = *problem.factors, *map(as_factor, problem.constraints)
    counts = [*(np.array(True) for _ in problem.factors), *map(bounded, problem.constraints)]
    with np.errstate(all="ignore"):
        linear, undefined = linearise(problem.space, items, x), []
    for item, count, residual, jacobian in zip(items, counts, linear.residual, linear.jacobian, strict=True):
        bad = (count & ~np.isfinite(np.dstack([residual, jacobian])).all(2)).any(1)
        undefined += [(item, item.nodes[bad])] if bad.any() else []
    return undefined


FIELDS = {
    "pose": "pose_prior",
    "relative_pose": "relative_pose",
    "relative_position": "relative_point",
    "body_spherical": "relative_point",
    "position": "point_prior",
    "range": "ranges",
}
"""Kinds of a graph's edges, by the kind of a factor without what follows its name."""
UNMEASURED_WEIGHT = 1e-9
"""1/m^2 or 1/rad^2, of a component that is not measured."""


def graph_of(problem: Problem) -> Graph:
    """The graph of what a problem measures, and of where it fixes nodes; what a graph has no edge for is left out.

    >>> problem = Problem(("here", "there"), dimension=2, poses=(0,)).add("position", "there", [3.0, 4.0], std=1.0)
    >>> graph_of(problem.add("range", ("here", "there"), 5.0, std=0.1))
    Graph(2-D: 1 poses of 1 robots, 1 points; 1 point_prior, 1 ranges)
    """
    d, n, poses = problem.dimension, len(problem.names), np.isin(np.arange(len(problem.names)), problem.poses)
    rows = defaultdict[str, list[Any]](list)
    for factor in problem.factors:
        field = _field(factor)
        used = factor.informative & (~poses[factor.nodes[:, -1]] if "point" in field else True)
        if field and used.any():
            rows[field].append([part[used] for part in (factor.nodes, *_measured(problem, factor))])
    edges = {}
    for field, own in rows.items():
        nodes, values, covariance = map(np.concatenate, zip(*own, strict=True))
        edges[field] = edges_of(field, nodes, values, covariance, ())
    names, still = problem.names, list(problem.fixed)
    at, orientation = np.full((n, d), np.nan), np.full((n, 1 if d == 2 else 4), np.nan)
    if problem.x0 is not None:
        held = problem.x0[still]
        at[still], orientation[still] = problem.space.position(held), to_orientation(problem.space.rotation(held))
    if not all(map(NAME.fullmatch, names)):
        part = parts(n, *(nodes for nodes, *_ in rows["relative_pose"]))
        names = tuple(f"{chr(65 + part[k] % 26)}{k}" for k in range(n))
    return Graph(d, names, poses, at, orientation, fixed=still, **edges)  # type: ignore[arg-type]


def along_poses(problem: Problem) -> Floats:
    """x0 (n, ambient) with poses where relative poses lead, from fixed poses, then from others, and points without a
    fix where a pose sees them, or by ranges.

    The start of a graph may follow measurements that have no weight here.
    """
    graph, space, x = graph_of(problem), problem.space, initial_guess(problem)
    roots = [(k, space.position(x[k]), space.rotation(x[k])) for k in (*problem.fixed, *problem.poses)]
    position, rotation, placed = walk(graph, np.ones(len(graph.relative_pose), bool), roots)
    position[~placed], rotation[~placed] = space.position(x[~placed]), space.rotation(x[~placed])
    return with_points(graph, position, rotation, placed)[:, : space.ambient]


def joining(problem: Problem) -> list[Ints]:
    """Of each factor that holds nodes in one body, their pairs: relative poses, and points that a pose sees."""
    every = [(f, f.nodes[f.informative]) for f in problem.factors if _field(f).startswith("relative")]
    return [n if f.measurement.compares_poses else n[np.isin(n[:, 1], problem.poses, invert=True)] for f, n in every]


def _field(factor: Factor) -> str:
    return FIELDS.get(factor.kind.removesuffix("_chordal").removesuffix("_log"), "")


def _measured(problem: Problem, factor: Factor) -> tuple[Floats, Floats]:
    """Values and covariances of a factor as a graph's edges have them, the same along all axes and about them."""
    d, space, root, z = problem.dimension, problem.space, factor.root, factor.z
    if factor.kind == "body_spherical":  # as vectors with the rotated covariance
        distance, rows = converted_rows([*z.T], np)
        axes = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
        root, z = root @ axes, distance[:, None] * axes[:, 0]
    information = np.square(root).sum(1) + UNMEASURED_WEIGHT
    variance = 1.0 / np.repeat(information[:, :d].mean(axis=1, keepdims=True), d, axis=1)
    if factor.measurement.compares_poses:
        z = np.hstack([space.position(z), to_orientation(space.rotation(z))])
        variance = np.hstack([variance, *[1.0 / information[:, d:].mean(axis=1, keepdims=True)] * space.angles])
    return z, variance[:, :, None] * np.eye(variance.shape[1])

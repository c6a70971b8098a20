"""Starts of poses without an x0: the graph of what is measured, each body where fixes and ranges put it."""

from collections import defaultdict
from typing import Any

import numpy as np

from ...arrays import Bools, Floats, Ints
from ...formats.graph import NAME, Graph, edges_of
from ...formats.values import to_orientation
from ..algebra.sparse import sparse
from ..descent.levenberg_marquardt import arrive
from ..model.derivatives import linearise
from ..model.factor import Factor, fused, stacked, taken, unchecked
from ..model.measurements import CONVERTED
from ..model.problem import Problem
from ..model.space import exp
from .graph_starts import parts, trilaterate, walk, with_points
from .initial import as_vectors, by_vectors, directed, initial_guess
from .mirrors import RANGES, ranges_of

FIELDS = {
    "pose": "pose_prior",
    "relative_pose": "relative_pose",
    "relative_position": "relative_point",
    "body_spherical": "relative_point",
    "position": "point_prior",
    "range": "ranges",
}
"""Kinds of a graph's edges, by the kind of a factor without what follows its name."""
UNKNOWN = 1e-9
"""1/m^2 or 1/rad^2, of a component that is not measured."""
ROWS_USED = 300
"""Fixes and ranges of a body that are used, spread over all."""
FIRST_STEPS, LAST_STEPS = 10, 100
"""Steps from each turn of a body, and from the best of these."""
ARRIVED = 0.1
"""m or rad, the last step towards where a body turns."""
MAX_STD = 1e100
"""Standard deviations, whose square is a number."""
FIXES = "position", "antenna"
"""Kinds whose z is where their first node is, or nearly."""
PLACING = {*FIELDS, "bearing", "displacement", CONVERTED}
"""Kinds by which a start places nodes; where there are others, nodes are drawn, too."""
LEVER = 1e-2
"""1/m^2 beside directions of length 1: a point of which there are no more bearings lies a few metres ahead."""


def graph_of(problem: Problem) -> Graph:
    """The graph of what a problem measures; what a graph has no edge for is left out.

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
    names = problem.names
    if not all(map(NAME.fullmatch, names)):
        part = parts(n, *(nodes for nodes, *_ in rows["relative_pose"]))
        names = tuple(f"{chr(65 + part[k] % 26)}{k}" for k in range(n))
    return Graph(d, names, poses, np.full((n, d), np.nan), np.full((n, 1 if d == 2 else 4), np.nan), **edges)  # type: ignore[arg-type]


def along_poses(problem: Problem) -> Floats:
    """x0 (n, ambient) with poses where relative poses lead, from fixed poses, then from others, and points without a
    fix where a pose sees them, or by ranges.

    The start of a graph may follow measurements that have no weight here.
    """
    graph, space, x = graph_of(problem), problem.space, initial_guess(problem)
    roots = [(k, space.position(x[k]), space.rotation(x[k])) for k in (*problem.fixed, *problem.poses)]
    position, rotation, placed = walk(graph, np.ones(len(graph.relative_pose), dtype=bool), roots)
    position[~placed], rotation[~placed] = space.position(x[~placed]), space.rotation(x[~placed])
    placed[list(problem.fixed)] = True
    return with_points(graph, position, rotation, placed)[:, : space.ambient]


def joining(problem: Problem) -> list[Ints]:
    """Of each factor that holds nodes in one body, their pairs: relative poses, and points that a pose sees."""
    every = [(f, f.nodes[f.informative]) for f in problem.factors if _field(f).startswith("relative")]
    points = np.setdiff1d(np.arange(len(problem.names)), problem.poses)
    return [n if f.measurement.compares_poses else n[np.isin(n[:, 1], points)] for f, n in every]


def facing(problem: Problem) -> Floats:
    """Nodes (n, ambient) where vectors in place of ranges and angles in body frames lead from x0: by these a pose turns
    to what it sees, however far."""
    factors = (
        unchecked(as_vectors(f), kind="relative_position") if f.kind == "body_spherical" else f for f in problem.factors
    )
    part = problem.replace_unchecked(factors=tuple(factors))
    return arrive(sparse(part), np.array(problem.x0), LAST_STEPS, ARRIVED).x


def _plain(factor: Factor) -> str:
    return factor.kind.removesuffix("_chordal").removesuffix("_log")


def _field(factor: Factor) -> str:
    return FIELDS.get(_plain(factor), "")


def _measured(problem: Problem, factor: Factor) -> tuple[Floats, Floats]:
    """Values and covariances of a factor as a graph's edges have them, the same along all axes and about them."""
    d, space = problem.dimension, problem.space
    factor = as_vectors(factor) if factor.kind == "body_spherical" else factor
    information, z = np.square(factor.root).sum(axis=1) + UNKNOWN, factor.z
    variance = 1.0 / np.repeat(information[:, :d].mean(axis=1, keepdims=True), d, axis=1)
    if factor.measurement.compares_poses:
        z = np.concatenate([space.position(z), to_orientation(space.rotation(z))], axis=1)
        turn = 1.0 / information[:, d:].mean(axis=1, keepdims=True)
        variance = np.concatenate([variance, np.repeat(turn, space.angles, axis=1)], axis=1)
    return z, variance[:, :, None] * np.eye(variance.shape[1])


def placed(problem: Problem, x: Floats) -> Floats:
    """Nodes x (n, ambient) with each body, which relative measurements hold together, turned and moved to where all
    that is measured between it and the world, or what is placed, fits best: the one with most such numbers first.
    Points go to their fixes, and where vectors and ranges put them.

    A body with a measured pose stays, and so does the first where nothing is placed. At last points go where bearings
    from poses cross.
    """
    d, n, x = problem.dimension, len(x), x.copy()
    bare = [unchecked(taken(f, np.flatnonzero(f.informative)), loss=None) for f in problem.factors]
    factors, ranges = [as_vectors(f) if f.kind == CONVERTED else f for f in bare], ranges_of(problem, x)
    part = parts(n, *joining(problem))
    single, vectors = np.bincount(part)[part] == 1, [f for f in factors if f.kind == "displacement"]
    stays = [part[f.nodes[:, 0]] for f in factors if f.kind.startswith("pose")]
    placing = stacked(f.nodes[:, :2].ravel() for f in factors if f.kind in RANGES or _plain(f) in PLACING)
    known = np.isin(part, stacked(stays)) | (single & ~np.isin(np.arange(n), placing))  # such as an antenna's arm
    for f in factors:
        if f.kind in FIXES:
            own = np.flatnonzero(single[f.nodes[:, 0]])
            x[f.nodes[own, 0], :d], known[f.nodes[own, 0]] = f.z[own], True
    while not known.all():
        numbers, aligning = np.zeros(n), [_aligning(f, part, known) for f in factors]
        for f, (_, body) in zip(factors, aligning, strict=True):
            if f.measurement.components[0] != "angle":
                numbers += f.size * np.bincount(body, minlength=n)
        best = np.lexsort([~single, numbers[part], ~known])[-1]
        moving = np.flatnonzero(part == part[best])
        own_factors = [taken(f, rows[body == part[best]]) for f, (rows, body) in zip(factors, aligning, strict=True)]
        if not single[best] and any(len(f.nodes) for f in own_factors):
            x[moving] = _fitted(problem, x, moving, own_factors)
        elif any(len(f.nodes) for f in own_factors if f.kind == "displacement"):
            linked = parts(n, *(f.nodes[(single | known)[f.nodes].all(axis=1)] for f in vectors))
            moving = np.flatnonzero(single & ~known & np.isin(linked, linked[known]))
            x = by_vectors(problem, x, np.setdiff1d(np.arange(n), moving), vectors)
        elif single[best]:
            edge = np.flatnonzero((known[ranges.nodes].sum(axis=1) == 1) & (ranges.weight > 0))
            ranged = np.where(known[ranges.nodes[edge, 0]], *ranges.nodes[edge, ::-1].T)
            others, seen = ranges.nodes[edge].sum(axis=1) - ranged, np.bincount(ranged, minlength=n)
            moving = np.flatnonzero(single & ~known & (seen >= min(seen[best], d + 1)))
            for node in moving[seen[moving] > 0].tolist():
                x[node, :d] = trilaterate(x[others[ranged == node], :d], ranges.distance[edge[ranged == node]])
        known[moving] = True
    return directed(problem, _crossed(problem, x))


def _aligning(factor: Factor, part: Ints, known: Bools) -> tuple[Ints, Ints]:
    """Rows of a factor that measure one body against the world or what is known, and its number in `part`."""
    new, own = ~known[factor.nodes], part[factor.nodes]
    body = own.max(axis=1, where=new, initial=-1)
    against = (own.shape[1] == 1) | ~new.all(axis=1)
    rows = np.flatnonzero(new.any(axis=1) & against & (~new | (own == body[:, None])).all(axis=1))
    return rows, body[rows]


def _fitted(problem: Problem, x: Floats, body: Ints, factors: list[Factor]) -> Floats:
    """Nodes of a body (K, ambient) moved from where they are in x (n, ambient), as a rigid body, to where factors
    without loss fit best, from turns that are spread over all."""
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    space, d = problem.space, problem.dimension
    factors = [taken(f, np.arange(0, len(f.nodes), len(f.nodes) // ROWS_USED + 1)) for f in factors if len(f.nodes)]
    at, rotation = space.position(x[body]), space.rotation(x[body])
    ends = ((f, f.nodes[:, :2][~np.isin(f.nodes[:, :2], body)]) for f in factors)
    known = np.concatenate([f.z[:, :d] if f.kind in FIXES else x[outside, :d] for f, outside in ends])
    middle = at.mean(axis=0)
    to = known.mean(axis=0) if len(known) else middle

    def moved(v: Floats, turn: Floats) -> Floats:
        turned, there = exp(v[d:]) @ turn, x.copy()
        there[body] = space.join(to + v[:d] + (at - middle) @ turned.T, turned @ rotation)
        return there

    def residuals(v: Floats, turn: Floats) -> Floats:
        white = linearise(space, factors, None, moved(v, turn)).residual
        return np.asarray(np.clip(np.nan_to_num(np.concatenate([r.ravel() for r in white])), -MAX_STD, MAX_STD))

    def fitted(v: Floats, turn: Floats, steps: int) -> tuple[float, Floats, Floats]:
        end = least_squares(residuals, v, args=(turn,), max_nfev=steps)
        return float(end.cost), end.x, turn

    turns = exp(np.arange(8)[:, None] * np.pi / 4) if d == 2 else Rotation.create_group("O").as_matrix()
    _, v, turn = min((fitted(np.zeros(space.dof), each, FIRST_STEPS) for each in turns), key=lambda end: end[0])
    return moved(*fitted(v, turn, LAST_STEPS)[1:])[body]


def _crossed(problem: Problem, x: Floats) -> Floats:
    """x with points of which there are bearings alone where these cross, as if all were level with the poses."""
    d, rotation = problem.dimension, problem.space.rotation(x)
    others = [f.nodes.ravel() for f in problem.factors if f.kind != "bearing"]
    for f in fused([f for f in problem.factors if f.kind == "bearing"])[:1]:
        for point in np.setdiff1d(f.nodes[:, 1], np.concatenate([problem.poses, *others])):
            (pose, _), angle = f.nodes[f.nodes[:, 1] == point].T, f.z[f.nodes[:, 1] == point, 0]
            ahead = np.einsum("mab,bm->ma", rotation[pose][:, :, :2], [np.cos(angle), np.sin(angle)])
            across = np.eye(d) - ahead[:, :, None] * ahead[:, None]
            right = np.einsum("mab,mb->a", across, x[pose, :d]) + LEVER * (x[pose[0], :d] + ahead[0])
            x[point, :d] = np.linalg.solve(across.sum(axis=0) + LEVER * np.eye(d), right)
    return x

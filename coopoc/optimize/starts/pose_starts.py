"""Starts of poses without an x0: the graph of what is measured, each body where fixes and ranges put it."""

from collections import defaultdict
from typing import Any

import numpy as np

from ...arrays import Floats
from ...formats.graph import NAME, Graph, edges_of
from ...formats.values import to_orientation
from ...world.links import wrap
from ..model.factor import Factor, fused, stacked, taken
from ..model.measurements import CONVERTED
from ..model.problem import Problem
from ..model.space import Space, exp
from .graph_starts import parts, trilaterate, walk, with_points
from .initial import as_vectors, by_vectors, directed, initial_guess
from .mirrors import ranges_of

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
MAX_STD = 1e100
"""Standard deviations, whose square is a number."""
PLACES_APART = 0.1
"""Share of the size of a body by which places of it differ."""
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


def places_all(problem: Problem) -> bool:
    """Whether a start knows all kinds of a problem."""
    return all(_plain(factor) in PLACING for factor in problem.factors)


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


def placed(problem: Problem, x: Floats, rank: int = 0) -> Floats:
    """Nodes x (n, ambient) with each body, which relative measurements hold together, turned and moved to where its
    fixes, and vectors, ranges and bearings between it and what is placed, fit best: those with most fixes first, then
    most ranges. The fix of an antenna is one of its pose, and a vector from what is placed is a fix.

    A body with a measured pose stays, and so does the first where nothing is placed. At last points go where bearings
    from poses cross. Of the places that ranges allow that of `rank` is taken, 0 the best.
    """
    d, space, x = problem.dimension, problem.space, x.copy()
    joined = [f.nodes[f.informative] for f in problem.factors if _field(f).startswith("relative")]
    part, ranges = parts(len(x), *joined), ranges_of(problem, x)
    fixes, vectors = (
        [taken(f, np.flatnonzero(f.informative)) for f in problem.factors if f.kind in kinds]
        for kinds in (("position", "antenna"), ("displacement", CONVERTED))
    )
    vectors = [as_vectors(f) if f.kind == CONVERTED else f for f in vectors]
    ends, vector = stacked((f.nodes for f in vectors), 2), stacked((f.z for f in vectors), d)
    own_fixed, own_fix = stacked(f.nodes[:, 0] for f in fixes), stacked((f.z for f in fixes), d)
    own_weight, vector_weight = (
        stacked(np.linalg.norm(f.root, axis=(1, 2)) / d**0.5 for f in factors) for factors in (fixes, vectors)
    )
    held = [part[f.nodes[:, 0]] for f in problem.factors if f.kind.startswith("pose")]
    known, single = np.isin(part, np.concatenate([[-1], *held])), np.bincount(part)[part] == 1
    aims = [f for f in problem.factors if f.kind == "bearing"]
    aimed = stacked((f.nodes for f in aims), 2)
    angle, sure = stacked(f.z[:, 0] for f in aims), stacked(f.root[:, 0, 0] for f in aims)
    here = (single & ~known)[own_fixed]
    x[own_fixed[here], :d], known[own_fixed[here]] = own_fix[here], True
    while not known.all():
        k, side = np.nonzero(known[ends[:, ::-1]] & ~known[ends])
        fixed = np.concatenate([own_fixed, ends[k, side]])
        fix = np.concatenate([own_fix, x[ends[k, 1 - side], :d] + np.where(side[:, None], 1.0, -1.0) * vector[k]])
        weight = np.concatenate([own_weight, vector_weight[k]])
        k, side = np.nonzero(known[ranges.nodes[:, ::-1]] & ~known[ranges.nodes] & (ranges.weight > 0)[:, None])
        own, places = ranges.nodes[k, side], ranges.nodes[k, 1 - side]
        seen = np.bincount(part[own], minlength=len(x))[part]
        best = np.lexsort([~single, seen, np.bincount(part[fixed], minlength=len(x))[part], ~known])[-1]
        moving, here = np.flatnonzero(part == part[best]), part[fixed] == part[best]
        there = (part[aimed[:, 0]] == part[best]) & known[aimed[:, 1]]
        if single[best] and here.any():
            linked = parts(len(x), ends[(single | known)[ends].all(axis=1)])
            moving = np.flatnonzero(single & ~known & np.isin(linked, linked[known]))
            x = by_vectors(problem, x, np.setdiff1d(np.arange(len(x)), moving), vectors)
        elif single[best]:
            moving = np.flatnonzero(single & ~known & (seen >= min(seen[best], d + 1)))
            for node in moving[seen[moving] > 0].tolist():
                x[node, :d] = trilaterate(x[places[own == node], :d], ranges.distance[k[own == node]])
        elif here.any() or seen[best] or there.any():
            rows = part[own] == part[best]
            distances = x[own[rows], :d], x[places[rows], :d], ranges.distance[k[rows]], ranges.weight[k[rows]]
            bearings = x[aimed[there, 0]], x[aimed[there, 1], :d], angle[there], sure[there]
            own_fixes = x[fixed[here], :d], fix[here], weight[here]
            x[moving] = _fitted(space, x[moving], own_fixes, distances, bearings, rank)
        known[moving] = True
    return directed(problem, _crossed(problem, x))


def _fitted(
    space: Space,
    body: Floats,
    fixes: tuple[Floats, ...],
    ranges: tuple[Floats, ...],
    bearings: tuple[Floats, ...],
    rank: int,
) -> Floats:
    """Nodes of a body (K, ambient) where it fits best, from turns that are spread over all.

    Args:
        space: of the nodes.
        body: its nodes.
        fixes: where they are on it (F, d), their fixes (F, d) and 1/m.
        ranges: where they are on it (M, d), the places (M, d) to which they have ranges, these (M,) and 1/m.
        bearings: poses of it (B, ambient), the places (B, d) of which they have bearings, these (B,) and 1/rad.
    """
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    d = space.dimension
    seen, fix, precise = (part[:: len(part) // ROWS_USED + 1] for part in fixes)
    near, places, distance, weight = (part[:: len(part) // ROWS_USED + 1] for part in ranges)
    poses, marks, angle, sure = (part[:: len(part) // ROWS_USED + 1] for part in bearings)
    middle, to = space.position(body).mean(axis=0), np.concatenate([fix, places, marks]).mean(axis=0)

    def moved(v: Floats, turn: Floats, at: Floats) -> Floats:
        return np.asarray(to + v[:d] + (at - middle) @ (exp(v[d:]) @ turn).T)

    def residuals(v: Floats, turn: Floats) -> Floats:
        off = (moved(v, turn, seen) - fix) * precise[:, None]
        length = np.linalg.norm(moved(v, turn, near) - places, axis=1)
        gap = marks - moved(v, turn, space.position(poses))
        east, north = np.einsum("mab,ma->bm", exp(v[d:]) @ turn @ space.rotation(poses), gap)[:2]
        aside = wrap(np.arctan2(north, east) - angle)
        every = np.concatenate([off.ravel(), (length - distance) * weight, aside * sure])
        return np.asarray(np.clip(np.nan_to_num(every), -MAX_STD, MAX_STD))

    def fitted(v: Floats, turn: Floats, steps: int) -> tuple[float, Floats, Floats]:
        end = least_squares(residuals, v, args=(turn,), max_nfev=steps)
        return float(end.cost), end.x, turn

    turns = exp(np.arange(8)[:, None] * np.pi / 4) if d == 2 else Rotation.create_group("O").as_matrix()
    ends = sorted((fitted(np.zeros(space.dof), each, FIRST_STEPS) for each in turns), key=lambda end: end[0])
    best, apart = list[Floats](), np.linalg.norm(space.position(body) - middle, axis=1).max()
    for _, v, turn in ends:
        _, v, turn = fitted(v, turn, LAST_STEPS)
        there = space.join(moved(v, turn, space.position(body)), exp(v[d:]) @ turn @ space.rotation(body))
        if all(np.abs(space.position(there - other)).max() > PLACES_APART * apart for other in best):
            best.append(there)
        if len(best) > rank:
            break
    return best[-1]


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

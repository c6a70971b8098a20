"""Starts of a graph: chained odometry, a spanning tree, points by trilateration, and one that grows with the drive."""

from collections.abc import Callable, Iterable, Sequence
from itertools import combinations, compress

import numpy as np
from numpy import flatnonzero, isfinite, zeros
from numpy.linalg import norm, pinv, svd

from ...arrays import Bools, Floats, Ints
from ...errors import InputError
from ...formats.graph import Graph, PointEdges, PoseEdges
from ..algebra.cholesky import Cholesky, cholesky_of
from ..algebra.sparse import sparse
from ..descent.levenberg_marquardt import arrive
from ..model.factor import stacked, taken, unchecked
from ..model.problem import Problem
from ..model.space import Space, carried, exp, log, nearest_rotation

Roots = Iterable[tuple[int, Floats, Floats]]
"""(pose, position, rotation) in the order in which the walk may start from them."""
STAGE = 25
"""Poses of the longest robot that the growing start adds at a time, at least."""
STAGES = 60
"""At most, unless odometry turns by more than DRIFT in one."""
DRIFT = 0.5
"""rad, standard deviation by which odometry may turn in a stage: beyond it a stage begins in no basin."""
SWEEPS = 10
"""Solves with the rotations of the one before; the matrix is factored once."""
PROXIMAL = 1e-4
"""Weight of the last rotations beside that of a median relative rotation: it acts over a hundred poses of a chain."""
WHOLE_GROWTH = 1.5
"""Growth after which a stage moves all nodes; the others move what is new and was so one stage before, and points."""
CUT_SPHERES = 12
"""Of the ranges of a point, whose spheres are cut."""
HOLDING = 2
"""Ranges per dimension from which a point is placed by them."""


def walk(graph: Graph, used: Bools, roots: Roots) -> tuple[Floats, Floats, Bools]:
    """Positions (n, d), rotations (n, d, d) and which are known (n,), along the shortest paths from the roots by the
    `used` relative poses, whose length is their variance."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import dijkstra

    edges, n, d = graph.relative_pose, len(graph.names), graph.dimension
    position, rotation = zeros((n, d)), np.tile(np.eye(d), (n, 1, 1))
    is_reached = zeros(n, bool)
    length, rows = np.trace(edges.covariance, axis1=1, axis2=2) + 1e-12, flatnonzero(used)
    which = rows[np.argsort(length[rows], kind="stable")]
    ends = np.stack([edges.nodes[which], edges.nodes[which, ::-1]], axis=1).reshape(-1, 2)  # there and back
    key, first = np.unique(ends[:, 0] * n + ends[:, 1], return_index=True)  # of parallel edges the shortest
    edge, forward = which[first // 2], first % 2 == 0
    lengths = csr_array((length[edge], key % n, np.searchsorted(key, n * np.arange(n + 1))), shape=(n, n))
    for root, at, turned in roots:
        if is_reached[root]:
            continue
        distance, before = dijkstra(lengths, indices=root, return_predecessors=True)
        reached = flatnonzero(isfinite(distance) & (before >= 0))
        before = before.astype(int)  # SciPy's 32 bits hold no product of two numbers beyond 46,340
        taken = np.searchsorted(key, before[reached] * n + reached)
        moved, turn = edges.position[edge[taken]], edges.rotation[edge[taken]]
        back = turn.mT
        turn = np.where(forward[taken, None, None], turn, back)
        moved = np.where(forward[taken, None], moved, -(back @ moved[..., None])[..., 0])
        index = np.full(n, -1)
        index[reached] = np.arange(len(reached))
        before = index[before[reached]]
        while (on := flatnonzero(before >= 0)).size:  # to poses as the root sees them: pointers jump
            by = before[on]
            moved[on] = moved[by] + (turn[by] @ moved[on, :, None])[..., 0]
            turn[on] = turn[by] @ turn[on]
            before[on] = before[by]
        position[root], rotation[root], is_reached[root] = at, turned, True
        position[reached], rotation[reached], is_reached[reached] = at + moved @ turned.T, turned @ turn, True
    return position, rotation, is_reached


def parts(n: int, *joined: Ints) -> Ints:
    """(n,) the connected component that each is in, by nodes (M, arity) that are joined; counted by first nodes.

    >>> parts(4, np.array([[3, 1]])).tolist()
    [0, 1, 2, 1]
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    pairs = stacked((nodes[:, k : k + 2] for nodes in joined for k in range(nodes.shape[1] - 1)), 2)
    part: Ints = connected_components(csr_array((np.ones(len(pairs)), pairs.T), (n, n)), directed=False)[1]
    return part


def crossings(places: Floats, ranges: Floats) -> Floats:
    """(C, d) points where d of the spheres of `ranges` (K,) around `places` (K, d) meet, or come nearest to it; of many
    some are cut that are spread over all.

    >>> crossings(np.array([[0.0, 0], [8, 0]]), np.array([5.0, 5])).round(6)
    array([[ 4., -3.],
           [ 4.,  3.]])
    """
    d, few = places.shape[1], np.unique(np.linspace(0, len(places) - 1, CUT_SPHERES).round().astype(int))
    chosen = np.array([*combinations(few, d)])
    p, r = places[chosen], ranges[chosen]
    gap = p[:, 1:] - p[:, :1]
    right = 0.5 * (np.square(gap).sum(2) - np.square(r[:, 1:]) + np.square(r[:, :1]))
    way, far = gap[:, 0], np.maximum(norm(gap[:, 0], axis=1, keepdims=True), 1e-99)
    if d == 2:  # in a tenth of the time
        foot, off = way / far * right / far, way[:, ::-1] / far * [-1, 1]
    else:
        foot, off = (pinv(gap) @ right[..., None])[..., 0], svd(gap)[2][:, -1]
    up = off * np.sqrt(np.maximum(np.square(r[:, :1]) - np.vecdot(foot, foot)[:, None], 0.0))
    return np.stack([p[:, 0] + foot - up, p[:, 0] + foot + up], axis=1).reshape(-1, d)


def trilaterate(places: Floats, ranges: Floats) -> Floats:
    """(d,) where spheres cross and all ranges fit best; of less than d spheres any point of one.

    Args:
        places: (K, d) m.
        ranges: (K,) m.

    >>> trilaterate(np.array([[0.0, 0], [8, 0], [4, 1]]), np.array([5.0, 5, 2])).round(6)
    array([4., 3.])
    """
    if len(places) < places.shape[1]:
        return np.asarray(places[0] + ranges[0] * np.eye(places.shape[1])[0])
    met = crossings(places, ranges)
    off = norm(met[:, None] - places, axis=2) - ranges
    return np.asarray(met[np.vecdot(off, off).argmin()])


def chained(graph: Graph) -> Floats:
    """(n, ambient): each robot's poses along its own relative poses, from a pose with a prior, else from its first
    vertex in the file; where the file has none, from a place on a ring."""
    return with_points(graph, *walk(graph, _own(graph), _roots(graph)))


def tree(graph: Graph) -> Floats:
    """(n, ambient): poses along the spanning tree of least variance over all relative poses, loop closures and those
    between robots too, their rotations then averaged, in space `relaxed`, and with these all positions averaged; what
    it does not join hangs on as in `chained`."""
    edges, roots, d = graph.relative_pose, _roots(graph), graph.dimension
    position, rotation, reached = walk(graph, np.ones(len(edges), bool), roots)
    held = [root for root, _, _ in roots]
    (i, j), variance = edges.nodes.T, rotation_variance(edges, d)
    if len(edges) and d == 3:
        rotation = relaxed(graph, rotation, held)
    elif len(edges):  # angles add, so that one solve is exact
        turns, _ = averaging(edges.nodes, variance, len(rotation), held)
        rotation = exp(turns(log(rotation[j] @ (rotation[i] @ edges.rotation).mT))) @ rotation
    every = ((each.nodes, each.position, position_variance(each, d)) for each in (edges, graph.relative_point))
    nodes, moved, variance = map(np.concatenate, zip(*every, strict=True))
    at, (i, j) = with_points(graph, position, rotation, reached)[:, :d], nodes.T
    places, _ = averaging(nodes, variance, len(at), held)
    at, still = at + places(at[j] - at[i] - (rotation[i] @ moved[..., None])[..., 0]), anchors(graph)
    at[still] = graph.position[still]
    return Space(d, has_rotation=True).join(at, rotation)


def relaxed(graph: Graph, rotation: Floats, held: Sequence[int]) -> Floats:
    """(n, d, d) minimum over any matrices of sum |R_j - R_i R_ij|_F^2 / var + |R_i - P_i|_F^2 / far, P those before,
    which are then projected to rotations, SWEEPS times; of each part the first that is `held` is as it was.

    Without the last term matrices shrink to zero along a chain, and what is left of them turns at random; with it each
    sweep is a step of a projected inverse power iteration.

    References:
        Carlone, Tron, Daniilidis, Dellaert, Initialization techniques for 3D SLAM, ICRA 2015 (chordal relaxation);
        Boumal, Nonconvex phase synchronization, SIAM J. Optim. 2016 (generalized power method).
    """
    from scipy.sparse import bsr_array, eye_array

    edges, (n, d, _) = graph.relative_pose, rotation.shape
    weight = 1.0 / np.sqrt(rotation_variance(edges, d))
    back, ones = -edges.rotation.mT, np.broadcast_to(np.eye(d), edges.rotation.shape)
    blocks = weight[:, None, None, None] * np.stack([back, ones], axis=1)
    gaps = bsr_array(
        (blocks.reshape(-1, d, d), edges.nodes.ravel(), 2 * np.arange(len(edges) + 1)), shape=(len(edges) * d, n * d)
    )
    far = PROXIMAL * np.median(weight) ** 2
    factored, turned = cholesky_of(gaps.T @ gaps + far * eye_array(n * d), np.repeat(np.arange(n), d)), rotation
    for _ in range(SWEEPS):
        if factored is None:
            return rotation
        turned = nearest_rotation(factored.solve(far * turned.mT.reshape(n * d, d)).reshape(n, d, d).mT)
    part = parts(n, edges.nodes)
    still = firsts(part, held)[part]
    return rotation[still] @ turned[still].mT @ turned


def firsts(part: Ints, held: Sequence[int]) -> Ints:
    """Of each part of all nodes (n,) the first that is `held`, or else its first."""
    still = np.unique(part, return_index=True)[1]
    for node in reversed(held):
        still[part[node]] = node
    return still


def averaging(
    nodes: Ints, variance: Floats, n: int, held: Sequence[int] = ()
) -> tuple[Callable[[Floats], Floats], Cholesky | None]:
    """Errors (M, k) of differences between pairs of nodes -> moves (n, k) which make the sum of squares over the
    variances least; and the factored Laplacian, None and no moves where rounding makes it indefinite. Of each part one
    of the `firsts` stays.

    References:
        Govindu, Lie-algebraic averaging for globally consistent motion estimation, CVPR 2004; Carlone et al., A fast
        and accurate approximation for planar pose graph optimization, IJRR 2014.
    """
    from scipy.sparse import csr_array, diags_array

    weight, ends, m = 1.0 / variance, nodes.ravel(), len(nodes)
    gap = csr_array((np.tile([-1.0, 1.0], m), ends, 2 * np.arange(m + 1)), shape=(m, n))
    pinned = zeros(n)  # of what may be shifted as a whole any weight holds a node where it is
    pinned[firsts(parts(n, nodes), held)] = weight.max(initial=1e-300)
    factored = cholesky_of(gap.T @ diags_array(weight) @ gap + diags_array(pinned))

    def moves(error: Floats) -> Floats:
        if factored is None:
            return zeros((n, error.shape[1]))
        return -factored.solve(gap.T @ (weight[:, None] * error))

    return moves, factored


def file(graph: Graph) -> Floats:
    """(n, ambient): the vertices as they are.

    Raises:
        InputError: a vertex without a position.
    """
    unknown = ~isfinite(graph.position).all(1)
    if unknown.any():
        needs = f"needs a position of {graph.names[int(unknown.argmax())]} in the file"
        raise InputError("start", "'file'", needs, 'Use start="odometry".')
    return Space(graph.dimension, has_rotation=True).join(graph.position, graph.rotation)


STARTS = {"odometry": chained, "file": file, "tree": tree}


def contenders(graph: Graph) -> tuple[str, ...]:
    """The starts that may differ on a graph, cheapest first: without loops all are chained odometry, but the file's
    vertices where they are a guess and not the truth."""
    from_file = ("file",) if graph.guess and isfinite(graph.position).all() else ()
    loops = len(graph.relative_pose.nodes) + len(graph.relative_point) + len(graph.point_prior) + len(graph.pose_prior)
    moved = len(graph.names) - len(np.setdiff1d(flatnonzero(~graph.is_pose), graph.relative_point.nodes[:, -1]))
    return (*("tree",) * (loops >= moved), "odometry", *from_file)


def _own(graph: Graph) -> Bools:
    """(M,) which relative poses join poses of one robot."""
    edges, letter = graph.relative_pose.nodes, np.array([ord(name[0]) for name in graph.names])
    return np.asarray(letter[edges[:, 0]] == letter[edges[:, 1]])


def _roots(graph: Graph) -> list[tuple[int, Floats, Floats]]:
    """Fixed poses, those with a prior at that, then each robot's first, and the first of each part that its odometry
    joins."""
    priors, poses = graph.pose_prior, flatnonzero(graph.is_pose)
    roots = [(int(i), graph.position[i], graph.rotation[i]) for i in anchors(graph) if graph.is_pose[i]]
    roots += [(int(i), priors.position[k], priors.rotation[k]) for k, i in enumerate(priors.nodes[:, 0])]
    part = parts(len(graph.names), graph.relative_pose.nodes[_own(graph)])[poses]
    _, first, count = np.unique(part, return_index=True, return_counts=True)
    robots = [int(places[0]) for places in graph.robots.values()]
    firsts = [*robots, *np.setdiff1d(poses[first[count > 1]], robots).tolist()]
    around = float(graph.ranges.distance.mean()) if len(graph.ranges) else 1.0
    for k, node in enumerate(firsts):
        angle = 2.0 * np.pi * k / len(firsts)
        if isfinite(graph.position[node]).all() and (graph.guess or k < len(robots)):
            roots.append((node, graph.position[node], graph.rotation[node]))
        else:
            at = around * np.array([np.cos(angle), np.sin(angle), 0.0])
            roots.append((node, at[: graph.dimension], np.eye(graph.dimension)))
    return roots


def anchors(graph: Graph) -> Ints:
    """Fixed vertices of which the graph has the place."""
    return graph.fixed[isfinite(graph.position[graph.fixed]).all(1)]


def with_points(graph: Graph, position: Floats, rotation: Floats, placed: Bools) -> Floats:
    """Nodes with the points where they are fixed, at their priors, where a pose sees them, or by ranges."""
    points, still = graph.point_prior, anchors(graph)
    position[points.nodes[:, 0]], placed[points.nodes[:, 0]] = points.position, True
    position[still], rotation[still], placed[still] = graph.position[still], graph.rotation[still], True
    for (i, j), at in zip(graph.relative_point.nodes.tolist(), graph.relative_point.position, strict=True):
        if not placed[j]:
            position[j], placed[j] = position[i] + rotation[i] @ at, True
    for j in flatnonzero(~placed & ~graph.is_pose).tolist():
        others, ranges = _ranged(graph, j, placed)
        if len(others):
            position[j] = trilaterate(position[others], ranges)
        placed[j] = True
    return Space(graph.dimension, has_rotation=True).join(position, rotation)


def _ranged(graph: Graph, point: int, placed: Bools) -> tuple[Ints, Floats]:
    """The known nodes to which a point has ranges, and these."""
    rows = flatnonzero((graph.ranges.nodes == point).any(1))
    others = graph.ranges.nodes[rows].sum(1) - point
    return others[placed[others]], graph.ranges.distance[rows[placed[others]]]


def incremental_start(graph: Graph, problem: Problem) -> tuple[Floats, int]:
    """Nodes (n, ambient) and iterations: each stage solves the measurements among the poses so far.

    Most stages move what is new alone, so that the whole costs a few steps of the last one (WHOLE_GROWTH).
    A stage begins at the answer of the one before, which it continues by the relative poses of the problem's x0, so
    that odometry drifts little. Points join when they are seen or have a prior, as x0 has them, or where enough ranges
    place them, and anew whenever these have doubled: few may have placed them on the wrong side.

    References:
        Kaess et al., iSAM, T-RO 2008: an estimate that follows the measurements in time.
    """
    x0 = np.asarray(problem.x0)
    space, x, n = problem.space, x0.copy(), len(graph.names)
    solved, ranges, iterations, whole = zeros(n, bool), zeros(n, int), 0, 0
    last, count = solved, _stages(graph)
    for stage in range(count):
        used = zeros(n, bool)
        for places in graph.robots.values():
            new = places[: int(np.ceil((stage + 1) / count * len(places)))]
            used[new] = True
            old = new[solved[new]]
            if len(old) and len(old) < len(places):
                x[places[len(old) :]] = carried(space, x0[places[len(old) :]], x0[old[-1]], x[old[-1]])
        joins = zeros(n, bool)
        for edges in (graph.relative_point, graph.point_prior):
            joins[edges.nodes[:, -1][used[edges.nodes[:, 0]] | ~graph.is_pose[edges.nodes[:, 0]]]] = True
        for point in flatnonzero(~graph.is_pose & ~joins).tolist():
            others, distance = _ranged(graph, point, used)
            joins[point] = len(others) >= HOLDING * space.dimension + 1
            if joins[point] and len(others) >= 2 * ranges[point]:
                x[point, : space.dimension] = trilaterate(x[others, : space.dimension], distance)
                ranges[point] = len(others)
        x[list(problem.fixed)] = x0[list(problem.fixed)]
        before, solved = solved, used | joins
        free = solved & (~before | last | ~graph.is_pose)
        last = solved & ~before
        if stage == count - 1 or solved.sum() >= WHOLE_GROWTH * whole:
            free, whole = solved, int(solved.sum())
        part, kept = _among(problem, solved, free, x)
        end = arrive(sparse(part), np.array(part.x0), 5, 1e-2)
        x[kept], iterations = end.x, iterations + end.iterations
    return x, iterations


def _among(problem: Problem, used: Bools, free: Bools, x: Floats) -> tuple[Problem, Bools]:
    """The problem from x (n, ambient) of the nodes that are `free` (n,) with their neighbours among the `used`, which
    are fixed, and which nodes it has."""
    factors = [taken(f, flatnonzero(used[f.nodes].all(1) & free[f.nodes].any(1))) for f in problem.factors]
    kept, still = free.copy(), ~free
    kept[stacked(f.nodes.ravel() for f in factors)] = True
    still[list(problem.fixed)] = True
    number = np.cumsum(kept) - 1
    part = problem.replace_unchecked(
        names=tuple(compress(problem.names, kept)),
        factors=tuple(unchecked(f, nodes=number[f.nodes]) for f in factors if len(f.nodes)),
        poses=tuple(number[[k for k in problem.poses if kept[k]]].tolist()),
        fixed=tuple(flatnonzero(still[kept]).tolist()),
        x0=x[kept],
    )
    return part, kept


def _stages(graph: Graph) -> int:
    """How many stages: STAGES, or as many as odometry needs to turn by no more than DRIFT in each."""
    longest = max(len(places) for places in graph.robots.values())
    turns = graph.relative_pose.covariance[:, graph.dimension :, graph.dimension :]
    variance = np.median(np.einsum("mii->m", turns) / turns.shape[-1]) if len(turns) else 0.0
    return max(min(longest // STAGE, max(STAGES, int(min(longest * variance / DRIFT**2, 200)))), 1)


def position_variance(edges: PoseEdges | PointEdges, d: int) -> Floats:
    """(M,) mean variance of the position."""
    return np.asarray(np.einsum("mii->m", edges.covariance[:, :d, :d]) / d)


def rotation_variance(edges: PoseEdges, d: int) -> Floats:
    """(M,) of an entry of the rotation, as the chordal objective has it."""
    turn = np.einsum("mii->m", edges.covariance[:, d:, d:])
    return np.asarray(turn if d == 2 else 2.0 * turn / 3.0)

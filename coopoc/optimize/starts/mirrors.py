"""What ranges alone place: multidimensional scaling, and moves across planes to lower minima; and the other windings of
cycles of relative poses: local minima in which errors sum to a turn the other way round."""

from collections.abc import Callable, Iterator, Sequence
from itertools import chain, combinations, islice
from typing import NamedTuple

import numpy as np
from numpy import inf, pi
from numpy.linalg import eigh, norm, svd

from ...arrays import TINY, Bools, Floats, Ints
from ..assess.assess import squared
from ..model.factor import Factor, Loss, stacked
from ..model.problem import Problem
from ..model.space import Space, exp, log, nearest_rotation
from .graph_starts import averaging, crossings, parts, position_variance, rotation_variance
from .initial import UNMEASURED_WEIGHT, graph_of

RANGES = "range", "range_offset"
"""Kinds of which the first two nodes are apart by z, or by z less the first coordinate of a third."""
LEVEL = "bearing", "azimuth"
"""Kinds whose measurements of a node in space fit its mirror image at a level plane as well."""
PATH_NODES = 2000
"""Nodes up to which all shortest paths are taken."""
RIVAL_COST = 10.0
"""Cost by which another minimum may be higher and still be the truth's: 1e-5 of chi-square with one degree."""
MAX_DESCENTS = 32
"""Moves that are followed by descents, of few bodies and the most promising first."""
TRIED_COST = 100.0
"""Times the cost of its ranges that a move may add before the others have given way, to be tried."""
ELSEWHERE_SHARE = 0.05
"""Share of its mean range by which a body must move to be elsewhere."""
REGISTERED, MOST_PLACES = 40, 3
"""Random places from which a body is registered, and steps; other places of a body that are tried."""
MOVED_NODES = 1800
"""Of the cycles together that are wound the other way round, and of bodies moved one at a time, whatever that adds."""
MIN_SAVING = 1e-6
"""Share of the cost that a move must save."""
BRIDGE = 1e-9
"""Share of its variance that averaging leaves of an error, or rad of error, below which no cycle holds it."""


Descend = Callable[[Floats], Floats]
"""From nodes (n, ambient) to a minimum."""
Cost = Callable[[Floats], float]
"""Of nodes (n, ambient)."""
Move = tuple[float, Floats, Ints]
"""What it adds to the cost of the ranges of a body, its nodes there, and the body."""


class Ranges(NamedTuple):
    """M ranges of a problem at x: nodes (M, 2), distance (M,) m, weight (M,) 1/m and the loss of each, None for least
    squares."""

    problem: Problem
    x: Floats
    nodes: Ints
    distance: Floats
    weight: Floats
    losses: tuple[tuple[Bools, Loss | None], ...]

    def cost(self, length: Floats, rows: Ints) -> Floats:
        """(C,) cost of some ranges (K,) where they are `length` (K, C)."""
        square = np.square((length - self.distance[rows, None]) * self.weight[rows, None])
        for own, loss in self.losses:
            if loss is not None and (here := own[rows]).any():
                square[here] = loss.cost(square[here])
        return np.asarray(0.5 * square.sum(0))


def ranges_of(problem: Problem, x: Floats) -> Ranges:
    """All ranges of a problem that have weight; offsets are those of x (n, ambient)."""
    factors = [f for f in problem.factors if f.kind in RANGES]
    own = np.repeat(np.arange(len(factors)), [len(f.nodes) for f in factors])
    distance = stacked(f.z[:, 0] - x[f.nodes[:, 2:], 0].sum(1) for f in factors)
    nodes, weight = stacked((f.nodes[:, :2] for f in factors), 2), stacked(f.root[:, 0, 0] for f in factors)
    return Ranges(problem, x, nodes, distance, weight, tuple((own == k, f.loss) for k, f in enumerate(factors)))


def firm(ranges: Ranges) -> Bools:
    """(n,) whether a node is fixed, or a fix that is accepted leaves what is ranged no other minimum:

    sum_k min(2 RIVAL_COST v, r_k^2) / (2 r_k^2) v / (s_k^2 + v_k) <= 1, v and v_k the variances of its fix and of that
    of what it ranges, r_k and s_k ranges and their deviations. Where it is h off the plane of those, (h / r_k)^2 / 2 is
    the share of a range's information by which the cost curves downwards midway to its image.

    >>> std = [[0.1, 0.1], [0.1, 0.1], [9.0, 9.0]]
    >>> towers = Problem([*"abc"], dimension=2).add("position", range(3), [[0.0, 0], [9, 0], [4, 3]], std=std)
    >>> towers = towers.add("range", [("a", "c"), ("b", "c")], [5.0, 5.8], std=0.1)
    >>> firm(ranges_of(towers, towers.factors[0].z))
    array([ True,  True, False])
    """
    problem, x, known = ranges.problem, ranges.x, np.zeros(len(ranges.x))
    for f in problem.factors:
        if f.kind == "position":
            own = np.square(f.root).sum(1).min(1) * _accepted(problem, f, x)
            known += np.bincount(f.nodes[:, 0], own, len(x))
    known[list(problem.fixed)] = inf
    v, weight, far = ((known > 0) / np.maximum(known, TINY))[ranges.nodes], ranges.weight**2, ranges.distance**2
    share = np.minimum(RIVAL_COST * v.T, 0.5 * far) / np.maximum(far, TINY) * v.T * weight / (1.0 + weight * v.T[::-1])
    return (known > 0) & (np.bincount(ranges.nodes.T.ravel(), share.ravel(), len(x)) <= 1.0)


def bodies(problem: Problem, x: Floats) -> list[Ints]:
    """Nodes that ranges alone, or in space with directions in a level plane, place, as what else is measured joins
    them: landmarks, points, robots with their odometry; at x (n, ambient), where robust losses may reject what would
    place others. Of fixes those hold a node that are `firm`.

    >>> from coopoc.optimize import pose
    >>> x = pose([[0.0, 0.0, 0.0], [3.0, 4.0, 2.0]])
    >>> near = Problem(("A", "p"), x0=x, poses=(0,)).add("pose", "A", x[0], std=0.1)
    >>> near = near.add("range", ("A", "p"), 5.4, std=0.1).add("bearing", ("A", "p"), 0.9, std=0.1)
    >>> bodies(near, x)  # below the pose or above it
    [array([1])]
    """
    vague = RANGES + LEVEL * (problem.dimension == 3)
    held = firm(ranges_of(problem, x))
    for f in problem.factors:
        if f.nodes.shape[1] == 1 and f.kind != "position":
            held[f.nodes[f.informative & _accepted(problem, f, x), 0]] = True
    if held.all():
        return []
    part = parts(len(x), *(f.nodes[f.informative] for f in problem.factors if f.kind not in vague))
    return [np.flatnonzero(part == body) for body in np.setdiff1d(part, part[held])]


def _accepted(problem: Problem, factor: Factor, x: Floats) -> Bools | bool:
    """(M,) which measurements of a factor a robust loss does not reject at x, or True."""
    return factor.loss is None or squared(problem, factor, x) <= factor.loss.scale**2


def scaled(problem: Problem, x: Floats) -> Floats:
    """Points x (n, d) with what ranges alone place by classical multidimensional scaling of shortest paths, turned and
    mirrored onto the other points; x itself where that is too large or does not hang together.

    References:
        Shang, Ruml, Zhang, Fromherz, Localization from mere connectivity, MobiHoc 2003 (MDS-MAP).
    """
    from scipy.sparse.csgraph import shortest_path

    ranges, (n, d) = ranges_of(problem, x), x.shape
    moved = [f for f in problem.factors if f.kind == "displacement"]
    loose = stacked(bodies(problem, x))
    if n > PATH_NODES or not len(loose) or not len(ranges.nodes):
        return x
    table = np.full((n, n), inf)
    np.minimum.at(table, tuple(ranges.nodes.T), np.maximum(ranges.distance, 0.0))
    for f in moved:
        np.minimum.at(table, tuple(f.nodes.T), norm(f.z, axis=1))
    placed = np.unique(np.concatenate([ranges.nodes, *(f.nodes for f in moved)]))  # no offset is
    fixed = np.setdiff1d(placed, loose)
    apart = norm(x[fixed, None] - x[fixed], axis=2)
    table[np.ix_(fixed, fixed)] = np.where(apart > 0, apart, inf)
    table, anchored = np.minimum(table, table.T)[np.ix_(placed, placed)], np.isin(placed, fixed)
    square = np.square(shortest_path(table, directed=False))
    if not np.isfinite(square).all():
        return x
    square -= square.mean(0)
    values, vectors = eigh(-0.5 * (square - square.mean(axis=1, keepdims=True)))
    y = np.pad(vectors * np.sqrt(np.maximum(values, 0.0)), ((0, 0), (d, 0)))[:, -d:]
    if len(fixed):
        middle, origin = x[fixed].mean(0), y[anchored].mean(0)
        left, _, right = svd((x[fixed] - middle).T @ (y[anchored] - origin))
        y = (y - origin) @ (left @ right).T + middle
    mirrored = x.copy()
    mirrored[placed[~anchored]] = y[~anchored]
    return mirrored


def registered(own: Floats, places: Floats, distance: Floats) -> tuple[Floats, Floats]:
    """Turns (S, d, d) and places (S, d) of the middle of a body, whose points `own` (K, d) range `places` (K, d), from
    random ones: points go to the nearest ones of their spheres, and the body follows.

    References:
        De Leeuw, Applications of convex analysis to multidimensional scaling, 1977 (majorization, which never rises).
    """
    rng, arms, d = np.random.default_rng(0), own - own.mean(0), own.shape[1]
    at = places.mean(0) + distance.mean() * rng.normal(size=(REGISTERED, d))
    turn = nearest_rotation(rng.normal(size=(REGISTERED, d, d)))
    for _ in range(REGISTERED):
        gap = arms @ turn.mT + at[:, None] - places
        to = places + distance[:, None] * gap / norm(gap, axis=2, keepdims=True)
        at = to.mean(1)
        turn = nearest_rotation(to.mT @ arms)
    return turn, at


def mirrored(at: Floats, places: Floats) -> Floats:
    """Points (K, d) reflected at the best-fit plane of places (M, d), which is level where they leave it open."""
    middle, d = places.mean(0), at.shape[1]
    gaps = places - middle
    normal = eigh(gaps.T @ gaps + 1e-9 * np.diag(np.arange(d) < 2))[1][:, :1]
    return np.asarray(at - 2.0 * (at - middle) @ normal @ normal.T)


def _elsewhere(ranges: Ranges, body: Ints, ends: Ints, most: float) -> list[Move]:
    """Other places of a body, which is at the `ends` (K,) of ranges (2 M,) to what is not of it, that add at `most` so
    much: it is reflected at the best-fit plane of what ranges it, and put where its ranges fit best, a point where its
    spheres cross: where what ranges it has yet to give way, these need not be the image."""
    space, x, rows = ranges.problem.space, ranges.x, ends // 2
    own, other = ranges.nodes[rows, ends % 2], ranges.nodes[rows, 1 - ends % 2]
    if len(rows) < 4 - space.dimension:
        return []
    at, places, index = space.position(x[body]), space.position(x[other]), np.searchsorted(body, own)
    distance = ranges.distance[rows]
    least = ELSEWHERE_SHARE * distance.mean()

    def costs(at: Floats) -> Floats:
        """(C,) of places (C, K, d) of the body."""
        return ranges.cost(norm(at[:, index] - places, axis=2).T, rows)

    image = mirrored(at, places)
    met, turn = image[None], nearest_rotation(np.eye(space.dimension)[None])
    if len(body) > 1:
        turn = nearest_rotation((image - image.mean(0)).T @ (at - at.mean(0)))[None]
        met = (at - at.mean(0)) @ turn[0].T + image.mean(0)[None, None]
        more, to = registered(at[index], places, distance)
        turn = np.concatenate([turn, more])
        met = np.concatenate([met, (at - at[index].mean(0)) @ more.mT + to[:, None]])
    elif len(rows) >= space.dimension:
        met = np.concatenate([met, crossings(places, distance)[:, None]])
        turn = np.repeat(turn, len(met), axis=0)
    here, away = costs(at[None]), np.asarray(norm(met - at, axis=2).max(1) > least)
    chosen, adds = list[int](), np.full(len(met), np.nan)
    adds[away] = costs(met[away]) - here
    for k in np.append(0, adds.argsort()).tolist():
        if adds[k] <= most and (norm(met[k] - met[chosen], axis=2).max(1) > least).all():
            chosen.append(k)
            if len(chosen) == MOST_PLACES:
                break
    return [(float(adds[k]), space.join(met[k], turn[k] @ space.rotation(x[body])), body) for k in chosen]


def _moves(ranges: Ranges, loose: list[Ints], anyway: int) -> Iterator[Floats]:
    """Points (n, ambient) to descend from: one body at a time moved, so many `anyway`, and several together; all points
    reflected at the plane of what holds them, where they range one another too."""
    x, most, single = ranges.x, TRIED_COST * (1.0 + len(ranges.nodes) / len(ranges.x)), list[Move]()
    which = np.full(len(x), -1)
    for k, body in enumerate(loose):
        which[body] = k
    own = which[ranges.nodes]
    own[(own[:, 0] == own[:, 1]) | (ranges.weight <= 0)] = -1
    for k, body in enumerate(loose):
        single += _elsewhere(ranges, body, np.flatnonzero(own == k), inf if anyway > 0 else most)
    single.sort(key=lambda move: move[0])
    near = [move for move in single if move[0] <= most][:MAX_DESCENTS]
    several = (combinations(near, size) for size in range(2, len(near) + 1))
    together = chain(combinations(single[: max(len(near), anyway)], 1), *several)
    holding, points, space = ranges.nodes[(own < 0) & (own[:, ::-1] >= 0)], stacked(loose), ranges.problem.space
    if len(holding) and len(points) == len(loose) and (own >= 0).all(1).any():
        image = mirrored(space.position(x[points]), space.position(x[holding]))
        together = chain([((0.0, space.join(image), points),)], together)
    for chosen in islice(together, MAX_DESCENTS):
        y = x.copy()
        for _, there, body in chosen:
            y[body] = there
        yield y


def across(
    problem: Problem, x: Floats, descend: Descend, cost: Cost, near: bool = False
) -> tuple[Floats, int, list[tuple[float, Floats]]]:
    """The lowest end (n, ambient) of descents from x, from mirror images of what ranges alone place and from cycles
    that are wound the other way, how many moves led down, and the other ends with their costs.

    Args:
        problem: whose ranges, and their losses, place the bodies.
        x: (n, ambient) a minimum.
        descend: from a point to a minimum.
        cost: of a point.
        near: x is beside an x0, so that one move fewer is tried whatever it adds.
    """
    loose = bodies(problem, x) if any(f.kind in RANGES for f in problem.factors) else []
    if not loose and not any(f.measurement.compares_poses for f in problem.factors):
        return x, 0, []
    least, count, ends = cost(x), 0, list[tuple[float, Floats]]()
    while count < 15:  # three are usual
        moves, ends = _moves(ranges_of(problem, x), loose, MOVED_NODES // len(x) - near) if loose else (), []
        for start in chain(moves, islice(rewound(problem, x, RIVAL_COST), min(MAX_DESCENTS, MOVED_NODES // len(x)))):
            end = descend(start)
            if (now := cost(end)) < (1.0 - MIN_SAVING) * least - 1e-9:
                x, least, count = end, now, count + 1
                break
            ends.append((now, end))
        else:
            break
    return x, count, ends


def movable(problem: Problem) -> Ints:
    """Points of which nothing but ranges and fixes is measured."""
    held = [f.nodes.ravel() for f in problem.factors if f.kind not in ("range", "position")]
    return np.setdiff1d(np.arange(len(problem.names)), np.concatenate([problem.fixed, problem.poses, *held]))


def rewound(problem: Problem, x: Floats, most: float) -> Iterator[Floats]:
    """Nodes x (n, ambient) with the error of one relative rotation shorter or longer by a turn, and what this bends
    averaged over all relative poses; those that cost least come first, and none that adds more than `most`. None adds
    less than 0 unless a cycle is wound up by a turn.

    With errors e_k of variances v_k that averaging leaves, and variances h_k of what it makes of each, a turn more
    adds 2 pi^2 (1 - h_k / v_k) / v_k - 2 pi |e_k| / v_k to the cost of rotations.

    References:
        Carlone, Censi, From angular manifolds to the integer lattice, T-RO 2014.

    >>> from coopoc.optimize import pose
    >>> ring = Problem(("a", "b", "c"), dimension=2, poses=(0, 1, 2)).add(
    ...     "relative_pose", [("a", "b"), ("b", "c"), ("c", "a")], pose(np.zeros((3, 2)), [2.0, 2.0, 2.0]), std=1.0
    ... )
    >>> [y] = rewound(ring, pose(np.zeros((3, 2))), 10.0)
    >>> np.degrees(np.arctan2(y[:, 4], y[:, 2])).round() % 360
    array([  0., 120., 240.])
    """
    space, n, joined = problem.space, len(x), [f for f in problem.factors if f.kind.startswith("relative_pose")]
    nodes = stacked((f.nodes for f in joined), 2)
    forest = len(nodes) < n and len(np.unique(np.sort(nodes) @ [n, 1])) + parts(n, nodes).max() < n
    if forest or not _windable(space, x, joined, most):
        return
    edges = graph_of(problem).relative_pose
    (i, j), turned, at = edges.nodes.T, space.rotation(x), space.position(x)
    weight = 1.0 / rotation_variance(edges, space.dimension)[:, None]
    error = weight * log(turned[j] @ (turned[i] @ edges.rotation).mT) * np.sign(j - i)[:, None]
    pairs, of = np.unique(np.sort(edges.nodes, axis=1), axis=0, return_inverse=True)
    sums = np.zeros((len(pairs), 1 + space.angles))
    np.add.at(sums, of.ravel(), np.hstack([weight, error]))
    error, v = sums[:, 1:] / sums[:, :1], 1.0 / sums[:, 0]
    turns, factored = averaging(pairs, v, n)
    if factored is None:
        return
    a, b = pairs.T
    move = turns(error)
    left = error + move[b] - move[a]
    size = norm(left, axis=1)
    own, other, both = factored.inverse(np.concatenate([a, b, a]), np.concatenate([a, b, b])).reshape(3, -1)
    closed = 1.0 - (own + other - 2.0 * both) / v
    adds = np.where(closed > BRIDGE, (2.0 * pi / v) * (pi * closed - size), inf)
    value, first = np.unique(adds.round(6), return_index=True)  # the same of all along a cycle
    chosen = first[value <= most].tolist()
    if chosen:
        places, _ = averaging(edges.nodes, position_variance(edges, space.dimension), n)
    for k in chosen:
        bent = error.copy()
        bent[k] -= 2.0 * pi * left[k] / max(size[k], BRIDGE)
        rotation = exp(turns(bent)) @ turned
        y = space.join(at + places(at[j] - at[i] - (rotation[i] @ edges.position[..., None])[..., 0]), rotation)
        y[list(problem.fixed)] = x[list(problem.fixed)]
        yield y


def _windable(space: Space, x: Floats, joined: Sequence[Factor], most: float) -> bool:
    """Whether a turn more may add at `most` so much. It adds 2 pi q (pi q - E) or more, q^2 = 1 / sum_k v_k and
    E^2 = sum_k |e_k|^2 / v_k: averaging leaves no larger errors, and v_k / (1 - h_k / v_k), the variance round a cycle,
    is no larger than all together."""
    d, together, error = space.dimension, 0.0, 0.0
    turned = space.rotation(x)
    for f in joined:
        i, j = f.nodes.T
        v = (d - 1) / (np.square(f.root[:, :, d:]).sum(1).mean(1) + UNMEASURED_WEIGHT)
        together += v.sum()
        off = log(turned[j].mT @ turned[i] @ space.rotation(f.z))
        error += (np.vecdot(off, off) / v).sum()
    q = 1.0 / np.sqrt(together)
    return not 2.0 * pi * q * (pi * q - np.sqrt(error)) > most

"""What ranges alone place: multidimensional scaling, moves across planes to lower minima, and consensus of ranges."""

from collections.abc import Callable, Iterator
from itertools import combinations, islice
from typing import NamedTuple

import numpy as np

from ...arrays import Bools, Floats, Ints
from ..assess.assess import squared
from ..model.factor import Factor, Loss, stacked
from ..model.problem import Problem
from ..model.space import nearest_rotation
from .graph_starts import parts

RANGES = "range", "range_offset"
"""Kinds of which the first two nodes are apart by z, or by z less the first coordinate of a third."""
LEVEL = "bearing", "azimuth"
"""Kinds whose measurements of a node in space fit its mirror image at a level plane as well."""
PATH_NODES = 2000
"""Nodes up to which all shortest paths are taken."""
SUBSETS = 60
"""Of the ranges of a point, whose spheres are cut."""
MAX_DESCENTS = 32
"""Moves that are followed by descents, of few bodies and the most promising first."""
DOUBTED_COST, TRIED_COST = 10.0, 100.0
"""Cost, and as many times the cost of its ranges, that a move may add before the others have given way, to be a doubt
and to be tried."""
MOVE_ROUNDS = 15
"""Of moves, of which three are usual."""
MIN_SAVING = 1e-6
"""Share of the cost that a move must save."""
BELIEVED_STDS, MAJORITY = 4.0, 0.55
"""Standard deviations within which a range fits a place, and the share of them that must, so that a point stays."""
MOST_RANGED = 6
"""Points with most ranges to others that are tried for the next one that is placed."""


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
        return np.asarray(0.5 * square.sum(axis=0))


def ranges_of(problem: Problem, x: Floats) -> Ranges:
    """All ranges of a problem that have weight; offsets are those of x (n, ambient)."""
    factors = [f for f in problem.factors if f.kind in RANGES]
    own = np.repeat(np.arange(len(factors)), [len(f.nodes) for f in factors])
    distance = stacked(f.z[:, 0] - x[f.nodes[:, 2:], 0].sum(axis=1) for f in factors)
    nodes, weight = stacked((f.nodes[:, :2] for f in factors), 2), stacked(f.root[:, 0, 0] for f in factors)
    return Ranges(problem, x, nodes, distance, weight, tuple((own == k, f.loss) for k, f in enumerate(factors)))


def bodies(problem: Problem, x: Floats) -> list[Ints]:
    """Nodes that ranges alone, or in space with directions in a level plane, place, as what else is measured joins
    them: landmarks, points, robots with their odometry; at x (n, ambient), where robust losses may reject what would
    place others.

    >>> from coopoc.optimize import pose
    >>> x = pose([[0.0, 0.0, 0.0], [3.0, 4.0, 2.0]])
    >>> near = Problem(("A", "p"), x0=x, poses=(0,)).add("pose", "A", x[0], std=0.1)
    >>> near = near.add("range", ("A", "p"), 5.4, std=0.1).add("bearing", ("A", "p"), 0.9, std=0.1)
    >>> bodies(near, x)  # below the pose or above it
    [array([1])]
    """
    vague = RANGES + LEVEL * (problem.dimension == 3)
    others = [f.nodes[f.informative] for f in problem.factors if f.kind not in vague]
    part = parts(len(problem.names), *others)
    alone = (_accepted(problem, f, x) for f in problem.factors if f.nodes.shape[1] == 1)
    held = np.concatenate([np.array(problem.fixed, np.int64), *alone])
    return [np.flatnonzero(part == body) for body in np.setdiff1d(part, part[held])]


def _accepted(problem: Problem, factor: Factor, x: Floats) -> Ints:
    """Nodes that a factor of one node each holds at x."""
    kept = factor.informative
    if factor.loss is not None:
        kept = kept & (squared(problem, factor, x) <= factor.loss.scale**2)
    return np.asarray(factor.nodes[kept, 0])


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
    table = np.full((n, n), np.inf)
    np.minimum.at(table, tuple(ranges.nodes.T), np.maximum(ranges.distance, 0.0))
    for f in moved:
        np.minimum.at(table, tuple(f.nodes.T), np.linalg.norm(f.z, axis=1))
    placed = np.unique(np.concatenate([ranges.nodes, *(f.nodes for f in moved)]))  # no offset is
    fixed = np.setdiff1d(placed, loose)
    apart = np.linalg.norm(x[fixed, None] - x[fixed], axis=2)
    table[np.ix_(fixed, fixed)] = np.where(apart > 0, apart, np.inf)
    table, anchored = np.minimum(table, table.T)[np.ix_(placed, placed)], np.isin(placed, fixed)
    square = np.square(shortest_path(table, directed=False))
    if not np.isfinite(square).all():
        return x
    square -= square.mean(axis=0)
    values, vectors = np.linalg.eigh(-0.5 * (square - square.mean(axis=1, keepdims=True)))
    y = np.pad(vectors * np.sqrt(np.maximum(values, 0.0)), ((0, 0), (d, 0)))[:, -d:]
    if len(fixed):
        middle, origin = x[fixed].mean(axis=0), y[anchored].mean(axis=0)
        left, _, right = np.linalg.svd((x[fixed] - middle).T @ (y[anchored] - origin))
        y = (y - origin) @ (left @ right).T + middle
    found = x.copy()
    found[placed[~anchored]] = y[~anchored]
    return found


def crossings(places: Floats, ranges: Floats) -> Floats:
    """(C, d) points where d of the spheres of `ranges` (K,) around `places` (K, d) meet, or come nearest to it.

    >>> crossings(np.array([[0.0, 0], [8, 0]]), np.array([5.0, 5])).round(6)
    array([[ 4., -3.],
           [ 4.,  3.]])
    """
    d = places.shape[1]
    chosen = np.array([*islice(combinations(range(len(places)), d), 10 * SUBSETS)])
    chosen = chosen[:: -(-len(chosen) // SUBSETS)]
    p, r = places[chosen], ranges[chosen]
    gap = p[:, 1:] - p[:, :1]
    right = 0.5 * (np.square(gap).sum(axis=2) - np.square(r[:, 1:]) + np.square(r[:, :1]))
    foot = (np.linalg.pinv(gap) @ right[..., None])[..., 0]
    height = np.sqrt(np.maximum(np.square(r[:, 0]) - np.square(foot).sum(axis=1), 0.0))
    up = height[:, None] * np.linalg.svd(gap)[2][:, -1]
    return np.stack([p[:, 0] + foot - up, p[:, 0] + foot + up], axis=1).reshape(-1, d)


def _plane(places: Floats) -> tuple[Floats, Floats]:
    """Middle and normal of the best-fit plane of points (K, d)."""
    middle = places.mean(axis=0)
    return middle, np.linalg.eigh((places - middle).T @ (places - middle))[1][:, 0]


def _image(points: Floats, plane: tuple[Floats, Floats]) -> Floats:
    """Points (K, d) reflected at a plane."""
    middle, normal = plane
    return points - 2.0 * np.outer((points - middle) @ normal, normal)


def _mirrored(problem: Problem, nodes: Floats, plane: tuple[Floats, Floats]) -> Floats:
    """Nodes (K, ambient) moved as a rigid body as near as possible to their image, keeping their handedness."""
    space = problem.space
    at = space.position(nodes)
    image = _image(at, plane)
    turn = nearest_rotation((image - image.mean(axis=0)).T @ (at - at.mean(axis=0)))
    moved = (at - at.mean(axis=0)) @ turn.T + image.mean(axis=0)
    return space.join(moved, turn @ space.rotation(nodes))


def _outward(ranges: Ranges, body: Ints) -> tuple[Ints, Ints, Ints]:
    """Rows of the ranges with weight from a body to what is not of it, their nodes of it and the others."""
    inside = np.isin(ranges.nodes, body)
    rows = np.flatnonzero(inside.any(axis=1) & ~inside.all(axis=1) & (ranges.weight > 0))
    return rows, ranges.nodes[rows][inside[rows]], ranges.nodes[rows][~inside[rows]]


def _all_mirrored(ranges: Ranges, loose: list[Ints]) -> Iterator[Floats]:
    """All bodies together, reflected at the plane of what ranges any of them: ranges among them hold them there."""
    if len(loose) < 2:
        return
    problem, x, (rows, _, outside) = ranges.problem, ranges.x, _outward(ranges, np.concatenate(loose))
    if len(rows) < 2:
        return
    plane, y = _plane(problem.space.position(x[outside])), x.copy()
    for body in loose:
        y[body] = _mirrored(problem, x[body], plane)
    gap = problem.space.position(y)[ranges.nodes]
    cost = ranges.cost(np.linalg.norm(gap[:, 0] - gap[:, 1], axis=1)[:, None], np.arange(len(gap)))
    if float(cost[0]) <= TRIED_COST * (1.0 + len(gap) / len(x)) * len(loose):
        yield y


def _elsewhere(ranges: Ranges, body: Ints) -> list[Move]:
    """Other places of a body, the cheapest first.

    It is reflected at the best-fit plane of what ranges it, keeping its handedness, and a point is also put where its
    spheres cross: where what ranges it has yet to give way, the cheapest of these need not be the image.
    """
    problem, x, (rows, own, other) = ranges.problem, ranges.x, _outward(ranges, body)
    space, d = problem.space, problem.dimension
    if len(rows) < 2:
        return []
    places, at = space.position(x[other]), space.position(x[body])
    plane = _plane(places)
    flipped = _image(at, plane)
    there = x[body].copy()
    if len(body) == 1:
        options = np.concatenate([at, flipped, *([crossings(places, ranges.distance[rows])] if len(rows) >= d else [])])
        costs = ranges.cost(np.linalg.norm(options - places[:, None], axis=2), rows)
        least = 0.05 * ranges.distance[rows].mean()
        moves, image = list[Move](), 1
        for k in (int(np.where(np.linalg.norm(options - at, axis=1) > least, costs, np.inf).argmin()), image):
            if all(np.linalg.norm(options[k] - other) > least for other in (at[0], *(m[1][0, :d] for m in moves))):
                there[0, :d] = options[k]
                moves.append((float(costs[k] - costs[0]), there.copy(), body))
        return moves
    there = _mirrored(problem, x[body], plane)
    moved = space.position(there)
    index = np.searchsorted(body, own)
    before, after = (ranges.cost(np.linalg.norm(p[index] - places, axis=1)[:, None], rows)[0] for p in (at, moved))
    return [(float(after - before), there, body)]


def _moves(ranges: Ranges, single: list[Move]) -> Iterator[Floats]:
    """Points (n, ambient) to descend from: all bodies where they cost less, one after the other, then one at a time,
    and several together."""
    x = ranges.x
    if any(adds < 0 for adds, _, _ in single):
        y = x.copy()
        for *_, body in single:
            if (moves := _elsewhere(ranges._replace(x=y), body)) and moves[0][0] < 0:
                y[body] = moves[0][1]
        yield y
    yield from _all_mirrored(ranges, [*{int(body[0]): body for *_, body in single}.values()])
    near = [move for move in single if move[0] <= TRIED_COST * (1.0 + len(ranges.nodes) / len(x))][:MAX_DESCENTS]
    together = (chosen for size in range(1, len(near) + 1) for chosen in combinations(near, size))
    for chosen in islice(together, MAX_DESCENTS):
        y = x.copy()
        for _, there, body in chosen:
            y[body] = there
        yield y


def across(problem: Problem, x: Floats, descend: Descend, cost: Cost) -> tuple[Floats, int, list[float], list[Ints]]:
    """The lowest end (n, ambient) of descents from x and from mirror images of what ranges alone place, how many
    moves led down, the costs of the other ends, and the bodies that ranges or level directions hardly
    distinguish from elsewhere.

    Args:
        problem: whose ranges, and their losses, place the bodies.
        x: (n, ambient) a minimum.
        descend: from a point to a minimum.
        cost: of a point.
    """
    ranges, loose, least, count = ranges_of(problem, x), bodies(problem, x), cost(x), 0
    every = loose
    if len(loose) == len(problem.names) or not len(ranges.nodes):  # nothing to mirror at
        loose = loose if len(loose) > 1 else []
    rivals, single = list[float](), list[Move]()
    while count < MOVE_ROUNDS:
        ranges = ranges_of(problem, x)
        single = sorted((move for body in loose for move in _elsewhere(ranges, body)), key=lambda move: move[0])
        rivals = []
        for start in _moves(ranges, single):
            end = descend(start)
            if (now := cost(end)) < (1.0 - MIN_SAVING) * least - 1e-9:
                x, least, count = end, now, count + 1
                break
            rivals.append(now)
        else:
            break
    doubtful = {int(body[0]): body for adds, _, body in single if adds <= DOUBTED_COST}
    if problem.dimension == 3 and any(f.kind in LEVEL for f in problem.factors):
        moved = {int(body[0]) for *_, body in single}
        doubtful |= {int(body[0]): body for body in every if body[0] not in moved}
    return x, count, rivals, [*doubtful.values()]


def movable(problem: Problem) -> Ints:
    """Points of which nothing but ranges and fixes is measured."""
    held = [f.nodes.ravel() for f in problem.factors if f.kind not in ("range", "position")]
    return np.setdiff1d(np.arange(len(problem.names)), np.concatenate([problem.fixed, problem.poses, *held]))


def regrown(problem: Problem, x: Floats) -> Floats:
    """Nodes x (n, ambient) with points that disagree with most of their ranges placed anew by those to the others.

    What disagrees most is left out, one point after the other, until the others agree. Of the crossings of the spheres
    of a point, and its fixes, that counts with which most measurements agree; the point with most comes first.

    References:
        Fischler, Bolles, Random Sample Consensus, 1981; Moore et al., Robust distributed network localization with
        noisy range measurements, SenSys 2004.

    >>> truth = np.array([[0.0, 0], [9, 0], [0, 9], [9, 9], [4, 5]])
    >>> pairs = np.stack(np.triu_indices(5, 1), axis=1)
    >>> problem = Problem(tuple("abcde"), dimension=2)
    >>> problem = problem.add("range", pairs, np.linalg.norm(np.diff(truth[pairs], axis=1), axis=(1, 2)), std=0.1)
    >>> regrown(problem, np.vstack([truth[:4], [[30.0, 30.0]]]))[4].round(6)
    array([4., 5.])
    """
    d, n, x = problem.dimension, len(x), x.copy()
    places, ranges = x[:, :d], ranges_of(problem, x)
    fixes = [f for f in problem.factors if f.kind == "position"]
    fixed, fix = stacked(f.nodes[:, 0] for f in fixes), stacked((f.z for f in fixes), d)
    root, known = stacked((f.root for f in fixes), d, d), stacked(np.full(len(f.z), f.loss is None) for f in fixes)

    def agree(at: Floats, rows: Ints, others: Ints, own: Ints) -> tuple[Bools, Bools]:
        """Whether ranges (K,) to others and fixes (F,) fit places (C, d): (C, K), (C, F)."""
        length = np.linalg.norm(at[:, None] - places[others], axis=2)
        off = np.einsum("fab,cfb->cfa", root[own], at[:, None] - fix[own])
        fits = np.abs(length - ranges.distance[rows]) * ranges.weight[rows] <= BELIEVED_STDS
        return fits, np.linalg.norm(off, axis=2) <= BELIEVED_STDS

    kept, loose = np.ones(n, dtype=bool), movable(problem)
    length = np.linalg.norm(places[ranges.nodes[:, 0]] - places[ranges.nodes[:, 1]], axis=1)
    fits = np.abs(length - ranges.distance) * ranges.weight <= BELIEVED_STDS
    near = np.linalg.norm(np.einsum("fab,fb->fa", root, places[fixed] - fix), axis=1) <= BELIEVED_STDS
    while True:
        both = kept[ranges.nodes].all(axis=1)
        of, good = (
            np.bincount(ranges.nodes[rows].ravel(), minlength=n) + d * np.bincount(fixed[own], minlength=n)
            for rows, own in ((both, np.ones(len(fixed), dtype=bool)), (both & fits, near))
        )
        share = good[loose] / np.maximum(of[loose], 1)
        out = kept[loose] & ((good[loose] <= d) | (share < MAJORITY))
        if not out.any():
            break
        kept[loose[np.argmin(np.where(out, share, np.inf))]] = False
    while not kept.all():
        rows = np.flatnonzero(kept[ranges.nodes].sum(axis=1) == 1)
        own = np.where(kept[ranges.nodes[rows, 0]], *ranges.nodes[rows, ::-1].T)
        count, best, at = np.bincount(own, minlength=n), 0.0, None
        left = np.flatnonzero(~kept)
        for point in left[np.argsort(-count[left], kind="stable")][:MOST_RANGED].tolist():
            of_point, own_fixes = rows[own == point], np.flatnonzero(fixed == point)
            others = ranges.nodes[of_point].sum(axis=1) - point
            if len(others) >= d or len(own_fixes):
                there = crossings(places[others], ranges.distance[of_point]) if len(others) >= d else fix[:0]
                there = np.concatenate([there, fix[own_fixes]])
                by_range, by_fix = agree(there, of_point, others, own_fixes)
                votes = by_range.sum(axis=1) + d * by_fix.sum(axis=1)
                votes *= (by_fix | ~known[own_fixes]).all(axis=1)
                if votes.max() > best:
                    best, at = votes.max(), (point, there[np.argmax(votes)])
        if at is None:
            break
        places[at[0]], kept[at[0]] = at[1], True
    return x

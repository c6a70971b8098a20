"""Poses along measured relative poses (shortest paths from known ones), and points by trilateration."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from ...arrays import Bools, Floats, Ints
from ..model.problem import Problem
from .initial import initial_guess

Roots = Iterable[tuple[int, Floats, Floats]]
"""(pose, position, rotation) in the order in which the walk may start from them."""


class Moves(NamedTuple):
    """M measured relative poses: nodes (M, 2), position (M, d) m, rotation (M, d, d), and their length (M,) > 0."""

    nodes: Ints
    position: Floats
    rotation: Floats
    length: Floats


def walk(n: int, d: int, moves: Moves, roots: Roots) -> tuple[Floats, Floats, Bools]:
    """Positions (n, d), rotations (n, d, d) and which are known (n,), along the shortest paths from the roots."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import dijkstra

    position, rotation = np.zeros((n, d)), np.tile(np.eye(d), (n, 1, 1))
    known = np.zeros(n, dtype=bool)
    which = np.argsort(moves.length, kind="stable")
    ends = np.stack([moves.nodes[which], moves.nodes[which, ::-1]], axis=1).reshape(-1, 2)  # there and back
    key, first = np.unique(ends[:, 0] * n + ends[:, 1], return_index=True)  # of parallel edges the shortest
    edge, forward = which[first // 2], first % 2 == 0
    graph = csr_array((moves.length[edge], (key // n, key % n)), shape=(n, n))
    for root, at, turned in roots:
        if known[root]:
            continue
        distance, before = dijkstra(graph, indices=root, return_predecessors=True)
        reached = np.flatnonzero(np.isfinite(distance) & (before >= 0))
        used = np.searchsorted(key, before[reached] * n + reached)
        moved, turn = moves.position[edge[used]], moves.rotation[edge[used]]
        back = np.swapaxes(turn, 1, 2)
        turn = np.where(forward[used, None, None], turn, back)
        moved = np.where(forward[used, None], moved, -(back @ moved[..., None])[..., 0])
        place = np.full(n, -1)
        place[reached] = np.arange(len(reached))
        moved, turn = _from_root(place[before[reached]], moved, turn)
        position[root], rotation[root], known[root] = at, turned, True
        position[reached], rotation[reached], known[reached] = at + moved @ turned.T, turned @ turn, True
    return position, rotation, known


def _from_root(before: Ints, position: Floats, rotation: Floats) -> tuple[Floats, Floats]:
    """Poses of a tree as its root sees them, from each as the one before sees it (-1: the root): pointers jump."""
    while (on := np.flatnonzero(before >= 0)).size:
        by = before[on]
        position[on] = position[by] + (rotation[by] @ position[on, :, None])[..., 0]
        rotation[on] = rotation[by] @ rotation[on]
        before[on] = before[by]
    return position, rotation


def along_poses(problem: Problem) -> Floats:
    """x0 (n, ambient) with poses where relative poses lead, from fixed poses, then from others, and points without a
    fix where a pose sees them.

    The start of a graph may follow measurements that have no weight here.
    """
    space, x, d = problem.space, initial_guess(problem)[0], problem.dimension
    used = [(f, f.informative) for f in problem.factors]
    moved = [
        Moves(f.nodes[on], space.position(f.z[on]), space.rotation(f.z[on]), 1.0 / np.square(f.root[on]).sum((1, 2)))
        for f, on in used
        if f.kind.startswith("relative_pose")
    ]
    if moved:
        roots = ((k, space.position(x[k]), space.rotation(x[k])) for k in (*problem.fixed, *problem.poses))
        moves = Moves(*(np.concatenate(part) for part in zip(*moved, strict=True)))
        position, rotation, known = walk(len(x), d, moves, roots)
        x[known] = space.join(position[known], rotation[known])
    still = np.concatenate([problem.fixed, *(f.nodes[on, 0] for f, on in used if f.kind == "position")])
    for f, on in used:
        if f.kind == "relative_position":
            rows = np.flatnonzero(on & ~np.isin(f.nodes[:, 1], still))[::-1]  # the first that sees a point places it
            i, j = f.nodes[rows].T
            x[j, :d] = x[i, :d] + np.einsum("mab,mb->ma", space.rotation(x[i]), f.z[rows])
    return np.asarray(x)


def parts(n: int, pairs: Ints) -> Ints:
    """(n,) number of the connected component that each node is in, by pairs (M, 2) that are joined."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    joined = csr_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    return np.asarray(connected_components(joined, directed=False)[1])


def trilaterate(places: Floats, ranges: Floats) -> Floats:
    """(d,) minimum of sum (|l - p_k| - r_k)^2, the lowest of those that three guesses lead to.

    2 p_k . l - |l|^2 = |p_k|^2 - r_k^2 is linear in l and |l|^2. Where the places nearly lie in a plane (on a line),
    how far l is from it follows from the ranges, and on which side from the descents.

    Args:
        places: (K, d) m; with K <= d one of the points that the ranges allow is returned.
        ranges: (K,) m.

    >>> trilaterate(np.array([[0.0, 0], [8, 0], [4, 1]]), np.array([5.0, 5, 2])).round(6)
    array([4., 3.])
    """
    from scipy.optimize import least_squares

    d, middle = places.shape[1], places.mean(axis=0)
    p = places - middle
    if len(p) <= d:
        return np.asarray(places[0] + ranges[0] * np.eye(d)[0])
    matrix = np.concatenate([2.0 * p, np.ones((len(p), 1))], axis=1)
    guess = np.linalg.lstsq(matrix, np.square(p).sum(axis=1) - ranges**2, rcond=None)[0][:d]
    normal = np.linalg.eigh(p.T @ p)[1][:, 0]
    flat = guess - normal * (guess @ normal)
    height = np.sqrt(max(float(np.mean(ranges**2 - np.square(p - flat).sum(axis=1))), 0.0))
    guesses = (guess, flat + height * normal, flat - height * normal)
    ends = [least_squares(lambda at: np.linalg.norm(at - p, axis=1) - ranges, at, method="lm") for at in guesses]
    return np.asarray(min(ends, key=lambda end: float(end.cost)).x + middle)

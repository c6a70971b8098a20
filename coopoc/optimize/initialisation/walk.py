"""Poses along measured relative poses, from some that are known."""

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
    which = np.argsort(-moves.length, kind="stable")  # of parallel edges the last, and shortest, is kept
    best = {}
    for k, (i, j) in zip(which.tolist(), moves.nodes[which].tolist(), strict=True):
        best[i, j], best[j, i] = (k, True), (k, False)
    pairs = np.array(list(best), dtype=np.int64).reshape(-1, 2)
    weight = moves.length[[k for k, _ in best.values()]]
    ways = csr_array((weight, (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    for root, at, turned in roots:
        if known[root]:
            continue
        distance, before = dijkstra(ways, indices=root, return_predecessors=True)
        position[root], rotation[root], known[root] = at, turned, True
        reached = np.flatnonzero(np.isfinite(distance) & ~known)
        for j in reached[np.argsort(distance[reached], kind="stable")].tolist():
            i = int(before[j])
            k, forward = best[i, j]
            moved, step = moves.position[k], moves.rotation[k]
            if not forward:
                moved, step = -step.T @ moved, step.T
            position[j], rotation[j] = position[i] + rotation[i] @ moved, rotation[i] @ step
        known[reached] = True
    return position, rotation, known


def along_poses(problem: Problem) -> Floats:
    """x0 (1, n, ambient) with poses where relative poses lead, from fixed poses, then from others, and points without
    a fix where a pose sees them.

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
            i, j = f.nodes[on & ~np.isin(f.nodes[:, 1], still)][::-1].T  # the first that sees a point places it
            z = f.z[on & ~np.isin(f.nodes[:, 1], still)][::-1]
            x[j, :d] = x[i, :d] + np.einsum("mab,mb->ma", space.rotation(x[i]), z)
    return np.asarray(x[None])

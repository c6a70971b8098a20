"""Bodies: the parts of a problem that its known inliers hold together, each in a frame of its own or in the world."""

from __future__ import annotations

import numpy as np

from ...arrays import Bools, Floats, Ints
from ..initialisation.linear_start import parts
from ..model.problem import Problem
from .outliers import Marked, reweigh

HELD = -1
"""The body of what known inliers join to the world: to fixed nodes, or to nodes that are measured alone."""


def bodies(problem: Problem, marked: Marked, weight: Floats, x: Floats) -> Ints:
    """(n,) the body of each node, HELD or its first pose (if it has none, its first node).

    Args:
        marked: the candidates, of which those with a weight (1, G) join nodes, too.
        x: (1, n, ambient).
    """
    measured = [f.nodes[f.informative] for f in reweigh(problem, marked, weight, x).pick(0).factors]
    pairs = [nodes for nodes in measured if nodes.shape[1] == 2]
    part = parts(len(problem.names), np.concatenate([np.empty((0, 2), np.int64), *pairs]))
    alone = [nodes[:, 0] for nodes in measured if nodes.shape[1] == 1]
    nodes = np.concatenate([problem.poses, np.setdiff1d(np.arange(len(part)), problem.poses)]).astype(np.int64)
    first = nodes[np.unique(part[nodes], return_index=True)[1]]
    first[part[np.concatenate([problem.fixed, *alone]).astype(np.int64)]] = HELD
    return np.asarray(first[part])


def pinned(problem: Problem, body: Ints) -> Problem:
    """The problem with the first node of each free body fixed; itself if there is none."""
    first = np.unique(body[body != HELD]).tolist()
    return problem.replace_unchecked(fixed=(*problem.fixed, *first)) if first else problem


def ends(problem: Problem, marked: Marked, body: Ints) -> Ints:
    """(M, 2) bodies that each candidate joins, ascending; HELD is one of those of a measurement of a single node."""
    found = np.full((len(marked.row), 2), HELD)
    for k in np.unique(marked.factor):
        here = marked.factor == k
        nodes = problem.factors[k].nodes[marked.row[here]]
        found[here, 2 - nodes.shape[1] :] = body[nodes]
    return np.sort(found, axis=1)


def within(marked: Marked, between: Ints, groups: int) -> Bools:
    """(G,) groups whose measurements are all of one body, by the `ends` of each."""
    return np.asarray(np.bincount(marked.group, between[:, 0] != between[:, 1], groups) == 0)

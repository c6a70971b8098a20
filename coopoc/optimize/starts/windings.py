"""The other windings of cycles of relative poses: local minima in which errors sum to a turn the other way round."""

from collections.abc import Iterator

import numpy as np

from ...arrays import Floats
from ..model.problem import Problem
from ..model.space import exp, log
from .graph_starts import averaging, position_variance, rotation_variance
from .pose_starts import graph_of

BRIDGE = 1e-9
"""Share of its variance that averaging leaves of an error, or rad of error, below which no cycle holds it."""


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
    edges, space, n = graph_of(problem).relative_pose, problem.space, len(x)
    if not len(edges):
        return
    (i, j), turned, at = edges.nodes.T, space.rotation(x), space.position(x)
    weight = 1.0 / rotation_variance(edges, space.dimension)[:, None]
    error = weight * log(turned[j] @ np.swapaxes(turned[i] @ edges.rotation, 1, 2)) * np.sign(j - i)[:, None]
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
    size = np.linalg.norm(left, axis=1)
    own, other, both = factored.inverse(np.concatenate([a, b, a]), np.concatenate([a, b, b])).reshape(3, -1)
    closed = 1.0 - (own + other - 2.0 * both) / v
    adds = np.where(closed > BRIDGE, (2.0 * np.pi / v) * (np.pi * closed - size), np.inf)
    value, first = np.unique(adds.round(6), return_index=True)  # the same of all along a cycle
    chosen = first[value <= most].tolist()
    if chosen:
        places, _ = averaging(edges.nodes, position_variance(edges, space.dimension), n)
    for k in chosen:
        bent = error.copy()
        bent[k] -= 2.0 * np.pi * left[k] / max(size[k], BRIDGE)
        rotation = exp(turns(bent)) @ turned
        gap = at[j] - at[i] - (rotation[i] @ edges.position[..., None])[..., 0]
        y = space.join(at + places(gap), rotation)
        y[list(problem.fixed)] = x[list(problem.fixed)]
        yield y

"""A part of a problem: some of its nodes and of its measurements."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...arrays import Bools, Floats, Ints, frozen
from .factor import Factor, unchecked
from .problem import Problem


def rows_among(problem: Problem, used: Bools) -> list[Ints]:
    """Of each factor, the rows whose nodes are all used (n,)."""
    return [np.flatnonzero(used[factor.nodes].all(axis=1)) for factor in problem.factors]


def taken(factor: Factor, rows: Ints) -> Factor:
    """Some measurements of a factor of a single problem."""
    parts = {
        name: array[rows] if len(array := getattr(factor, name)) == len(factor.nodes) else array
        for name in ("z", "std", "sqrt_information", "constants")
        if getattr(factor, name) is not None
    }
    return unchecked(factor, nodes=factor.nodes[rows], **parts)


def restricted(problem: Problem, used: Bools, x: Floats, rows: Sequence[Ints] | None = None) -> Problem:
    """The problem of some nodes, from x, which has no separator.

    Args:
        problem: a single one.
        used: (n,) which nodes.
        x: (n, ambient).
        rows: of each factor, among the nodes that are used; None: all among them.
    """
    number = np.cumsum(used) - 1
    kept = [
        taken(f, own) for f, own in zip(problem.factors, rows or rows_among(problem, used), strict=True) if len(own)
    ]
    factors = tuple(unchecked(factor, nodes=number[factor.nodes]) for factor in kept)
    poses, fixed = (tuple(number[[k for k in which if used[k]]].tolist()) for which in (problem.poses, problem.fixed))
    names = tuple(name for name, keep in zip(problem.names, used.tolist(), strict=True) if keep)
    changes = {"names": names, "factors": factors, "x0": frozen(x[used]), "poses": poses, "fixed": fixed}
    return problem.replace_unchecked(**changes, separator=())

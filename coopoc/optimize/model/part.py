"""A part of a problem: some of its nodes and of its measurements."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...arrays import Bools, Floats, Ints, frozen
from .factor import unchecked
from .problem import Problem


def restricted(problem: Problem, used: Bools, x: Floats, rows: Sequence[Ints] | None = None) -> Problem:
    """The problem of some nodes, from x, which has no separator.

    Args:
        problem: a single one.
        used: (n,) which nodes.
        x: (n, ambient).
        rows: of each factor, among the nodes that are used; None: all among them.
    """
    number = np.cumsum(used) - 1
    factors = []
    for k, factor in enumerate(problem.factors):
        own = np.flatnonzero(used[factor.nodes].all(axis=1)) if rows is None else rows[k]
        if len(own):
            parts = {
                name: array[own] if len(array := getattr(factor, name)) == len(factor.nodes) else array
                for name in ("z", "std", "sqrt_information", "constants")
                if getattr(factor, name) is not None
            }
            factors.append(unchecked(factor, nodes=number[factor.nodes[own]], **parts))
    poses, fixed = (tuple(number[[k for k in which if used[k]]].tolist()) for which in (problem.poses, problem.fixed))
    names = tuple(name for name, keep in zip(problem.names, used.tolist(), strict=True) if keep)
    changes = {"names": names, "factors": tuple(factors), "x0": frozen(x[used]), "poses": poses, "fixed": fixed}
    return problem.replace_unchecked(**changes, separator=())

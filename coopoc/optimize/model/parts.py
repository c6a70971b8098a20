"""Problems made of others: a part of the nodes and measurements, factors of one kind fused, how a start was found."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import Any

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


def fused(problem: Problem) -> Problem:
    """The problem with a factor per kind, loss and form of its noise; itself if no two factors go together.

    >>> problem = Problem(("a", "b")).add("position", "a", [0, 0, 0], std=1.0).add("position", "b", [1, 0, 0], std=2.0)
    >>> fused(problem)
    Problem(2 points; 2 position)
    """
    if problem.batch is not None:
        return problem
    forms = [_form(factor) for factor in problem.factors]
    if len(set(forms)) == len(forms):
        return problem
    order = sorted(range(len(forms)), key=forms.__getitem__)
    groups = [list(group) for _, group in groupby(order, key=forms.__getitem__)]
    groups.sort(key=min)
    return problem.replace_unchecked(factors=tuple(_one([problem.factors[k] for k in group]) for group in groups))


def _form(factor: Factor) -> tuple[Any, ...]:
    loss = ("", 0.0) if factor.loss is None else (factor.loss.name, factor.loss.scale)
    return factor.kind, *loss, factor.std is None


def _one(factors: list[Factor]) -> Factor:
    if len(factors) == 1:
        return factors[0]

    def joined(name: str) -> Floats | None:
        arrays = [getattr(factor, name) for factor in factors]
        if arrays[0] is None:
            return None
        wide = [np.broadcast_to(a, (len(f.nodes), *a.shape[1:])) for a, f in zip(arrays, factors, strict=True)]
        return np.concatenate(wide)

    nodes = np.concatenate([factor.nodes for factor in factors])
    changes = {name: joined(name) for name in ("z", "std", "sqrt_information", "constants")}
    return unchecked(factors[0], nodes=nodes, **changes)

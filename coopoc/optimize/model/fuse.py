"""Factors of one kind as one: a problem grown measurement by measurement solves as fast as one of arrays."""

from __future__ import annotations

from itertools import groupby
from typing import Any

import numpy as np

from ...arrays import Floats
from .factor import Factor, unchecked
from .problem import Problem


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

"""A single problem by tapes and a kept pattern: cost, gradient and Hessian at a point, factors of it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np

from ...arrays import Floats
from ..model.problem import Problem
from ..model.space import Space
from . import layout as layouts
from .cholesky import Cholesky
from .dense_cholesky import DenseCholesky
from .entries import Entries
from .layout import Layout, layout_of
from .tape import Model, numbers_of


@dataclass(frozen=True, eq=False)
class Sparse:
    """A single problem over its m unknowns; build it with `sparse`. It does not hold the problem, which holds it.

    Args:
        space: where the nodes live.
        layout: of its structure.
        numbers: per factor, the inputs of its tape that are no nodes.
    """

    space: Space
    layout: Layout
    numbers: tuple[Floats, ...]

    @cached_property
    def entries(self) -> Entries:
        """Of its Hessians."""
        return self.layout.entries

    @cached_property
    def size(self) -> int:
        """m."""
        return self.entries.size

    @property
    def cholesky(self) -> Cholesky | DenseCholesky:
        """Factors of its Hessians, whose ordering is kept; each thread has its own."""
        return self.layout.cholesky

    def cost(self, x: Floats) -> float:
        """1/2 sum of rho at x (n, ambient)."""
        return float(self.layout.total("cost")(x, self.numbers)[0])

    def quadratic(self, x: Floats, model: Model) -> tuple[float, Floats, Floats]:
        """Cost, gradient (m,) and the values of the Hessian's upper triangle at x: J^T J, or the exact one."""
        m = self.size
        total = self.layout.total(model)(x, self.numbers)
        return float(total[0]), total[1 : m + 1], total[m + 1 : -1]

    def retract(self, x: Floats, step: Floats) -> Floats:
        """x after a step (m,)."""
        number = self.entries.number
        if len(step) == number.size:
            return self.space.retract(x, step.reshape(number.shape))
        return self.space.retract(x, np.append(step, 0.0)[number])


LARGE = 60
"""Nodes beyond which a problem without a separator is sparse."""
_KEPT: WeakKeyDictionary[Problem, Sparse | None] = WeakKeyDictionary()


def sparse(problem: Problem, least: int = LARGE) -> Sparse | None:
    """A single problem ready to be evaluated, kept as long as the problem is; None if it has constraints, a kind that
    no tape can hold, or more than DENSE unknowns and yet a separator or at most `least` nodes."""
    if problem.batch is not None or problem.constraints:
        return None
    size = len(problem.names)
    if size * problem.space.dof > layouts.DENSE and (problem.separator or size <= least):
        return None
    try:
        return _KEPT[problem]
    except KeyError:
        made = _KEPT[problem] = _made(problem)
        return made


def keep(former: Problem, problem: Problem) -> Problem:
    """The problem, with what is kept of a former one that differs from it in x0 and its search alone."""
    if former in _KEPT:
        _KEPT[problem] = _KEPT[former]
    return problem


def _made(problem: Problem) -> Sparse | None:
    layout = layout_of(problem)
    if layout is None:
        return None
    return Sparse(problem.space, layout, tuple(numbers_of(factor) for factor in problem.factors))

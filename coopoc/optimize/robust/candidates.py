"""Candidates of GNC: measurements that may be outliers, in groups that share a weight, and the problem reweighed."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...arrays import AnyArray, Floats, Ints, checked, frozen, instance, plain
from ...errors import InputError, shown
from ..assess.assess import squared
from ..model.factor import Factor, unchecked
from ..model.problem import Problem

Candidates = Sequence[int | tuple[int, Sequence[int]]]
"""Factors by their index, all rows of them or some: [0, (2, [1, 3])]."""


@dataclass(frozen=True, eq=False)
class Marked:
    """The M candidate measurements: factor, row and group (M,), groups numbered from 0."""

    factor: Ints
    row: Ints
    group: Ints

    def sums(self, values: Floats) -> Floats:
        """(G,) sums over each group of values (M,)."""
        return np.asarray(np.bincount(self.group, values, int(self.group.max(initial=-1)) + 1), np.float64)


def mark(problem: Problem, candidates: Candidates, groups: npt.ArrayLike | None = None) -> Marked:
    """The candidates, checked."""
    instance("problem", problem, Problem)
    places: list[tuple[int, int]] = []
    for item in candidates if isinstance(candidates, Sequence) else [candidates]:
        k, rows = item if isinstance(item, tuple | list) and len(item) == 2 else (item, None)
        if isinstance(k, bool) or not isinstance(k, int | np.integer) or not 0 <= k < len(problem.factors):
            allowed = f"must be a factor in 0..{len(problem.factors) - 1} or (factor, rows)"
            raise InputError("candidates", shown(item), allowed, "See problem.factors.")
        factor = problem.factors[k]
        if factor.loss is not None:
            allowed = f"has a {factor.loss.name} loss already"
            raise InputError("candidates", repr(factor), allowed, "Leave its loss out.")
        chosen = range(len(factor.nodes)) if rows is None else checked("candidates", rows, "(M,)", (-1,), int).tolist()
        if bad := [r for r in chosen if not 0 <= r < len(factor.nodes)]:
            raise InputError("candidates", bad[:3], f"must be rows of {factor!r}", "Rows count from 0.")
        places += [(int(k), r) for r in chosen]
    if not places or len(set(places)) < len(places):
        hint = "Name the factors that may hold outliers."
        raise InputError("candidates", list(candidates)[:3], "must name measurements, each once", hint)
    labels = np.arange(len(places)) if groups is None else plain(groups)
    if labels.shape != (len(places),) or labels.dtype.kind not in "iuSU":
        allowed = f"must have shape ({len(places)},), one whole number or word per candidate measurement"
        actual = f"shape {labels.shape} of {labels.dtype}"
        raise InputError("groups", actual, allowed, "Leave it out to judge each alone.")
    factor_of, row = np.array(places).T
    return Marked(factor_of, row, np.unique(labels, return_inverse=True)[1])


def reweigh(problem: Problem, marked: Marked, weight: Floats, x0: Floats) -> Problem:
    """The problem from x0 (n, ambient), with W of the candidates times sqrt(weight) (G,) in place of their loss."""
    factors = list(problem.factors)
    for k in np.unique(marked.factor):
        factor, here = factors[k], marked.factor == k
        root = np.ones((len(factor.nodes), 1))
        root[marked.row[here], 0] = np.sqrt(weight[marked.group[here]])
        if factor.std is None:
            factors[k] = unchecked(factor, loss=None, sqrt_information=factor.sqrt_information * root[..., None])
        else:
            with np.errstate(divide="ignore"):  # no weight is an infinite std
                factors[k] = unchecked(factor, loss=None, std=factor.std / root)
    return problem.replace_unchecked(factors=tuple(factors), x0=frozen(x0))


def squares(problem: Problem, marked: Marked, x: Floats) -> Floats:
    """(G,) r^2 of each group at x (n, ambient)."""
    return _sums(problem, marked, lambda factor: squared(problem, factor, x))


def bounds(problem: Problem, marked: Marked, threshold: float) -> Floats:
    """(G,) c^2: chi-square quantiles at the degrees of freedom of each group, without infinite stds."""
    from scipy.special import gammaincinv

    freedom = _sums(problem, marked, lambda factor: (factor.root != 0).any(axis=-1).sum(axis=-1))
    return np.asarray(2.0 * gammaincinv(0.5 * np.maximum(freedom, 1.0), threshold))


def _sums(problem: Problem, marked: Marked, of: Callable[[Factor], AnyArray]) -> Floats:
    """(G,) sums over each group of what there is of each measurement of a factor."""
    sums = np.empty(len(marked.row))
    for k in np.unique(marked.factor):
        here = marked.factor == k
        sums[here] = of(problem.factors[k])[marked.row[here]]
    return marked.sums(sums)

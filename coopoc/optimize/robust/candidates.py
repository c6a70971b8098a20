"""Candidates of GNC: measurements that may be outliers, in groups that share a weight, and the problem reweighed."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...arrays import TINY, AnyArray, Floats, Ints, checked, frozen, number, plain
from ...errors import InputError, shown
from ..assess.assess import squared
from ..model.factor import Factor, reweighed
from ..model.problem import Problem

Inner = Callable[[Problem], Floats]
"""Solves a weighted problem from its x0 and gives its nodes (n, ambient)."""
Candidates = Sequence[int | tuple[int, Sequence[int]]]
"""Factors by their index, all rows of them or some: [0, (2, [1, 3])]."""


@dataclass(frozen=True, eq=False)
class Marked:
    """A problem of which M measurements are candidates.

    Args:
        problem: whose candidates have no loss.
        factor: (M,) of each.
        row: (M,) of that factor.
        group: (M,) which of the G that share a weight, numbered from 0.
        bound: (G,) c^2.
    """

    problem: Problem
    factor: Ints
    row: Ints
    group: Ints
    bound: Floats

    def sums(self, values: Floats) -> Floats:
        """(G,) sums over each group of values (M,)."""
        return np.asarray(np.bincount(self.group, values, len(self.bound)), np.float64)

    def collected(self, of: Callable[[Factor], AnyArray]) -> Floats:
        """(G,) sums over each group of what there is of each measurement of a factor."""
        values = np.empty(len(self.row))
        for k in np.unique(self.factor):
            here = self.factor == k
            values[here] = of(self.problem.factors[k])[self.row[here]]
        return self.sums(values)

    def squares(self, x: Floats) -> Floats:
        """(G,) r^2 of each group at x (n, ambient)."""
        return self.collected(lambda factor: squared(self.problem, factor, x))

    def reweigh(self, weight: Floats, x0: Floats) -> Problem:
        """The problem from x0 (n, ambient), with W of the candidates times sqrt(weight) (G,)."""
        factors = list(self.problem.factors)
        for k in np.unique(self.factor):
            here, root = self.factor == k, np.ones((len(factors[k].nodes), 1))
            root[self.row[here], 0] = np.sqrt(weight[self.group[here]])
            factors[k] = reweighed(factors[k], root)
        return self.problem.replace_unchecked(factors=tuple(factors), x0=frozen(x0))


def mark(problem: Problem, candidates: Candidates, groups: npt.ArrayLike | None = None) -> Marked:
    """The problem with its candidates, checked; their bounds are yet to be given."""
    places = []
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
    names, group = np.unique(labels, return_inverse=True)
    return Marked(problem, factor_of, row, group, np.ones(len(names)))


def bounds(marked: Marked, threshold: float) -> Floats:
    """(G,) c^2: chi-square quantiles at the degrees of freedom of each group, without infinite stds; InputError for a
    threshold that is no probability in (0, 1)."""
    from scipy.special import gammaincinv

    hint = "Use 0.99, or scipy.stats.chi2.cdf(c ** 2, size)."
    threshold = number(
        "threshold", threshold, TINY, np.nextafter(1.0, 0.0), allowed="a probability in (0, 1)", hint=hint
    )

    freedom = marked.collected(lambda factor: factor.measured)
    return np.asarray(2.0 * gammaincinv(0.5 * np.maximum(freedom, 1.0), threshold))

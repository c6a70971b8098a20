"""Graduated non-convexity: candidates, which may be outliers and share weights in groups, and the loop in which least
squares and weights alternate while a nearly convex surrogate becomes the loss.
"""

from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from typing import NamedTuple

import numpy as np
from numpy import inf
from numpy.typing import ArrayLike

from ...arrays import TINY, AnyArray, Floats, Ints, checked, frozen, number, plain, whole
from ...errors import InputError
from ..algebra.sparse import sparse
from ..assess.assess import squared
from ..backend import MAX_ITERATIONS, SOLVER_STEP_TOLERANCE
from ..descent.levenberg_marquardt import arrive, progress
from ..model.factor import Factor, Loss, reweighed, taken, unchecked
from ..model.problem import Problem
from ..starts.mirrors import Cost, Descend, across, movable, scaled
from ..starts.race import QUIET_DRAWS, doubts, drawn, higher, reached_once, scattered

Inner = Callable[[Problem], Floats]
"""Solves a weighted problem from its x0 and gives its nodes (n, ambient)."""
Candidates = Sequence[int | tuple[int, Sequence[int]]]
"""Factors by their index, all rows of them or some: [0, (2, [1, 3])]."""


class Marked(NamedTuple):
    """A problem of which M measurements are candidates.

    Attributes:
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
        return np.asarray(np.bincount(self.group, values, len(self.bound)), float)

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


def mark(problem: Problem, candidates: Candidates, groups: ArrayLike | None = None) -> Marked:
    """The problem with its candidates, checked; their bounds are yet to be given."""
    places, last = [], len(problem.factors) - 1
    for item in candidates if isinstance(candidates, Sequence) else [candidates]:
        k, rows = item if isinstance(item, tuple | list) and len(item) == 2 else (item, None)
        k = whole("candidates", k, 0, last, "Give factors of problem.factors, or (factor, rows).")
        factor = problem.factors[k]
        if factor.loss is not None:
            lacks = f"has a {factor.loss.name} loss already"
            raise InputError("candidates", repr(factor), lacks, "Leave its loss out.")
        chosen = range(len(factor.nodes)) if rows is None else checked("candidates", rows, "(M,)", (-1,), int).tolist()
        if bad := [r for r in chosen if not 0 <= r < len(factor.nodes)]:
            raise InputError("candidates", bad[:3], f"must be rows of {factor!r}", "Rows count from 0.")
        places += [(k, r) for r in chosen]
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

    half = 0.5 * np.maximum(marked.collected(lambda factor: factor.measured), 1.0)
    return np.asarray(2.0 * gammaincinv(half, threshold))


MAX_ROUNDS = 300
"""About 20 are needed."""
MU_RATE = 1.4
"""By which mu changes from round to round."""
EASY, LAST_MU = 1e-6, 1e6
"""Below the first mu is not inverted: all candidates are far within their thresholds; mu of a last graduation."""
REGRADUATE_RATIO2 = 17.0
"""Squared ratio of a residual to its threshold from which the end graduates once more: it may then give up other
measurements, as good as those that it rejects."""
AGREEING_DRAWS, RIVAL_DISTANCE, PATH_SHARE = 6, 0.05, 0.8
"""Random starts that must lead to the lowest minimum to end them, the share of the extent by which another minimum is
elsewhere, and that of the ranges whose shortest paths make a start."""
HOPELESS = 1.1
"""Times a cost that another start has reached, beyond which a surrogate whose minimum is not yet reached ends."""
GAINED = 1e-3
"""Share of the cost that another round must save."""


def first_mu(worst: float) -> float:
    """mu at which the surrogate is convex for ratios s = r^2 / c^2 up to the worst (Yang et al.); it grows from there
    until the surrogate is min(r^2, c^2), or near enough, at LAST_MU."""
    return 1.0 / max(2.0 * worst - 1.0, EASY)


def weights(s: Floats, mu: float) -> Floats:
    """w(s) = d rho_mu / d r^2 of the surrogate of min(r^2, c^2)."""
    return np.clip(np.sqrt(mu * (mu + 1.0) / np.maximum(s, 1e-30)) - mu, 0.0, 1.0)


class Graduation(NamedTuple):
    """Where the loop ended: x (n, ambient), weight (G,), and whether the weights settled."""

    x: Floats
    weight: Floats
    settled: bool


def graduate(
    marked: Marked, inner: Inner, x: Floats, mu: float, weight: Floats | None = None, most: float = inf
) -> Graduation:
    """Alternate `inner`, which solves a weighted problem, and weights, from x (n, ambient), mu and weight (G,),
    default ones, until all are 0 or 1, or the cost is further above `most` than it fell in a round: that of the
    surrogate, 1/2 sum_g c^2 (w s + mu (1 - w) / (mu + w)), which grows with mu along its minima, to that of the loss.

    References:
        Black, Rangarajan, On the unification of line processes, outlier rejection, and robust statistics, IJCV 1996.
    """
    weight, cost = np.ones(len(marked.bound)) if weight is None else weight, inf
    for _ in range(MAX_ROUNDS):
        before, weight = weight, weights(marked.squares(x) / marked.bound, mu)
        if ((weight == before) & ((weight == 0.0) | (weight == 1.0))).all():
            return Graduation(x, weight, True)
        part = marked.reweigh(weight, x)
        x, last = inner(part), cost
        cost = sparse(part).cost(x) + 0.5 * float(marked.bound @ (mu * (1.0 - weight) / (mu + weight)))
        if cost > HOPELESS * most and cost - most > last - cost:
            break
        mu *= MU_RATE
    return Graduation(x, weight, False)


def from_convex(marked: Marked, inner: Inner, start: Floats, most: float = inf) -> Graduation:
    """The graduation of all from a start (n, ambient) and a convex surrogate, until that costs more than `most`."""
    x = inner(marked.problem.starting_at(start))
    return graduate(marked, inner, x, first_mu((marked.squares(x) / marked.bound).max()), most=most)


def contest(
    marked: Marked, inner: Inner, start: Floats, finish: Descend, cost: Cost
) -> tuple[str, Floats, Graduation, tuple[str, ...]]:
    """The start of least cost after `finish`, its end (n, ambient), the graduation from the convex surrogate, notes.

    That graduation races with the start itself and with descents of Huber's and Cauchy's losses, which reject nothing.
    Points that ranges place are then drawn and placed anew by consensus (`drawn`), and what is lowest graduates once
    more. At last what ranges alone place is mirrored.

    Args:
        marked: the problem and its candidates.
        inner: solves a problem from its x0.
        start: (n, ambient).
        finish: from where a start leads to a minimum of the cost.
        cost: that is to be least.
    """
    graduation = from_convex(marked, inner, start)
    huber, cauchy, truncated = (softened(marked, name) for name in ("huber", "cauchy", "truncated"))

    with progress("robust") as counted:

        def landed(at: Floats) -> Floats:
            end = finish(at)
            counted(cost(end))
            return end

        def soft(at: Floats) -> Floats:
            return inner(cauchy.starting_at(at))

        starts = {"graduated": graduation.x, "x0": start, "cauchy": soft(start)}
        starts["huber"] = soft(inner(huber.starting_at(start)))
        ends = {name: landed(at) for name, at in starts.items()}
        costs = {name: np.nan_to_num(cost(at), nan=inf) for name, at in ends.items()}
        best = min(ends, key=costs.__getitem__)
        if (graduation.weight == 1.0).all() and not higher(costs["graduated"], costs[best]):
            return "graduated", ends["graduated"], graduation, ()
        loose = movable(cauchy)
        mirrored_x, moved, *_ = across(cauchy, ends[best], lambda at: landed(soft(at)), cost)
        places = islice(_places(cauchy, mirrored_x, loose), QUIET_DRAWS)
        best_x, tried = drawn(places, mirrored_x, lambda at: landed(soft(at)), cost, AGREEING_DRAWS)
        d, (lowest, _) = cauchy.dimension, min(tried, key=lambda end: end[0])
        size = RIVAL_DISTANCE * np.ptp(np.concatenate([y[:, :d] for _, y in tried]), axis=0).max()
        notes = doubts(best_x, [end for end in tried if abs(end[1] - best_x)[:, :d].max() > size], cost)
        notes = *notes, *reached_once([each for each, _ in tried], lowest)
        name, least = best if best_x is mirrored_x else "drawn", inf
        while cost(best_x) < (1.0 - GAINED) * least:
            least = cost(best_x)
            if len(loose):
                best_x = min((best_x, landed(graduate(marked, inner, best_x, first_mu(REGRADUATE_RATIO2)).x)), key=cost)
            best_x, moves, *_ = across(
                truncated, best_x, lambda at: min((landed(at), landed(soft(at))), key=cost), cost
            )
            moved += moves
    return name + ", moved" * (moved > 0), best_x, graduation, notes


def _places(problem: Problem, x: Floats, loose: Ints) -> Iterator[Floats]:
    """Nodes x (n, ambient) with the `loose` points `scattered`, and every other time where shortest paths along a part
    of the ranges put them."""
    rng = np.random.default_rng(0)
    for k, y in enumerate(scattered(problem, x, loose)):
        part = tuple(
            taken(f, np.flatnonzero(rng.random(len(f.nodes)) < PATH_SHARE)) if f.kind == "range" else f
            for f in problem.factors
        )
        paths = x if k % 2 or problem.poses else scaled(problem.replace_unchecked(factors=part), x)
        yield y if paths is x else paths


def softened(marked: Marked, loss: str) -> Problem:
    """The problem with a loss on its candidates (their rows are factors of their own), each of the scale of its
    group."""
    factors = []
    for k, factor in enumerate(marked.problem.factors):
        here = marked.factor == k
        rows, scale = marked.row[here], np.sqrt(marked.bound[marked.group[here]])
        rest = np.setdiff1d(np.arange(len(factor.nodes)), rows)
        factors += [taken(factor, rest)] if len(rest) else []
        factors += [
            unchecked(taken(factor, rows[scale == each]), loss=Loss(loss, float(each))) for each in np.unique(scale)
        ]
    return marked.problem.replace_unchecked(factors=tuple(factors))


def robust_start(problem: Problem, start: Floats) -> Problem:
    """The problem from where its losses lead lowest: see `contest`; its search names the start.

    Far from the minimum truncated and Geman-McClure losses are flat: every measurement is rejected, and no step is
    left. Cauchy's has a minimum for each subset that agrees.

    >>> from coopoc.optimize import Loss, Problem
    >>> z = [[0, 0, 0], [0, 0, 0], [99, 0, 0]]
    >>> problem = Problem(("a",)).add("position", ["a"] * 3, z, std=1.0, loss=Loss("truncated", 1.0))
    >>> problem = problem.replace_unchecked(search=problem.search._replace(start="odometry"))
    >>> robust_start(problem, np.array([[99.0, 0, 0]])).search.start
    'graduated'
    """
    steps, search = 0, problem.search
    robust = {k: f.loss for k, f in enumerate(problem.factors) if f.loss is not None}
    marked = mark(problem.replace_unchecked(factors=tuple(unchecked(f, loss=None) for f in problem.factors)), [*robust])
    marked = marked._replace(bound=np.array([robust[k].scale ** 2 for k in marked.factor.tolist()]))

    def inner(part: Problem) -> Floats:
        nonlocal steps
        end = arrive(sparse(part), np.array(part.x0), MAX_ITERATIONS, SOLVER_STEP_TOLERANCE)
        steps += end.iterations
        return end.x

    best, x, _, notes = contest(marked, inner, start, lambda at: inner(problem.starting_at(at)), sparse(problem).cost)
    best = search.start or best if best == "x0" else best
    return problem.starting_at(x).replace_unchecked(
        search=search._replace(start=best, iterations=search.iterations + steps, notes=(*search.notes, *notes))
    )

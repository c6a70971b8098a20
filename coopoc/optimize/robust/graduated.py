"""The graduated loop: weighted least squares and weights alternate while a nearly convex surrogate becomes the loss."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...arrays import Floats, frozen, number, one_of
from ...errors import InputError
from ..algebra.sparse import sparse
from ..backend import MAX_ITERATIONS, TOLERANCE
from ..descent.levenberg_marquardt import arrive
from ..model.factor import Loss, unchecked
from ..model.problem import Problem
from .candidates import Marked, mark, reweigh, squares

ROUNDS = 300
"""About 20 are needed."""
RATE = 1.4
"""By which mu changes from round to round."""
SETTLED = 1e-6
"""Largest change of a weight that is none."""
EASY = 1e-6
"""Below this mu is not inverted: all candidates are far within their thresholds."""


@dataclass(frozen=True)
class Surrogate:
    """A robust loss made convex by mu, as weights of the ratio s = r^2 / c^2.

    Args:
        first: mu from the largest ratio.
        weight: w(s, mu) = d rho_mu / d r^2.
        later: the next mu.
        done: whether the weights (G,) have settled, from the new ones, those before and mu.
        last: mu at which rho_mu is rho, or near enough.
    """

    first: Callable[[float], float]
    weight: Callable[[Floats, float], Floats]
    later: Callable[[float], float]
    done: Callable[[Floats, Floats, float], bool]
    last: float


SURROGATES = {
    "truncated": Surrogate(
        lambda worst: 1.0 / max(2.0 * worst - 1.0, EASY),
        lambda s, mu: np.clip(np.sqrt(mu * (mu + 1.0) / np.maximum(s, 1e-30)) - mu, 0.0, 1.0),
        lambda mu: mu * RATE,
        lambda new, old, mu: bool(((new == old) & ((new == 0.0) | (new == 1.0))).all()),
        1e6,
    ),
    "geman-mcclure": Surrogate(
        lambda worst: max(2.0 * worst, 1.0),
        lambda s, mu: np.square(mu / (s + mu)),
        lambda mu: max(mu / RATE, 1.0),
        lambda new, old, mu: mu == 1.0 and bool((np.abs(new - old) <= SETTLED).all()),
        1.0,
    ),
}
"""Of Yang et al.: min(r^2, c^2) as mu grows from c^2 / (2 r_max^2 - c^2), r^2 / (1 + r^2/c^2) as it falls to 1."""


def surrogate_of(loss: str, threshold: float) -> Surrogate:
    """The surrogate of a loss; InputError if there is none, or if the threshold is no probability in (0, 1)."""
    one_of("loss", loss, SURROGATES)
    if not 0 < number("threshold", threshold, allowed="a probability in (0, 1)") < 1:
        hint = "Use 0.99, or scipy.stats.chi2.cdf(c ** 2, size)."
        raise InputError("threshold", threshold, "must be a probability in (0, 1)", hint)
    return SURROGATES[loss]


class Graduation(NamedTuple):
    """Where the loop ended: x (n, ambient), weight (G,), rounds, mu, and whether the weights settled."""

    x: Floats
    weight: Floats
    rounds: int
    mu: float
    settled: bool


def graduate(
    problem: Problem,
    marked: Marked,
    bound: Floats,
    surrogate: Surrogate,
    inner: Callable[[Problem], Floats],
    x: Floats,
    weight: Floats,
    mu: float,
) -> Graduation:
    """Alternate `inner`, which solves a weighted problem, and weights, from x (n, ambient), weight (G,) and mu."""
    for rounds in range(ROUNDS):
        new = surrogate.weight(squares(problem, marked, x) / bound, mu)
        settled, weight = surrogate.done(new, weight, mu), new
        if settled:
            return Graduation(x, weight, rounds, mu, True)
        x, mu = inner(reweigh(problem, marked, weight, x)), surrogate.later(mu)
    return Graduation(x, weight, ROUNDS, mu, False)


def robust_start(problem: Problem, start: Floats) -> Problem:
    """The problem from where its truncated and Geman-McClure losses lead by graduation, by descent from the start
    (n, ambient), or by that of Cauchy's loss, which rejects nothing: the one of the lowest cost; its search names it.

    Far from the minimum these losses are flat: every measurement is rejected, and no step is left.

    >>> from coopoc.optimize import Loss, Problem
    >>> z = [[0, 0, 0], [0, 0, 0], [99, 0, 0]]
    >>> problem = Problem(("a",)).add("position", ["a"] * 3, z, std=1.0, loss=Loss("truncated", 1.0))
    >>> problem = problem.replace_unchecked(search=problem.search._replace(start="odometry"))
    >>> robust_start(problem, np.array([[99.0, 0, 0]])).search.start
    'graduated'
    """
    if problem.constraints:
        return problem
    taken, factors = 0, problem.factors
    robust = {k: f.loss for k, f in enumerate(factors) if f.loss is not None and f.loss.redescends}
    bare = problem.replace_unchecked(factors=tuple(unchecked(f, loss=None) for f in factors))
    marked = mark(bare, list(robust))
    bound = np.array([robust[k].scale ** 2 for k in marked.factor.tolist()])

    def inner(part: Problem) -> Floats:
        nonlocal taken
        end = arrive(sparse(part), np.array(part.x0), MAX_ITERATIONS, TOLERANCE)
        taken += end.iterations
        return end.x

    surrogate, weight = SURROGATES[next(iter(robust.values())).name], np.ones(len(bound))
    x = inner(reweigh(problem, marked, weight, start))
    mu = surrogate.first(float((squares(problem, marked, x) / bound).max()))
    losses = [None if f.loss is None else Loss("cauchy", f.loss.scale) for f in factors]
    softer = tuple(unchecked(f, loss=loss) for f, loss in zip(factors, losses, strict=True))
    starts = {
        "graduated": graduate(problem, marked, bound, surrogate, inner, x, weight, mu).x,
        "x0": start,
        "cauchy": inner(problem.replace_unchecked(factors=softer, x0=start)),
    }
    ends = {name: inner(problem.replace_unchecked(x0=at)) for name, at in starts.items()}
    cost = {name: np.nan_to_num(sparse(problem).cost(at), nan=np.inf) for name, at in ends.items()}
    best, search = min(ends, key=cost.__getitem__), problem.search
    search = search._replace(
        start=search.start if best == "x0" and search.start else best,
        iterations=search.iterations + taken,
    )
    return problem.replace_unchecked(x0=frozen(ends[best]), search=search)

"""Graduated non-convexity: which measurements to disbelieve, decided by least squares whose weights sharpen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ..arrays import Bools, Floats, Ints
from ..errors import InputError
from .batch import Batch, solve_batch
from .descend import MAX_ITERATIONS, TOLERANCE
from .problem import Problem
from .solution import Solution, SolveError, Status
from .solve import solve
from .suspects import Marked, Suspects, bounds, mark, reweigh, squares

RATE = 1.4
"""By which mu changes from round to round."""
ROUNDS = 300
"""About 20 are needed."""
SETTLED = 1e-6
"""Largest change of a weight that is none."""
EASY = 1e-6
"""Below this mu is not inverted: all suspects are far within their thresholds."""


@dataclass(frozen=True)
class Surrogate:
    """A robust loss made convex by mu, as weights of the ratio s = r^2 / c^2.

    Args:
        first: mu from the largest ratio. weight: w(s, mu) = d rho_mu / d r^2. later: the next mu.
        done: whether the weights (B, G) have settled, from the new ones, those before and mu (B,).
    """

    first: Callable[[Floats], Floats]
    weight: Callable[[Floats, Floats], Floats]
    later: Callable[[Floats], Floats]
    done: Callable[[Floats, Floats, Floats], Bools]


SURROGATES = {
    "truncated": Surrogate(
        lambda worst: 1.0 / np.maximum(2.0 * worst - 1.0, EASY),
        lambda s, mu: np.clip(np.sqrt(mu * (mu + 1.0) / np.maximum(s, 1e-30)) - mu, 0.0, 1.0),
        lambda mu: mu * RATE,
        lambda new, old, mu: np.asarray(((new == old) & ((new == 0.0) | (new == 1.0))).all(axis=1)),
    ),
    "geman-mcclure": Surrogate(
        lambda worst: np.maximum(2.0 * worst, 1.0),
        lambda s, mu: np.square(mu / (s + mu)),
        lambda mu: np.maximum(mu / RATE, 1.0),
        lambda new, old, mu: np.asarray((mu == 1.0) & (np.abs(new - old) <= SETTLED).all(axis=1)),
    ),
}
"""Of Yang et al.: min(r^2, c^2) as mu grows from c^2 / (2 r_max^2 - c^2), r^2 / (1 + r^2/c^2) as it falls to 1."""


@dataclass(frozen=True, eq=False)
class Graduated(Batch):
    """A Batch whose suspects got weights: weights (B, M) of the M suspect measurements, rounds and mu (B,).

    Args:
        problem: the weighted problem that was solved last.
    """

    weights: Floats
    rounds: Ints
    mu: Floats
    problem: Problem


def graduate(
    problem: Problem,
    suspects: Suspects,
    loss: str = "truncated",
    threshold: float = 0.99,
    groups: npt.ArrayLike | None = None,
    backend: str = "gauss-newton",
    throw: bool = True,
    **options: Any,
) -> Solution:
    """A minimum of 1/2 sum |r_inlier|^2 + 1/2 sum_g rho(r_g^2), r_g^2 = sum over the group of |W (h(x) - z)|^2.

    rho is min(r^2, c^2) ("truncated") or r^2 / (1 + r^2/c^2) ("geman-mcclure"), c^2 the chi-square quantile at as many
    degrees of freedom as the group has numbers. Starting from a nearly convex surrogate rho_mu, weighted least squares
    and the weights w = d rho_mu / d r^2 alternate while mu turns rho_mu into rho:

        truncated: w = sqrt(mu (mu + 1)) c/|r| - mu within [0, 1], mu from c^2 / (2 r_max^2 - c^2) up by 1.4 a round
        geman-mcclure: w = (mu c^2 / (r^2 + mu c^2))^2, mu from 2 r_max^2 / c^2 down to 1

    until the weights no longer change, truncated ones at 0 or 1. It needs no good start, but honest groups that agree
    better than the others: a majority that lies in concert wins, and so does an error that all share. (Yang, Antonante,
    Tzoumas, Carlone, RA-L 2020, equations 12 and 14, remark 5; methods.md section 6.5.)

    Args:
        problem: a single one; all that is not suspected is a known inlier.
        suspects: factors by index, or (factor, rows); M measurements in all.
        loss: "truncated" or "geman-mcclure". threshold: probability that an honest group is within c.
        groups: (M,) labels; measurements with one label share one weight, such as the fixes of one neighbour. Default:
            each on its own.
        backend, throw, options: of `solve`, which solves every round.

    Returns:
        The Solution of the last weighted problem, whose cost, gradient and covariance are those of the weighted least
        squares; iterations and times are of all rounds; extras has weights (M,), rounds and mu.

    Raises:
        InputError: suspects that do not exist, appear twice or have a loss, other groups than measurements, a threshold
            outside (0, 1), an unknown loss, and what `solve` refuses.
        SolveError: (if `throw`) as `solve`, or weights that did not settle.

    >>> problem = Problem(("a",)).add("position", ["a"] * 3, [[0, 0, 0], [1, 0, 0], [50, 0, 0]], std=1.0)
    >>> solution = graduate(problem, suspects=[0])
    >>> float(solution.x[0, 0].round(3)), solution.extras["weights"]
    (0.5, array([1., 1., 0.]))
    """
    if problem.batch is not None:
        mend = "Pick one with problem.pick(0), or use graduate_batch."
        raise InputError("problem", repr(problem), "must be a single realisation", mend)
    each: list[Solution] = []

    def inner(weighted: Problem) -> Floats:
        each.append(solve(weighted.pick(0), backend, throw=False, **options))
        return each[-1].x[None]

    marked = mark(problem, suspects, groups)
    end = _sharpen(problem, marked, loss, threshold, inner)
    weighted = reweigh(problem, marked, end.weight, end.x).pick(0)
    final = solve(weighted, backend, throw=throw and bool(end.settled[0]), **options)
    extras = {"weights": end.weight[0, marked.group], "rounds": int(end.rounds[0]), "mu": float(end.mu[0])}
    solution = replace(
        final, extras=final.extras | extras, iterations=sum(s.iterations for s in (*each, final)),
        build_seconds=sum(s.build_seconds for s in (*each, final)),
        solve_seconds=sum(s.solve_seconds for s in (*each, final)),
        status=final.status if end.settled[0] else Status.MAX_ITERATIONS,
    )  # fmt: skip
    if throw and not end.settled[0]:
        raise SolveError(solution)
    return solution


def graduate_batch(
    problem: Problem,
    suspects: Suspects,
    loss: str = "truncated",
    threshold: float = 0.99,
    groups: npt.ArrayLike | None = None,
    max_iterations: int = MAX_ITERATIONS,
    tolerance: float = TOLERANCE,
) -> Graduated:
    """All realisations as `graduate` solves each, by gauss-newton; one leaves the batch when its weights have settled.

    Args:
        problem: with a batch axis B (a single problem is a batch of one); the others as `graduate` and `solve_batch`.

    Raises:
        InputError: as `graduate`.
    """

    def inner(weighted: Problem) -> Floats:
        return solve_batch(weighted, max_iterations=max_iterations, tolerance=tolerance).x

    marked = mark(problem, suspects, groups)
    end = _sharpen(problem, marked, loss, threshold, inner)
    weighted = reweigh(problem, marked, end.weight, end.x)
    last = solve_batch(weighted, max_iterations=max_iterations, tolerance=tolerance)
    return Graduated(
        last.x, last.covariance, last.cost, last.iterations, last.converged & end.settled, last.again,
        end.weight[:, marked.group], end.rounds, end.mu, weighted,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _End:
    """x (B, n, width), weight (B, G), mu, rounds and settled (B,) of the last round of each realisation."""

    x: Floats
    weight: Floats
    mu: Floats
    rounds: Ints
    settled: Bools


def _sharpen(problem: Problem, marked: Marked, loss: str, threshold: float, inner: Callable[[Problem], Floats]) -> _End:
    """The alternation, in which `inner` solves the weighted least squares of the realisations that still change."""
    surrogate, bound = surrogate_of(loss, threshold), bounds(problem, marked, threshold)
    x = inner(problem)
    bound = np.broadcast_to(bound, (len(x), bound.shape[1]))
    ratio = squares(problem, marked, x) / bound
    mu, weight = surrogate.first(ratio.max(axis=1)), np.ones_like(ratio)
    rounds, active = np.zeros(len(x), dtype=np.int64), np.arange(len(x))
    for _ in range(ROUNDS):
        new = surrogate.weight(ratio, mu[active, None])
        going = ~surrogate.done(new, weight[active], mu[active])
        weight[active] = new
        active = active[going]
        if not len(active):
            break
        part = problem.pick(active)
        x[active] = inner(reweigh(part, marked, weight[active], x[active]))
        ratio = squares(part, marked, x[active]) / bound[active]
        mu[active] = surrogate.later(mu[active])
        rounds[active] += 1
    return _End(x, weight, mu, rounds, ~np.isin(np.arange(len(x)), active))


def surrogate_of(loss: str, threshold: float) -> Surrogate:
    """The surrogate of a loss; InputError if there is none, or if the threshold is no probability in (0, 1)."""
    if loss not in SURROGATES:
        raise InputError("loss", repr(loss), f"must be one of {sorted(SURROGATES)}", "Or use a Loss in solve.")
    if not 0 < threshold < 1:
        mend = "Use 0.99, or scipy.stats.chi2.cdf(c ** 2, size)."
        raise InputError("threshold", threshold, "must be a probability in (0, 1)", mend)
    return SURROGATES[loss]

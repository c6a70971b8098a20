"""Graduated non-convexity (GNC): least squares whose weights find the outliers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt

from ...arrays import Bools, Floats, Ints, instance
from ...errors import InputError
from ...plugins import one_of
from ...short_repr import short_repr
from ..backend import Backend
from ..batch import Batch, solve_batch
from ..model.problem import Problem
from ..solution import Solution, SolveError, Status
from ..solve import solve
from .compatible import compatible
from .outliers import Candidates, Marked, bounds, mark, reweigh, squares
from .surrogates import surrogate_of

Start = Literal["all", "known"]
ROUNDS = 300
"""About 20 are needed."""


@dataclass(frozen=True, eq=False)
class GNCBatch(Batch):
    """A Batch whose candidates got weights: weights (B, M) of the M candidate measurements, rounds and mu (B,).

    Args:
        problem: the weighted problem that was solved last.
    """

    weights: Floats
    rounds: Ints
    mu: Floats
    problem: Problem

    __repr__ = short_repr


def solve_gnc(
    problem: Problem,
    candidates: Candidates,
    loss: str = "truncated",
    threshold: float = 0.99,
    groups: npt.ArrayLike | None = None,
    backend: str | Backend = "gauss-newton",
    throw: bool = True,
    start: Start = "all",
    **options: Any,
) -> Solution:
    """A minimum of 1/2 sum |r_inlier|^2 + 1/2 sum_g rho(r_g^2), r_g^2 = sum over the group of |W (h(x) - z)|^2.

    rho is min(r^2, c^2) ("truncated") or r^2 / (1 + r^2/c^2) ("geman-mcclure"), c^2 the chi-square quantile at as many
    degrees of freedom as the group has numbers. Starting from a nearly convex surrogate rho_mu, weighted least squares
    and the weights w = d rho_mu / d r^2 alternate while mu turns rho_mu into rho:

        truncated: w = sqrt(mu (mu + 1)) c/|r| - mu within [0, 1], mu from c^2 / (2 r_max^2 - c^2) up by 1.4 a round
        geman-mcclure: w = (mu c^2 / (r^2 + mu c^2))^2, mu from 2 r_max^2 / c^2 down to 1

    until the weights no longer change, truncated ones at 0 or 1. It needs no good start, but inlier groups that agree
    better than the others: a majority of consistent outliers wins, and so does an error that all share.

    start="known" begins with the known inliers alone, which candidates join where they are predicted (`compatible`),
    and then alternates with rho itself. Long drives with wrong loop closures need that: the first least squares over
    all of them bends the whole drive. Robots that only candidates join are placed by those that agree most.

    Args:
        problem: a single one; measurements that are no candidates are known inliers.
        candidates: factors by index, or (factor, rows); M measurements in all.
        loss: "truncated" or "geman-mcclure".
        threshold: probability that the residual of an inlier group is within c.
        groups: (M,) labels; measurements with one label share one weight, such as the fixes of one neighbour. Default:
            each on its own.
        backend: of `solve`, which solves every round.
        throw: as in `solve`.
        start: "all" with full weights, or "known" inliers.
        options: of the backend.

    Returns:
        The Solution of the last weighted problem, whose cost, gradient and covariance are those of the weighted least
        squares; iterations and times are of all rounds; extras has weights (M,), rounds and mu, and "joined", where
        only candidates join parts: their first nodes, how many candidates agree on their place, how many agree on the
        best other place (rival), and how many there are.

    Raises:
        InputError: candidates that do not exist, appear twice or have a loss, other groups than measurements, a
            threshold outside (0, 1), an unknown loss or start, known inliers that leave nodes free which the candidates
            do not place where the start is theirs, and what `solve` refuses.
        SolveError: (if `throw`) as `solve`, or weights that did not settle.

    References:
        Yang, Antonante, Tzoumas, Carlone, RA-L 2020, equations 12 and 14, remark 5.

    >>> problem = Problem(("a",)).add("position", ["a"] * 3, [[0, 0, 0], [1, 0, 0], [50, 0, 0]], std=1.0)
    >>> solution = solve_gnc(problem, candidates=[0])
    >>> float(solution.x[0, 0].round(3)), solution.extras["weights"]
    (0.5, array([1., 1., 0.]))
    """
    if instance("problem", problem, Problem).batch is not None:
        hint = "Pick one with problem.pick(0), or use solve_gnc_batch."
        raise InputError("problem", repr(problem), "must be a single realisation", hint)
    each: list[Solution] = []

    def inner(weighted: Problem) -> Floats:
        each.append(solve(weighted.pick(0), backend, throw=False, **options))
        return each[-1].x[None]

    marked = mark(problem, candidates, groups)
    one_of("start", start, get_args(Start))
    end = _sharpen(problem, marked, loss, threshold, inner, start)
    weighted = reweigh(problem, marked, end.weight, end.x).pick(0)
    final = solve(weighted, backend, throw=throw and bool(end.settled[0]), **options)
    extras = {"weights": end.weight[0, marked.group], "rounds": int(end.rounds[0]), "mu": float(end.mu[0])}
    extras |= {"joined": end.joined} if end.joined else {}
    solution = replace(
        final,
        extras=final.extras | extras,
        iterations=sum(s.iterations for s in (*each, final)),
        build_seconds=sum(s.build_seconds for s in (*each, final)),
        solve_seconds=sum(s.solve_seconds for s in (*each, final)),
        status=final.status if end.settled[0] else Status.MAX_ITERATIONS,
    )
    if throw and not end.settled[0]:
        raise SolveError(solution)
    return solution


def solve_gnc_batch(
    problem: Problem,
    candidates: Candidates,
    loss: str = "truncated",
    threshold: float = 0.99,
    groups: npt.ArrayLike | None = None,
    backend: str | Backend = "gauss-newton",
    **options: Any,
) -> GNCBatch:
    """All realisations as `solve_gnc` solves each; one leaves the batch when its weights have settled.

    Args:
        problem: with a batch axis B (a single problem is a batch of one).
        candidates: as in `solve_gnc`, and so are loss, threshold and groups.
        backend: of `solve_batch`, and so are the options.

    Raises:
        InputError: as `solve_gnc`.
    """

    def inner(weighted: Problem) -> Floats:
        return solve_batch(weighted, backend, **options).x

    marked = mark(problem, candidates, groups)
    end = _sharpen(problem, marked, loss, threshold, inner)
    weighted = reweigh(problem, marked, end.weight, end.x)
    last = solve_batch(weighted, backend, **options)
    return GNCBatch(
        last.x,
        last.covariance,
        last.cost,
        last.iterations,
        last.converged & end.settled,
        last.again,
        end.weight[:, marked.group],
        end.rounds,
        end.mu,
        weighted,
    )


@dataclass(frozen=True, eq=False)
class _End:
    """x (B, n, ambient), weight (B, G), mu, rounds and settled (B,) of the last round of each realisation; `joined` as
    of Known."""

    x: Floats
    weight: Floats
    mu: Floats
    rounds: Ints
    settled: Bools
    joined: tuple[dict[str, Any], ...]


def _sharpen(
    problem: Problem,
    marked: Marked,
    loss: str,
    threshold: float,
    inner: Callable[[Problem], Floats],
    start: Start = "all",
) -> _End:
    """The alternation, in which `inner` solves the weighted least squares of the realisations that still change."""
    surrogate, bound = surrogate_of(loss, threshold), bounds(problem, marked, threshold)
    before, joined = 0, tuple[dict[str, Any], ...]()
    if start == "known":
        known = compatible(problem, marked, bound, inner)
        x, weight, before, joined = known.x, known.weight, known.rounds, known.joined
        ratio, mu = squares(problem, marked, x) / bound, np.array([surrogate.last])
    else:
        x = inner(problem)
        bound = np.broadcast_to(bound, (len(x), bound.shape[1]))
        ratio = squares(problem, marked, x) / bound
        mu, weight = surrogate.first(ratio.max(axis=1)), np.ones_like(ratio)
    rounds, active = np.full(len(x), before), np.arange(len(x))
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
    return _End(x, weight, mu, rounds, ~np.isin(np.arange(len(x)), active), joined)

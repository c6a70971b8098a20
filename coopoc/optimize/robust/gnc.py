"""Graduated non-convexity (GNC): least squares whose weights find the outliers."""

from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from ...arrays import Floats, instance, one_of
from ...kernels.compiling.waiting import clock
from ..algebra.sparse import sparse
from ..assess.assess import INLIER_WEIGHT, expected, implausible, rejection
from ..backend import MAX_ITERATIONS, SOLVER_STEP_TOLERANCE, Backend
from ..descent.levenberg_marquardt import Arrival, arrive
from ..graph_problems import started
from ..model.problem import Problem
from ..solution import Solution, SolveError, Status
from ..solve import solve
from ..starts.initial import initial_guess
from .graduated import LAST_MU, Candidates, Graduation, bounds, contest, from_convex, graduate, mark
from .loop_closures import known_start, unconfirmed

Start = Literal["any", "known"]
CONTEST_NODES, RIVAL_STEPS = 1000, 100
"""Nodes beyond which, where candidates are relative poses or linear, the graduation alone competes with known inliers,
and steps of each of its least squares: the first ones bend a long drive."""


def solve_gnc(
    problem: Problem,
    candidates: Candidates,
    threshold: float = 0.99,
    groups: ArrayLike | None = None,
    backend: str | Backend = "gauss-newton",
    throw: bool = True,
    start: Start = "any",
    **options: Any,
) -> Solution:
    """A minimum of 1/2 sum |r_inlier|^2 + 1/2 sum_g rho(r_g^2), r_g^2 = sum over the group of |W (h(x) - z)|^2.

    rho is min(r^2, c^2), c^2 the chi-square quantile at as many degrees of freedom as the group has numbers. Starting
    from a nearly convex surrogate rho_mu, weighted least squares and the weights w = d rho_mu / d r^2 alternate while
    mu turns rho_mu into rho,

        w = sqrt(mu (mu + 1)) c/|r| - mu within [0, 1], mu from c^2 / (2 r_max^2 - c^2) up by 1.4 a round,

    until the weights no longer change, at 0 or 1. Inlier groups must agree better than the others: a
    majority of consistent outliers wins, and so does an error that all share.

    Where known inliers hold every node, as odometry does, they are the start, which candidates join where they are
    predicted (`loop_closures.py`): a first least squares over wrong loop closures would bend a long drive. The
    graduation and other starts (`graduated.py`) race with that, and the least cost wins, unless every candidate is a
    relative pose or linear, and the noise explains what remains of them. Of more than CONTEST_NODES the graduation
    alone does, until its surrogate costs more.

    Args:
        problem: a single one; measurements that are no candidates are known inliers.
        candidates: factors by index, or (factor, rows); M measurements in all.
        threshold: probability that the residual of an inlier group is within c.
        groups: (M,) labels; measurements with one label share one weight, such as the fixes of one neighbour. Default:
            each on its own.
        backend: of `solve`, for the last problem, and with constraints for every round.
        throw: as in `solve`.
        start: "known" lets nothing compete with known inliers that hold every node: that takes several times as long
            for thousands of poses whose noise is stated too small.
        options: of the backend.

    Returns:
        The Solution of the last weighted problem, whose cost, gradient and covariance are those of the weighted least
        squares; iterations and times are of all rounds; extras has weights (M,).

    Raises:
        InputError: candidates that do not exist, appear twice or have a loss, other groups than measurements, a
            threshold outside (0, 1), an unknown start, and what `solve` refuses.
        SolveError: (if `throw`) as `solve`, or weights that did not settle.

    References:
        Yang, Antonante, Tzoumas, Carlone, RA-L 2020, equation 14, remark 5.

    >>> problem = Problem(("a",)).add("position", ["a"] * 3, [[0, 0, 0], [1, 0, 0], [50, 0, 0]], std=1.0)
    >>> solution = solve_gnc(problem, candidates=[0])
    >>> float(solution.x[0, 0].round(3)), solution.extras["weights"]
    (0.5, array([1., 1., 0.]))
    >>> solve_gnc(Problem(("a",)).add("position", ["a"] * 2, [[-40, 0, 0], [40, 0, 0]], std=1.0), [0]).notes[1]
    'another minimum, elsewhere, costs as much'
    """
    problem = started(instance("problem", problem, Problem))
    one_of("start", start, Start)
    marked = mark(problem, candidates, groups)
    marked = marked._replace(bound=bounds(marked, threshold))
    each, began, doubts = list[int](), clock(), tuple[str, ...]()

    def inner(part: Problem, steps: int = MAX_ITERATIONS) -> Floats:
        end: Solution | Arrival
        if problem.constraints:
            end = solve(part, backend, throw=False, covariance=False, **options)
        else:
            end = arrive(sparse(part), np.array(part.x0), steps, SOLVER_STEP_TOLERANCE)
        each.append(end.iterations)
        return end.x

    def finish(at: Floats, weight: Floats | None = None) -> Graduation:
        return graduate(marked, inner, at, LAST_MU, weight)

    def explained(end: Graduation) -> bool:  # the minimum of ranges and angles need not be the only one
        part = marked.reweigh(end.weight, end.x)
        return single and not implausible(sparse(part).cost(end.x), *expected(part, sparse(part).size))

    def cost(at: Floats) -> float:
        s = marked.squares(at) / marked.bound
        return sparse(marked.reweigh(0.0 * s, at)).cost(at) + 0.5 * float(marked.bound @ np.minimum(s, 1.0))

    single = all(m.linear or m.compares_poses for m in {problem.factors[k].measurement for k in marked.factor})
    known = known_start(marked, inner)
    best, end = "known", finish(*known) if known else None
    if end is None or (start == "any" and not explained(end)):
        least, guess = cost(end.x) if end else np.inf, initial_guess(problem)
        if end and single and len(problem.names) > CONTEST_NODES:
            best, other = "graduated", from_convex(marked, lambda part: inner(part, RIVAL_STEPS), guess, least)
        else:
            best, x, graduation, doubts = contest(marked, inner, guess, lambda at: finish(at).x, cost)
            other = graduation if best == "graduated" else finish(x)
        if end and (least <= cost(other.x) or not other.settled):
            best, other = "known", end
        end = other
    weight = end.weight
    final = solve(marked.reweigh(weight, end.x), backend, throw=throw and end.settled, **options)
    status = final.status if end.settled else Status.MAX_ITERATIONS
    out = int((weight < INLIER_WEIGHT).sum())
    notes = (rejection("GNC", out, len(weight), "candidates", final.cost, final.expected),) if out else ()
    solution = replace(
        final,
        iterations=sum(each) + final.iterations,
        solve_seconds=clock() - began - final.build_seconds - final.check_seconds,
        status=status,
        notes=(*notes, *doubts, *unconfirmed(marked, weight), *final.notes),
        extras=final.extras | {"start": best, "weights": weight[marked.group]},
    )
    if throw and not end.settled:
        raise SolveError(solution)
    return solution

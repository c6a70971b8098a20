"""Assessment of a point independently of its solver: covariance, free nodes, curvature, plausible cost."""

from collections.abc import Sequence
from itertools import compress
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy import inf, nan
from numpy.linalg import LinAlgError, eigh, norm, qr

from ...arrays import Bools, Floats, checked, instance
from ...errors import InputError
from ..algebra.cholesky import cholesky_of
from ..algebra.sparse import Entries, layout_of, sparse, structure_of
from ..model.derivatives import Model, linearise, numbers_of
from ..model.factor import Factor, as_factor, reweighed, stacked, unchecked
from ..model.problem import Problem, linearised, several
from .active import Active, active_at

if TYPE_CHECKING:
    from ..solution import Solution

CHORDAL = "pose_chordal", "relative_pose_chordal"
"""Kinds that compare the entries of rotation matrices."""
INFLATION = 1e10
"""A variance this many times what it would be with all else known counts as unbounded."""
CANCELLED = 1e-7
"""Share of its terms that a row may keep along a direction that it does not see."""
ROUNDED = 1e-14
"""Share of the largest number of a column up to which another is rounding, such as sin(0)."""
DENSE_COLUMNS = 200
"""Columns up to which the null space of J is that of a dense matrix."""
DENSE_WORK = 4e9
"""Rows by columns squared up to which marginals are of the R of J: a second."""
SLACK = 1e-6
"""Share of the diagonal of J^T J by which the curvature may be negative: a flat minimum is one, whatever the
rounding."""
FLAT_CURVATURE = 1e-9
"""Curvature, as a share of the diagonal of J^T J, that is rounding."""
LEVER = 0.1
"""m or rad, least radius of a way along which no measurement changes."""
TAIL = 1e-6
"""Probability below which a cost, or one above it, is not explained by the noise that is stated."""
DOUBTFUL_SHARE = 0.25
"""Share of measurements whose rejection casts doubt on the minimum."""
PROBES = 4
"""Random signs by which a trace is estimated."""
INLIER_WEIGHT = 0.5
"""Weight rho' below which a robust loss rejects a measurement."""


class Assessment(NamedTuple):
    """Of a problem at x.

    Attributes:
        cost: 1/2 sum of rho.
        gradient_norm: |J^T r|, or with constraints |J^T r + C^T multipliers|.
        covariance: (n, dof, dof) m^2, rad^2.
        remaining: m or rad, largest move of a Gauss-Newton step.
        unobservable: names of nodes that can move without changing the cost.
        active: what holds x, None without constraints.
        predicted: decrease of the cost by this step, as its model predicts; infinite where constraints hold it.
        curved: J^T J hardly sees some direction, and the exact Hessian, which does, stands in for it.
        newton: the step is Newton's, by an exact Hessian that is positive definite.
        leverage: of the rows that weigh rotations twice; 0, its least, where it is not computed.
    """

    cost: float
    gradient_norm: float
    covariance: Floats
    remaining: float
    unobservable: tuple[str, ...] = ()
    active: Active | None = None
    predicted: float = inf
    curved: bool = False
    newton: bool = False
    leverage: float = 0.0

    @property
    def violation(self) -> float:
        """Largest of a constraint, m, rad or m/s."""
        return 0.0 if self.active is None else float(self.active.rows.outside.max())


def assess(problem: Problem, x: Floats, covariance: bool = True, quick: bool = False) -> Assessment:
    """Assessment of a problem at x (n, ambient); without constraints the covariance may be left out, and be `quick`
    where the exact Hessian alone shows that x is held.

    >>> from coopoc.optimize import Problem
    >>> vague = Problem(("a",)).add("position", ["a"], [[0, 0, 0]], std=1e8)  # known to 1e8 m is not unknown
    >>> assess(vague.constrain("position", "a", upper=9e9), np.zeros((1, 3))).covariance[0].diagonal()
    array([1.e+16, 1.e+16, 1.e+16])
    """
    if not problem.constraints:
        return _unconstrained(problem, x, covariance, quick and not problem.linear)
    (linear, J), still = linearised(problem, x), ~problem.movable
    gradient = J.T @ stacked(r.ravel() for r in linear.residual)
    active = active_at(problem, x, gradient.reshape(still.shape))
    size = float(norm(gradient + active.rows.matrix.T @ active.multipliers))
    try:
        cov, dx = _marginals(J, still, gradient, active)
        if (stated := as_stated(problem)) is not problem:
            cov = _marginals(linearised(stated, x)[1], still, gradient, active)[0]
    except LinAlgError:
        free = _unobservable(problem, J, active)
        return Assessment(linear.cost, size, np.full((*still.shape, still.shape[1]), nan), nan, free, active)
    cov = cov * ~(still[:, :, None] | still[:, None, :])
    return Assessment(linear.cost, size, cov, float(abs(dx).max(initial=0.0)), (), active)


def _unconstrained(problem: Problem, x: Floats, covariance: bool, quick: bool = False) -> Assessment:
    """The assessment of a problem without constraints.

    A pivot is the information of an unknown with those before it eliminated and those after it given, so that its
    inverse is no larger than the variance: along a free direction one is rounding.
    """
    system = sparse(problem)
    cholesky, entries = system.cholesky, system.entries
    cost, gradient, values = system.quadratic(x, "newton" if quick else "gauss-newton")
    none = np.full((len(x), *(problem.space.dof,) * 2), nan)
    if not (quick or (np.isfinite(values).all() and np.isfinite(cost))):
        return Assessment(cost, inf, none, nan)
    size = float(norm(gradient))
    unknown = Assessment(cost, size, none, nan)

    def ended(cov: Floats, dx: Floats, curved: bool = False) -> Assessment:
        far, gain = float(abs(dx).max(initial=0.0)), 0.5 * abs(float(gradient @ dx))
        return Assessment(cost, size, cov, far, predicted=gain, curved=curved, leverage=leverage)

    own, cov = largest(problem, values[entries.diagonal]), none
    step = variance = np.full(entries.size, inf)
    leverage = 0.0
    if held := cholesky.factor(values):
        step, variance, leverage = cholesky.solve(gradient), 1.0 / cholesky.pivots, _leverage(problem, x)
        if not quick and (covariance or not (variance * own < INFLATION).all()):
            cov, variance = _inverse(problem, x, "gauss-newton")
        if (variance * own < INFLATION).all():
            return ended(cov, step)._replace(newton=quick)
    if quick:
        return _unconstrained(problem, x, covariance)
    exact, bent = values if problem.linear else system.quadratic(x, "newton")[2], None
    if not problem.linear and np.isfinite(exact).all():
        scale, steepness = own + (own == 0), largest(problem, abs(gradient))
        flat = FLAT_CURVATURE + (steepness / scale + np.finfo(float).eps * abs(x).max()) / LEVER
        bent = _symmetric(entries, exact), np.sqrt(scale), flat
    if nodes := _unobservable(problem, problem.whiten(x)[1], None, bent):
        return unknown._replace(unobservable=nodes)
    if (half := _by_rows(problem, x)) is not None:
        free, rows, columns = entries.marginals
        cov[free] = np.vecdot(half[rows], half[columns])
    if bent is None:
        return ended(cov, step) if held else unknown
    if not cholesky.factor(exact):
        values[entries.diagonal] += SLACK * own + (own == 0)
        return ended(none, cholesky.solve(gradient) if cholesky.factor(values) else step, True)
    newton = cholesky.solve(gradient)
    inverse, less = _inverse(problem, x, "newton")
    return ended(inverse, newton, True) if (2.0 * less < variance).any() else ended(cov, step)


def largest(problem: Problem, numbers: Floats) -> Floats:
    """(m,) the largest of such numbers among the positions, or the turns, of the node of each unknown."""
    number, d = sparse(problem).entries.number, problem.dimension
    table = np.append(numbers, 0.0)[number]
    for part in (table[:, :d], table[:, d:]):
        part[:] = part.max(axis=1, initial=0.0, keepdims=True)
    return table[number >= 0]


def _inverse(problem: Problem, x: Floats, model: Model) -> tuple[Floats, Floats]:
    """Marginals (n, dof, dof) under the noise that is stated, and their diagonal (m,); the cost's factor is at hand."""
    system, stated = sparse(problem), as_stated(problem)
    free, rows, columns = system.entries.marginals
    blocks, cov = np.full(len(rows), nan), np.zeros(free.shape)
    if stated is problem or system.cholesky.factor(sparse(stated).quadratic(x, model)[2]):
        blocks = system.cholesky.inverse(rows, columns)
    cov[free] = blocks
    return cov, blocks[rows == columns]


def _by_rows(problem: Problem, x: Floats) -> Floats | None:
    """H (m, m) with H H^T = (J^T J)^-1 by R of J = Q R, rows of large numbers first and columns pivoted, which keeps
    digits that J^T J rounds away; None where J is singular, or its work beyond DENSE_WORK.

    References:
        Cox, Higham, Stability of Householder QR factorization for weighted least squares problems, 1998.
    """
    from scipy.linalg import inv, qr

    J = as_stated(problem).whiten(x)[1][:, problem.movable.ravel()]
    if J.shape[0] * J.shape[1] ** 2 > DENSE_WORK:
        return None
    J = J.toarray()
    upper, pivot = qr(J[np.argsort(-abs(J).max(1))], mode="r", pivoting=True)
    own = abs(upper.diagonal())
    singular = len(own) < J.shape[1] or own.min() <= ROUNDED * own.max()
    return None if singular else np.asarray(inv(upper[: len(own)])[np.argsort(pivot)])


def _symmetric(entries: Entries, values: Floats) -> Any:
    """(m, m) sparse Hessian from its upper triangle."""
    from scipy.sparse import csc_array, triu

    half = csc_array((values, entries.indices, entries.indptr), shape=(entries.size,) * 2)
    return half + triu(half, 1).T


def _marginals(J: Any, still: Bools, gradient: Floats, active: Active) -> tuple[Floats, Floats]:
    """Marginals under the equalities, and the Gauss-Newton step along what holds.

    With Z the directions that remain: cov = Z (Z^T J^T J Z)^-1 Z^T, and the step solves the same system after the least
    step onto what holds.

    Raises:
        numpy.linalg.LinAlgError: a matrix is not positive definite, or a variance not bounded.
    """
    from scipy.sparse import diags_array

    along, exact, onto = active.along, active.exact.tocsr(), active.onto
    hessian = J.T @ J + diags_array(still.ravel().astype(float))
    within = [ways.T @ hessian @ ways for ways in (along, exact)]
    free, held = map(cholesky_of, within)
    if free is None or held is None:
        raise LinAlgError("not positive definite")
    dx = onto - along @ free.solve(along.T @ (gradient + hessian @ onto))
    nodes = [exact[rows] for rows in np.arange(still.size).reshape(still.shape)]
    cov = np.array([ways @ held.solve(ways.T.toarray()) for ways in nodes])
    own = (exact @ within[1] @ exact.T).diagonal()
    inflation = own * np.einsum("nii->ni", cov).ravel()
    sound = (own > 1e-13 * own.max(initial=0.0)) & (inflation > 0) & (inflation < INFLATION)
    if not (sound[exact.power(2).sum(1) > 1e-9].all() and np.isfinite(dx).all()):
        raise LinAlgError("not bounded")
    return cov, dx


def _unobservable(
    problem: Problem, J: Any, active: Active | None, bent: tuple[Any, Floats, Floats] | None = None
) -> tuple[str, ...]:
    """Nodes that take part in a direction which no measurement sees: the null space of J with unit columns.

    Where `bent` has the exact Hessian H (m, m), scales D^1/2 (m,) of the unknowns and shares (m,), only along which
    D^-1/2 H D^-1/2 is no larger than its share, too: between two anchors that are too close together, a node is held
    across their line by the curvature of ranges that are too short, and pushed off it by longer ones. A gradient bends
    a direction that nothing sees by as much as its share: along a circle about an anchor by |g| / radius.
    """
    from scipy.sparse import eye_array

    ways = eye_array(J.shape[1], format="csc") if active is None else active.exact
    J = _evened(J @ ways).tocsc()
    length = np.sqrt(J.power(2).sum(0))
    measured = length > 0
    null = _null_rows(J[:, measured], length[measured])
    if bent is None:
        null = null @ ways[:, measured].T
        moves = np.square(null).sum(0) + ways[:, ~measured].power(2).sum(1)
        moves = moves * problem.movable.ravel()
    else:
        hessian, scale, flat = bent
        moving = np.flatnonzero(problem.movable)
        lost, curved = ~measured[moving], abs(hessian).sum(0) > 0
        every = np.zeros((J.shape[1], len(null)))
        every[measured] = null.T / length[measured, None]
        own = np.arange(len(moving))[:, None] == np.flatnonzero(lost & curved)
        basis = qr(np.hstack([scale[:, None] * every[moving], own]))[0]
        values, turned = eigh(basis.T @ (hessian @ (basis / scale[:, None]) / scale[:, None]))
        moves = np.zeros(J.shape[1])
        ways_squared = np.square(basis @ turned)
        moves[moving] = ways_squared[:, abs(values) <= flat @ ways_squared].sum(1) + (lost & ~curved)
    return tuple(compress(problem.names, moves.reshape(len(problem.names), -1).sum(1) > 1e-6))


def _evened(J: Any) -> Any:
    """Rows of J (sparse) over their largest number: their weights hide no direction; of numbers that are no rounding
    beside the largest of their column."""
    from scipy.sparse import diags_array

    least, J = ROUNDED * abs(J).sum(0), J.tocoo()
    J.data *= abs(J.data) > least[J.col]
    return diags_array(1.0 / np.maximum(abs(J).max(1).toarray().ravel(), 1e-300)) @ J


def _null_rows(J: Any, length: Floats) -> Floats:
    """Rows that span the null space of J with unit columns; where J is large, those that inverse iteration finds.

    Args:
        J: (m, k) sparse.
        length: (k,) of its columns, > 0.

    >>> from scipy.sparse import csc_array
    >>> _null_rows(csc_array([[1.0, 0], [0, 1e6]]), np.array([1.0, 1e6])).shape
    (0, 2)
    """
    from scipy.sparse import diags_array

    unit = (J @ diags_array(1.0 / length)).tocsc()
    square = unit.T @ unit
    if len(length) <= DENSE_COLUMNS:
        values, ways = eigh(square.toarray())
        return ways[:, values <= 1e-10 * values.max(initial=1.0)].T
    shift, factored = 1e-12, None
    while factored is None:
        factored, shift = cholesky_of(square + diags_array(np.full(len(length), shift))), 10.0 * shift
    ways = np.random.default_rng(0).standard_normal((len(length), 12))
    for _ in range(6):
        ways = qr(factored.solve(ways))[0]
    ways = ways @ eigh(ways.T @ (square @ ways))[1]
    return np.asarray(ways[:, ~_seen(unit, ways)].T)


def _seen(J: Any, ways: Floats) -> Bools:
    """(K,) whether a row of J sees a direction (columns of `ways`), whatever its weight.

    Along a direction that nothing measures the terms of every row cancel to rounding; where one is only weakly held,
    some row keeps a share of its terms.
    """
    rows = _evened(J)
    left, terms = abs(rows @ ways), abs(rows) @ abs(ways)
    matters = terms > 1e-6 * terms.max(0)  # a chain bends by angles that are small beside its length
    return np.asarray((matters & (left > CANCELLED * terms)).any(0))


def newton_decrease(problem: Problem, x: Floats) -> float | None:
    """Predicted decrease of the cost, 1/2 g^T H^-1 g, by a full Newton step from x (n, ambient); None if the cost
    curves downwards there.

    It is half the squared Newton decrement, the distance to the minimum in standard deviations, whatever the units of
    the nodes (Boyd and Vandenberghe, Convex Optimization, section 9.5.1). A linear problem has J^T J alone: 0 here.
    """
    if problem.linear or problem.constraints:
        return 0.0
    system = sparse(problem)
    _, gradient, values = system.quadratic(x, "newton")
    if not np.isfinite(values).all():
        return None
    if not system.cholesky.factor(values):
        own = system.entries.diagonal
        values[own] += SLACK * system.quadratic(x, "gauss-newton")[2][own]
        if not system.cholesky.factor(values):
            return None
    return float(0.5 * gradient @ system.cholesky.solve(gradient))


def is_constrained_minimum(problem: Problem, x: Floats, active: Active) -> bool:
    """True unless the Lagrangian of a problem curves downwards at x (n, ambient) within what `active` allows.

    Z^T (H + sum_c m_c d2 h_c / dx2) Z is positive definite, H the Hessian of the cost, m the multipliers and Z the
    directions that remain, eased by SLACK. The far side of a range that must be met is a stationary point too, and a
    maximum. Source: Nocedal and Wright, Numerical Optimization, 2nd ed., theorem 12.6.
    """
    if problem.linear:
        return True
    if active.along.shape[0] == active.along.shape[1]:  # no direction is taken away
        return newton_decrease(problem.replace_unchecked(constraints=()), x) is not None
    system, structure, rows = sparse(problem), structure_of(problem), active.rows.origin
    terms, numbers = list(structure.factors), list(system.numbers)
    for k, (item, term) in enumerate(zip(problem.constraints, structure.constraints, strict=True)):
        own, weight = rows[:, 0] == k, np.zeros(item.lower.shape)
        weight[rows[own, 1], rows[own, 2]] = active.multipliers[own]
        numbers.append(numbers_of(reweighed(as_factor(item), weight)))
        terms.append(term._replace(kind=term.kind._replace(bound=True)))
    layout = layout_of(structure._replace(factors=tuple(terms)))
    entries, values = layout.entries, layout.total("newton", x, numbers)[system.size + 1 : -1]
    values[entries.diagonal] += SLACK * system.quadratic(x, "gauss-newton")[2][system.entries.diagonal]
    moving = problem.movable.ravel()
    ways, still = active.along[moving], active.along[~moving]
    within = ways.T @ _symmetric(entries, values) @ ways + still.T @ still
    return not within.shape[0] or cholesky_of(within) is not None


def judged(problem: Problem, x: Floats, truth: Assessment) -> tuple[float, tuple[str, ...]]:
    """Expected cost at a minimum x (n, ambient) by the chi-square law, and notes on one that is far from it.

    Measurements that a robust loss rejects count neither in the cost nor in what is expected. Where inequalities push,
    the cost is no more than that of the truth, which all that is measured adds to.
    """
    unknowns, notes, rejected = sparse(problem).size, [], []
    spent, out, pushing = 0.0, 0, 0
    if not np.isfinite(truth.cost):
        return nan, ("the cost overflows: z, x0 or 1/std is too large",)
    if truth.curved:
        lost = "there is no covariance, and others may cost as little"
        what = lost if np.isnan(truth.covariance).all() else "the covariance is that of the exact Hessian"
        notes.append(f"J^T J is singular here: {what}")
    if truth.active is not None:
        (free, along), exact = truth.active.along.shape, truth.active.exact.shape[1]
        unknowns, pushing = unknowns - free + along, exact - along
    for factor in problem.factors:
        if factor.loss is None:
            continue
        square = squared(problem, factor, x)
        beyond = factor.loss.weight(square) < INLIER_WEIGHT
        if count := int(beyond.sum()):
            spent += 0.5 * float(factor.loss.cost(square[beyond]).sum())
            rejected.append((f"{factor.loss.name} loss", count, len(square), f"measurements {factor.kind}"))
            out += int(factor.measured[beyond].sum())
    mean, variance = expected(problem, unknowns + out, truth.leverage)
    notes += [rejection(*each, truth.cost - spent, mean) for each in rejected]
    most, spread = expected(problem, out, truth.leverage) if pushing else (mean, variance)
    if implausible(truth.cost - spent, most, spread):
        convex = problem.linear or not problem.movable.any()
        whys = [] if convex else ["a local minimum (try other x0, or certify it)"]
        if pushing:
            whys += [f"{pushing} bounds that push contradict the measurements"]
        elif equal := sorted({c.kind for c in problem.constraints if (c.lower == c.upper).any()}):
            whys += [f"constraints of {', '.join(equal)} that contradict the measurements"]
        cost = f"cost {truth.cost - spent:.4g} where the stated noise explains {most:.3g} +- {np.sqrt(spread):.2g}: "
        notes.append(cost + ", ".join([*whys, "outliers, or noise that is stated too small"]))
    else:
        notes += outlying(problem, x, truth.cost)
    return mean + spent, tuple(notes)


def outlying(problem: Problem, x: Floats, cost: float) -> list[str]:
    """A note on the worst measurement of each factor without a loss, if TAIL of all problems have one as bad.

    >>> line = Problem(("a",)).add("position", ["a"] * 1000, np.eye(1000, 3) * [8, 0, 0], std=1.0)
    >>> outlying(line, np.zeros((1, 3)), 500.0)
    ['position a is 8 standard deviations off: an outlier?']
    """
    from scipy.special import gammaincc

    every, notes = sum(len(factor.nodes) for factor in problem.factors), []
    for factor in problem.factors if every * np.exp(-cost) < TAIL else ():  # else none is as bad
        if factor.loss is None:
            square = squared(problem, factor, x) / (1 + factor.twice)
            tail = every * gammaincc(0.5 * np.maximum(factor.measured, 1), 0.5 * square)
            k = tail.argmin()
            if tail[k] < TAIL:
                names = "-".join(problem.names[node] for node in factor.nodes[k])
                notes.append(f"{factor.kind} {names} is {np.sqrt(square[k]):.3g} standard deviations off: an outlier?")
    return notes


def rejection(what: str, out: int, of: int, which: str, cost: float, mean: float) -> str:
    """The note on measurements that are rejected, and on what remains; it begins louder from DOUBTFUL_SHARE of them on.

    >>> rejection("GNC", 4, 9, "candidates", 2.5, 3.0)
    'DOUBTFUL: GNC rejects 4 of 9 candidates; the rest costs 2.5 where the stated noise explains 3'
    """
    loud = "DOUBTFUL: " if out >= DOUBTFUL_SHARE * of else ""
    rest = f"the rest costs {cost:.4g} where the stated noise explains {mean:.3g}"
    return f"{loud}{what} rejects {out} of {of} {which}; {rest}"


def as_stated(problem: Problem) -> Problem:
    """The problem with the weights of the noise that it states, of the same structure: without those that count
    rotations twice."""
    if not any(f.twice for f in problem.factors):
        return problem
    share = np.sqrt([1.0] * problem.dimension + [0.5] * (problem.space.ambient - problem.dimension))
    return problem.replace_unchecked(factors=tuple(reweighed(f, share) if f.twice else f for f in problem.factors))


def squared(problem: Problem, factor: Factor, x: Floats) -> Floats:
    """(M,) |W (h(x) - z)|^2 of the measurements of a factor at x (n, ambient)."""
    (residual,) = linearise(problem.space, [unchecked(factor, loss=None)], x).residual
    return np.asarray(np.vecdot(residual, residual))


def implausible(cost: float, mean: float, variance: float) -> bool:
    """Whether a cost lies in the upper TAIL of 2 cost / g ~ chi-square with h degrees of freedom, g = variance / mean
    and h = 2 mean / g, which has this mean and variance (Satterthwaite); g = 1 but for angles of rotation matrices."""
    if cost <= max(mean, 0.5) + 3.0 * np.sqrt(max(variance, 0.5)):  # no less than one spare number explains
        return False
    if not mean > 0:
        return True
    from scipy.special import gammaincc

    scale = variance / mean
    return bool(gammaincc(mean / scale, cost / scale) < TAIL)


def expected(problem: Problem, unknowns: int, leverage: float = inf) -> tuple[float, float]:
    """Mean and variance of the cost at its minimum under the noise that it assumes.

    Each number that is measured beyond the unknowns adds 1/2 to both. The entries of a rotation matrix count as the
    angles that they hold. Those of the plane that weigh twice add 1/2 and 3/2 more but for their `leverage`, one a
    pose at most: the mean is 1/2 tr((I - P) S), P = J (J^T J)^-1 J^T, S the covariance of whitened residuals.
    """
    count = matrices = 0
    for factor in problem.factors:
        measured = factor.measured
        if factor.kind in CHORDAL:
            turned = np.count_nonzero(factor.root[:, :, problem.dimension :].any(1), axis=1)
            measured = measured - np.maximum(turned - problem.space.angles, 0)
            matrices += int(np.count_nonzero(turned)) * factor.twice
        count += int(measured.sum())
    turns = max(matrices - min(leverage, len({*problem.poses} - {*problem.fixed})), 0.0)
    mean = 0.5 * (max(count - unknowns, 0) + turns)
    return mean, mean + turns


def _leverage(problem: Problem, x: Floats) -> float:
    """tr(J_t H^-1 J_t^T) of the rows that weigh twice, H factored last, by Hutchinson's estimator: to a third of the
    standard deviation of the cost."""
    if not any(f.twice for f in problem.factors):
        return 0.0
    turns = stacked(np.tile(f.twice & (np.arange(f.size) >= problem.dimension), len(f.nodes)) for f in problem.factors)
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (len(turns), PROBES))
    probes = (linearised(problem, x)[1].T @ (turns[:, None] * signs))[problem.movable.ravel()]
    return float(np.vdot(probes, sparse(problem).cholesky.solve(probes)) / PROBES)


def joint_covariance(problem: Problem, solution: "Solution", nodes: Sequence[str | int]) -> Floats:
    """Covariance of some nodes together: their rows and columns of (J^T J)^-1, or of the inverse of
    the exact Hessian where `Solution.covariance` is that, at the solution.

    Two nodes of it give the covariance of their difference, which their marginals do not: P_ii + P_jj - P_ij - P_ji.

    Args:
        problem: that was solved.
        solution: of it.
        nodes: k names or indices; one alone is the first.

    Returns:
        (k, k, dof, dof) m^2, rad^2: block [i, j] between nodes i and j, zero where one cannot move.

    Raises:
        InputError: an unknown node, a problem with constraints, one whose nodes can move freely.

    >>> from coopoc import solve
    >>> problem = Problem(("a", "b")).add("position", "a", [0, 0, 0], std=1.0)
    >>> problem = problem.add("displacement", ("a", "b"), [5, 0, 0], std=1.0)
    >>> joint_covariance(problem, solve(problem), ("a", "b"))[:, :, 0, 0].round(6)
    array([[1., 1.],
           [1., 2.]])
    """
    instance("problem", problem, Problem)
    values: Any = getattr(solution, "x", None)
    x = checked("solution", values, "(n, ambient)", (len(problem.names), problem.space.ambient))
    if problem.constraints:
        raise InputError("problem", "constraints", "must have none", "Read solution.covariance instead.")
    places = [problem.index(node) for node in several(nodes)]
    if len(places) > len(problem.names):
        allowed = f"must name each of {len(problem.names)} nodes once"
        raise InputError("nodes", f"{len(places)} nodes", allowed, "Name each node once.")
    dof, system = problem.space.dof, sparse(as_stated(problem))
    truth = assess(problem, x, covariance=False)
    model: Model = "newton" if truth.curved else "gauss-newton"
    if truth.unobservable or not system.cholesky.factor(system.quadratic(x, model)[2]):
        raise InputError("problem", repr(problem), "must be observable", "Add measurements of solution.unobservable.")
    wanted = system.entries.number[places].ravel()
    unit = (np.arange(system.size)[:, None] == wanted).astype(float)
    solved = system.cholesky.solve(unit) if places else unit
    if not truth.curved and (half := _by_rows(problem, x)) is not None:
        solved = half @ (half.T @ unit)
    whole = np.pad(solved, ((0, 1), (0, 0)))[wanted]  # the last row for what cannot move
    return whole.reshape(len(places), dof, len(places), dof).swapaxes(1, 2)

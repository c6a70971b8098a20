"""Shor's semidefinite relaxation of the QCQP, by a cone solver, and certificates of solutions.

1/2 |A X|^2 is smallest over the free rows at X_f = -Q_ff^-1 Q_fc X_c, Q = A^T A, and is then 1/2 <C, X_c X_c^T> with
C = Q_cc - Q_cf Q_ff^-1 Q_fc. Whatever block-diagonal L is subtracted, C - L is the Schur complement of Q - diag(L, 0).
The relaxation keeps Z = X_c X_c^T positive semidefinite with the diagonal blocks that the constraints give it, and
drops its rank: a bound that no point beats, and a start from which to refine.
"""

import importlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from numpy.linalg import eigh, eigvalsh

from ...arrays import Bools, Floats
from ...errors import InputError, said
from ...text import short_repr
from ..algebra.cholesky import Cholesky, cholesky_of
from ..model.problem import Problem
from ..solution import Solution
from ..solve import solve
from .qcqp import Multipliers, Quadratic, multipliers, quadratic

FORMED_ROWS = 500
"""Up to this many constrained rows C is formed."""
ROUNDED = 2.0**-51
"""Share of the diagonal of Q by which C may be off: at most 0.84 of 2^-52 where fractions give the cost."""


@dataclass(frozen=True, eq=False)
class Reduced:
    """C through a sparse factorisation of Q."""

    problem: Quadratic

    @cached_property
    def _kept(self) -> Bools:
        """False for the first position of each part that could be moved as a whole: it is fixed at zero."""
        from scipy.sparse import eye_array
        from scipy.sparse.csgraph import connected_components

        bound, width = self.problem.bound, self.problem.sphere.shape[1]
        free = self.problem.rows[:, bound:].tocsc()
        part = connected_components(free.T @ free, directed=False)[1]
        _, first, label = np.unique(part * width + np.arange(len(part)) % width, return_index=True, return_inverse=True)
        whole = eye_array(len(first), format="csr")[label]
        moved, terms = (abs(each).max(0).toarray().ravel() for each in (free @ whole, abs(free) @ whole))
        kept = np.ones(self.problem.rows.shape[1], bool)
        kept[bound + first[moved <= 1e-9 * terms]] = False
        return kept

    @cached_property
    def _rows(self) -> Any:
        """A without what is fixed at zero."""
        return self.problem.rows[:, self._kept]

    @cached_property
    def gram(self) -> Any:
        """Q."""
        return (self._rows.T @ self._rows).tocsc()

    @cached_property
    def _inverse(self) -> Cholesky:
        factor = cholesky_of(self.gram[self.problem.bound :, self.problem.bound :])
        assert factor is not None  # what could be moved as a whole is not among the rows
        return factor

    def _all(self, X: Floats) -> Floats:
        """The constrained rows X and the free ones where the cost is smallest."""
        bound = self.problem.bound
        right = -(self._rows[:, bound:].T @ (self._rows[:, :bound] @ X))
        return np.concatenate([X, self._inverse.solve(right)])

    def times(self, X: Floats) -> Floats:
        """C X."""
        return np.asarray(self._rows[:, : self.problem.bound].T @ (self._rows @ self._all(X)))

    def settle(self, X: Floats) -> Floats:
        """All rows of X: the free ones where the cost is smallest."""
        out = np.zeros((len(self._kept), X.shape[1]))
        out[self._kept] = self._all(X)
        return out

    @cached_property
    def matrix(self) -> Floats:
        """C (bound, bound)."""
        moved = self._rows @ self._all(np.eye(self.problem.bound))
        return np.asarray(moved.T @ moved)

    @cached_property
    def scale(self) -> float:
        """Mean diagonal of the constrained rows."""
        return float(self.gram.diagonal()[: self.problem.bound].mean())

    def smallest(self, L: Multipliers, count: int = 1) -> Floats:
        """Smallest eigenvalues of C - L (count,); of a large one by Lanczos on the inverse, around a shift that a
        factorisation shows to be below the spectrum."""
        from scipy.sparse import block_diag, eye_array
        from scipy.sparse.linalg import LinearOperator, eigsh

        size = self.problem.bound
        if size <= FORMED_ROWS:
            return eigvalsh(self.matrix - L.matrix.toarray())[:count]
        less, shift, factored, rest = L.matrix, -1e-7 * self.scale, None, self.gram.shape[0] - size
        while factored is None:  # the Schur complement of this matrix is C - less - shift I
            shift *= 10.0
            moved = block_diag([shift * eye_array(size) + less, 0.0 * eye_array(rest)])
            factored = cholesky_of((self.gram - moved).tocsc())
        zero = np.zeros(rest)
        whole = LinearOperator((size, size), matvec=lambda v: self.times(v.reshape(-1, 1))[:, 0] - less @ v.ravel())
        inverse = LinearOperator((size, size), matvec=lambda v: factored.solve(np.append(v, zero))[:size])
        start = np.random.default_rng(0).standard_normal(size)
        options = {"sigma": shift, "OPinv": inverse, "v0": start, "tol": 1e-10, "return_eigenvectors": False}
        return np.sort(eigsh(whole, k=min(count, size - 1), **options))

    def lower_bound(self, L: Multipliers, count: int = 1) -> tuple[float, Floats]:
        """A cost that no point beats, for any multipliers L, rounded down by the error of C; the smallest eigenvalues
        of C - L (count,)."""
        values = self.smallest(L, count)
        error = ROUNDED * self.scale * self.problem.bound
        return 0.5 * (L.trace + self.problem.trace * min(float(values[0]), 0.0)) - error, values


MAX_SHOR_ROWS = 60
"""Constrained rows up to which `shor` takes seconds at most."""
TIGHT = 1e-6
"""Gap of a tight relaxation, as a share of the cost (at least of 1)."""
SOLVER = {**dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), 1e-9), "max_threads": 1}
"""Settings of Clarabel."""
SAME_POINT = 1e-2
"""Sum of squares below which two points are one: what is this near, the curvature at a minimum decides."""
CERTIFIED_GAP = 1e-6
"""Largest gap of a certified solution, as a share of its cost (at least of 1, the cost of two residuals of one std)."""


@dataclass(frozen=True, eq=False)
class Relaxation:
    """Lower bound, rounded point and solution of a relaxation.

    Args:
        lower_bound: no point has a smaller cost; corrected for the solver's error, so that it holds to rounding.
        rank_gap: eigenvalue d + 1 over eigenvalue d of Z (second over first where the columns are stacked): 0 if tight.
        x: (n, ambient) the rounded point, m and rotations.
        cost: of it.
        solution: refined from it by Gauss-Newton.
        seconds: in all.
    """

    lower_bound: float
    rank_gap: float
    x: Floats
    cost: float
    solution: Solution
    seconds: float

    __repr__ = short_repr

    @property
    def gap(self) -> float:
        """Cost of the best point found less the bound, at least 0."""
        return max(min(self.cost, self.solution.cost) - self.lower_bound, 0.0)

    @property
    def tight(self) -> bool:
        """True if the best point found is a global optimum, to TIGHT."""
        return self.gap <= TIGHT * max(self.lower_bound, 1.0)


def shor(problem: Problem) -> Relaxation:
    """Shor's semidefinite relaxation by CVXPY and Clarabel, rounded and refined.

    minimise 1/2 <C, Z> over Z >= 0 with Z_BB = I on Stiefel blocks, tr Z_BB = 1 on spheres. For scalar weights Z has
    d + m rows with m ranges, and the same value as with the d m + 1 rows of [1; vec s][1; vec s]^T. Tight (rank d) in
    nearly all stars whose vehicles have fixes, in half of the plane's meshes, less often with anisotropic weights or
    precise ranges beside vague fixes, seldom where vehicles have no fix (benchmarks/tightness.py).

    Args:
        problem: one that `quadratic` takes.

    Raises:
        InputError: as `quadratic`, or more than MAX_SHOR_ROWS constrained rows.

    >>> problem = Problem(("a", "b")).add("position", ["a", "b"], [[0, 0, 0], [4, 0, 0]], std=1.0)
    >>> relaxed = shor(problem.add("range", ("a", "b"), 6.0, std=1.0))
    >>> round(relaxed.lower_bound, 6), relaxed.tight
    (0.666667, True)
    """
    began = perf_counter()
    form = quadratic(problem)
    if form.bound > MAX_SHOR_ROWS:
        hint = "Solve it, and ask certify(problem, solution), which takes any number."
        raise InputError("problem", f"{form.bound} constrained rows", f"must have at most {MAX_SHOR_ROWS}", hint)
    reduced = Reduced(form)
    block, sphere, Z = semidefinite(form.stiefel.shape, form.sphere.shape)(reduced.matrix)
    bound = reduced.lower_bound(Multipliers(form, block, sphere))[0]
    values, vectors = (each[..., ::-1] for each in eigh(Z))
    values, d, space = np.append(np.maximum(values, 0.0), np.zeros(form.columns)), form.columns, problem.space
    gap = float(values[d] / max(values[d - 1], 1e-300))
    top = np.pad(vectors, ((0, 0), (0, d)))[:, :d] * np.sqrt(values[:d])
    x = space.join(*form.drop(reduced.settle(form.project(top))))
    solution = solve(replace(problem, x0=x), throw=False)
    X = form.lift(space.position(solution.x), space.rotation(solution.x))[: form.bound]
    # the refined point's own bound never exceeds Shor's but by what the solver lacks
    bound = max(bound, reduced.lower_bound(multipliers(form, X, reduced.times(X)))[0])
    return Relaxation(max(bound, 0.0), gap, x, problem.cost(x), solution, perf_counter() - began)


@lru_cache(maxsize=64)
def semidefinite(
    stiefel: tuple[int, int], sphere: tuple[int, int]
) -> Callable[[Floats], tuple[Floats, Floats, Floats]]:
    """Solver of min 1/2 <C, Z>, whose dual is max 1/2 tr L over block-diagonal L with C - L >= 0, built once per shape.

    It takes C (bound, bound) and returns the multipliers of Stiefel blocks (n, k, k) and of spheres (m,), and Z.
    """
    cvxpy = importlib.import_module("cvxpy")
    (n, k), (m, q) = stiefel, sphere
    size = n * k + m * q
    Z, C = cvxpy.Variable((size, size), PSD=True), cvxpy.Parameter((size, size), symmetric=True)
    spans = [slice(k * i, k * i + k) for i in range(n)], [slice(n * k + q * j, n * k + q * j + q) for j in range(m)]
    turns = [Z[at, at] == np.eye(k) for at in spans[0]]
    units = [cvxpy.trace(Z[at, at]) == 1 for at in spans[1]]
    programme = cvxpy.Problem(cvxpy.Minimize(cvxpy.trace(C @ Z)), [*turns, *units])

    def run(matrix: Floats) -> tuple[Floats, Floats, Floats]:
        scale = max(float(np.trace(matrix)) / size, 1e-300)
        C.value = (matrix + matrix.T) / (2.0 * scale)
        try:
            programme.solve(solver=cvxpy.CLARABEL, **SOLVER)
        except cvxpy.SolverError as error:
            hint = "Solve it, and ask certify(problem, solution)."
            raise InputError("problem", said(error), "must be one that Clarabel solves", hint) from None
        block = -scale * np.array([each.dual_value for each in turns]).reshape(n, k, k)
        return (block + block.mT) / 2, -scale * np.array([each.dual_value for each in units]), Z.value

    return run


class Certificate(NamedTuple):
    """Bounds of a solution's cost against the smallest cost of any point.

    Attributes:
        certified: no point has a cost smaller by more than a share CERTIFIED_GAP of max(cost, 1).
        sentence: the verdict in words.
        cost: of the solution.
        lower_bound: no point has a smaller cost.
        smallest_eigenvalue: of C - L.
        unique: no other point costs as little: no node can move freely, and 2 gap / lambda_{d + 1} of C - L bounds the
            sum of squares by which unit vectors and rotations of such a point leave the span of the solution's.
    """

    certified: bool
    sentence: str
    cost: float
    lower_bound: float
    smallest_eigenvalue: float
    unique: bool = False

    @property
    def gap(self) -> float:
        """cost - lower_bound, at least 0."""
        return max(self.cost - self.lower_bound, 0.0)

    def __str__(self) -> str:
        return self.sentence


def certify(problem: Problem, solution: Solution) -> Certificate:
    """Certificate of a solution, at the price of one eigenvalue.

    With the multipliers L that belong to the solution's X in closed form, every point of the QCQP costs at least

        1/2 tr L + 1/2 tr(X X^T) min(0, lambda_min(C - L)),       tr(X X^T) fixed by the constraints,

    and 1/2 tr L is the solution's own cost (Lagrangian duality; CORA, arXiv 2302.11614). Where
    lambda_min is negative the solution may be a local minimum, or the relaxation is not tight there: `shor`
    then gives a better bound.

    Args:
        problem: one that `quadratic` takes.
        solution: of it.

    Raises:
        InputError: as `quadratic`.

    >>> from coopoc.optimize import solve
    >>> fixes = Problem(("a", "b")).add("position", ["a", "b"], [[0, 0, 0], [4, 0, 0]], std=1.0)
    >>> problem = fixes.add("range", ("a", "b"), 5.0, std=0.5)
    >>> print(certify(problem, solve(problem)))
    certified global optimum of Problem(2 points; 2 position, 1 range), and no other point costs as little
    """
    form = quadratic(problem)
    x = solution.x
    X = form.lift(problem.space.position(x), problem.space.rotation(x))[: form.bound]
    reduced = Reduced(form)
    bound, values = reduced.lower_bound(multipliers(form, X, reduced.times(X)), form.columns + 1)
    gap, smallest = solution.cost - bound, float(values[0])
    certified = gap <= CERTIFIED_GAP * max(solution.cost, 1.0)
    framed = form.stiefel.size and len(values) > form.columns
    alone = certified and bool(framed and 2.0 * max(gap, 0.0) < SAME_POINT * values[-1])
    unique = alone and not solution.unobservable
    image = "a motion of all, costs" if alone else "a mirror image, may cost"
    other = "no other point costs as little" if unique else f"another, such as {image} as little"
    sentence = (
        f"certified global optimum of {problem!r}, and {other}"
        if certified
        else f"not certified: cost {solution.cost:.6g}, no point of {problem!r} costs less than {max(bound, 0.0):.6g} "
        f"(smallest eigenvalue {smallest:.1e}); a local minimum, or the relaxation is not tight"
    )
    return Certificate(certified, sentence, solution.cost, max(bound, 0.0), smallest, unique)

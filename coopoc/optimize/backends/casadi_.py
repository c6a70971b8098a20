"""casadi: one parametric nonlinear programme per structure, with exact second derivatives, for constraints of any kind.

The expressions (see `symbolic`) are differentiated once per structure; measurements, weights, bounds and the start are
parameters, so that the next problem of the structure pays for its solution only. Poses are steps in a chart around a
centre that moves to each answer until the step is below the tolerance.

Two methods. "ipopt" is an interior-point method: robust, the one for inequalities and for many unknowns. "fatrop" is
the same algorithm with dense elimination, which takes a fifth of the time for a star; without inequalities it ends in
the same minimum, with them it often does not end and is refused. "auto" takes fatrop where that is at its best and
ipopt elsewhere. Where an answer fails the checks of `solve`, ipopt has another try (see `fallback`).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ...arrays import Floats
from ...errors import InputError
from ...plugins import one_of
from ..backend import Backend, Capabilities, Solver, SolverResult
from ..descent.descend import MAX_ITERATIONS, TOLERANCE, check_limits, diagonal
from ..model.constraint import steerable
from ..model.problem import Problem
from ..model.symbolic import Structure, parameters, structure_of
from .casadi_programme import NlpSolver, Programme, programme

DENSE = 200
"""Numbers that can move up to which fatrop is faster than ipopt: 2.0 against 3.8 ms for 165 of a window, 6.6 against
2.3 for 330."""
ROUNDS = 10
"""Moves of the chart of the poses, at most."""
HOPELESS = ("Infeasible_Problem_Detected", "Maximum_Iterations_Exceeded")
"""Statuses of CasADi after which another chart would not help."""
METHODS = ("auto", "fatrop", "ipopt")


def prepare(
    structure: Problem, max_iterations: int = MAX_ITERATIONS, tolerance: float = TOLERANCE, method: str = "auto"
) -> Solver:
    """Solver of a structure.

    Args:
        structure: a problem whose structure counts, and which of its constraints are equalities.
        max_iterations: of the method's own.
        tolerance: m or rad, step of a pose below which its chart is kept.
        method: "auto", "fatrop" or "ipopt".

    Raises:
        InputError: an unknown method, inequalities for fatrop, more equalities than numbers that can move.

    >>> from coopoc.optimize import solve
    >>> problem = Problem(("a", "b")).add("position", ["a", "b"], [[0, 0, 0], [9, 0, 0]], std=1.0)
    >>> solve(problem.constrain("range", ("a", "b"), upper=7.0), "casadi").x.round(3)[:, 0]
    array([1., 8.])
    """
    check_limits(max_iterations, tolerance)
    one_of("method", method, METHODS)
    form, sides = structure_of(structure), _sides(structure)
    if method == "fatrop" and not np.array_equal(*sides):
        raise InputError("method", repr(method), "does not hold inequalities", "Leave it out: ipopt takes those.")
    equal, moving = int((sides[0] == sides[1]).sum()), int(form.movable.sum())
    if equal > moving:
        raise InputError(
            "constraints",
            f"{equal} equalities",
            f"must be at most the {moving} numbers that can move",
            "Leave out those that follow from the others.",
        )
    found = programme(form, _chosen(form, sides, method), int(max_iterations))

    def solver(problem: Problem, x: Floats) -> SolverResult:
        numbers, nlp = _numbers(problem, x), NlpSolver(found.solver)
        parts = (problem.pick(b) if problem.batch else problem for b in range(len(x)))
        each = [_run(found, nlp, *given, sides, tolerance) for given in zip(parts, numbers, x, strict=True)]
        counts, hopeless = (np.array([getattr(e, name) for e in each]) for name in ("iterations", "infeasible"))
        return SolverResult(np.stack([e.x for e in each]), counts, hopeless, each[0].extras)

    return solver


def fallback(problem: Problem, options: dict[str, Any]) -> dict[str, Any] | None:
    """The options with which `solve` tries again where an answer fails its checks: ipopt's, None where it was that."""
    if _chosen(structure_of(problem), _sides(problem), options.get("method", "auto")) == "ipopt":
        return None
    return {**options, "method": "ipopt"}


def _chosen(structure: Structure, sides: tuple[Floats, Floats], method: str) -> str:
    """The method of "auto"."""
    if method != "auto":
        return method
    return "fatrop" if structure.movable.sum() <= DENSE and np.array_equal(*sides) else "ipopt"


def _run(
    found: Programme,
    nlp: NlpSolver,
    problem: Problem,
    numbers: Floats,
    x: Floats,
    sides: tuple[Floats, Floats],
    tolerance: float,
) -> SolverResult:
    """Solve around x (n, ambient), and for poses again around the answer until it stays."""
    space, free, count, rounds = found.structure.space, found.structure.movable, 0, 0
    multipliers: Floats = np.zeros(len(sides[0]))
    while rounds < ROUNDS:
        at, multipliers, iterations, status = nlp(np.zeros(int(free.sum())), numbers, sides, multipliers)
        before, step, count, rounds = x, np.zeros(free.shape), count + iterations, rounds + 1
        step[free] = at
        if np.isfinite(at).all():
            x = space.retract(x, _exponential(step, space.dimension) if space.has_rotation else step)
        if not space.has_rotation or status in HOPELESS or np.abs(x - before).max(initial=0.0) <= tolerance:
            break
        numbers = _numbers(problem, x[None])[0]
    extras = {"method": found.method, "return_status": status, "rounds": rounds}
    return SolverResult(x, count, status == HOPELESS[0], extras)


def _numbers(problem: Problem, x: Floats) -> Floats:
    """(B, .) the parameters around x (B, n, ambient), and last by what the cost is multiplied: 1 / max diag J^T J."""
    numbers = parameters(problem, x)
    curvature = diagonal(problem, problem.linearise(x)).max(axis=(1, 2))
    return np.append(numbers, 1.0 / np.maximum(curvature, 1e-12)[:, None], axis=1)


def _sides(problem: Problem) -> tuple[Floats, Floats]:
    """Lower and upper sides of the numbers that are bounded and can change."""
    kept = [(c, steerable(c, problem.movable)) for c in problem.constraints]
    lower, upper = [c.lower[which] for c, which in kept], [c.upper[which] for c, which in kept]
    return np.concatenate([np.empty(0), *lower]), np.concatenate([np.empty(0), *upper])


def _exponential(step: Floats, dimension: int) -> Floats:
    """Steps whose turn is that of the Cayley map, C(w) = Exp(2 atan(|w|/2) w/|w|); in the plane both are the angle."""
    if dimension == 2:
        return step
    w = step[:, dimension:]
    half = 0.5 * np.linalg.norm(w, axis=-1, keepdims=True)
    ratio = np.where(half > 1e-9, np.arctan(half) / np.where(half > 1e-9, half, 1.0), 1.0)
    return np.concatenate([step[:, :dimension], ratio * w], axis=-1)


BACKEND = Backend(
    "casadi",
    prepare,
    "nonlinear programming by FATROP or IPOPT, any constraints",
    "casadi",
    Capabilities(batched=True, losses=("huber", "cauchy", "geman-mcclure"), constraints="all"),
    fallback,
)

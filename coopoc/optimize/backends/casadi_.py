"""casadi: one parametric nonlinear programme per structure, with exact second derivatives, for constraints of any kind.

The expressions (see `symbolic`) are differentiated once per structure; measurements, weights, bounds and the start are
parameters, so that the next problem of the structure pays for its solution only. Poses are steps in a chart around a
centre that moves to each answer until the step is below the tolerance.

Three methods. "ipopt" is an interior-point method: robust, the one for inequalities and for many unknowns. "fatrop"
is the same algorithm with dense elimination, which takes a fifth of the time for a star; without inequalities it ends
in the same minimum, with them it often does not end and is refused. "sqp" solves quadratic programmes by an active-set
method (qrqp), first with J^T J, which is never indefinite, then with the exact Hessian; it may end in another minimum.
"auto" takes fatrop where that is at its best and ipopt elsewhere. Where an answer fails the checks of `solve`, ipopt
has another try (see `second`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ...arrays import Floats
from ...errors import InputError
from ..active import steerable
from ..descend import MAX_ITERATIONS, TOLERANCE, check_limits, diagonal
from ..problem import Problem
from ..symbolic import Structure, numbers_of, structure_of
from .casadi_programme import Programme, Solver, programme
from .run import Ended, Run

DENSE = 200
"""Numbers that can move up to which fatrop is faster than ipopt: 2.0 against 3.8 ms for 165 of a window, 6.6 against
2.3 for 330."""
ROUNDS = 10
"""How often the chart of the poses is moved."""
HOPELESS = ("Infeasible_Problem_Detected", "Maximum_Iterations_Exceeded")
"""What CasADi says where another chart would not help."""
METHODS = ("auto", "fatrop", "ipopt", "sqp")
NO_SIDES = np.empty(0), np.empty(0)


def build(
    problem: Problem, max_iterations: int = MAX_ITERATIONS, tolerance: float = TOLERANCE, method: str = "auto",
    codegen: bool = False,
) -> Run:  # fmt: skip
    """Solver of one problem.

    Args:
        max_iterations: of the method's own. tolerance: m or rad, step of a pose below which its chart is kept.
        method: "auto", "fatrop", "ipopt" or "sqp".
        codegen: compile the derivatives with gcc. It buys little: of 200 us for a star of 10 it takes 45, of 2.8 ms for
            a window of 10 steps (sqp 9.4 ms) 0.5 ms (4.7 ms), after 2 s and 27 s of compilation (sqp 81 s). Only long
            runs over one structure repay it.

    Raises:
        InputError: an unknown method, inequalities for fatrop, a truncated loss, more equalities than numbers that can
            move, no gcc to compile.

    >>> from coopoc.optimize import solve
    >>> problem = Problem(("a", "b")).add("position", ["a", "b"], [[0, 0, 0], [9, 0, 0]], std=1.0)
    >>> solve(problem.constrain("range", ("a", "b"), upper=7.0), "casadi").x.round(3)[:, 0]
    array([1., 8.])
    """
    check_limits(max_iterations, tolerance)
    if method not in METHODS:
        raise InputError("method", repr(method), f"must be one of {METHODS}", "Leave it out for auto.")
    structure, sides = structure_of(problem), _sides(problem)
    if method == "fatrop" and not np.array_equal(*sides):
        raise InputError("method", repr(method), "does not hold inequalities", "Leave it out: ipopt takes those.")
    equal, moving = int((sides[0] == sides[1]).sum()), int(structure.free.sum())
    if equal > moving:
        raise InputError("constraints", f"{equal} equalities", f"must be at most the {moving} numbers that can move",
                         "Leave out those that follow from the others.")  # fmt: skip
    if not moving:
        return lambda x: Ended(x, 0)
    found = programme(structure, _chosen(structure, sides, method), int(max_iterations), bool(codegen))
    return lambda x: _run(found, problem, sides, x, tolerance)


def second(problem: Problem, options: dict[str, Any]) -> dict[str, Any] | None:
    """The options with which `solve` tries again where an answer fails its checks: ipopt's, None where it was that."""
    structure = structure_of(problem)
    if not structure.free.any() or _chosen(structure, _sides(problem), options.get("method", "auto")) == "ipopt":
        return None
    return {**options, "method": "ipopt"}


def _chosen(structure: Structure, sides: tuple[Floats, Floats], method: str) -> str:
    """What "auto" takes."""
    if method != "auto":
        return method
    return "fatrop" if structure.free.sum() <= DENSE and np.array_equal(*sides) else "ipopt"


def each(
    problem: Problem, x: Floats, max_iterations: int = MAX_ITERATIONS, tolerance: float = TOLERANCE,
    method: str = "auto", codegen: bool = False,
) -> list[Ended]:  # fmt: skip
    """`build` of B realisations without constraints, from x (B, n, width): points share all but the solution."""
    structure = structure_of(problem)
    if problem.space.turning or not structure.free.any():
        parts = [problem.pick(b) for b in range(len(x))] if problem.batch else [problem]
        return [build(part, max_iterations, tolerance, method, codegen)(a) for part, a in zip(parts, x, strict=True)]
    build(problem, max_iterations, tolerance, method, codegen)  # checks the options
    found = programme(structure, _chosen(structure, NO_SIDES, method), int(max_iterations), bool(codegen))
    numbers, solvers = _numbers(problem, x), found.ready()
    return [_once(found, solvers, given, NO_SIDES, a, NO_SIDES[0])[0] for given, a in zip(numbers, x, strict=True)]


def _run(found: Programme, problem: Problem, sides: tuple[Floats, Floats], x: Floats, tolerance: float) -> Ended:
    """Solve around x, and for poses again around the answer until it stays."""
    multipliers: Floats = np.zeros(len(sides[0]))
    solvers, count = found.ready(), 0
    for rounds in range(1, ROUNDS + 1):
        ended, multipliers = _once(found, solvers, _numbers(problem, x[None])[0], sides, x, multipliers)
        count += ended.iterations
        ended = replace(ended, iterations=count, extras=ended.extras | {"rounds": rounds})
        still = np.abs(ended.x - x).max(initial=0.0) <= tolerance
        if not found.structure.space.turning or still or ended.extras["return_status"] in HOPELESS:
            break
        x = ended.x
    return ended


def _numbers(problem: Problem, x: Floats) -> Floats:
    """(B, .) the parameters around x (B, n, width), and last by what the cost is multiplied: 1 / max diag J^T J."""
    numbers = numbers_of(problem, x)
    curvature = diagonal(problem, problem.linearise(x)).max(axis=(1, 2))
    return np.append(numbers, 1.0 / np.maximum(curvature, 1e-12)[:, None], axis=1)


def _once(
    found: Programme, solvers: Sequence[Solver], numbers: Floats, sides: tuple[Floats, Floats], x: Floats,
    multipliers: Floats,
) -> tuple[Ended, Floats]:  # fmt: skip
    """Where the solvers end, and the multipliers."""
    space, free = found.structure.space, found.structure.free
    at: Floats = np.zeros(int(free.sum()))
    count, said = 0, ""
    for solver in solvers:
        at, multipliers, iterations, said = solver(at, numbers, sides, multipliers)
        count += iterations
    step = np.zeros(free.shape)
    step[free] = at
    if np.isfinite(step).all():
        x = space.retract(x, _exponential(step, space.dimension) if space.turning else step)
    extras = {"method": found.method, "return_status": said, "rounds": 1}
    return Ended(x, count, extras, said == HOPELESS[0]), multipliers


def _sides(problem: Problem) -> tuple[Floats, Floats]:
    """Lower and upper sides of the numbers that are bounded and can change."""
    kept = [(c, steerable(problem, c)) for c in problem.constraints]
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

"""casadi: one parametric nonlinear programme per structure, with exact second derivatives, for constraints of any kind.

The expressions (see `symbolic`) are differentiated once per structure; measurements, weights, bounds and the start are
parameters, so that the next problem of the structure pays for its solution only. Poses are steps in a chart around a
centre that moves to each answer until the step is below the tolerance. IPOPT (interior point) solves all of them.
"""

from functools import lru_cache
from threading import get_ident
from typing import Any

import numpy as np

from ...arrays import Floats
from ...errors import InputError
from ..algebra.sparse import sparse, structure_of
from ..backend import MAX_ITERATIONS, SOLVER_STEP_TOLERANCE, Backend, Capabilities, SolverResult
from ..model.derivatives import Structure, expressions, linearise, numbers_of
from ..model.factor import as_factor, steerable, unchecked
from ..model.problem import Problem

HOPELESS = ("Infeasible_Problem_Detected", "Maximum_Iterations_Exceeded")
"""Statuses of CasADi after which another chart would not help."""
IPOPT = {
    "print_level": 0,
    "sb": "yes",
    "nlp_scaling_method": "none",
    "bound_relax_factor": 0.0,
    "tol": 1e-12,
    "constr_viol_tol": 1e-9,
    "compl_inf_tol": 1e-18,
    "acceptable_tol": 1e-8,
    "acceptable_iter": 3,
    "acceptable_constr_viol_tol": 1e-8,
    "acceptable_compl_inf_tol": 1e-17,
}
"""For a cost scaled to a curvature of 1; what `tol` asks may lie below rounding, hence the acceptable level."""


def solver(
    problem: Problem, x: Floats, max_iterations: int = MAX_ITERATIONS, tolerance: float = SOLVER_STEP_TOLERANCE
) -> SolverResult:
    """Solve a problem from x (n, ambient).

    Args:
        problem: that is solved.
        x: start.
        max_iterations: of the method's own.
        tolerance: m or rad, step of a pose below which its chart is kept.

    Raises:
        InputError: more equalities than numbers that can move.

    >>> from coopoc.optimize import solve
    >>> problem = Problem(("a", "b")).add("position", ["a", "b"], [[0, 0, 0], [9, 0, 0]], std=1.0)
    >>> solve(problem.constrain("range", ("a", "b"), upper=7.0), "casadi").x.round(3)[:, 0]
    array([1., 8.])
    """
    nlp = programme(structure_of(problem), int(max_iterations), get_ident())
    space, free, count, multipliers = problem.space, problem.movable, 0, 0.0
    for _ in range(10):  # for poses again around the answer until it stays
        numbers, lower, upper, unit = _numbers(problem, x)
        if (equal := int((lower == upper).sum())) > len(unit):
            raise InputError(
                "constraints",
                f"{equal} equalities",
                f"must be at most the {len(unit)} numbers that can move",
                "Leave out those that follow from the others.",
            )
        end = nlp(p=numbers, lbg=lower, ubg=upper, lam_g0=multipliers)
        at, multipliers, stats = end["x"].toarray().ravel(), end["lam_g"], nlp.stats()
        status = stats["return_status"]
        step, count = np.zeros(free.shape), count + int(stats["iter_count"])
        step[free] = at * unit
        if np.isfinite(at).all():
            x = space.retract(x, _exponential(step))
        if status in HOPELESS or not (space.has_rotation and abs(step).max(initial=0.0) > tolerance):
            break
    return SolverResult(x, count, status == HOPELESS[0], {"return_status": status})


def _numbers(problem: Problem, x: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Parameters around x (n, ambient), lower and upper sides of the numbers that are bounded and can change, and the
    units of what can move.

    Parameters are x, numbers of the factors and constraints, by what the cost is multiplied, 1 / max diag J^T J in
    those units, and the units. What is no angle counts from its value at x, so that far from the origin its digits are
    those of a step, and in a length between the extent of the nodes and the least deviation: IPOPT's barrier and
    tolerances are for numbers near 1.
    """
    system, d = sparse(problem), problem.dimension
    diagonal = system.quadratic(x, "gauss-newton")[2][system.entries.diagonal]
    at, along = problem.space.position(x), np.nonzero(problem.movable)[1] < d
    extent = np.median(np.linalg.norm(at - np.median(at, axis=0), axis=1)) or 1.0
    length = np.sqrt(extent) * diagonal[along].max(initial=extent**-2) ** -0.25
    unit = np.where(along, length, 1.0)
    parts, sides = [x, *system.numbers], [np.empty((2, 0))]
    for c in problem.constraints:
        item, angle = as_factor(c), c.measurement.angles(d)
        units = np.where(angle, 1.0, length)[None]
        (value,) = linearise(problem.space, [item], x).residual
        item = unchecked(item, z=item.z + value * ~angle, std=units)
        parts.append(numbers_of(item))
        sides.append(((np.stack([c.lower, c.upper]) - item.z) / units)[:, steerable(c, problem.movable)])
    scale = 1.0 / np.max(unit**2 * diagonal, initial=1e-12)
    return np.concatenate([*map(np.ravel, parts), [scale], unit]), *np.hstack(sides), unit


def _exponential(step: Floats) -> Floats:
    """Steps whose turn is that of the Cayley map, C(w) = Exp(2 atan(|w|/2) w/|w|); in the plane both are the angle."""
    w = step[:, 3:]
    half = 0.5 * np.linalg.norm(w, axis=-1, keepdims=True)
    ratio = np.where(half > 1e-9, np.arctan(half) / np.maximum(half, 1e-9), 1.0)
    return np.concatenate([step[:, :3], ratio * w], axis=-1)


@lru_cache(maxsize=64)
def programme(structure: Structure, max_iterations: int, thread: int) -> Any:
    """CasADi's nlpsol of a structure, its own for each thread, kept for the next problems that share it."""
    import casadi as ca

    nlp, scale = expressions(structure), ca.SX.sym("scale")
    unit = ca.SX.sym("unit", nlp["x"].shape)
    f, g = ca.substitute([scale * nlp["f"], nlp["g"]], [nlp["x"]], [unit * nlp["x"]])
    nlp |= {"p": ca.vertcat(nlp["p"], scale, unit), "f": f, "g": g}
    options: Any = dict.fromkeys(("print_time", "calc_lam_p", "show_eval_warnings", "error_on_fail"), False)
    return ca.nlpsol("solver", "ipopt", nlp, options | {"ipopt": {**IPOPT, "max_iter": max_iterations}})


BACKEND = Backend(
    "casadi", solver, "casadi", Capabilities(losses=("huber", "cauchy", "geman-mcclure"), constraints="all")
)

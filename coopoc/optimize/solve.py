"""solve: a Problem, the name of a backend, a Solution whose figures no backend has computed."""

from __future__ import annotations

import importlib
import inspect
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.util import find_spec
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np

from ..arrays import Floats, Ints
from ..errors import InputError, MissingLibraryError
from ..one_file import in_file
from ..plugins import find, names
from .active import constraint_rows
from .assess import Assessment, assess
from .backends.run import Ended, Run
from .curvature import is_minimum
from .descend import MAX_ITERATIONS
from .initial import initial_guess, somewhere
from .lagrangian import is_constrained_minimum
from .problem import Problem
from .solution import Solution, SolveError, Status

POSITION_TOLERANCE = 1e-6
"""m, what one more Gauss-Newton step may still move."""
FEASIBLE = 1e-6
"""m, rad or m/s by which a constraint may be violated."""


@dataclass(frozen=True)
class Backend:
    """A solver by name: what it is for, the library that it needs (None: none but ours) and whether that is installed.

    Args:
        solver: `build(problem, **options)`, which returns a Run: a function from a start (n, width) to an Ended, see
            `coopoc.optimize.backends.run`; or the name of one of our modules that has it.
        constraints: which it can hold: "none", "linear" (of kinds position and displacement) or "all".
    """

    name: str
    solver: str | Callable[..., Run]
    purpose: str
    library: str | None = None
    constraints: Literal["none", "linear", "all"] = "none"

    @property
    def installed(self) -> bool:
        """True if it can run here."""
        return self.library is None or find_spec(self.library) is not None


BACKENDS = {
    b.name: b
    for b in (
        Backend("gauss-newton", "gauss_newton", "reference: Levenberg-Marquardt, batched over noise runs"),
        Backend("gtsam", "gtsam_", "elimination by GTSAM, or its own LM, dogleg, ISAM2, GNC (optimizer=)", "gtsam"),
        Backend("casadi", "casadi_", "nonlinear programming by FATROP or IPOPT, any constraints", "casadi", "all"),
        Backend("cvxpy", "cvxpy_", "convex relaxations: QP, Shor's SDP with a lower bound, SOCP", "cvxpy"),
        Backend("osqp", "osqp_", "sequential quadratic programming, persistent workspace", "osqp", "linear"),
    )
}


def backends() -> dict[str, Backend]:
    """The backends by name, those of other distributions too, with what each is for and whether it is installed.

    >>> backends()["gauss-newton"].installed
    True
    """
    return {name: BACKENDS[name] if name in BACKENDS else usable(name) for name in [*BACKENDS, *_others()]}


def solve(problem: Problem, backend: str = "gauss-newton", throw: bool = True, **options: Any) -> Solution:
    """The most probable positions: a minimum of the problem's cost, by the named backend.

    Cost, gradient, covariance, status and times are computed here from x alone, so that no backend can flatter itself.
    Where the answer is no minimum and the backend has another way (casadi's is ipopt), that is taken, and
    extras["failed_first"] says what became of the first.

    Args:
        problem: a single one; `solve_batch` takes B realisations. backend: a name of `backends()`, or
            "folder/mine.py:BACKEND".
        throw: raise unless SOLVED; otherwise failure is data.
        options: of the backend, such as max_iterations and tolerance (m).

    Raises:
        InputError: unknown backend or option, B realisations, points that coincide, or (if `throw`) free points.
        MissingLibraryError: the backend's library is not installed.
        SolveError: (if `throw`) no minimum was reached; it carries the Solution.

    >>> problem = Problem(("ego", "b")).add("position", ["ego", "b"], [[0, 0, 0], [9, 0, 0]], std=1.0)
    >>> solve(problem.add("range", ("ego", "b"), 10.0, std=1.0)).x.round(3)[:, 0]
    array([-0.333,  9.333])
    """
    module = backend_module(backend, options)
    if problem.batch is not None:
        mend = "Pick one with problem.pick(0), or use solve_batch."
        raise InputError("problem", repr(problem), "must be a single realisation", mend)
    if not problem.factors:
        raise InputError("problem", repr(problem), "has no measurements", "Add factors: problem.add(...).")
    if problem.constraints:
        _check_constraints(problem, usable(backend))
    solution = _solved(problem, backend, module, options)
    if solution.status is not Status.SOLVED and (other := second_way(module, problem, options)) is not None:
        solution = _after(solution, _solved(problem, backend, module, other))
    if throw and solution.status is not Status.SOLVED:
        _raise(solution)
    return solution


def _solved(problem: Problem, backend: str, module: Any, options: dict[str, Any]) -> Solution:
    """What a backend finds, and what is true of it."""
    began = time.perf_counter()
    start = _start(problem)
    run = module.build(problem, **options)
    built = time.perf_counter()
    ended = run(start)
    solved = time.perf_counter()
    truth = assess(problem, ended.x)
    violated = {"violated": truth.violated} if truth.violation > FEASIBLE or ended.infeasible else {}
    return Solution(
        x=ended.x, covariance=truth.covariance, cost=truth.cost, gradient=truth.gradient,
        status=_status(problem, ended, truth, options.get("max_iterations", MAX_ITERATIONS)),
        iterations=ended.iterations, build_seconds=built - began, solve_seconds=solved - built, backend=backend,
        names=problem.names, shown=problem.hub[-1] if problem.hub else 0, free=truth.free, space=problem.space,
        violation=truth.violation, extras=ended.extras | violated,
    )  # fmt: skip


def _after(first: Solution, second: Solution) -> Solution:
    """The second, with what became of the first and the time of both."""
    return replace(
        second, build_seconds=first.build_seconds + second.build_seconds,
        solve_seconds=first.solve_seconds + second.solve_seconds,
        extras=second.extras | {"failed_first": f"{first.extras['method']}: {first.status.name}"},
    )  # fmt: skip


def second_way(module: Any, problem: Problem, options: dict[str, Any]) -> dict[str, Any] | None:
    """The options with which a backend tries again where its answer fails the checks; None if it has no other way."""
    found: dict[str, Any] | None = module.second(problem, options) if hasattr(module, "second") else None
    return found


def usable(backend: str) -> Backend:
    """The backend of a name; InputError that lists the names, MissingLibraryError with the line that installs it."""
    known = BACKENDS[backend] if backend in BACKENDS else _other(backend)
    if not known.installed:
        raise MissingLibraryError(str(known.library), f"backend {backend!r}", str(known.library))
    return known


def _others() -> list[str]:
    return [name for name in names("coopoc.backends") if name not in BACKENDS]


def _other(backend: str) -> Backend:
    """A backend from elsewhere, by its name or its file."""
    found = find("coopoc.backends", backend) if in_file(backend) or backend in _others() else None
    if found is None:
        known = sorted([*BACKENDS, *_others()])
        raise InputError("backend", repr(backend), f"must be one of {known}", "See backends().")
    if not isinstance(found, Backend):
        mend = "Give coopoc.Backend(name, build, purpose)."
        raise InputError("backend", repr(backend), f"is a {type(found).__name__}, no Backend", mend)
    return found


def backend_module(backend: str, options: dict[str, Any]) -> Any:
    """The module of a backend that takes the options; errors as `solve`."""
    given = usable(backend).solver
    module = _module(given) if isinstance(given, str) else SimpleNamespace(build=given)
    allowed = _options(module.build)
    for name in options:
        if name not in allowed:
            raise InputError(name, options[name], f"is no option of {backend}, which has {allowed}", "Leave it out.")
    return module


@lru_cache(maxsize=64)
def _module(name: str) -> Any:
    return importlib.import_module(f".backends.{name}", __package__)


@lru_cache(maxsize=64)
def _options(build: Any) -> list[str]:
    """Names of what a backend's build takes besides the problem."""
    return list(inspect.signature(build).parameters)[1:]


def _check_constraints(problem: Problem, known: Backend) -> None:
    """InputError if the backend cannot hold the problem's constraints; it names those that can."""
    needed = "linear" if all(c.measurement.linear for c in problem.constraints) else "all"
    able = [b.name for b in backends().values() if b.constraints in (needed, "all")]
    if known.name not in able:
        kinds = sorted({c.kind for c in problem.constraints})
        raise InputError("constraints", kinds, f"cannot be held by {known.name}, only by {able}", "Name one of those.")


def _start(problem: Problem) -> Floats:
    """(n, width); InputError if a measurement or a constraint has no derivative there."""
    if problem.linear and not problem.constraints:
        return np.asarray(somewhere(problem)[0])
    start: Floats = initial_guess(problem)[0]
    with np.errstate(all="ignore"):
        linear = problem.linearise(start[None])
    for factor, residual, slope in zip(problem.factors, linear.residual, linear.slope, strict=True):
        bad = ~np.isfinite(residual[0]).all(axis=-1)
        for by_node in slope:
            bad = bad | ~np.isfinite(by_node[0]).all(axis=(-2, -1))
        if bad.any():
            raise _without_direction(problem, factor.kind, factor.nodes[np.flatnonzero(bad)[0]])
    if problem.constraints:
        with np.errstate(all="ignore"):
            rows = constraint_rows(problem, start)
        bad = ~np.isfinite(rows.value + rows.matrix.sum(axis=1))
        if bad.any():
            k, row, _ = rows.place[np.flatnonzero(bad)[0]]
            raise _without_direction(problem, problem.constraints[k].kind, problem.constraints[k].nodes[row])
    return start


def _without_direction(problem: Problem, kind: str, nodes: Ints) -> InputError:
    pair = " and ".join(problem.names[n] for n in nodes)
    return InputError("x0", f"{pair} coincide or stand above each other", f"leave {kind} without a direction",
                      "Give an x0 that keeps them apart.")  # fmt: skip


def _status(problem: Problem, ended: Ended, truth: Assessment, limit: int) -> Status:
    if truth.violation > FEASIBLE or ended.infeasible:
        return Status.INFEASIBLE
    if truth.free:
        return Status.RANK_DEFICIENT
    if truth.remaining <= POSITION_TOLERANCE:
        held = truth.active
        minimum = is_constrained_minimum(problem, ended.x, held) if held else is_minimum(problem, ended.x)
        return Status.SOLVED if minimum else Status.SADDLE
    return Status.MAX_ITERATIONS if ended.iterations >= limit else Status.FAILED


def _raise(solution: Solution) -> None:
    if solution.status is not Status.RANK_DEFICIENT:
        raise SolveError(solution)
    shown = ", ".join(solution.free[:6]) + (", ..." if len(solution.free) > 6 else "")
    raise InputError(
        "problem", f"{len(solution.free)} of {len(solution.names)} points can move freely ({shown})",
        "must be observable", "Add a position factor (a fix) to one of them, or more measurements between them.",
    )  # fmt: skip

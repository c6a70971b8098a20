"""solve: a Problem and the name of a backend give a Solution, verified independently of the solver."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import chain, islice
from typing import Any

import numpy as np
from numpy.linalg import norm

from ..arrays import Floats, instance
from ..errors import InputError
from ..kernels.compiling.waiting import clock, load, spent
from .algebra.sparse import LIBRARIES, sparse
from .assess.active import constraint_rows
from .assess.assess import Assessment, assess, is_constrained_minimum, judged, newton_decrease
from .backend import MAX_ITERATIONS, Backend, Options, SolverResult, require_backend
from .descent.levenberg_marquardt import arrive
from .graph_problems import started
from .model.factor import fused
from .model.measurements import CONVERTED
from .model.problem import Problem, Search
from .robust.graduated import robust_start
from .solution import Solution, SolveError, Status
from .starts.initial import converted, directed, guessed, undirected
from .starts.mirrors import RANGES, RIVAL_COST, scaled
from .starts.race import (
    ELSEWHERE,
    FIRST_STEPS,
    QUIET_DRAWS,
    RACE_TOLERANCE,
    doubts,
    drawn,
    higher,
    race,
    reached_once,
    scattered,
    smooth,
)

POSITION_TOLERANCE = 1e-6
"""m, what one more Gauss-Newton step may still move."""
DECREASE = 1e-10
"""Predicted decrease of one more step, as a share of the cost, at a minimum: in a flat valley points move far for no
gain."""
NEWTON_DECREASE = 1e-8
"""That of a Newton step where Gauss-Newton's step is below the tolerance: 1e-4 standard deviations away."""
DRAWN_STEPS = 50
"""From each random place, of problems with constraints."""
ASTRAY_SHARE = 0.25
"""Share of the extent of points by which an x0 may err and its `smooth` way needs no random starts beside it."""
IMAGED = (*RANGES, "antenna")
"""Formulas of several nodes whose other minima are images; beside a near x0 others are sought from random places."""
COINCIDENT, AWAY = 1e-3, 1e4
"""Shares of the median distance of nodes from their middle below which two coincide and beyond which one is lost."""
FEASIBLE = 1e-6
"""m, rad or m/s by which a constraint may be violated."""
COVARIANCE_NODES = 1000
"""Nodes beyond which covariances are computed only where they are asked for: they take as long as some steps."""
DEFAULTS = ("gauss-newton", "osqp", "casadi")
"""Backends of a problem for which none is named: the first that can solve it."""


def solve(
    problem: Problem,
    backend: str | Backend | None = None,
    throw: bool = True,
    covariance: bool | None = None,
    **options: Any,
) -> Solution:
    """The most probable positions: a minimum of the problem's cost, by the named backend.

    Cost, gradient, covariance, status and times are computed here from x alone, independently of the solver; what makes
    the answer doubtful is in `Solution.notes`. Where neither an x0 nor a measurement with a direction places a node,
    and of poses without an x0, several starts race, and extras["start"] names the one that won. Losses that are not
    convex start where several lead lowest (`robust/graduated.py`).

    Args:
        problem: what to solve.
        backend: a name of `backends()`, "folder/mine.py:BACKEND" or a Backend; None: gauss-newton, and where there are
            constraints the first of osqp and casadi that holds them and does not fail.
        throw: raise unless SOLVED; otherwise failure is data.
        covariance: whether to compute marginals; None: of up to COVARIANCE_NODES nodes.
        options: of the backend, such as max_iterations and tolerance (m).

    Raises:
        InputError: unknown backend or option, a problem beyond the backend's capabilities, points that coincide, or (if
            `throw`) free points.
        MissingLibraryError: the backend's library is not installed.
        SolveError: (if `throw`) no minimum was reached; it carries the Solution.

    >>> problem = Problem(("ego", "b")).add("position", ["ego", "b"], [[0, 0, 0], [9, 0, 0]], std=1.0)
    >>> solve(problem.add("range", ("ego", "b"), 10.0, std=1.0)).x.round(3)[:, 0]
    array([-0.333,  9.333])
    """
    instance("problem", problem, Problem)
    able = (one for one in map(require_backend, DEFAULTS) if not one.capabilities.lacking(problem))
    chosen = next(able, require_backend(DEFAULTS[0])) if backend is None else require_backend(backend)
    instance("throw", throw, bool, "Give False to get the Solution whatever its status.")
    wanted = len(problem.names) <= COVARIANCE_NODES if covariance is None else instance("covariance", covariance, bool)
    if not problem.factors:
        raise InputError("problem", repr(problem), "has no measurements", "Add factors: problem.add(...).")
    if (factors := fused(problem.factors)) is not problem.factors:
        problem = problem.replace_unchecked(factors=factors)
    solution, lacks = _solved(problem, chosen, options, wanted), "gauss-newton cannot"
    if problem.constraints and solution.status is Status.FAILED and backend is None and (other := next(able, None)):
        solution, lacks = _solved(problem, other, options, wanted), f"{lacks}, {chosen.name} failed"
    if backend is None and chosen.name != DEFAULTS[0]:
        solution = replace(solution, notes=(f"solved by {solution.backend}: {lacks}", *solution.notes))
    if throw and solution.status is not Status.SOLVED:
        _raise(solution)
    return solution


def _solved(problem: Problem, backend: Backend, options: Options, covariance: bool) -> Solution:
    """The result of a backend, and its assessment."""
    load(*LIBRARIES)
    began = clock()
    backend.check(problem, options)
    if has_start := problem.x0 is not None and not np.array_equal(problem.x0, problem.search.x0):  # type: ignore[arg-type]
        problem = problem.replace_unchecked(search=Search(notes=problem.search.notes))
    earlier, problem = problem.search.seconds, started(problem)
    start, placed = _start(problem)
    whole = placed and all(f.measurement.linear or f.kind == CONVERTED for f in problem.factors)
    constraints, searching, given = problem.constraints, problem.x0 is None and not whole, start
    if constraints:  # which the search for a start leaves to the solver
        problem = problem.replace_unchecked(constraints=())
    if searching:
        problem = _searched(problem, start, None, True)
    built, searched = clock(), problem.search.seconds
    if any(f.loss is not None and (not f.loss.convex or problem.x0 is None) for f in problem.factors):
        problem = robust_start(problem, start if problem.x0 is None else problem.x0)
    start = start if problem.x0 is None else problem.x0
    if constraints:
        problem = problem.replace_unchecked(constraints=constraints)
    result = backend.run(problem, start, options)
    if constraints:
        far = has_start and abs(problem.cost(given) - problem.cost(result.x)) > RIVAL_COST
        if not problem.linear and (_violated(problem, result.x) or (not whole and (far or searching))):
            problem, result = _drawn(problem, backend, options, result, has_start)
    elif has_start and not problem.linear:
        problem, result = _challenged(problem, backend, options, result, whole)
    search = problem.search
    solved = clock()
    x, iterations = result.x, result.iterations
    truth = assess(problem, x, covariance, quick=not covariance)
    status = Status.INFEASIBLE if result.infeasible else _status(problem, x, truth)
    extras = dict(result.extras)
    if search.start:
        extras |= {"start": search.start, "start_iterations": search.iterations, "start_seconds": search.seconds}
    if truth.active is not None and status is Status.INFEASIBLE:
        extras["violated"] = truth.active.violated
    stopped = not result.infeasible and iterations >= options.get("max_iterations", MAX_ITERATIONS)
    if stopped and status in (Status.FAILED, Status.INFEASIBLE):
        status = Status.MAX_ITERATIONS
    expected, notes = judged(problem, x, truth)
    if np.isfinite(truth.cost):
        notes = (*notes, *_unsolved(problem, x, truth, status))
    return Solution(
        x=x,
        covariance=truth.covariance,
        cost=truth.cost,
        gradient_norm=truth.gradient_norm,
        status=status,
        iterations=iterations + search.iterations,
        build_seconds=built - began - (searched - earlier),
        solve_seconds=solved - built + searched,
        check_seconds=clock() - solved,
        load_seconds=spent.load,
        compile_seconds=spent.compile,
        backend=backend.name,
        names=problem.names,
        shown=problem.shown,
        unobservable=truth.unobservable,
        space=problem.space,
        violation=truth.violation,
        expected=expected,
        notes=(*(note for note in search.notes if not truth.unobservable or note != ELSEWHERE), *notes),
        extras=extras,
    )


def _searched(problem: Problem, start: Floats, end: Floats | None, draws: bool) -> Problem:
    """A problem of points from where its converted measurements (n, d), multidimensional scaling, random starts, if it
    `draws`, or an x0, which led to the `end` (n, d), lead lowest."""
    return race(problem, {"converted": lambda: start, "scaled": lambda: scaled(problem, start)}, {}, draws, end)


def _drawn(
    problem: Problem, backend: Backend, options: Options, first: SolverResult, has_start: bool
) -> tuple[Problem, SolverResult]:
    """The lowest feasible result of a problem with constraints, of the first, of points those from random places, and
    beside a given x0 that from where the measurements lead; the problem's notes are of the minima that were found."""
    few, steps, search = {**options, "max_iterations": DRAWN_STEPS}, 0, problem.search
    free, around = problem.replace_unchecked(constraints=()), first.x
    led = [around := np.asarray(_measured(free, first.x, True).x0)] if has_start else []

    def descend(x: Floats) -> Floats:
        nonlocal steps
        end = backend.run(problem, x, few)
        steps += end.iterations
        return end.x

    def cost(x: Floats) -> float:
        return np.inf if _violated(problem, x) else sparse(problem).cost(x)

    x, ends = drawn(
        chain(led, islice(scattered(problem, around), 0 if problem.poses else QUIET_DRAWS)), first.x, descend, cost
    )
    notes, start = doubts(x, ends, cost), search.start
    if x is not first.x:
        steps, start, first = steps + first.iterations, "drawn", backend.run(problem, x, options)
    search = search._replace(start=start, iterations=search.iterations + steps, notes=notes)
    return problem.replace_unchecked(search=search), first


def _violated(problem: Problem, x: Floats) -> bool:
    return bool(constraint_rows(problem, x).outside.max() > FEASIBLE)


def _challenged(
    problem: Problem, backend: Backend, options: Options, first: SolverResult, whole: bool
) -> tuple[Problem, SolverResult]:
    """The result from a given x0; where the way from there was long and not `smooth`, or of points whose vectors are
    not measured as a `whole`, the lower of it and that from where the measurements lead, which a note names; elsewhere
    that from mirror images and other windings, unless noise may decide between them."""
    system, record = sparse(problem), first.extras.get("record")
    if record is None:
        record = arrive(system, np.asarray(problem.x0), FIRST_STEPS, RACE_TOLERANCE, smooth=True).record
    x = first.x
    cost = system.cost(x)
    if not np.isfinite(cost) or first.iterations >= options.get("max_iterations", np.inf):
        return problem, first
    search = problem.search
    near = record[0, 0] - cost <= RIVAL_COST or ((whole or problem.poses) and smooth(record))
    if near and (whole or search.start):
        return problem, first
    if near:
        strange = any(f.measurement.frame == "nodes" and f.kind not in IMAGED for f in problem.factors)
        other = race(problem, {}, {}, strange, x)
        if not other.search.iterations:
            return problem, first
    else:
        astray = abs(x - np.asarray(problem.x0)).max() > ASTRAY_SHARE * np.ptp(x, axis=0).max()
        other = _measured(problem, x, not whole and (astray or not smooth(record)))
    least = system.cost(np.asarray(other.x0))
    won, saved = other.search, cost - least
    if higher(cost, least) and (not near or saved > RIVAL_COST):
        won = won._replace(iterations=won.iterations + first.iterations)
        note = f"x0 leads to a higher minimum, of cost {cost:.4g}: start {won.start!r} led here"
        other = other.replace_unchecked(search=won._replace(notes=(*search.notes, *won.notes, note)))
        return other, backend.run(other, np.asarray(other.x0), options)
    notes = reached_once([cost, least], cost) if higher(least, cost) else won.notes
    if higher(cost, least):
        notes = (f"another minimum costs {saved:.3g} less: noise may decide between them",)
    return problem.replace_unchecked(search=search._replace(notes=(*search.notes, *notes))), first


def _measured(problem: Problem, end: Floats, draws: bool) -> Problem:
    """A problem from where its measurements lead lowest, or from the end (n, ambient) of its x0."""
    return started(problem, end) if problem.poses else _searched(problem, converted(problem, end)[0], end, draws)


def _start(problem: Problem) -> tuple[Floats, bool]:
    """(n, ambient), and whether anything places every node in it; InputError if a measurement or a constraint has no
    derivative there."""
    if problem.linear and not problem.constraints:
        return np.zeros((len(problem.names), problem.space.ambient)) if problem.x0 is None else problem.x0, True
    start, placed = guessed(problem)
    lost = undirected(problem, start)
    if lost and problem.x0 is None:
        start = directed(problem, start)
        lost = undirected(problem, start)
    for item, nodes in lost:
        pair = " and ".join(problem.names[n] for n in nodes[0])
        if item.measurement.compares_poses:
            what, hint = f"{pair} half a turn from the measured rotation", "Give an x0 nearer to the measured rotation."
        else:
            what, hint = f"{pair} coincide, or differ in height alone", "Give an x0 that keeps them apart."
        raise InputError("x0", what, f"leaves {item.kind} without a direction", hint)
    return start, placed


def _status(problem: Problem, x: Floats, truth: Assessment) -> Status:
    """Status of x, by its assessment alone."""
    if truth.violation > FEASIBLE:
        return Status.INFEASIBLE
    if not np.isfinite(truth.cost):
        return Status.FAILED
    if truth.unobservable:
        return Status.RANK_DEFICIENT
    still, least = truth.remaining <= POSITION_TOLERANCE, DECREASE * max(truth.cost, 1.0)
    if not (still or truth.predicted <= least):
        return Status.FAILED
    if truth.active is not None:
        return Status.SOLVED if is_constrained_minimum(problem, x, truth.active) else Status.SADDLE
    left = truth.predicted if truth.newton else newton_decrease(problem, x)
    if left is None:
        return Status.SADDLE
    return Status.SOLVED if left <= max(least, NEWTON_DECREASE * still) else Status.FAILED


def _unsolved(problem: Problem, x: Floats, truth: Assessment, status: Status) -> Iterator[str]:
    """Why nodes x (n, ambient) are no minimum that stands: a node far away, two that coincide, at a minimum in an
    angle's formula and to the tolerance, a step that is left."""
    at, names, near, solved = problem.space.position(x), problem.names, POSITION_TOLERANCE, status is Status.SOLVED
    if not (solved and truth.remaining <= POSITION_TOLERANCE):
        off = norm(at - np.median(at, axis=0), axis=1)
        extent, lost = np.median(off), (off * problem.movable.any(1)).argmax()
        if off[lost] > AWAY * extent > 0.0:
            yield f"{names[lost]} went {off[lost]:.2g} m away: what is measured of it fits no place nearby"
        near = near if solved else COINCIDENT * extent
    for f in problem.factors:
        kind = f.measurement
        if kind.arity != 2 or (solved and (kind.frame == "nodes" or "angle" not in kind.components)):
            continue
        gap = np.diff(at[f.nodes], axis=1)
        if kind.frame == "body":
            gap = gap @ problem.space.rotation(x)[f.nodes[:, 0]]
        off = np.hypot(*gap[:, 0, :2].T)
        if off.min(initial=np.inf) < near:
            pair = " and ".join(names[node] for node in f.nodes[off.argmin()])
            yield f"{pair} nearly coincide, or differ in height alone: no direction has a derivative"
    if status is Status.FAILED:
        yield f"another step would move a node by {truth.remaining:.2g} m or rad and save {truth.predicted:.2g}"


def _raise(solution: Solution) -> None:
    if solution.status is not Status.RANK_DEFICIENT:
        raise SolveError(solution)
    lacks = solution.unobservable
    hint = "Add a position factor (a fix) to one of them, or more measurements between them."
    if rejected := [note for note in solution.notes if "rejects" in note]:
        hint = f"The {', the '.join(rejected)}: give a nearer x0 or a larger scale, or measure more."
    if lost := [note for note in solution.notes if "fits no place" in note]:
        hint = f"{lost[0]}: look for outliers."
    raise InputError(
        "problem",
        f"{len(lacks)} of {len(solution.names)} points can move freely "
        f"({', '.join(lacks[:6])}{', ...' * (len(lacks) > 6)})",
        "must be observable",
        hint,
    )

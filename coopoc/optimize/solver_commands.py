"""coopoc solve and coopoc check: the solvers from the command line."""

import json
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from tyro.conf import Positional, arg

from ..arrays import one_of
from ..errors import InputError, dependencies
from ..formats import load_graph
from ..paths import replaceable, write
from ..workers import say
from .backend import backends
from .graph_problems import Objective, Start, from_graph, loop_closures
from .model.problem import Problem
from .robust.gnc import solve_gnc
from .solution import Solution, Status
from .solve import solve

UNLIKELY_FACTOR = 30.0
"""Factor by which residuals may differ from what is stated; on real graphs they are 0.2 to 1 times as large."""
COVARIANCE_HINT = (
    "Are its matrices covariances where the format has information, or the reverse, its angles in rad, lengths in m?"
)


def solve_file(
    file: Annotated[Positional[Path], arg(metavar="FILE")],
    /,
    backend: Annotated[str, arg(metavar="NAME")] = "gauss-newton",
    objective: Objective = "chordal",
    start: Start = "auto",
    output: Annotated[Path | None, arg(metavar="FILE")] = None,
    outliers: bool = False,
    repair: bool = False,
    covariance: bool = False,
) -> int:
    """Solve the factor graph of a PyFG or g2o file.

    Example: coopoc solve drive.pyfg --backend gtsam --output solution.json

    Args:
        file: graph in .pyfg or .g2o.
        backend: solver (see coopoc check).
        objective: chordal (quadratic, can be certified), or geodesic with the full covariances.
        start: point where the solve begins, see docs/optimize.md; auto takes the lowest cost of all. Where outliers
            are looked for it is odometry.
        output: file for the solution with all nodes, as JSON; a summary goes to stdout.
        outliers: find wrong loop closures and relative poses between robots, and leave them out (solve_gnc).
        repair: take the nearest positive definite matrix where a g2o file's information is none.
        covariance: compute marginals of graphs of more than 1,000 nodes, too.
    """
    if output is not None:
        one_of("ending of --output", replaceable(output).suffix, (".json",))
    problem = from_graph(load_graph(file, repair), objective, "odometry" if outliers else start)
    say(problem)
    solve_one = partial(solve, throw=False, covariance=covariance or None)
    solution = (without_outliers if outliers else solve_one)(problem, backend)
    summary = described(solution) | {"fixed": [problem.names[k] for k in problem.fixed]}
    summary |= {"misfit": (size := None if outliers else misfit(solution))}
    if output is not None:
        write(output, json.dumps(summary | nodes(solution)) + "\n")
        say(f"the solution is in {output}")
    print(json.dumps(summary, indent=1))
    if solution.status is not Status.SOLVED:
        say(solution.status.value)
    for note in solution.notes:
        say(note)
    if size is not None and not 1 / UNLIKELY_FACTOR < size < UNLIKELY_FACTOR:
        say(f"residuals are {size:.2g} times what the file states. {COVARIANCE_HINT}")
    return int(solution.status is not Status.SOLVED)


def without_outliers(problem: Problem, backend: str) -> Solution:
    """The solution without relative poses that GNC rejects; extras["rejected"] has their names.

    Raises:
        InputError: no relative pose but odometry, which is taken as right.
    """
    candidates = loop_closures(problem)
    if not candidates:
        allowed = "must hold relative poses beside each robot's odometry"
        raise InputError("outliers", repr(problem), allowed, "Leave out --outliers.")
    solution = solve_gnc(problem, candidates, backend=backend, throw=False, start="known")
    nodes = np.concatenate([problem.factors[k].nodes[rows] for k, rows in candidates])
    rejected = [[problem.names[i] for i in pair] for pair in nodes[solution.extras["weights"] < 0.5].tolist()]
    return replace(solution, extras=solution.extras | {"rejected": rejected})


def misfit(solution: Solution) -> float | None:
    """Size of the residuals over their standard deviations, the root of the cost over the expected one; 1 is as stated,
    None where the measurements only just suffice.

    >>> misfit(solve(tiny())) < 2
    True
    """
    mean = solution.expected
    return float(np.sqrt(solution.cost / mean)) if mean > 0 and np.isfinite(solution.cost) else None


def described(solution: Solution) -> dict[str, Any]:
    """Status, cost and times of a solution, without its nodes."""
    times = "build_seconds solve_seconds check_seconds seconds load_seconds compile_seconds"
    named = f"backend cost expected gradient_norm iterations {times} notes".split()
    row: dict[str, Any] = {"status": solution.status.name, "sentence": solution.status.value}
    row |= {name: getattr(solution, name) for name in named}
    row |= {"start": solution.extras.get("start"), "unobservable": list(solution.unobservable)}
    if "rejected" in solution.extras:
        row["rejected"] = solution.extras["rejected"]
    return row


def nodes(solution: Solution) -> dict[str, Any]:
    """Positions m, rotation matrices and covariances (position m, then rotation rad) by name; NaN becomes null."""
    rows = {}
    for name, x, covariance in zip(solution.names, solution.x, solution.covariance, strict=True):
        node = {"position": solution.space.position(x).tolist()}
        if solution.space.has_rotation:
            node["rotation"] = solution.space.rotation(x).tolist()
        rows[name] = node | {"covariance": covariance.tolist() if np.isfinite(covariance).all() else None}
    return {"nodes": rows}


def tiny(kind: str = "spherical") -> Problem:
    """Two vehicles in 3-D with a fix each and the range, azimuth and inclination between them, or the range alone."""
    problem = Problem(("ego", "b")).add("position", ["ego", "b"], [[0, 0, 0], [9, 1, 0]], std=2.0)
    size = 3 if kind == "spherical" else 1
    return problem.add(kind, ("ego", "b"), [10.0, 0.05, 1.55][:size], std=[0.5, 0.05, 0.05][:size])


def check() -> int:
    """Name libraries that are missing, and solve one tiny problem with every backend; of a log: coopoc data check LOG.

    Example: coopoc check
    """
    failed = 0
    absent = [package for library, package in dependencies().items() if find_spec(library) is None]
    for package in absent:
        say(f"{package} is not installed. Run: pip install {package}")
    print(f"{'backend':<14} {'constraints':<12} {'status':<10} {'cost':>12} {'differs [m]':>11}  measures")
    for name, backend in backends().items():
        fixed = backend.capabilities.constraints
        if not backend.installed or find_spec("casadi") is None:
            print(f"{name:<14} {fixed:<12} needs {backend.library if not backend.installed else 'casadi'}")
            continue
        kind = "range" if backend.capabilities.lacking(tiny()) else "spherical"
        expected = solve(tiny(kind))
        solution = solve(tiny(kind), name, throw=False)
        off = float(abs(solution.x - expected.x).max())
        good = solution.status is Status.SOLVED and off < 1e-6
        failed += not good
        print(f"{name:<14} {fixed:<12} {solution.status.name:<10} {solution.cost:12.6g} {off:11.1e}  {kind}")
    say(f"{len(backends())} backends, {failed} disagree with gauss-newton")
    return int(failed > 0 or bool(absent))

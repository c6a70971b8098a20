"""Joint covariances of any nodes, by solves with the factor of their problem."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..arrays import Floats, Ints, checked, instance
from ..errors import InputError
from .algebra.sparse import sparse
from .model.problem import Problem, several

if TYPE_CHECKING:
    from .solution import Solution


def joint_covariance(problem: Problem, solution: Solution, nodes: Sequence[str | int]) -> Floats:
    """Covariance of some nodes together: their rows and columns of (J^T J)^-1 at the solution.

    Two nodes of it give the covariance of their difference, which their marginals do not: P_ii + P_jj - P_ij - P_ji.

    Args:
        problem: that was solved.
        solution: of it.
        nodes: k names or indices.

    Returns:
        (k, k, dof, dof) m^2, rad^2: block [i, j] between nodes i and j, zero where one cannot move.

    Raises:
        InputError: an unknown node, a problem with constraints or realisations, one whose nodes can move freely.

    >>> from coopoc import solve
    >>> problem = Problem(("a", "b")).add("position", "a", [0, 0, 0], std=1.0)
    >>> problem = problem.add("displacement", ("a", "b"), [5, 0, 0], std=1.0)
    >>> joint_covariance(problem, solve(problem), ("a", "b"))[:, :, 0, 0].round(6)
    array([[1., 1.],
           [1., 2.]])
    """
    instance("problem", problem, Problem)
    given: Any = getattr(solution, "x", None)
    x = checked("solution", given, "(n, ambient)", (len(problem.names), problem.space.ambient))
    if problem.constraints or problem.batch is not None:
        what = "constraints" if problem.constraints else f"{problem.batch} realisations"
        raise InputError("problem", what, "must be a single one without constraints", "Pick one: problem.pick(0).")
    places = [problem.index(node) for node in (nodes if isinstance(nodes, str) else several(nodes))]
    if len(places) > len(problem.names):
        allowed = f"must name each of {len(problem.names)} nodes once"
        raise InputError("nodes", f"{len(places)} nodes", allowed, "Leave out those that stand twice.")
    dof = problem.space.dof
    number, solve_one = _solver(problem, x)
    wanted = number[places].ravel()
    moving = np.flatnonzero(wanted >= 0)
    whole = np.zeros((len(wanted), len(wanted)))
    for column in moving.tolist():
        unit = np.zeros(int(number.max()) + 1)
        unit[wanted[column]] = 1.0
        whole[moving, column] = solve_one(unit)[wanted[moving]]
    return whole.reshape(len(places), dof, len(places), dof).swapaxes(1, 2)


def _solver(problem: Problem, x: Floats) -> tuple[Ints, Callable[[Floats], Floats]]:
    """Which unknown a direction (n, dof) of a node is, -1 where it cannot move, and (u,) -> (J^T J)^-1 (u,)."""
    system = sparse(problem)
    if not system.cholesky.factor(system.quadratic(x, "gauss-newton")[2]):
        hint = "Measure what is free: see solution.unobservable."
        raise InputError("problem", repr(problem), "must hold all nodes", hint)
    return system.entries.number, system.cholesky.solve

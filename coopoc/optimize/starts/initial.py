"""Where to start: the linear least-squares solution of the converted measurements."""

import numpy as np

from ...arrays import Floats, Ints
from ...errors import InputError
from ..algebra.sparse import sparse
from ..model.derivatives import linearise
from ..model.factor import Factor, as_factor, bounded, stacked
from ..model.problem import Problem

NUDGE_STD = 0.1
"""m or rad, standard deviation of such a move."""
RIDGE = 1e-9
"""1/m^2 on every point, so that one without information has a place to start from."""


def initial_guess(problem: Problem) -> Floats:
    """(n, ambient): x0 if the problem has one, else the linear solution of vectors, see `converted_rows`.

    Raises:
        InputError: poses without an x0.
    """
    return guessed(problem)[0]


def guessed(problem: Problem) -> tuple[Floats, bool]:
    """`initial_guess`, and whether anything places every node in it."""
    if problem.x0 is not None:
        return problem.x0.copy(), True
    if problem.poses:
        raise InputError("x0", "none", "is needed where there are poses", "Give coopoc.optimize.pose(position, angle).")
    return converted(problem, np.zeros((len(problem.names), problem.dimension)))


def converted(problem: Problem, x: Floats) -> tuple[Floats, bool]:
    """Points (n, d) where vectors put them, from any x, and whether these touch all that can move."""
    system = sparse(problem)
    _, gradient, values = system.quadratic(x, "converted")
    own = values[system.entries.diagonal]
    values[system.entries.diagonal] = own + RIDGE
    system.cholesky.factor(values)
    return system.retract(x, -system.cholesky.solve(gradient)), bool(own.min(initial=np.inf) > 0.0)


def directed(problem: Problem, x: Floats) -> Floats:
    """Nodes x (n, ambient) with those moved at random at which a measurement has no derivative."""
    rng, movable = np.random.default_rng(0), problem.movable
    for _ in range(5):
        lost = [nodes for _, nodes in undirected(problem, x)]
        if not lost:
            break
        step = np.zeros(movable.shape)
        nodes = np.unique(stacked(each.ravel() for each in lost))
        step[nodes] = NUDGE_STD * rng.normal(size=(len(nodes), movable.shape[1]))
        x = problem.space.retract(x, step * movable)
    return x


def undirected(problem: Problem, x: Floats) -> list[tuple[Factor, Ints]]:
    """Measurements and bounds without a derivative at x (n, ambient), and the nodes (K, arity) of such rows."""
    if not problem.constraints and np.isfinite(sparse(problem).quadratic(x, "gauss-newton")[1]).all():
        return []
    items = *problem.factors, *map(as_factor, problem.constraints)
    counts = [*(np.array(True) for _ in problem.factors), *map(bounded, problem.constraints)]
    with np.errstate(all="ignore"):
        linear, undefined = linearise(problem.space, items, problem.movable, x), []
    for item, count, residual, jacobian in zip(items, counts, linear.residual, linear.jacobian, strict=True):
        bad = (count & ~np.isfinite(np.dstack([residual, *jacobian])).all(axis=2)).any(axis=1)
        undefined += [(item, item.nodes[bad])] if bad.any() else []
    return undefined

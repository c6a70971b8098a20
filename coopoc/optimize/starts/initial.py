"""Where to start: the linear least-squares solution of the converted measurements."""

import numpy as np

from ...arrays import Floats
from ...errors import InputError
from ..algebra.sparse import Sparse, sparse
from ..model.derivatives import Model
from ..model.factor import Factor, unchecked
from ..model.measurements import columns, converted_rows, is_converted
from ..model.problem import Problem

RIDGE = 1e-9
"""1/m^2 on every point, so that one without information has a place to start from."""


def converted(problem: Problem) -> Problem:
    """The linear problem: spherical factors become vectors d u with the rotated covariance; other angles are left out.

    d u = h^-1(d, az, inc), W' = W diag(1, 1/(d sin inc), 1/d) [u e_az e_inc]^T, from the measured values themselves, so
    that the first guess needs none. It is within 0.02 % of the maximum-likelihood accuracy of a snapshot.
    """
    factors = [as_vectors(f) if is_converted(f.measurement) else unchecked(f, loss=None) for f in problem.factors]
    return problem.replace_unchecked(factors=tuple(f for f in factors if f.measurement.linear), x0=None, fixed=())


def initial_guess(problem: Problem) -> Floats:
    """(n, ambient): x0 if the problem has one, else the solution of `converted`.

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
    x, touched = _solution(sparse(problem), "converted")
    return (x if touched else _apart(problem, x)), touched


def _solution(system: Sparse, model: Model) -> tuple[Floats, bool]:
    """(n, d) where a quadratic cost of points is least, and whether every point has a part in it."""
    zero = np.zeros(system.entries.number.shape)
    _, gradient, values = system.quadratic(zero, model)
    own = values[system.entries.diagonal]
    values[system.entries.diagonal] = own + RIDGE
    system.cholesky.factor(values)
    return system.retract(zero, -system.cholesky.solve(gradient)), bool(own.min(initial=np.inf) > 0.0)


def somewhere(problem: Problem) -> Floats:
    """(n, ambient): x0, or all points at their fixes or at one of them, which is near enough for a linear problem.

    Raises:
        InputError: poses without an x0.
    """
    if problem.x0 is not None or problem.poses:
        return initial_guess(problem)
    x = np.zeros((len(problem.names), problem.dimension))
    fixes = [f for f in problem.factors if f.kind == "position"]
    if fixes:
        x[:] = fixes[0].z[0]
    for f in fixes:
        x[f.nodes[:, 0]] = f.z
    return x


def _apart(problem: Problem, x: Floats) -> Floats:
    """x with what no linear factor touches on a spiral around the others: two in one place have no direction."""
    touched = np.zeros(len(x), dtype=bool)
    for f in problem.factors:
        if not (f.measurement.linear or is_converted(f.measurement)):
            continue
        touched[f.nodes[f.informative]] = True
    ranges = [f.z[:, 0].mean() for f in problem.factors if f.measurement.components[0] == "distance"]
    index = np.cumsum(~touched) - 1
    turn, radius = 2.4 * index, np.sqrt(1.0 + index) * (ranges[0] if ranges else 1.0)
    spiral = np.zeros_like(x)
    spiral[:, 0], spiral[:, 1] = radius * np.cos(turn), radius * np.sin(turn)
    middle = x[touched].sum(axis=0) / max(touched.sum(), 1)
    return np.where(touched[:, None], x, middle + spiral)


def as_vectors(factor: Factor) -> Factor:
    """A spherical factor as one of vectors."""
    d, rows = converted_rows(columns(factor.z), np)
    inverse = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    z, nothing = d[:, None] * inverse[:, 0], np.empty((len(factor.nodes), 0))
    root = factor.root @ inverse
    return unchecked(factor, kind="displacement", z=z, std=None, sqrt_information=root, constants=nothing, loss=None)

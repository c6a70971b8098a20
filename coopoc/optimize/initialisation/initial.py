"""Where to start: the linear least-squares solution of the converted measurements."""

from __future__ import annotations

import numpy as np

from ...arrays import Floats
from ...errors import InputError
from ..algebra.dense import damped_step
from ..algebra.sparse import sparse
from ..model.factor import Factor, unchecked
from ..model.problem import Problem

LEAST_RANGE = 1.0
"""m; a noisy range near zero would make the converted angles seem exact."""
LEAST_SINE = 0.05
"""Of the inclination: near the vertical the azimuth carries no information."""
RIDGE = 1e-9
"""1/m^2 on every point, so that one without information has a place to start from."""


def converted(problem: Problem) -> Problem:
    """The linear problem: spherical factors become vectors d u with the rotated covariance; other angles are left out.

    d u = h^-1(d, az, inc), W' = W diag(1, 1/(d sin inc), 1/d) [u e_az e_inc]^T, from the measured values themselves, so
    that the first guess needs none. It is within 0.02 % of the maximum-likelihood accuracy of a snapshot.
    """
    factors = [_vector(f) if f.kind == "spherical" else unchecked(f, loss=None) for f in problem.factors]
    return problem.replace_unchecked(factors=tuple(f for f in factors if f.measurement.linear), x0=None, fixed=())


def initial_guess(problem: Problem) -> Floats:
    """(B, n, ambient): x0 if the problem has one, else the solution of `converted`.

    Raises:
        InputError: poses without an x0.
    """
    batch = problem.batch or 1
    if problem.x0 is not None:
        return np.array(np.broadcast_to(problem.x0, (batch, len(problem.names), problem.space.ambient)))
    if problem.poses:
        raise InputError("x0", "none", "is needed where there are poses", "Give poses: coopoc.optimize.pose, or chain.")
    linear = converted(problem)
    x: Floats = np.zeros((batch, len(problem.names), problem.dimension))
    if linear.factors and (system := sparse(linear)) is not None:
        _, gradient, values = system.quadratic(x[0], "gauss-newton")
        own = system.entries.diagonal
        every = bool((values[own] > 0.0).all())
        values[own] += RIDGE
        system.cholesky.factor(values)
        x = system.retract(x[0], -system.cholesky.solve(gradient))[None]
        if every:  # a linear factor touches each
            return x
    elif linear.factors:
        x = damped_step(linear, linear.linearise(x), np.full_like(x, RIDGE))
    return _apart(problem, linear, x)


def somewhere(problem: Problem) -> Floats:
    """(B, n, ambient): x0, or all points at their fixes or at one of them, which is near enough for a linear problem.

    Raises:
        InputError: poses without an x0.
    """
    if problem.x0 is not None or problem.poses:
        return initial_guess(problem)
    x = np.zeros((problem.batch or 1, len(problem.names), problem.dimension))
    fixes = [f for f in problem.factors if f.kind == "position"]
    if fixes:
        x[:] = fixes[0].z[..., :1, :]
    for f in fixes:
        x[:, f.nodes[:, 0]] = f.z
    return x


def _apart(problem: Problem, linear: Problem, x: Floats) -> Floats:
    """x with what no linear factor touches on a spiral around the others: two in one place have no direction."""
    touched = np.zeros(x.shape[:2], dtype=bool)
    for f in linear.factors:
        informative = f.informative
        if informative.all():
            touched[:, f.nodes] = True
        else:
            for column in f.nodes.T:
                np.logical_or.at(touched.T, column, np.atleast_2d(informative).T)
    if touched.all():
        return x
    ranges = [f.z[..., 0].mean() for f in problem.factors if f.measurement.components[0] == "distance"]
    place = np.cumsum(~touched, axis=1) - 1
    turn, radius = 2.4 * place, np.sqrt(1.0 + place) * (ranges[0] if ranges else 1.0)
    spiral = np.zeros_like(x)
    spiral[..., 0], spiral[..., 1] = radius * np.cos(turn), radius * np.sin(turn)
    middle = (x * touched[..., None]).sum(axis=1) / np.maximum(touched.sum(axis=1), 1)[:, None]
    return np.where(touched[..., None], x, middle[:, None] + spiral)


def _vector(factor: Factor) -> Factor:
    d, az = np.maximum(factor.z[..., 0], LEAST_RANGE), factor.z[..., 1]
    sa, ca = np.sin(az), np.cos(az)
    inverse = np.zeros((*d.shape, factor.size, factor.size))
    if factor.size == 2:
        inverse[..., 0, 0], inverse[..., 0, 1] = ca, sa
        inverse[..., 1, 0], inverse[..., 1, 1] = -sa / d, ca / d
    else:
        si, ci = np.sin(factor.z[..., 2]), np.cos(factor.z[..., 2])
        across = d * np.where(si < 0, -1.0, 1.0) * np.maximum(np.abs(si), LEAST_SINE)
        inverse[..., 0, 0], inverse[..., 0, 1], inverse[..., 0, 2] = si * ca, si * sa, ci
        inverse[..., 1, 0], inverse[..., 1, 1] = -sa / across, ca / across
        inverse[..., 2, 0], inverse[..., 2, 1], inverse[..., 2, 2] = ci * ca / d, ci * sa / d, -si / d
    z, nothing = factor.z[..., :1] * inverse[..., 0, :], np.empty((len(factor.nodes), 0))
    root = factor.whiten_jacobian(inverse)
    return unchecked(factor, kind="displacement", z=z, std=None, sqrt_information=root, constants=nothing, loss=None)

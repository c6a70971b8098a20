"""GTSAM's rows of backends.py."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np
from backends_star import TOLERANCE, Job, Row, as_good, ours, single
from classical import KNOWN, NEIGHBOURS, SENSORS

from coopoc.optimize import Problem
from coopoc.optimize.starts.initial import initial_guess
from coopoc.world.links import spherical, wrap


def gtsam_linear(problem: Problem) -> Job:
    """Prior and Between factors of the converted problem."""
    (fixes, edges), runs = problem.factors, problem.batch or 1
    model = gtsam.noiseModel.Diagonal.Sigmas(np.array(KNOWN.gnss_std))
    zero, keys = gtsam.Values(), range(NEIGHBOURS + 1)
    for k in keys:
        zero.insert(k, np.zeros(3))

    def one(fix: Any, vector: Any, root: Any) -> Any:
        graph = gtsam.NonlinearFactorGraph()
        for k in keys:
            graph.add(gtsam.PriorFactorPoint3(k, fix[k], model))
        for k in range(NEIGHBOURS):
            edge = gtsam.noiseModel.Gaussian.SqrtInformation(root[k], False)
            graph.add(gtsam.BetweenFactorPoint3(0, k + 1, vector[k], edge))
        return graph.linearize(zero).optimize().vector().reshape(-1, 3)

    def batch() -> Any:
        return np.stack([one(*given) for given in zip(fixes.z, edges.z, edges.root, strict=True)])

    def custom() -> Any:
        return np.stack([custom_factors(fixes.z[b], edges.z[b], edges.root[b]) for b in range(4)])

    job = "gtsam, snapshot, converted"
    return Job(
        [
            Row(job, "ours", runs, ours(problem, "gtsam", runs)),
            Row(job, "hand-written", runs, batch),
            Row(job, "CustomFactors and Levenberg-Marquardt", 4, custom),
            Row(job, "ours, solve() one by one", 4, single(problem, "gtsam", 4)),
        ],
        as_good(problem),
    )


def custom_factors(fix: Any, vector: Any, root: Any) -> Any:
    """The same by Python's callbacks, derivatives by hand."""
    graph, at, unit = gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.noiseModel.Unit.Create(3)
    model = gtsam.noiseModel.Diagonal.Sigmas(np.array(KNOWN.gnss_std))

    def edge(k: int) -> Callable[..., Any]:
        def error(factor: Any, found: Any, jacobians: Any) -> Any:
            if jacobians is not None:
                jacobians[0], jacobians[1] = -root[k], root[k]
            return root[k] @ (found.atPoint3(k + 1) - found.atPoint3(0) - vector[k])

        return error

    for k, z in enumerate(fix):
        graph.add(gtsam.PriorFactorPoint3(k, z, model))
        at.insert(k, z)
    for k in range(len(vector)):
        graph.add(gtsam.CustomFactor(unit, [0, k + 1], edge(k)))
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-12)
    found = gtsam.LevenbergMarquardtOptimizer(graph, at, params).optimize()
    return np.stack([found.atPoint3(k) for k in range(len(fix))])


def seen(x: Any, z: Any, std: Any) -> tuple[Any, Any]:
    """Whitened residuals (B, K, 3) of ranges and angles at x (B, n, 3), and derivatives (B, K, 3, 3)."""
    dx, dy, dz = np.moveaxis(x[:, 1:] - x[:, :1], 2, 0)
    flat2 = dx**2 + dy**2
    flat, r2 = np.sqrt(flat2), flat2 + dz**2
    r = np.sqrt(r2)
    jacobian = np.stack(
        [
            np.stack([dx / r, dy / r, dz / r], -1),
            np.stack([-dy / flat2, dx / flat2, 0 * r], -1),
            np.stack([dx * dz / (flat * r2), dy * dz / (flat * r2), -flat / r2], -1),
        ],
        -2,
    )
    return wrap(np.stack(spherical(dx, dy, dz), -1) - z) / std, jacobian / std[..., None]


def gtsam_exact(problem: Problem) -> Job:
    """Gauss-Newton whose JacobianFactors come from NumPy, all realisations at once."""
    (fixes, edges), runs = problem.factors, problem.batch or 1
    start, keys = initial_guess(problem), range(NEIGHBOURS + 1)
    unit = gtsam.noiseModel.Unit.Create(3)
    weight, std = 1.0 / np.array(KNOWN.gnss_std), np.array(SENSORS.relative_std)
    eye = np.diag(weight)

    def one(prior: Any, residual: Any, jacobian: Any, order: Any) -> Any:
        graph = gtsam.GaussianFactorGraph()
        for k in keys:
            graph.add(k, eye, prior[k], unit)
        for k, (a, b, c) in enumerate(zip(-jacobian, jacobian, -residual, strict=True), 1):
            graph.add(0, a, k, b, c, unit)
        return graph.optimize(order).vector().reshape(-1, 3)

    def batch() -> Any:
        x, going = start.copy(), np.arange(runs)
        order = gtsam.Ordering()
        for k in [*keys[1:], 0]:
            order.push_back(k)
        while len(going):
            near = x[going]
            residual, jacobian = seen(near, edges.z[going], std)
            prior = (fixes.z[going] - near) * weight
            step = np.stack([one(*given, order) for given in zip(prior, residual, jacobian, strict=True)])
            x[going] += step
            going = going[np.abs(step).max(axis=(1, 2)) > TOLERANCE]
        return x

    job = "gtsam, snapshot, exact"
    return Job(
        [
            Row(job, "ours", runs, ours(problem, "gtsam", runs, tolerance=TOLERANCE)),
            Row(job, "hand-written", runs, batch),
        ],
        as_good(problem),
    )

"""GTSAM's rows of backends.py, and the pose smoother against a loop on GTSAM's incremental fixed-lag smoother."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from backends_star import TOLERANCE, Job, Row, as_good, ours, single
from classical import KNOWN, NEIGHBOURS, SENSORS

import coopoc as co
from coopoc.methods.poses.pose_factors import PoseRun, pose_subgraph
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


sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))
from oracles.pose_smoother import by_hand  # noqa: E402

LAG = 5.05
NOISE = co.Sensors(
    velocity_reading="speed", range_std=0.3, azimuth_std=0.02, inclination_std=0.02, heading_std=0.05, yaw_rate_std=0.02
)


def convoy(steps: int) -> co.Recording:
    """Four vehicles that wind along at 10 m/s, 8 m apart, and two masts."""
    t = 0.1 * np.arange(steps)
    course = 0.5 * np.sin(0.3 * t[:, None] + 0.4 * np.arange(4))
    velocity = 10 * np.stack([np.cos(course), np.sin(course), 0 * course], axis=2)
    position = 8.0 * np.arange(4)[:, None] * [1, 0, 0] + np.cumsum(0.1 * velocity, axis=0)
    masts = np.broadcast_to([[0.0, 12, 0], [40, -9, 0]], (steps, 2, 3))
    moving = np.append(velocity, 0 * masts, axis=1)
    fleet = co.Fleet(("a", "b", "c", "d", "m", "n"), t, np.append(position, masts, axis=1), moving)
    return co.observe(fleet, NOISE, co.V2X(max_neighbours=3), frame="body", landmarks=["m", "n"])


def pose_lag(steps: int = 150) -> Job:
    """Poses, fixes, compasses, ranges and bearings, a lag of fifty steps; the loop's numbers are made beforehand."""
    recording, smoother = convoy(steps), co.PoseSmoother(LAG)
    drive = PoseRun(recording, 0, NOISE, np.full((len(recording.ids), 4), np.nan), np.array(smoother.spread))
    known: dict[str, Any] = {}
    parts = []
    for step, found in enumerate(smoother.estimates(recording)):
        parts.append(pose_subgraph(drive, step, known))
        marks = dict(zip(parts[-1].names, parts[-1].x0, strict=True))  # type: ignore[arg-type]
        known |= {name: x for name, x in marks.items() if "@" not in name}
        known |= dict(zip(found.names, found.x, strict=True))

    def mine() -> Any:
        return np.stack([found.x[:, :2] for found in smoother.estimates(recording)])

    def hand() -> Any:
        return by_hand(parts, LAG, recording.dt)

    best = hand()
    job = "gtsam, fixed lag, poses"
    rows = [Row(job, "ours", steps, mine), Row(job, "hand-written", steps, hand)]
    return Job(rows, lambda x: float(np.abs(x - best).max()) < 0.01)

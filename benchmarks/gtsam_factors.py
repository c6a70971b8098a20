"""What a GTSAM factor costs: its own, a JacobianFactor per step from NumPy, or a Python CustomFactor.

    python benchmarks/gtsam_factors.py            # a Markdown table on stdout, one minute

All rows of a problem come from the same process, one after the other in every round; the ratios are to be compared, the
times are this machine's. A CustomFactor has its derivatives by hand here, from Python's math on single numbers.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import gtsam
import numpy as np

from coopoc import InputError
from coopoc.optimize import Problem, pose
from coopoc.optimize.backends import gauss_newton, gtsam_
from coopoc.optimize.backends.gtsam_forms import forms
from coopoc.optimize.backends.gtsam_native import native_graph, values, which_turn
from coopoc.optimize.initialisation.initial import initial_guess

ROUNDS = 15


def star(kind: str, neighbours: int = 10) -> Problem:
    """An ego that measures its neighbours; all have a fix."""
    rng = np.random.default_rng(3)
    truth = np.concatenate([np.zeros((1, 3)), rng.uniform(-25, 25, (neighbours, 3)) * [1, 1, 0.2]])
    names = ["ego", *(f"v{j}" for j in range(neighbours))]
    pairs = [("ego", name) for name in names[1:]]
    problem = Problem(names, separator=(0,)).add("position", names, truth + rng.normal(0, 2, truth.shape), std=2.0)
    x, y, z = truth[1:].T
    r = np.linalg.norm(truth[1:], axis=1)
    seen = np.stack([r + rng.normal(0, 0.5, neighbours), np.arctan2(y, x), np.arccos(z / r)], axis=1)
    if kind == "range":
        return problem.add("range", pairs, seen[:, :1], std=0.5)
    return problem.add("spherical", pairs, seen, std=[0.5, 0.07, 0.07])


def two_drives(steps: int) -> Problem:
    """Two vehicles in the plane: odometry, a range at each step, a fix at every fifth, a pose at the start."""
    rng = np.random.default_rng(4)
    turn = np.cumsum(rng.normal(0, 0.2, steps))
    first = np.cumsum(5.0 * np.stack([np.cos(turn), np.sin(turn)], axis=1), axis=0)
    at, angle = np.concatenate([first, first + np.array([8, 3])]), np.concatenate([turn, turn + 0.1])
    i = np.concatenate([np.arange(steps - 1), steps + np.arange(steps - 1)])
    rotation = pose(at, angle)[:, 2:].reshape(-1, 2, 2)
    moved = np.einsum("kji,kj->ki", rotation[i], at[i + 1] - at[i]) + rng.normal(0, 0.1, (len(i), 2))
    turned = angle[i + 1] - angle[i] + rng.normal(0, 0.02, len(i))
    x0 = pose(at + rng.normal(0, 0.5, at.shape), angle + rng.normal(0, 0.05, len(angle)))
    problem = Problem([str(k) for k in range(2 * steps)], x0=x0, dimension=2, poses=range(2 * steps))
    problem = problem.add(
        "relative_pose", np.stack([i, i + 1], axis=1).tolist(), pose(moved, turned), std=[0.1, 0.1, 0.02]
    )
    gaps = np.linalg.norm(at[:steps] - at[steps:], axis=1) + rng.normal(0, 0.3, steps)
    problem = problem.add("range", [(k, steps + k) for k in range(steps)], gaps[:, None], std=0.3)
    fixed = np.arange(0, 2 * steps, 5)
    problem = problem.add("position", fixed.tolist(), at[fixed] + rng.normal(0, 1, (len(fixed), 2)), std=1.0)
    return problem.add("pose", [0, steps], pose(at[[0, steps]], angle[[0, steps]]), std=[0.5, 0.5, 0.05])


def custom_range(z: np.ndarray, point: Callable[[Any, int], np.ndarray], wide: Callable[[Any, int, np.ndarray], Any]):
    def error(factor: Any, found: Any, jacobians: list[np.ndarray] | None) -> np.ndarray:
        i, j = factor.keys()
        gap = point(found, j) - point(found, i)
        far = math.sqrt(float(gap @ gap))
        if jacobians is not None:
            row = (gap / far)[None]
            jacobians[0], jacobians[1] = wide(found, i, -row), wide(found, j, row)
        return np.array([far - z[0]])

    return error


def custom_spherical(z: np.ndarray):
    def error(factor: Any, found: Any, jacobians: list[np.ndarray] | None) -> np.ndarray:
        i, j = factor.keys()
        x, y, up = (found.atPoint3(j) - found.atPoint3(i)).tolist()
        flat2 = x * x + y * y
        flat, r2 = math.sqrt(flat2), flat2 + up * up
        r = math.sqrt(r2)
        if jacobians is not None:
            jacobian = np.array(
                [
                    [x / r, y / r, up / r],
                    [-y / flat2, x / flat2, 0.0],
                    [x * up / (flat * r2), y * up / (flat * r2), -flat / r2],
                ]
            )
            jacobians[0], jacobians[1] = -jacobian, jacobian
        return np.array([r - z[0], math.remainder(math.atan2(y, x) - z[1], math.tau), math.atan2(flat, up) - z[2]])

    return error


def custom_relative_pose(z: np.ndarray):
    tz, back = z[:2], z[2:].reshape(2, 2).T
    angle = math.atan2(z[4], z[2])

    def error(factor: Any, found: Any, jacobians: list[np.ndarray] | None) -> np.ndarray:
        i, j = factor.keys()
        a, b = found.atPose2(i), found.atPose2(j)
        between = a.between(b)
        t = between.translation()
        if jacobians is not None:
            first, second = np.zeros((3, 3)), np.zeros((3, 3))
            first[:2, :2], first[:2, 2] = -back, back @ [t[1], -t[0]]
            second[:2, :2] = back @ between.rotation().matrix()
            first[2, 2], second[2, 2] = -1.0, 1.0
            jacobians[0], jacobians[1] = first, second
        return np.append(back @ (t - tz), math.remainder(between.theta() - angle, math.tau))

    return error


def custom_graph(problem: Problem) -> Any:
    """All pairs as CustomFactors, what has one node as GTSAM's own."""
    pairs = [factor.nodes.shape[1] == 2 for factor in problem.factors]
    forms_ = ["" if pair else form for pair, form in zip(pairs, forms(problem), strict=True)]
    graph = native_graph(problem, forms_).graph
    if problem.poses:
        point = lambda found, k: found.atPose2(k).translation()  # noqa: E731
        wide = lambda found, k, row: np.append(row @ found.atPose2(k).rotation().matrix(), [[0.0]], axis=1)  # noqa: E731
    else:
        point, wide = (lambda found, k: found.atPoint3(k)), (lambda found, k, row: row)
    make = {
        "range": lambda z: custom_range(z, point, wide),
        "spherical": custom_spherical,
        "relative_pose": custom_relative_pose,
    }
    for factor in problem.factors:
        if factor.nodes.shape[1] == 2:
            model = gtsam.noiseModel.Diagonal.Sigmas(np.array(factor.std[0]))
            for node, z in zip(factor.nodes.tolist(), factor.z, strict=True):
                graph.add(gtsam.CustomFactor(model, node, make[factor.kind](z)))
    return graph


def ways(problem: Problem) -> dict[str, tuple[Callable[[], Any], Callable[[Any], Any]]]:
    """By name: how to build a graph, and one linear step with what was built."""
    x = initial_guess(problem)
    at = values(problem.space, which_turn(problem), x[0], range(len(problem.names)))
    found: dict[str, tuple[Callable[[], Any], Callable[[Any], Any]]] = {}
    forms_ = forms(problem)
    if not any(isinstance(form, str) for form in forms_):
        found["GTSAM's own"] = (
            lambda: native_graph(problem, forms(problem)).graph,
            lambda graph: graph.linearize(at).optimize(),
        )
    damping = np.zeros((1, len(problem.names), problem.space.dof))
    found["JacobianFactors from NumPy"] = (
        lambda: gtsam_.linear_step(problem),
        lambda step: step(problem.linearise(x), damping),
    )
    found["CustomFactors, Python's loop"] = (
        lambda: custom_graph(problem),
        lambda graph: graph.linearize(at).optimize(),
    )
    return found


def custom_in_gtsam(problem: Problem) -> tuple[float, float]:
    """Milliseconds to build and per iteration, of GTSAM's Levenberg-Marquardt with CustomFactors."""
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-12)
    at = values(problem.space, which_turn(problem), initial_guess(problem)[0], range(len(problem.names)))
    began = time.process_time()
    graph = custom_graph(problem)
    built = time.process_time()
    found = gtsam.LevenbergMarquardtOptimizer(graph, at, params)
    found.optimize()
    ended = time.process_time()
    return 1e3 * (built - began), 1e3 * (ended - built) / found.iterations()


def timed(call: Callable[[], Any]) -> tuple[float, Any]:
    began = time.process_time()
    result = call()
    return 1e3 * (time.process_time() - began), result


def steps_table(problems: dict[str, Problem]) -> list[str]:
    """Milliseconds to build and per linear step, medians of interleaved rounds; ratio of the steps to the first row."""
    lines = ["| problem | factors | build, ms | linear step, ms | ratio |", "|--|--|--|--|--|"]
    for title, problem in problems.items():
        spent: dict[str, list[tuple[float, float]]] = {}
        for _ in range(ROUNDS):
            for way, (build, step) in ways(problem).items():
                building, built = timed(build)
                step(built)
                spent.setdefault(way, []).append((building, timed(partial(step, built))[0]))
            spent.setdefault("CustomFactors, GTSAM's loop", []).append(custom_in_gtsam(problem))
        medians = {way: np.median(times, axis=0) for way, times in spent.items()}
        first = next(iter(medians.values()))[1]
        lines += [f"| {title} | {way} | {b:.2f} | {s:.3f} | {s / first:.1f} |" for way, (b, s) in medians.items()]
    return lines


def solves_table(problems: dict[str, Problem]) -> list[str]:
    """Milliseconds to build and to run a backend, and its iterations."""
    backends = {
        "gauss-newton": gauss_newton.prepare,
        **{o: partial(gtsam_.prepare, optimizer=o) for o in ("elimination", "lm")},
    }
    lines = ["| problem | " + " | ".join(backends) + " |", "|--" * (1 + len(backends)) + "|"]
    for title, problem in problems.items():
        spent: dict[str, list[tuple[float, int]]] = {}
        start = initial_guess(problem)
        for _ in range(ROUNDS):
            for name, prepare in backends.items():
                try:
                    took, ended = timed(lambda prepare=prepare: prepare(problem)(problem, start))  # noqa: B023
                except InputError:  # what GTSAM has no factors for
                    continue
                spent.setdefault(name, []).append((took, int(np.ravel(ended.iterations)[0])))
        cells = [
            f"{np.median([t for t, _ in spent[b]]):.1f} ({spent[b][0][1]})" if b in spent else "-" for b in backends
        ]
        lines.append(f"| {title} | " + " | ".join(cells) + " |")
    return lines


if __name__ == "__main__":
    cases = {
        "star of 10, ranges": star("range"),
        "star of 10, spherical": star("spherical"),
        "2 drives of 20 poses": two_drives(20),
        "2 drives of 200 poses": two_drives(200),
    }
    print("\n".join(steps_table(cases)), "\n")
    print("\n".join(solves_table(cases)))

"""The star that the rows of backends.py solve, what a row is and ours; one star after the other through `solve`."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from classical import KNOWN, NEIGHBOURS, ring
from scipy.optimize import least_squares

from coopoc.optimize import Problem, solve
from coopoc.optimize.model.factor import Factor
from coopoc.world.links import wrap

TOLERANCE = 1e-4
"""m, of the iterated solves of all rows."""


class Row(NamedTuple):
    """One way to do a job: the job, its words, solves per call and the call, whose answer is (solves, n, 3); if it is
    to be the job's answer, and not another one by construction."""

    job: str
    words: str
    solves: int
    call: Callable[[], Any]
    judged: bool = True


class Job(NamedTuple):
    """Rows of one job, the hand-written loop second, and a check of an answer (solves, n, 3)."""

    rows: list[Row]
    right: Callable[[Any], bool]


def stars(runs: int) -> list[Problem]:
    """An ego with ten neighbours around it, a problem for each realisation."""
    recording = ring(NEIGHBOURS, 2, runs)
    return [Problem.from_snapshot(recording, 1, 0, run, KNOWN) for run in range(runs)]


def as_good(problems: list[Problem]) -> Callable[[Any], bool]:
    """Whether x (solves, n, 3) is gauss-newton's of the first problems, cost and position."""
    best = [solve(problem, tolerance=1e-10) for problem in problems]

    def right(x: Any) -> bool:
        each = zip(problems, best, x, strict=False)
        return all(np.abs(at - own.x).max() < 1e-3 and p.cost(at) / own.cost - 1 < 1e-6 for p, own, at in each)

    return right


def ours(problems: list[Problem], backend: str, **options: Any) -> Callable[[], Any]:
    """`solve` of one after the other: status, saddle and free points looked at for each."""
    return lambda: np.stack([solve(problem, backend, **options).x for problem in problems])


COUNT = 20
"""Stars per call."""


def rows_of(problem: Problem) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """x (n, 3) -> whitened residuals (rows,) and Jacobian (rows, 3 n) of fixes, vectors and spherical measurements."""
    fixed = [_prepared(factor) for factor in problem.factors]

    def whitened(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        residuals, jacobians = [], []
        for kind, nodes, z, root in fixed:
            vector = x[nodes[:, -1]] - (x[nodes[:, 0]] if nodes.shape[1] == 2 else 0.0)
            predicted, slope = (spherical if kind == "spherical" else straight)(vector)
            gap = predicted - z
            if kind == "spherical":
                gap[:, 1] = wrap(gap[:, 1])
            residuals.append((root @ gap[..., None]).ravel())
            wide, slope = np.zeros((len(nodes), 3, *x.shape)), root @ slope
            wide[np.arange(len(nodes)), :, nodes[:, -1]] = slope
            if nodes.shape[1] == 2:
                wide[np.arange(len(nodes)), :, nodes[:, 0]] = -slope
            jacobians.append(wide.reshape(-1, x.size))
        return np.concatenate(residuals), np.concatenate(jacobians)

    return whitened


def _prepared(factor: Factor) -> tuple[str, np.ndarray, np.ndarray, np.ndarray]:
    return factor.kind, factor.nodes, factor.z, factor.root


def straight(v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The vector itself."""
    return v.copy(), np.broadcast_to(np.eye(3), (len(v), 3, 3))


def spherical(v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Range, azimuth and inclination of vectors (M, 3), and their derivatives."""
    x, y, z = v.T
    flat, d = np.hypot(x, y), np.linalg.norm(v, axis=1)
    slope = np.zeros((len(v), 3, 3))
    slope[:, 0] = v / d[:, None]
    slope[:, 1, 0], slope[:, 1, 1] = -y / flat**2, x / flat**2
    slope[:, 2, 0], slope[:, 2, 1], slope[:, 2, 2] = x * z / (flat * d**2), y * z / (flat * d**2), -flat / d**2
    return np.stack([d, np.arctan2(y, x), np.arctan2(flat, z)], axis=1), slope


def gauss_newton(problem: Problem) -> np.ndarray:
    """The star's nodes by Gauss-Newton steps from the fixes."""
    whitened, x = rows_of(problem), fixes(problem)
    for _ in range(50):
        r, J = whitened(x)
        dx = np.linalg.solve(J.T @ J, -J.T @ r).reshape(x.shape)
        x = x + dx
        if problem.linear or np.abs(dx).max() < TOLERANCE:
            break
    return x


def scipys(problem: Problem) -> np.ndarray:
    """The same by SciPy."""
    whitened, x = rows_of(problem), fixes(problem)
    flat = [lambda v, k=k: whitened(v.reshape(x.shape))[k] for k in (0, 1)]
    return np.asarray(least_squares(flat[0], x.ravel(), jac=flat[1], xtol=1e-10, ftol=1e-12).x.reshape(x.shape))


def fixes(problem: Problem) -> np.ndarray:
    """(n, 3) where every node's own fix puts it."""
    (factor,) = (f for f in problem.factors if f.kind == "position")
    x = np.empty((len(problem.names), 3))
    x[factor.nodes[:, 0]] = factor.z
    return x


def one_by_one(problems: list[Problem], name: str) -> Job:
    """A star after the other: SciPy, the hand-written loop, ours by backend."""
    parts = problems[:COUNT]

    def each(way: Callable[[Problem], Any]) -> Callable[[], Any]:
        return lambda: np.stack([way(part) for part in parts])

    words = f"solve(), {name}"
    return Job(
        [
            Row(words, "SciPy's least_squares", COUNT, each(scipys)),
            Row(words, "hand-written, x alone", COUNT, each(gauss_newton)),
            Row(words, "ours, gauss-newton", COUNT, ours(parts, "gauss-newton")),
            Row(words, "ours, gtsam", COUNT, ours(parts, "gtsam")),
        ],
        as_good(parts),
    )

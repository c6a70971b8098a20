"""The star that the rows of backends.py solve, what a row is, and ours."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from classical import KNOWN, NEIGHBOURS, SENSORS

import coopoc as co
from coopoc.optimize import Problem, solve, solve_batch

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


def star(runs: int, neighbours: int = NEIGHBOURS) -> Problem:
    """An ego with ten neighbours around it, all realisations at once."""
    around = np.linspace(0, 2 * np.pi, neighbours, endpoint=False)
    gap = np.linspace(12, 25, neighbours)
    offset = np.vstack([np.zeros(3), np.stack([gap * np.cos(around), gap * np.sin(around), 0.05 * gap], axis=1)])
    velocity = np.tile([10.0, 0.0, 0.0], (2, neighbours + 1, 1))
    fleet = co.Fleet(
        tuple(f"v{i}" for i in range(neighbours + 1)),
        [0.0, 0.1],
        np.stack([offset, offset + 0.1 * velocity[0]]),
        velocity,
    )
    recording = co.observe(fleet, SENSORS, co.V2X(max_neighbours=neighbours), runs=runs, observers=[0])
    return Problem.from_snapshot(recording, 1, 0, run=None, noise=KNOWN)


def as_good(problem: Problem) -> Callable[[Any], bool]:
    """Whether x (solves, n, 3) is gauss-newton's, cost and position."""
    best = solve_batch(problem, tolerance=1e-10)
    assert best.converged.all()

    def right(x: Any) -> bool:
        few = np.arange(len(x))
        cost = problem.pick(few).linearise(np.asarray(x)).cost
        return float(np.abs(x - best.x[few]).max()) < 1e-3 and float((cost / best.cost[few] - 1).max()) < 1e-6

    return right


def ours(problem: Problem, backend: str, count: int, **options: Any) -> Callable[[], Any]:
    """`solve_batch` of the first realisations."""
    part = problem.pick(np.arange(count))
    return lambda: solve_batch(part, backend, **options).x


def single(problem: Problem, backend: str, count: int, **options: Any) -> Callable[[], Any]:
    """`solve` of one after the other: status, saddle and free points looked at for each."""
    parts = [problem.pick(k) for k in range(count)]
    return lambda: np.stack([solve(part, backend, **options).x for part in parts])

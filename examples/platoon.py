"""A platoon that knows its road: what a surface, a lane and a top speed are worth beside GNSS, odometry and ranging.

Five vehicles follow each other over hills, z = f(x, y). Over a window of ten steps each has GNSS fixes and odometry and
measures range, azimuth and inclination of the one in front. Three things are known exactly and are constraints:

    lane        -0.8 m <= y <= 0.8 m                 linear: osqp and casadi
    top speed   |p(t + 1) - p(t)| <= 15 m/s dt       casadi
    surface     z = f(x, y), an equality             casadi, with a measurement registered here

Run:  python examples/platoon.py
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from coopoc.arrays import Floats
from coopoc.optimize import MEASUREMENTS, Problem, measurement, solve

VEHICLES, STEPS, DT = 5, 10, 0.5
LANE, TOP_SPEED = 0.8, 15.0
GNSS_STD, ODOMETRY_STD, RANGING_STD = 3.5, 0.3, (0.5, 0.03, 0.03)


def road(x: Any, y: Any, m: Any = np) -> Any:
    """Height of the surface, m: hills of 2 m every 250 m and a cross slope of 3 %."""
    return 2.0 * m.sin(x / 40.0) + 0.03 * y


def height(x: Any, y: Any, z: Any, m: Any = np) -> Sequence[Any]:
    """Height above the surface, m: one formula, which NumPy evaluates and CasADi differentiates twice."""
    return (z - road(x, y, m),)


@dataclass(frozen=True)
class Row:
    """One line of the table: rms error per axis and in all, and the share of solves that ended at a minimum."""

    constraints: str
    backend: str
    error: Floats
    total: float
    solved: float


def drive() -> Floats:
    """(T, N, 3) m, true positions: 20 m apart, close to the top speed, weaving a little inside the lane."""
    t = DT * np.arange(STEPS)[:, None]
    x = 14.8 * t - 20.0 * np.arange(VEHICLES)
    y = 0.6 * np.sin(x / 25.0)
    return np.stack([x, y, road(x, y)], axis=-1)


def window(truth: Floats, seed: int) -> Problem:
    """The measurements of all vehicles and steps; node v@t is vehicle v at step t."""
    rng = np.random.default_rng(seed)
    name = [[f"{v}@{t}" for v in range(VEHICLES)] for t in range(STEPS)]
    steps = [(a, b) for now, then in pairwise(name) for a, b in zip(now, then, strict=True)]
    ahead = [(b, a) for now in name for a, b in pairwise(now)]
    moved = np.diff(truth, axis=0).reshape(-1, 3)
    gap = (truth[:, :-1] - truth[:, 1:]).reshape(-1, 3)
    seen = MEASUREMENTS["spherical"].predict(gap)
    flat = [node for now in name for node in now]
    problem = Problem(tuple(flat))
    problem = problem.add("position", flat, truth.reshape(-1, 3) + GNSS_STD * rng.normal(size=(len(flat), 3)), GNSS_STD)
    problem = problem.add("displacement", steps, moved + ODOMETRY_STD * rng.normal(size=moved.shape), ODOMETRY_STD)
    return problem.add("spherical", ahead, seen + RANGING_STD * rng.normal(size=seen.shape), RANGING_STD)


def lane(problem: Problem) -> Problem:
    """Every vehicle stays in its lane at every step."""
    return problem.constrain("position", problem.names, [-np.inf, -LANE, -np.inf], [np.inf, LANE, np.inf])


def top_speed(problem: Problem) -> Problem:
    """No vehicle is faster than it can be."""
    steps = next(f.nodes for f in problem.factors if f.kind == "displacement")
    return problem.constrain("speed", steps.tolist(), upper=TOP_SPEED, constants=[DT])


def surface(problem: Problem) -> Problem:
    """Every vehicle stands on the road."""
    return problem.constrain("height", problem.names, 0.0, 0.0)


CASES: tuple[tuple[str, str, tuple[Callable[[Problem], Problem], ...]], ...] = (
    ("none", "gauss-newton", ()),
    ("lane", "osqp", (lane,)),
    ("lane", "casadi", (lane,)),
    ("lane, top speed", "casadi", (lane, top_speed)),
    ("lane, top speed, surface", "casadi", (lane, top_speed, surface)),
)


def main(seeds: int = 5) -> list[Row]:
    """Print and return rms errors over a few noise seeds."""
    if "height" not in MEASUREMENTS:
        measurement("height", arity=1, components=("coordinate",))(height)
    truth, rows = drive(), []
    print(f"{'constraints':26}{'backend':14}{'x':>7}{'y':>7}{'z':>7}{'total':>8}   rms error in m over {seeds} seeds")
    for what, backend, add in CASES:
        errors, solved = [], 0
        for seed in range(seeds):
            problem = window(truth, seed)
            for constrain in add:
                problem = constrain(problem)
            solution = solve(problem, backend)
            solved += solution.status.name == "SOLVED"
            errors.append(solution.position - truth.reshape(-1, 3))
        each = np.sqrt(np.mean(np.square(errors), axis=(0, 1)))
        row = Row(what, backend, each, float(np.linalg.norm(each)), solved / seeds)
        print(f"{what:26}{backend:14}{each[0]:7.2f}{each[1]:7.2f}{each[2]:7.2f}{row.total:8.2f}")
        rows.append(row)
    return rows


if __name__ == "__main__":
    main()

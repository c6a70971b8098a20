"""Range-only cooperative localization: is the solution the global optimum? A certificate proves it.

Vehicles and anchors have fixes or not, and the ranges between them, no angles. The cost

    1/2 sum_i |x_i - z_i|^2 / sigma_i^2 + 1/2 sum_e (|x_j - x_i| - r_e)^2 / sigma_r^2

is not convex: a vehicle without a fix may end on the wrong side of its anchors, and Gauss-Newton reports SOLVED there
too. `certify` looks at one eigenvalue, which shows whether any point can be better; where it does not certify, `shor`
solves the semidefinite relaxation, whose value no point can beat, and starts Gauss-Newton from its solution.

Run:  python examples/range_only.py
"""

from dataclasses import dataclass, replace

import numpy as np

from coopoc.optimize import Problem, solve
from coopoc.optimize.convex import certify, shor
from coopoc.optimize.model.problem import Search

ANCHOR_STD, RANGE_STD = 0.3, 0.1


@dataclass(frozen=True)
class Row:
    """One scene: cost from a start without knowledge and its verdict; bound, cost and tightness of the relaxation."""

    blind: float
    certified: bool
    bound: float
    cost: float
    tight: bool


def scene(seed: int, anchors: int = 4, vehicles: int = 2) -> Problem:
    """Surveyed anchors and vehicles without a fix on a square of 40 m; ranges to and between the vehicles."""
    rng = np.random.default_rng(seed)
    truth = rng.uniform(-20, 20, (anchors + vehicles, 2))
    names = [*(f"anchor{i}" for i in range(anchors)), *(f"v{i}" for i in range(vehicles))]
    surveyed = truth[:anchors] + ANCHOR_STD * rng.standard_normal((anchors, 2))
    pairs = [(i, j) for i in range(len(names)) for j in range(max(i + 1, anchors), len(names))]
    ranges = [np.linalg.norm(truth[i] - truth[j]) + RANGE_STD * rng.standard_normal() for i, j in pairs]
    problem = Problem(tuple(names), dimension=2).add("position", names[:anchors], surveyed, ANCHOR_STD)
    return problem.add("range", pairs, np.abs(ranges)[:, None], RANGE_STD)


def judge(problem: Problem, seed: int) -> Row:
    """Gauss-Newton from a random start with its certificate, then the relaxation."""
    start = np.random.default_rng([seed, 1]).uniform(-20, 20, (len(problem.names), 2))
    blind = solve(replace(problem, x0=start, search=Search("blind", x0=start)), throw=False)  # and from nowhere else
    relaxed = shor(problem)
    return Row(blind.cost, certify(problem, blind).certified, relaxed.lower_bound, relaxed.solution.cost, relaxed.tight)


def main(seeds: int = 10) -> list[Row]:
    """Print and return a row per scene."""
    rows = [judge(scene(seed), seed) for seed in range(seeds)]
    print(f"{'scene':>5} {'blind start':>12} {'certified':>10} {'lower bound':>12} {'relaxed':>12} {'tight':>6}")
    for seed, row in enumerate(rows):
        print(f"{seed:5d} {row.blind:12.4f} {row.certified!s:>10} {row.bound:12.6f} {row.cost:12.6f} {row.tight!s:>6}")
    worse = sum(row.blind > row.cost * (1 + 1e-6) for row in rows)
    print(f"{worse} of {len(rows)} blind starts ended in a local minimum; none of them was certified.")
    print(f"{sum(row.tight for row in rows)} relaxations are tight: their point is a certified global optimum.")
    return rows


if __name__ == "__main__":
    main()

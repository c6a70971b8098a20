"""Neighbours that lie about where they are: windows solved with and without graduated non-convexity.

A share of the vehicles broadcasts fixes with a constant offset of 5 to 40 m, either way, on each axis. The problem of
an ego's last five steps (Problem.from_window) either believes all of them, or gives the fixes of each neighbour one
weight and lets graduated non-convexity decide (solve_gnc; Yang et al., RA-L 2020). The egos themselves are honest, and
the same vehicles, moved by the same offsets, are among the spoofed of every larger share.

Run:  python examples/outlier_attack.py
"""

from dataclasses import dataclass

import numpy as np

import coopoc as co
from coopoc.optimize import Problem, solve, solve_gnc
from coopoc.world.spoofing import spoofed

WINDOW = 5


@dataclass(frozen=True)
class Row:
    """Share of the vehicles that are spoofed, and the rms error of both estimates, m."""

    share: float
    least_squares: float
    robust: float


def estimates(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """The ego's newest position (3,) m by least squares, and with a weight for each neighbour's fixes."""
    owners, ego = [name.split("@")[0] for name in problem.names], problem.shown
    fixes = [k for k, owner in enumerate(owners) if owner != owners[ego]]  # of the others
    plain, robust = solve(problem), solve_gnc(problem, [(0, fixes)], groups=[owners[k] for k in fixes])
    return plain.x[ego], robust.x[ego]


def main(steps: int = 12, runs: int = 3, shares: tuple[float, ...] = (0.0, 0.2, 0.4, 0.6)) -> list[Row]:
    """Print and return the rows of a short crop of the drive, with two egos and six neighbours each."""
    fleet = co.load_fleet("town10").between(100, 100 + steps)
    egos = [6, 36]
    clean = co.observe(fleet, co.Sensors.paper_scenario2(), co.V2X(max_neighbours=6), runs=runs, observers=egos)
    rows = []
    print(f"{'spoofed':>9} {'least squares':>15} {'robust':>9}   rms [m]")
    for share in shares:
        seen = spoofed(clean, share, seed=0, honest=egos)
        errors = [
            np.array(estimates(Problem.from_window(seen, t, ego, WINDOW, run))) - fleet.position[t, ego]
            for ego in egos
            for run in range(runs)
            for t in range(WINDOW - 1, steps)
        ]
        rms = np.sqrt(np.square(errors).sum(axis=-1).mean(axis=0))
        rows.append(Row(share, *rms.tolist()))
        print(f"{100 * share:7.0f} % {rms[0]:15.2f} {rms[1]:9.2f}")
    return rows


if __name__ == "__main__":
    main()

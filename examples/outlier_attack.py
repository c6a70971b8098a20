"""Neighbours that lie about where they are: the window estimate with and without graduated non-convexity.

A share of the vehicles broadcasts fixes with a constant offset of 5 to 40 m, either way, on each axis. The window of
the last five steps either believes all of them (least squares), or gives the fixes of each neighbour one weight and
lets graduated non-convexity decide (CooperativeMAP(robust="truncated"), Yang et al., RA-L 2020). The egos themselves
are honest, and the same vehicles, moved by the same offsets, are among the spoofed of every larger share.

Run:  python examples/outlier_attack.py
"""

from __future__ import annotations

from dataclasses import dataclass

import coopoc as co
from coopoc.world.spoofing import spoofed

METHODS = {"least squares": co.CooperativeMAP(window=5), "robust": co.CooperativeMAP(window=5, robust="truncated")}


@dataclass(frozen=True)
class Row:
    """Share of the vehicles that are spoofed, and RT-LE of both estimates, m, averaged over runs and egos."""

    share: float
    least_squares: float
    robust: float


def main(steps: int = 12, runs: int = 3, shares: tuple[float, ...] = (0.0, 0.2, 0.4, 0.6)) -> list[Row]:
    """Print and return the rows of a short crop of the drive, with two egos and six neighbours each."""
    fleet = co.load_fleet("town10").between(100, 100 + steps)
    egos = [6, 36]
    v2x = co.V2X(max_neighbours=6)
    clean = co.observe(fleet, co.Sensors.paper_scenario2(), v2x, runs=runs, seed=0, observers=egos)
    rows = []
    print(f"{'spoofed':>9} {'least squares':>15} {'robust':>9}   RT-LE [m]")
    for share in shares:
        seen = spoofed(clean, share, seed=0, honest=egos)
        errors = [float(co.rt_le(method(seen, egos), fleet).mean()) for method in METHODS.values()]
        rows.append(Row(share, *errors))
        print(f"{100 * share:7.0f} % {rows[-1].least_squares:15.2f} {rows[-1].robust:9.2f}")
    return rows


if __name__ == "__main__":
    main()

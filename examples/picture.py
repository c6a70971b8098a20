"""The picture of the README: a town and one vehicle's star; errors of five egos over time beside their bounds."""

import sys

import numpy as np
from matplotlib.figure import Figure

import coopoc as co
from coopoc.evaluate.pictures import COLORS, INK, PALE, axes, ellipses, pairs

EGO, STEP, EGOS = 24, 100, [0, 12, 24, 36, 48]


def main(out: str = "picture.png") -> None:
    """Write the picture.

    Args:
        out: its file.
    """
    fleet = co.load_fleet("town10").between(0, 400)
    sensors, v2x = co.Sensors.paper_scenario2(), co.V2X(max_neighbours=6)
    seen = co.observe(fleet, sensors, v2x, runs=200, seed=0, observers=EGOS)
    figure = Figure(figsize=(9.0, 3.7), dpi=150, layout="constrained")
    town, error = figure.subplots(1, 2)

    axes(town)
    for k in range(len(fleet.ids)):
        town.plot(*fleet.position[:, k, :2].T, color=PALE, lw=2, zorder=1)
    town.plot(*fleet.position[STEP, :, :2].T, "o", ms=4, color=INK, zorder=3)
    town.plot([], [], "o", ms=4, color=INK, label="vehicles")
    solution = co.solve(co.Problem.from_snapshot(seen, step=STEP, ego=EGO))
    x = solution.position[:, :2]
    ellipses(town, x, solution.covariance[:, :2, :2], COLORS[1], "95 % of one snapshot")
    pairs(town, np.repeat(x[:1], len(x) - 1, axis=0), x[1:], COLORS[1], "measured by the ego")
    town.set_aspect("equal", adjustable="box")
    town.set(xlim=(x[0, 0] - 45, x[0, 0] + 25), ylim=(x[0, 1] - 28, x[0, 1] + 28))
    town.legend(loc="lower left", fontsize=8)

    for color, label, method, links in (
        (COLORS[4], "Kalman filter, alone", co.Kalman("nominal"), None),
        (COLORS[0], "joint filter, six neighbours", co.JointFilter("nominal"), v2x),
    ):
        off = method(seen, egos=EGOS).x - fleet.position[:, EGOS]
        error.plot(fleet.t, np.sqrt((off**2).sum(axis=-1).mean(axis=(0, 2))), color=color, lw=1.4, label=label)
        bounds = [np.trace(co.posterior_bound(fleet, sensors, ego, links), axis1=1, axis2=2) for ego in EGOS]
        error.plot(fleet.t, np.sqrt(np.mean(bounds, axis=0)), "--", color=INK, lw=1.0)
    error.plot([], [], "--", color=INK, lw=1.0, label="their Cramér-Rao bounds")
    error.set(xlabel="Time [s]", ylabel="RMS error of five egos [m]", ylim=(0, 3))
    error.legend(fontsize=8, frameon=False)
    error.grid(True, color="#EDF0F4")
    figure.savefig(out)


if __name__ == "__main__":
    main(*sys.argv[1:])

"""Vehicles of a log: a map of true and estimated paths, and the error of each over time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from coopoc.arrays import Floats
from coopoc.escapes import picture
from coopoc.study.numbers import present

from . import lineup, scene

if TYPE_CHECKING:
    from coopoc import Results
    from coopoc.study.plot import Plot

DRAWN = ("gnss", "kalman", "joint", "cooperative-filter")
"""Methods that are drawn, those of them that were run."""
MAP = "Paths of the vehicles; the truth is grey."
HELD = "GNSS repeats a fix until the next one, and errs by the way driven since."


def views(results: Results, over_time: bool) -> Plot | None:
    """Paths seen from above, or the distance of each vehicle from its truth over time; None if all is simulated."""
    from coopoc.study.plot import Plot, canvas, legend, plain_log, strokes

    data, methods = str(results.settings["data"]), [name for name in DRAWN if present(results, {"method": name}, "run")]
    truth = scene.fleet(data)
    if not methods or not scene.is_real(data) or (over_time and not truth.present.any()):
        return None
    egos = scene.egos(results.settings)
    rows, height = (len(egos), 0.8 + 1.5 * len(egos)) if over_time else (1, 4.0)
    with canvas(rows, width=7.2, height=height, sharex=True, sharey=True, squeeze=False) as (figure, grid):
        for ego, axes in zip(egos, grid[:, 0] if over_time else [grid[0, 0]] * len(egos), strict=True):
            known = truth.position[:, truth.index(ego)]
            if not over_time:
                axes.plot(*known[:, :2].T, color="#C3CBD6", linewidth=4, label="_truth", zorder=1)
            for name in methods:
                t, x = _path(results, name, ego)
                gap = np.linalg.norm(x - known[np.searchsorted(truth.t, t - truth.dt / 2)], axis=1)
                marks = {"marker": ".", "linestyle": "none"} if name == "gnss" and not over_time else {"marker": ""}
                style = {**strokes({"method": name}), "linewidth": 1.1, "markersize": 2, **marks}
                axes.plot(*((t, gap) if over_time else x[:, :2].T), **style)
            where = {"xy": (0.01, 0.9), "xycoords": "axes fraction"} if over_time else {"xy": x[-1, :2]}
            axes.annotate(picture(ego), **where)
            axes.set(ylabel="Error [m]" if over_time else "North [m]")
        axes.set(xlabel="Time [s]" if over_time else "East [m]")
        legend(grid[0, 0], [{"method": name} for name in methods])
        if over_time:
            plain_log(grid[0, 0].yaxis)
        else:
            grid[0, 0].set_aspect("equal", adjustable="datalim")
    what = f"Distance from the truth over time. {HELD * ('gnss' in methods)}" if over_time else MAP
    most = results.frame["max_neighbours"].max()
    return Plot(figure, scene.caption(results, f"{what.strip()} Filters with K = {most}."))


def _path(results: Results, name: str, ego: str) -> tuple[Floats, Floats]:
    """Times s and positions m in the first run, at the largest K; NaN where the vehicle is away."""
    rows = results.select(method=name).sort_values("max_neighbours")
    p = {**results.settings, **rows.iloc[-1][list(results.axes)], "egos": ego}
    _, t, x = next(lineup.tracks(p))
    breaks = np.flatnonzero(np.diff(t) > 1.5 * np.median(np.diff(t))) + 1
    return np.insert(t, breaks, t[breaks]), np.insert(x, breaks, np.nan, axis=0)

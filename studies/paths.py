"""Vehicles of a log: a map of true and estimated paths, and the error of each over time."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from coopoc.arrays import Floats
from coopoc.escapes import picture

from . import lineup, scene

if TYPE_CHECKING:
    from coopoc.study.plot import Plot
    from coopoc.study.results import Results

DRAWN = ("gnss", "kalman", "joint", "cooperative-filter")
"""Methods whose paths are drawn, those that were run; others where none of them was."""
OUTAGE = 3.0
"""Gap between two fixes, in multiples of the usual one, from which on it is an outage."""


def plan(results: Results) -> Plot | None:
    """True and estimated paths of a log's vehicles, seen from above."""
    from coopoc.study.plot import Plot, canvas, legend, strokes

    if not _shown(results):
        return None
    truth = scene.fleet(results.settings["data"])
    drawn = {ego: list(_paths(results, ego)) for ego in _egos(results)}
    every = np.concatenate([x[:, :2] for paths in drawn.values() for _, _, x in paths])
    east, north = np.nanmax(every, axis=0) - np.nanmin(every, axis=0)
    with canvas(width=7.2, height=float(np.clip(5.0 * north / (east + 1e-9), 1.2, 5.0)) + 0.8) as (figure, axes):
        for ego, paths in drawn.items():
            axes.plot(
                *truth.position[:, truth.index(ego), :2].T, color="#C3CBD6", linewidth=4, label="_truth", zorder=1
            )
            for name, _, x in paths:
                marks = {"marker": ".", "linestyle": "none", "markersize": 2} if name == "gnss" else {"marker": ""}
                axes.plot(*x[:, :2].T, **{**strokes({"method": name}), "linewidth": 1.1, **marks})
            axes.annotate(picture(ego), x[0, :2], xytext=(4, 4), textcoords="offset points", fontsize=8)
        axes.set_aspect("equal", adjustable="datalim")
        axes.set(xlabel="East [m]", ylabel="North [m]")
        legend(axes, [{"method": name} for name in _shown(results)])
    known = "the truth is grey" if truth.present.any() else "there is no truth"
    return Plot(figure, scene.caption(results, f"Paths of the vehicles with K = {_most(results)}; {known}."))


def errors(results: Results) -> Plot | None:
    """Distance of each vehicle's estimates from its truth over time, a panel each."""
    from coopoc.study.plot import Plot, canvas, legend, plain_log, strokes

    truth, outages = scene.fleet(results.settings["data"]), False
    egos = [ego for ego in _egos(results) if truth.present[:, truth.index(ego)].any()] if _shown(results) else []
    if not egos:
        return None
    gaps = list[Floats]()
    size = {"width": 7.2, "height": 0.8 + 1.5 * len(egos)}
    with canvas(len(egos), sharex=True, sharey=True, squeeze=False, **size) as (figure, grid):
        for ego, axes in zip(egos, grid[:, 0], strict=True):
            for name, t, x in _paths(results, ego):
                at = np.searchsorted(truth.t, t - truth.dt / 2)
                gap = np.linalg.norm(x - truth.position[at, truth.index(ego)], axis=1)
                gaps.append(gap)
                axes.plot(t, gap, **{**strokes({"method": name}), "marker": "", "linewidth": 1.1})
            for start, stop in _outages(results, ego):
                axes.axvspan(start, stop, color="#E9ECEF", linewidth=0, zorder=0)
                outages = True
            plain_log(axes.yaxis)
            axes.set_ylim(bottom=np.nanquantile(np.concatenate(gaps), 0.01))
            axes.set(title=picture(ego), ylabel="Error [m]")
        axes.set(xlabel="Time [s]")
        legend(grid[0, 0], [{"method": name} for name in _shown(results)])
    text = f"Distance from the truth over time with K = {_most(results)}."
    text += " Grey: no fix arrives, and GNSS repeats the last one." if outages else ""
    return Plot(figure, scene.caption(results, text))


def _egos(results: Results) -> tuple[str, ...]:
    return scene.egos(str(results.settings["data"]), str(results.settings["egos"]))


def _most(results: Results) -> int:
    return int(results.frame["max_neighbours"].max())


def _shown(results: Results) -> list[str]:
    """Methods that are drawn: none for simulated measurements, whose errors the tables have."""
    if "method" not in results.frame or not scene.is_real(str(results.settings["data"])):
        return []
    ran = [str(name) for name in results.frame["method"].unique() if name != "bound"]
    return [name for name in ran if name in DRAWN] or ran[:4]


def _paths(results: Results, ego: str) -> Iterator[tuple[str, Floats, Floats]]:
    """Method, times s and positions m of a vehicle in the first run, at the largest K; NaN where it is away."""
    for name in _shown(results):
        rows = results.select(method=name)
        first = rows[rows["max_neighbours"] == rows["max_neighbours"].max()].iloc[0]
        p: dict[str, Any] = {**results.settings, **{axis: first[axis] for axis in results.axes}, "egos": ego}
        _, t, x, _ = next(lineup.tracks(p))
        breaks = np.flatnonzero(np.diff(t) > 1.5 * np.median(np.diff(t))) + 1
        yield name, np.insert(t, breaks, t[breaks]), np.insert(x, breaks, np.nan, axis=0)


def _outages(results: Results, ego: str) -> Iterator[tuple[float, float]]:
    """Begin and end s of the times without a fix."""
    seen = scene.measured(str(results.settings["data"]))
    assert seen is not None
    t = seen.t[np.isfinite(seen.gnss[0, :, seen.ids.index(ego), 0])]
    gaps = np.diff(t)
    for k in np.flatnonzero(gaps > OUTAGE * np.median(gaps)) if len(gaps) else ():
        yield float(t[k]), float(t[k + 1])

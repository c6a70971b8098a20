"""Plots of data: paths and speeds of a fleet, innovations against the assumed Gaussian."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from scipy import stats

from ..arrays import AnyArray, Floats, robust_std
from ..errors import InputError
from ..escapes import picture
from ..world.fleet import Fleet
from .plot import Plot, canvas
from .style import NEUTRAL


def paths(fleet: Fleet, caption: str = "") -> Plot:
    """Plot the path (colour: speed) and the speed over time of each vehicle of a fleet, one column per vehicle.

    Args:
        fleet: at most six vehicles.
        caption: under the figure.

    Raises:
        InputError: more than six vehicles.
    """
    count = len(fleet.ids)
    if count > 6:
        raise InputError("fleet", f"{count} vehicles", "must be at most 6", "Pick some with fleet.select([...]).")
    speed = np.linalg.norm(fleet.velocity, axis=2)
    top = float(np.nanmax(speed))
    with canvas(
        2, count, width=max(1.9 * count, 3.0), height=3.7, squeeze=False, gridspec_kw={"height_ratios": [1.5, 1.0]}
    ) as (figure, axes):
        for n, name in enumerate(fleet.ids):
            shade = _path(axes[0, n], fleet.position[:, n, :2], speed[:, n], top)
            axes[0, n].set(title=picture(name), xlabel="East [m]")
            axes[1, n].plot(fleet.t - fleet.t[0], speed[:, n], color="#333333", linewidth=1.0)
            axes[1, n].set(xlabel="Time [s]", ylim=(0, 1.05 * top))
        axes[0, 0].set_ylabel("North [m]")
        axes[1, 0].set_ylabel("Speed [m/s]")
        figure.colorbar(shade, ax=axes[0].tolist(), label="Speed [m/s]", aspect=14, pad=0.01)
    return Plot(figure, caption or f"Paths and speeds of {fleet.name or 'the vehicles'}; a dot marks each start.")


def innovations(samples: Mapping[str, tuple[AnyArray, float, str]], caption: str = "") -> Plot:
    """Plot a histogram of each measurement's innovations against the Gaussian of its assumed standard deviation.

    Args:
        samples: name -> (innovations of any shape, assumed standard deviation, unit). NaN is no measurement.
        caption: under the figure.
    """
    with canvas(1, len(samples), width=3.3 * len(samples), height=2.9, squeeze=False) as (figure, axes):
        for panel, (name, (values, sigma, unit)) in zip(axes[0], samples.items(), strict=True):
            _histogram(panel, np.asarray(values, dtype=float).ravel(), sigma, unit)
            panel.set(title=picture(name), xlabel=f"Innovation [{unit}]")
        axes[0, 0].set_ylabel("Density")
    return Plot(figure, caption or "Innovations (bars) against the Gaussian that is assumed (line).")


def _path(axes: Axes, xy: Floats, speed: Floats, top: float) -> LineCollection:
    every = slice(None, None, max(1, len(xy) // 600))
    xy, speed = xy[every], speed[every]
    segments = np.stack([xy[:-1], xy[1:]], axis=1)
    path = LineCollection(list(segments), cmap="viridis", norm=Normalize(0.0, top), linewidths=1.8)
    path.set_array(speed[1:])
    axes.add_collection(path)
    axes.plot(*xy[0], "o", color="black", markersize=3.5)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.08)
    return path


def _histogram(axes: Axes, values: Floats, sigma: float, unit: str) -> None:
    values = values[np.isfinite(values)]
    reach = 5 * sigma
    inside = np.abs(values) <= reach
    axes.hist(
        values[inside],
        bins=61,
        range=(-reach, reach),
        color=NEUTRAL,
        weights=np.full(inside.sum(), 61 / (2 * reach * len(values))),
    )
    grid = np.linspace(-reach, reach, 301)
    axes.plot(grid, stats.norm.pdf(grid, scale=sigma), color="black")
    axes.set_ylim(top=1.4 * axes.get_ylim()[1])
    middle, robust = np.median(values), robust_std(values)
    axes.text(
        0.98,
        0.98,
        f"assumed σ {sigma:.3g} {unit}, rms {np.sqrt(np.mean(values**2)):.3g} {unit}\n"
        f"median {middle:.2g}, MAD σ {robust:.3g} {unit}\n"
        f"beyond 5σ {100 * (1 - inside.mean()):.1f} %, n {len(values)}",
        transform=axes.transAxes,
        ha="right",
        va="top",
        fontsize=6.5,
    )

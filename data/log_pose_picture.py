"""The picture of a log in body frames: where everything drove, when what was measured, how well headings are known."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from coopoc.escapes import picture
from coopoc.evaluate.metrics import heading_error
from coopoc.methods.track import Track
from coopoc.pictures import COLORS, INK

from .log import Log
from .log_picture import STYLE, times
from .log_poses import PoseCheck

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def draw_poses(found: PoseCheck, path: Path) -> Path:
    """Write the picture of a log in body frames as PNG (or what the ending says): paths, times, headings.

    Args:
        found: its `check_poses`.
        path: of the picture.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.style import context

    log = found.log
    with context(STYLE):
        figure = Figure(figsize=(11.5, 8.2), dpi=150, layout="constrained")
        FigureCanvasAgg(figure)
        grid = figure.subplot_mosaic([["map", "map"], ["times", "heading"]], height_ratios=[1.4, 1])
        _map(grid["map"], log, found.track)
        times(grid["times"], log.recording)
        _headings(grid["heading"], log, found.track)
        figure.savefig(path)
    return path


def _map(axes: Axes, log: Log, track: Track) -> None:
    rec = log.recording
    for column in rec.landmarks:
        axes.plot(*rec.gnss[0, 0, column, :2], "^", color="#5B6470", ms=8, mec="white")
    for k, column in enumerate(track.egos):
        color = COLORS[k % len(COLORS)]
        axes.plot(*rec.gnss[0, :, column, :2].T, ".", color=color, ms=3.2, alpha=0.4, mew=0, rasterized=True)
        axes.plot(*track.x[0, :, k, :2].T, color=color, lw=1.6, label=picture(rec.ids[column]))
        if log.truth is not None:
            axes.plot(*log.truth.position[:, column, :2].T, color=INK, lw=0.7, ls=(0, (4, 2)))
    axes.set_aspect("equal", "datalim")
    extra = ", truth dashed" if log.truth is not None else ""
    axes.set_title(f"{log.summary.name}: fixes (dots), landmarks (triangles), the fleet's pose filter (lines){extra}")
    axes.set_xlabel("east [m]")
    axes.set_ylabel("north [m]")
    axes.legend(loc="best", handlelength=1.2)


def _headings(axes: Axes, log: Log, track: Track) -> None:
    assert track.heading_covariance is not None
    t = track.t - track.t[0]
    for k in range(len(track.egos)):
        std = np.rad2deg(np.sqrt(track.heading_covariance[0, :, k, 3]))
        axes.plot(t, std, color=COLORS[k % len(COLORS)], lw=1.4)
        if log.truth is not None and log.truth.heading is not None:
            off = np.rad2deg(np.abs(heading_error(track, log.truth)[0, :, k]))
            axes.plot(t, off, ".", color=COLORS[k % len(COLORS)], ms=2, alpha=0.5, mew=0, rasterized=True)
    axes.set_yscale("log")
    axes.set_ylim(bottom=0.1 * np.rad2deg(np.sqrt(np.nanmin(track.heading_covariance[0, :, :, 3]))))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set_xlabel("time [s]")
    axes.set_ylabel("heading [deg]")
    axes.set_title("Standard deviation of the heading (lines), errors (dots)")

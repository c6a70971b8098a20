"""Plot of a log: fixes, a filter of each vehicle, what stands, and the truth; below it when each vehicle has fixes."""

from __future__ import annotations

from pathlib import Path
from textwrap import fill

import numpy as np
from matplotlib.figure import Figure

from coopoc.escapes import picture
from coopoc.plots import plot_recording
from coopoc.world.pictures import COLORS, INK, axes

from .residuals import Check

LONG, NAMED = 5.0, 30
"""Extent of a drive, in multiples of its width, above which the axes have two scales, so that lanes are apart; rows
that have their names."""


def draw(result: Check, path: Path) -> Path:
    """Write the picture of a log as PNG (or what the ending says).

    Args:
        result: of `check`.
        path: of the picture.
    """
    drawn(result).savefig(path)
    return path


def drawn(result: Check) -> Figure:
    """The picture of a log: the plane above, the times of fixes below."""
    rec, truth = result.log.recording, result.log.truth
    moving = [rec.ids.index(row["vehicle"]) for row in result.vehicles]
    rows = 0.5 + 0.14 * min(len(moving), NAMED)
    figure = Figure(figsize=(6.4, 5.2 + rows), dpi=150, layout="constrained")
    ax, when = figure.subplots(2, 1, height_ratios=(5.2, rows))
    plot_recording(rec, axes(ax), step=0)
    for k in moving:
        color = COLORS[k % len(COLORS)]
        ax.plot(*result.x[:, k, :2].T, color=color, lw=0.8)
        if truth is not None:
            ax.plot(*truth.position[:, k, :2].T, color=INK, lw=1, ls="--")
        there = np.isfinite(rec.gnss[0, :, k]).any(axis=-1)
        when.plot(rec.t[there], np.full(there.sum(), moving.index(k)), "|", ms=5, mew=0.6, color=color)
    ax.plot(*np.delete(rec.gnss[0, 0, :, :2], moving, axis=0).T, "^", color=INK, ms=8)
    extent = np.nanmax(result.x[:, moving, :2], axis=(0, 1)) - np.nanmin(result.x[:, moving, :2], axis=(0, 1))
    if extent.max() > LONG * extent.min():
        ax.set_aspect("auto")
        ax.set_xlabel("East [m], on a scale of its own")
    figure.suptitle(fill(picture(result.log.summary.name), 70), fontsize=10)
    ax.set_title(
        "Fixes (points; circles: the first), filters (lines), what stands (triangles), truth (dashed)", fontsize=8
    )
    when.set(xlabel="Time [s]", ylim=(len(moving) - 0.5, -0.5), xlim=(rec.t[0], rec.t[-1]))
    when.set_title("When there are fixes", fontsize=9)
    names = [picture(rec.ids[k]) for k in moving]
    when.set_yticks(
        range(len(moving)) if len(moving) <= NAMED else [], names if len(moving) <= NAMED else [], fontsize=7
    )
    if len(moving) <= NAMED and (legend := ax.get_legend()):
        legend.remove()  # the rows below name the colours
    return figure

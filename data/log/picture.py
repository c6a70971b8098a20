"""Plot of a log: fixes, a filter of each vehicle, what stands, and the truth."""

from pathlib import Path
from textwrap import fill

import numpy as np
from matplotlib.figure import Figure

from coopoc import plot_recording
from coopoc.evaluate.pictures import COLORS, INK, axes
from coopoc.text import picture

from .residuals import Check

LONG_EXTENT = 5.0
"""Extent of a drive, in multiples of its width, above which the axes have two scales, so that lanes are apart."""


def draw(result: Check, path: Path) -> Figure:
    """Write the picture of a log as PNG (or what the ending says).

    Args:
        result: of `check`.
        path: of the picture.
    """
    rec, truth = result.log.recording, result.log.truth
    moving = [rec.ids.index(row["vehicle"]) for row in result.vehicles]
    figure = Figure(figsize=(6.4, 5.2), dpi=150, layout="constrained")
    ax = plot_recording(rec, axes(figure.subplots()), step=0)
    for k in moving:
        color = COLORS[k % len(COLORS)]
        ax.plot(*result.x[:, k, :2].T, color=color, lw=0.8)
        if truth is not None:
            ax.plot(*truth.position[:, k, :2].T, color=INK, lw=1, ls="--")
    ax.plot(*np.delete(rec.gnss[0, 0, :, :2], moving, axis=0).T, "^", color=INK, ms=8)
    x, y = np.ptp(ax.dataLim.get_points(), axis=0)
    if max(x, y) > LONG_EXTENT * min(x, y):
        ax.set(aspect="auto", xlabel="East [m], on a scale of its own")
    words = "fixes (points; circles: the first), filters (lines), what stands (triangles), truth (dashed)"
    figure.suptitle(fill(f"{picture(result.log.summary.name)}: {words}", 72), fontsize=9)
    figure.savefig(path)
    return figure

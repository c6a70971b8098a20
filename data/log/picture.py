"""Plot of a log: fixes, a filter of each vehicle, what stands, and the truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from coopoc.escapes import picture
from coopoc.plots import plot_recording
from coopoc.world.pictures import COLORS, INK, finish

from .residuals import Check


def draw(result: Check, path: Path) -> Path:
    """Write the picture of a log as PNG (or what the ending says).

    Args:
        result: of `check`.
        path: of the picture.
    """
    rec, truth = result.log.recording, result.log.truth
    ax = plot_recording(rec, step=0)
    moving = [rec.ids.index(row["vehicle"]) for row in result.vehicles]
    for k in moving:
        ax.plot(*result.x[:, k, :2].T, color=COLORS[k % len(COLORS)], lw=1)
        if truth is not None:
            ax.plot(*truth.position[:, k, :2].T, color=INK, lw=1, ls="--")
    ax.plot(*np.delete(rec.gnss[0, 0, :, :2], moving, axis=0).T, "^", color=INK, ms=8)
    ax.set_title(f"{picture(result.log.summary.name)}: fixes, filters (lines), what stands (triangles), truth (dashed)")
    finish(ax).figure.savefig(path)  # type: ignore[union-attr]
    return path

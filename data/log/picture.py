"""Plot of a log: paths, and the histogram of normalised innovations beside chi-squared."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from coopoc.escapes import picture
from coopoc.evaluate.metrics import dimensions
from coopoc.world.pictures import COLORS, INK

from .check import Check

GREY = "#5B6470"
DASHED: dict[str, Any] = {"color": INK, "lw": 1.0, "ls": (0, (4, 2))}


def draw(result: Check, path: Path) -> Path:
    """Write the picture of a log as PNG (or what the ending says).

    Args:
        result: of `check`.
        path: of the picture.
    """
    from matplotlib.figure import Figure
    from scipy.stats import chi2

    figure = Figure(figsize=(11.5, 8.2), dpi=150, layout="constrained")
    places, squares = figure.subplots(2, height_ratios=[1.6, 1])
    rec, truth = result.log.recording, result.log.truth
    size, line = dimensions(rec), np.linspace(0, 14, 200)
    members = f"{len(rec.ids)} members, {rec.t[-1] - rec.t[0]:.0f} s in steps of {rec.dt:g} s"
    figure.suptitle(f"{picture(result.log.summary.name)}   ·   {members}")
    moving = [rec.ids.index(row["vehicle"]) for row in result.vehicles]
    for k in moving:
        color, name = COLORS[k % len(COLORS)], picture(rec.ids[k])
        places.plot(*rec.gnss[0, :, k, :2].T, ".", color=color, ms=3, alpha=0.4, rasterized=True)
        places.plot(*result.x[:, k, :2].T, color=color, label=name)
        if truth is not None:
            places.plot(*truth.position[:, k, :2].T, **DASHED)
        values = size * result.normalised[np.isfinite(result.normalised[:, k]), k]
        if len(values) > 1:
            bars: dict[str, Any] = {"bins": 35, "range": (0, 14), "density": True, "histtype": "step"}
            squares.hist(values.clip(0, 14), color=color, label=f"{name}: mean {values.mean():.3g}", **bars)
    places.plot(*np.delete(rec.gnss[0, 0, :, :2], moving, axis=0).T, "^", color=GREY, ms=8)
    places.set_aspect("equal", "datalim")
    title = "Fixes (dots), what stands (triangles), a filter of each vehicle (lines), truth (dashed)"
    places.set(title=title, xlabel="east [m]", ylabel="north [m]")
    if 0 < len(moving) <= 12:
        places.legend(ncols=2)
    squares.plot(line, chi2(size).pdf(line), label=f"$\\chi^2_{size}$: mean {size}", **DASHED)
    squares.set(ylim=(0, 0.6), title="Normalised innovations of the fixes", xlabel=r"$d^\top S^{-1} d$")
    squares.legend(loc="upper right")
    figure.savefig(path)
    return path

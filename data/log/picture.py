"""The picture of a log: where everything drove, when what was measured, and how innovations compare with theory."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from coopoc.escapes import picture
from coopoc.evaluate.metrics import dimensions
from coopoc.pictures import COLORS, INK

from .check import Check

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PALE, GREY, LIGHT = "#D8DEE6", "#5B6470", "#9DB0C3"
DASHED: dict[str, Any] = {"color": INK, "lw": 1.0, "ls": (0, (4, 2))}


def draw(found: Check, path: Path) -> Path:
    """Write the picture of a log as PNG (or what the ending says).

    Args:
        found: its `check`.
        path: of the picture.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.5, 8.2), dpi=150, layout="constrained")
    axes = figure.subplot_mosaic([["map", "map"], ["time", "fixes"]], height_ratios=[1.4, 1])
    rec = found.log.recording
    members = f"{len(rec.ids)} members, {rec.t[-1] - rec.t[0]:.0f} s in steps of {rec.dt:g} s"
    figure.suptitle(f"{picture(found.log.summary.name)}   ·   {members}")
    moving = {row["vehicle"] for row in found.vehicles}
    drives = [(k, picture(name), COLORS[k % len(COLORS)]) for k, name in enumerate(rec.ids) if name in moving]
    _map(axes["map"], found, drives)
    _times(axes["time"], found)
    innovations(axes["fixes"], found, drives)
    figure.savefig(path)
    return path


def _map(axes: Axes, found: Check, drives: list[tuple[int, str, str]]) -> None:
    rec, truth = found.log.recording, found.log.truth
    for k, name, color in drives:
        axes.plot(*rec.gnss[0, :, k, :2].T, ".", color=color, ms=3, alpha=0.4, rasterized=True)
        axes.plot(*found.x[:, k, :2].T, color=color, label=name)
        if truth is not None:
            axes.plot(*truth.position[:, k, :2].T, **DASHED)
    stands = sorted(set(range(len(rec.ids))) - {k for k, _, _ in drives})
    axes.plot(*rec.gnss[0, 0, stands, :2].T, "^", color=GREY, ms=8)
    axes.set_aspect("equal", "datalim")
    title = "Fixes (dots), what stands (triangles), a filter of each vehicle (lines), truth (dashed)"
    axes.set(title=title, xlabel="east [m]", ylabel="north [m]")
    if 0 < len(drives) <= 12:
        axes.legend(ncols=2)


def _times(axes: Axes, found: Check) -> None:
    """When each member was there, had a fix, measured another and received a message."""
    rec, links = found.log.recording, found.log.recording.links
    t, measured = rec.t - rec.t[0], np.isfinite(rec.relative[0]).any(axis=1)
    for k in range(len(rec.ids)):
        axes.plot(t, np.where(np.isfinite(rec.velocity[0, :, k, 0]), k, np.nan), color=PALE, lw=12)
        mine = links.observer == k
        seen, heard = links.step[mine & measured], links.step[mine & (rec.arrival[0] >= 0)]
        events = [t[np.isfinite(rec.gnss[0, :, k, 0])], t[np.unique(seen)], t[np.unique(heard)]]
        colors, offsets = [COLORS[k % len(COLORS)], GREY, LIGHT], [k - 0.2, k, k + 0.2]
        axes.eventplot(events, lineoffsets=offsets, linelengths=0.18, linewidths=0.6, colors=colors)
    axes.set_yticks(range(len(rec.ids)), [picture(name) for name in rec.ids])
    axes.invert_yaxis()
    axes.set(title="There (bar); from above: fixes, relative measurements, messages", xlabel="time [s]")


def innovations(axes: Axes, found: Check, drives: list[tuple[int, str, str]]) -> None:
    """Normalised innovations of the fixes beside their chi-squared distribution."""
    from scipy.stats import chi2

    size, line = dimensions(found.log.recording), np.linspace(0, 14, 200)
    for k, name, color in drives:
        each = size * found.normalised[np.isfinite(found.normalised[:, k]), k]
        if len(each) > 1:
            label = f"{name}: mean {each.mean():.3g}"
            bars: dict[str, Any] = {"bins": 35, "range": (0, 14), "density": True, "histtype": "step"}
            axes.hist(each.clip(0, 14), color=color, label=label, **bars)
    if not axes.get_legend_handles_labels()[1]:
        axes.text(7, 0.2, "no vehicle has a fix after its first", ha="center")
    axes.plot(line, chi2(size).pdf(line), label=f"$\\chi^2_{size}$: mean {size}", **DASHED)
    axes.set(ylim=(0, 0.6), title="Normalised innovations of the fixes", xlabel=r"$d^\top S^{-1} d$", ylabel="density")
    axes.legend(loc="upper right")

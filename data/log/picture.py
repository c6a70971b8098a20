"""The picture of a log: where everything drove, when what was measured, and how innovations compare with theory."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from coopoc.escapes import picture
from coopoc.evaluate.innovations import dimensions
from coopoc.pictures import COLORS, INK

from .check import UNITS, Check

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PALE, GREY, LIGHT = "#D8DEE6", "#5B6470", "#9DB0C3"
DASHED = {"color": INK, "lw": 1.8, "ls": (0, (4, 2))}
STYLE: dict[str, Any] = {
    "font.size": 9.5,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#EDF0F4",
    "axes.axisbelow": True,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
}


def draw(found: Check, path: Path) -> Path:
    """Write the picture of a log as PNG (or what the ending says).

    Args:
        found: its `check`.
        path: of the picture.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.style import context

    with context(STYLE):
        figure = Figure(figsize=(11.5, 8.2), dpi=150, layout="constrained")
        FigureCanvasAgg(figure)
        grid = figure.subplot_mosaic([["map", "fixes"], ["time", "relative"]], width_ratios=[1.25, 1])
        rec = found.log.recording
        members = f"{len(rec.ids)} members, {rec.t[-1] - rec.t[0]:.0f} s in steps of {rec.dt:g} s"
        figure.suptitle(f"{picture(found.log.summary.name)}   ·   {members}", fontsize=12.5)
        _map(grid["map"], found)
        _times(grid["time"], found)
        innovations(grid["fixes"], found)
        _relative(grid["relative"], found)
        figure.savefig(path)
    return path


def _drives(found: Check) -> list[tuple[int, str, str]]:
    """Column, name and colour of those that move."""
    rows = {row["vehicle"] for row in found.vehicles}
    ids = enumerate(found.log.recording.ids)
    return [(k, picture(name), COLORS[k % len(COLORS)]) for k, name in ids if name in rows]


def _map(axes: Axes, found: Check) -> None:
    rec, truth, drives = found.log.recording, found.log.truth, _drives(found)
    for k, name, color in drives:
        axes.plot(*rec.gnss[0, :, k, :2].T, ".", color=color, ms=3.2, alpha=0.4, mew=0, rasterized=True)
        axes.plot(*found.x[:, k, :2].T, color=color, lw=1.6, label=name)
        if truth is not None:
            axes.plot(*truth.position[:, k, :2].T, **{**DASHED, "lw": 0.7})
    stands = sorted(set(range(len(rec.ids))) - {k for k, _, _ in drives})
    axes.plot(*rec.gnss[0, 0, stands, :2].T, "^", color=GREY, ms=8, mec="white")
    axes.set_aspect("equal", "datalim")
    extra = "" if truth is None else ", truth dashed"
    axes.set(title=f"Fixes (dots), what stands (triangles), a filter (lines){extra}", xlabel="east [m]")
    axes.set_ylabel("north [m]")
    if 0 < len(drives) <= 12:
        axes.legend(loc="best", ncols=2 if len(drives) > 6 else 1, handlelength=1.2)


def _times(axes: Axes, found: Check) -> None:
    """When each member was there, had a fix, measured another and received a message."""
    rec = found.log.recording
    t, links = rec.t - rec.t[0], rec.links
    measured = np.isfinite(rec.relative[0]).any(axis=1)
    for k in range(len(rec.ids)):
        there = np.isfinite(rec.velocity[0, :, k, 0]).astype(int)
        edges = np.flatnonzero(np.diff(there, prepend=0, append=0)).reshape(-1, 2)
        spans = [(t[a], t[min(b, len(t) - 1)] - t[a]) for a, b in edges]
        axes.broken_barh(spans, (k - 0.36, 0.72), facecolors=PALE, lw=0)
        mine = links.observer == k
        for times, offset, color in (
            (t[np.isfinite(rec.gnss[0, :, k, 0])], -0.21, COLORS[k % len(COLORS)]),
            (np.unique(t[links.step[mine & measured]]), 0.0, GREY),
            (np.unique(t[links.step[mine & (rec.arrival[0] >= 0)]]), 0.21, LIGHT),
        ):
            axes.vlines(times, k + offset - 0.09, k + offset + 0.09, color=color, lw=0.6, rasterized=True)
    axes.set_yticks(range(len(rec.ids)), [picture(name) for name in rec.ids])
    axes.set_ylim(len(rec.ids) - 0.4, -0.6)
    axes.grid(axis="y", visible=False)
    axes.set(title="There (bar); from above: fixes, relative measurements, messages", xlabel="time [s]")


def innovations(axes: Axes, found: Check) -> None:
    """Normalised innovations of the fixes beside their chi-squared distribution."""
    from scipy.stats import chi2

    size, top = dimensions(found.log.recording), 14.0
    bins, line = np.linspace(0, top, 36), np.linspace(0, top, 200)
    for k, name, color in _drives(found):
        each = size * found.normalised[np.isfinite(found.normalised[:, k]), k]
        if len(each) > 1:
            heights, _ = np.histogram(np.minimum(each, top - 1e-9), bins, density=True)
            axes.stairs(heights, bins, color=color, lw=1.4, label=f"{name}: mean {each.mean():.3g}")
    if not axes.get_legend_handles_labels()[1]:
        _note(axes, "no vehicle has a fix after its first")
    axes.plot(line, chi2(size).pdf(line), label=f"$\\chi^2_{size}$: mean {size}", **DASHED)
    axes.set(xlim=(0, top), ylim=(0, 0.6), title="Normalised innovations of the fixes", ylabel="density")
    axes.set_xlabel(r"$d^\top S^{-1} d$ (the last bin holds what is beyond)")
    axes.legend(loc="upper right")


def _relative(axes: Axes, found: Check) -> None:
    axes.set_title("Relative measurements less the filters' positions")
    if not found.measurements:
        _note(axes, "the log has none")
        axes.set_axis_off()
        return
    bins, line = np.linspace(-5, 5, 61), np.linspace(-5, 5, 200)
    for k, row in enumerate(found.measurements):
        r, color = found.relative[:, list(UNITS).index(str(row["measurement"]))], COLORS[k % len(COLORS)]
        heights, _ = np.histogram(np.clip(r[np.isfinite(r)] / row["expected_std"], -5, 5), bins, density=True)
        label = f"{row['measurement']}: {row['robust_std']:.3g} {row['unit']} ({row['expected_std']:.3g} expected)"
        axes.stairs(heights, bins, color=color, lw=1.5, label=label)
    axes.plot(line, np.exp(-0.5 * line**2) / np.sqrt(2 * np.pi), label="normal", **DASHED)
    axes.set(xlim=(-5, 5), ylim=(0, 1.45 * axes.get_ylim()[1]), ylabel="density")
    axes.set_xlabel("residual / expected standard deviation")
    axes.legend(loc="upper right")


def _note(axes: Axes, text: str) -> None:
    axes.text(0.5, 0.5, text, ha="center", va="center", color=GREY, transform=axes.transAxes)

"""The picture of a log: where everything drove, when what was measured, and how innovations compare with theory."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from coopoc.escapes import picture
from coopoc.evaluate.innovations import dimensions
from coopoc.pictures import COLORS, INK
from coopoc.world.recording import Recording

from .log import Log
from .log_check import UNITS, Check

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PALE = "#D8DEE6"
STYLE: dict[str, Any] = {
    "font.size": 9.5,
    "axes.edgecolor": "#9AA3AF",
    "axes.labelcolor": INK,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlecolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#EDF0F4",
    "axes.axisbelow": True,
    "xtick.color": "#5B6470",
    "ytick.color": "#5B6470",
    "legend.frameon": False,
    "legend.fontsize": 8.5,
}


def draw(log: Log, found: Check, path: Path) -> Path:
    """Write the picture of a log as PNG (or what the ending says).

    Args:
        log: what was read.
        found: its `check`.
        path: of the picture.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.style import context

    with context(STYLE):
        figure = Figure(figsize=(11.5, 8.2), dpi=150, layout="constrained")
        FigureCanvasAgg(figure)
        figure.get_layout_engine().set(w_pad=0.12, h_pad=0.12)  # type: ignore[union-attr, call-arg]
        grid = figure.subplot_mosaic([["map", "fixes"], ["time", "relative"]], width_ratios=[1.25, 1])
        rec = log.recording
        figure.suptitle(
            f"{log.summary.name}   ·   {len(rec.ids)} members, {rec.t[-1] - rec.t[0]:.0f} s in steps of {rec.dt:g} s",
            x=0.012,
            ha="left",
            fontsize=12.5,
            fontweight="bold",
            color=INK,
        )
        _map(grid["map"], log, found)
        times(grid["time"], rec)
        _fixes(grid["fixes"], rec, found)
        _relative(grid["relative"], found)
        figure.savefig(path)
    return path


def _color(column: int) -> str:
    return COLORS[column % len(COLORS)]


def _stands(rec: Recording, column: int) -> bool:
    return not np.nanmax(np.abs(rec.velocity[0, :, column]), initial=0.0) > 0


def _map(axes: Axes, log: Log, found: Check) -> None:
    rec = log.recording
    for column, name in enumerate(rec.ids):
        z, color = rec.gnss[0, :, column], _color(column)
        if _stands(rec, column):
            axes.plot(*z[0, :2], "^", color=color, ms=9, mec="white", label=picture(name))
            continue
        axes.plot(z[:, 0], z[:, 1], ".", color=color, ms=3.2, alpha=0.4, mew=0, rasterized=True)
        axes.plot(found.x[:, column, 0], found.x[:, column, 1], color=color, lw=1.6, label=picture(name))
        if log.truth is not None:
            true = log.truth.position[:, column]
            axes.plot(true[:, 0], true[:, 1], color=INK, lw=0.7, ls=(0, (4, 2)))
    axes.set_aspect("equal", "datalim")
    extra = ", truth dashed" if log.truth is not None else ""
    axes.set_title(f"Fixes (dots) and a solo Kalman filter (lines){extra}")
    axes.set_xlabel("east [m]")
    axes.set_ylabel("north [m]")
    if len(rec.ids) <= 12:
        axes.legend(loc="best", ncols=2 if len(rec.ids) > 6 else 1, handlelength=1.2)


def times(axes: Axes, rec: Recording) -> None:
    """When each member was there, had a fix, measured another and received a message."""
    t = rec.t - rec.t[0]
    for column, _ in enumerate(rec.ids):
        there = np.isfinite(rec.velocity[0, :, column, 0]).astype(int)
        edges = np.flatnonzero(np.diff(there, prepend=0, append=0)).reshape(-1, 2)
        spans = [(t[a], t[min(b, len(t) - 1)] - t[a]) for a, b in edges]
        axes.broken_barh(spans, (column - 0.36, 0.72), facecolors=PALE, lw=0)
        fixed = t[np.isfinite(rec.gnss[0, :, column, 0])]
        mine = rec.links.observer == column
        measured = np.isfinite(rec.relative[0]).any(axis=1)
        rows = (
            (fixed, -0.21, _color(column)),
            (np.unique(t[rec.links.step[mine & measured]]), 0.0, "#5B6470"),
            (np.unique(t[rec.links.step[mine & (rec.arrival[0] >= 0)]]), 0.21, "#9DB0C3"),
        )
        for times, offset, color in rows:
            axes.vlines(times, column + offset - 0.09, column + offset + 0.09, color=color, lw=0.6, rasterized=True)
    axes.set_yticks(range(len(rec.ids)), [picture(name) for name in rec.ids])
    axes.set_ylim(len(rec.ids) - 0.4, -0.6)
    axes.grid(axis="y", visible=False)
    axes.set_xlabel("time [s]")
    axes.set_title("There (bar); from above: fixes, relative measurements, messages")


def _fixes(axes: Axes, rec: Recording, found: Check) -> None:
    from scipy.stats import chi2

    size, top = dimensions(rec), 14.0
    bins = np.linspace(0, top, 36)
    for column, name in enumerate(rec.ids):
        each = size * found.normalised[np.isfinite(found.normalised[:, column]), column]
        if len(each) > 1 and not _stands(rec, column):
            heights, _ = np.histogram(np.minimum(each, top - 1e-9), bins, density=True)
            label = f"{picture(name)}: mean {each.mean():.3g}"
            axes.stairs(heights, bins, color=_color(column), lw=1.4, label=label)
    if not axes.get_legend_handles_labels()[1]:
        text = "no vehicle has a fix after its first"
        axes.text(0.5, 0.5, text, ha="center", va="center", color="#5B6470", transform=axes.transAxes)
    line = np.linspace(0, top, 200)
    axes.plot(line, chi2(size).pdf(line), color=INK, lw=1.8, ls=(0, (4, 2)), label=f"$\\chi^2_{size}$: mean {size}")
    axes.set_xlim(0, top)
    axes.set_ylim(0, 0.6)
    axes.set_title("Normalised innovations of the fixes")
    axes.set_xlabel(r"$d^\top S^{-1} d$ (the last bin holds what is beyond)")
    axes.set_ylabel("density")
    axes.legend(loc="upper right")


def _relative(axes: Axes, found: Check) -> None:
    names = [str(row["measurement"]) for row in found.measurements]
    axes.set_title("Relative measurements less the filters' positions")
    if not names:
        axes.text(0.5, 0.5, "the log has none", ha="center", va="center", color="#5B6470", transform=axes.transAxes)
        axes.set_axis_off()
        return
    bins = np.linspace(-5, 5, 61)
    for k, row in enumerate(found.measurements):
        r = found.relative[:, list(UNITS).index(str(row["measurement"]))]
        ratio = r[np.isfinite(r)] / row["expected_std"]
        heights, _ = np.histogram(np.clip(ratio, -5, 5), bins, density=True)
        label = f"{row['measurement']}: {row['robust_std']:.3g} {row['unit']} ({row['expected_std']:.3g} expected)"
        axes.stairs(heights, bins, color=_color(k), lw=1.5, fill=True, alpha=0.12)
        axes.stairs(heights, bins, color=_color(k), lw=1.5, label=label)
    line = np.linspace(-5, 5, 200)
    axes.plot(line, np.exp(-0.5 * line**2) / np.sqrt(2 * np.pi), color=INK, lw=1.8, ls=(0, (4, 2)), label="normal")
    axes.set_xlim(-5, 5)
    axes.set_ylim(0, 1.45 * axes.get_ylim()[1])
    axes.set_xlabel("residual / expected standard deviation")
    axes.set_ylabel("density")
    axes.legend(loc="upper right")

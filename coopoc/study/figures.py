"""Figures for every study, in one style; the Pareto front and the scenes are in files of their own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from .front import pareto
from .plot import Plot, apart, canvas, groups, legend, line_names, plain_log, strokes
from .results import SEED
from .scenes import innovations, paths
from .style import SYMBOLS, label, look, title, words

if TYPE_CHECKING:
    import pandas as pd

    from .results import Results

__all__ = ["Plot", "cdf", "convergence", "innovations", "pareto", "paths", "sweep"]

Where = Mapping[str, Any] | None


def sweep(
    results: Results,
    x: str,
    y: str = "rt_le_m",
    where: Where = None,
    caption: str = "",
    log: bool = False,
    facet: str = "",
) -> Plot:
    """Plot a metric against an axis: one line per method and noise model with its 95 % band; "bound" is dashed.

    Without a column `method` there is one line per combination of the other axes.

    Args:
        results: of the study.
        x: column of the horizontal axis.
        y: metric.
        where: column -> value or values.
        caption: under the figure; default the metric, the axis and what `where` selects.
        log: logarithmic vertical axis.
        facet: column of which each value has a panel of its own.

    Raises:
        InputError: as `Results.summary`.
    """
    by = [name for name in line_names(results, x, facet) if name != facet]
    summary = results.summary([*by, *([facet] if facet else []), x], y, where)
    panels = list(summary.groupby(facet)) if facet else [("", summary)]
    drawn: list[dict[str, Any]] = []
    size = {"width": 6.4 if len(panels) == 1 else 2.2 + 2.6 * len(panels)}
    with canvas(1, len(panels), squeeze=False, sharex=True, sharey=True, **size) as (figure, ((*grid,),)):
        for axes, (value, part) in zip(grid, panels, strict=True):
            drawn += [names for names in _bands(axes, part, by, x) if names not in drawn]
            axes.set(xlabel=words(x), title=title(facet, value) if facet else "")
        ticks = sorted(summary[x].unique())
        if len(ticks) <= 12:
            grid[0].set_xticks(ticks)
        if log:
            plain_log(grid[0].yaxis)
        else:
            grid[0].set_ylim(bottom=0)
        grid[0].set(ylabel=words(y))
        legend(grid[-1], drawn)
    text = f"{words(y)} against {words(x)}{_selected(where)}. Bands: 95 % intervals over egos, then runs."
    return Plot(figure, caption or text)


def _bands(axes: Axes, summary: pd.DataFrame, by: Sequence[str], x: str) -> list[dict[str, Any]]:
    """Draw the lines of a panel with their bands; their names."""
    drawn = []
    for names, group in groups(summary, by):
        group = group.sort_values(x)
        options = strokes(names)
        axes.plot(group[x], group["mean"], **options)
        band = {"color": options["color"], "gid": options["gid"], "linewidth": 0}
        axes.fill_between(group[x], group["low"], group["high"], alpha=0.15, **band)
        drawn.append(names)
    return drawn


def _selected(where: Where) -> str:
    """What a figure is restricted to, for its caption."""
    found = []
    for column, value in (where or {}).items():
        values = value if isinstance(value, list | tuple) else [value]
        found.append(f"{SYMBOLS.get(column, words(column))} = {' or '.join(label(column, one) for one in values)}")
    return f" at {', '.join(found)}" if found else ""


def cdf(
    results: Results, value: str = "error_quantiles_m", where: Where = None, caption: str = "", log: bool = False
) -> Plot:
    """Plot the share of errors below each value, with a marker at the mean of the per-run maxima.

    Args:
        results: of the study.
        value: column of lists: equally likely quantiles of the errors of one run and ego, the last its maximum.
        where: column -> value or values.
        caption: under the figure.
        log: logarithmic horizontal axis.

    Raises:
        InputError: an unknown column or value.
    """
    drawn: list[dict[str, Any]] = []
    text: dict[str, str] = {}
    with canvas() as (figure, axes):
        for key, frame in results.groups(by := line_names(results), where):
            names = dict(zip(by, key, strict=True))
            errors = np.sort(np.concatenate(frame[value].to_list()))
            share = np.arange(1, len(errors) + 1) / len(errors)
            worst = float(np.mean([np.max(q) for q in frame[value]]))
            options = strokes(names)
            axes.plot(errors, share, **{**options, "marker": None})
            axes.plot(worst, np.interp(worst, errors, share), **{**options, "linestyle": "none"}, zorder=3)
            drawn.append(names)
            text[names["method"]] = _maximum(text.get(names["method"], ""), worst)
        axes.set(xlabel="Error [m]", ylabel="Share of time steps below", ylim=(0, 1.02))
        if log:
            plain_log(axes.xaxis)
            axes.set_xlim(left=0.1)
        else:
            axes.set_xlim(left=0)
        legend(axes, drawn, text)
    return Plot(
        figure,
        caption or f"Cumulative distribution of the error{_selected(where)}. Markers: mean of the per-run maxima.",
    )


def convergence(
    results: Results,
    x: str = "round",
    y: str = "rt_le_m",
    where: Where = None,
    levels: Mapping[str, float] | None = None,
    caption: str = "",
) -> Plot:
    """Plot a metric after every round: mean over training seeds, band from the lowest to the highest seed.

    Args:
        results: of the study.
        x: column of rounds.
        y: metric.
        where: column -> value or values.
        levels: label -> constant value, such as the error of an individual net.
        caption: under the figure.

    Raises:
        InputError: as `Results.summary`; no column "train_seed".
    """
    by = line_names(results)
    seeds = results.summary([*by, SEED, x], y, where)
    drawn = []
    with canvas() as (figure, axes):
        for names, group in groups(seeds, by):
            table = group.pivot(index=x, columns=SEED, values="mean").sort_index()
            options = strokes(names)
            axes.plot(table.index, table.mean(axis=1), **options, markevery=max(1, len(table) // 10))
            axes.fill_between(
                table.index,
                table.min(axis=1),
                table.max(axis=1),
                color=options["color"],
                gid=options["gid"],
                alpha=0.18,
                linewidth=0,
            )
            drawn.append(names)
        axes.set(xlabel=words(x), ylabel=words(y))
        axes.set_xlim(left=0)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        _levels(axes, levels or {})
        low, high = axes.get_ylim()
        axes.set_ylim(low, high + 0.25 * (high - low))  # room for the legend above the curves
        legend(axes, drawn, inside=True)
    text = f"{words(y)} after every round{_selected(where)}: mean over training seeds; bands: lowest to highest."
    return Plot(figure, caption or text)


def _maximum(before: str, worst: float) -> str:
    return f"{before[:-3]} / {worst:.1f} m)" if before else f" (max {worst:.1f} m)"


def _levels(axes: Axes, levels: Mapping[str, float]) -> None:
    color = look("individual").color
    low, high = axes.get_ylim()
    heights = apart(levels, 0.045 * (max(high, *levels.values()) - low) if levels else 0.0)
    for name, level in levels.items():
        axes.axhline(level, color=color, linewidth=0.9, linestyle=(0, (6, 2)))
        axes.annotate(
            name,
            (1.0, level),
            (1.015, heights[name]),
            ("axes fraction", "data"),
            fontsize=7,
            va="center",
            textcoords=("axes fraction", "data"),
            color=color,
        )

"""Figures for every study, in one style; the Pareto front and the scenes are in files of their own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from .front import pareto
from .plot import Plot, apart, canvas, groups, legend, line_names, plain_log, strokes
from .results import SEED
from .scenes import innovations, paths
from .style import look, words

if TYPE_CHECKING:
    from .results import Results

__all__ = ["Plot", "cdf", "convergence", "innovations", "pareto", "paths", "sweep"]

Where = Mapping[str, Any] | None


def sweep(
    results: Results, x: str, y: str = "rt_le_m", where: Where = None, caption: str = "", log: bool = False
) -> Plot:
    """Plot a metric against an axis: one line per method and noise model with its 95 % band; "bound" is dashed.

    Without a column `method` there is one line per combination of the other axes.

    Args:
        results: of the study.
        x: column of the horizontal axis.
        y: metric.
        where: column -> value or values.
        caption: under the figure; default the metric and the axis.
        log: logarithmic vertical axis.

    Raises:
        InputError: as `Results.summary`.
    """
    by = line_names(results, x)
    summary = results.summary([*by, x], y, where)
    drawn = []
    with canvas() as (figure, axes):
        for names, group in groups(summary, by):
            group = group.sort_values(x)
            options = strokes(names)
            axes.plot(group[x], group["mean"], **options)
            band = {"color": options["color"], "gid": options["gid"], "linewidth": 0}
            axes.fill_between(group[x], group["low"], group["high"], alpha=0.15, **band)
            drawn.append(names)
        ticks = sorted(summary[x].unique())
        if len(ticks) <= 12:
            axes.set_xticks(ticks)
        if log:
            plain_log(axes.yaxis)
        else:
            axes.set_ylim(bottom=0)
        axes.set(xlabel=words(x), ylabel=words(y))
        legend(axes, drawn)
    return Plot(figure, caption or f"{words(y)} against {words(x)}. Bands: 95 % intervals over egos, then runs.")


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
    return Plot(figure, caption or "Cumulative distribution of the error. Markers: mean of the per-run maxima.")


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
    return Plot(figure, caption or f"{words(y)} after every round: mean over training seeds; bands: lowest to highest.")


def _maximum(before: str, worst: float) -> str:
    return f"{before[:-3]} / {worst:.1f} m)" if before else f" (max {worst:.1f} m)"


def _levels(axes: Axes, levels: Mapping[str, float]) -> None:
    color = look("individual").color
    low, high = axes.get_ylim()
    heights = apart(levels, 0.045 * (max(high, *levels.values()) - low) if levels else 0.0)
    for label, level in levels.items():
        axes.axhline(level, color=color, linewidth=0.9, linestyle=(0, (6, 2)))
        axes.annotate(
            label,
            (1.0, level),
            (1.015, heights[label]),
            ("axes fraction", "data"),
            fontsize=7,
            va="center",
            textcoords=("axes fraction", "data"),
            color=color,
        )

"""The Pareto front of accuracy and received bytes, and beside it the bytes of the training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from .plot import Plot, canvas, groups, legend, line_names, plain_log, strokes
from .results import Results
from .style import look, words


def pareto(
    results: Results,
    x: str = "bytes_per_second",
    y: str = "rt_le_m",
    along: Sequence[str] = ("max_neighbours",),
    where: Mapping[str, Any] | None = None,
    training: Mapping[str, float] | None = None,
    caption: str = "",
) -> Plot:
    """Plot a metric against received bytes per second (log); methods that receive nothing are in a strip at the left.

    Args:
        results: of the study.
        x: bytes per second of online cooperation.
        y: metric.
        along: axes that vary; a line joins the points of along[0], one line per value of the others.
        where: column -> value or values.
        training: method -> bytes that one vehicle sends and receives in training, as bars beside the front.
        caption: under the figure.

    Raises:
        InputError: as `Results.summary`.
    """
    by = [*line_names(results, *along), *along[1:]]
    summary = results.summary([*by, along[0]], y, where)
    summary["bytes"] = results.summary([*by, along[0]], x, where)["mean"]
    panels = [1.0, 6.0, 2.4][: 3 if training else 2]
    drawn = []
    with canvas(1, len(panels), width=7.6, gridspec_kw={"width_ratios": panels}) as (figure, axes):
        for names, group in groups(summary, by):
            _front(axes, names, group.sort_values("bytes"))
            drawn.append(names)
        _share_height(axes[0], axes[1], words(y), 0.8 * float(summary["low"].min()))
        plain_log(axes[1].xaxis)
        axes[1].set_xlabel(words(x))
        if training:
            _bars(axes[2], training)
        legend(axes[-1], drawn)
    return Plot(figure, caption or f"{words(y)} against {words(x)}. Bars: 95 % intervals over egos, then runs.")


def _front(axes: Sequence[Axes], names: Mapping[str, Any], group: pd.DataFrame) -> None:
    options = strokes(names, thin=True)
    ends = np.array([group["mean"] - group["low"], group["high"] - group["mean"]])
    silent = (group["bytes"] == 0).to_numpy()
    for panel, chosen in ((axes[0], silent), (axes[1], ~silent)):
        part = group[chosen]
        at = np.zeros(len(part)) if panel is axes[0] else part["bytes"]
        panel.errorbar(at, part["mean"], yerr=ends[:, chosen], elinewidth=0.7, **options)


def _share_height(left: Axes, right: Axes, label: str, low: float) -> None:
    top = 1.03 * max(left.get_ylim()[1], right.get_ylim()[1])
    for panel in (left, right):
        plain_log(panel.yaxis)
        panel.set_ylim(low, top)
    left.set(ylabel=label, xticks=[0], xlim=(-1, 1))
    left.set_xticklabels(["0"])
    right.tick_params(labelleft=False)


def _bars(axes: Axes, training: Mapping[str, float]) -> None:
    shown = [look(method) for method in training]
    axes.bar(range(len(shown)), list(training.values()), color=[s.color for s in shown], width=0.6)
    axes.set(yscale="log", ylabel="Bytes per vehicle", title="Training, once")
    axes.set_xticks(range(len(shown)), [s.label for s in shown], rotation=35, ha="right")

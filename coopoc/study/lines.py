"""Lines of methods over a parameter, one panel per case, with levels such as the bound across."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from matplotlib.axes import Axes

from ..escapes import picture
from ..evaluate.statistics import Interval
from .numbers import ran
from .plot import Plot, canvas, legend, plain_log, strokes


@dataclass(frozen=True)
class Line:
    """A line of a panel.

    Args:
        names: method, and noise model if it matters; they give colour, marker and dashes.
        points: x -> value, or an interval that gets a band; None where it was not run. A number alone is a level.
        style: matplotlib options instead of those of the names.
    """

    names: Mapping[str, Any]
    points: Mapping[Any, float | Interval | None] | float | None
    style: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Panel:
    """A panel: its lines, title, label of the horizontal axis and ticks (or tick -> text), by default matplotlib's."""

    lines: Sequence[Line]
    title: str = ""
    xlabel: str = ""
    xticks: Sequence[float] | Mapping[float, str] = ()


def panels(
    shown: Sequence[Panel],
    caption: str,
    width: float,
    height: float = 3.0,
    ylabel: str = "RT-LE [m]",
    log: bool = False,
    words: Mapping[str, str] | None = None,
) -> Plot | None:
    """Plot panels that share a vertical axis, with one legend; None if no line was run.

    Args:
        shown: the panels.
        caption: under the figure.
        width: inches.
        height: inches.
        ylabel: label of the vertical axis.
        log: logarithmic vertical axis; a linear one starts at zero.
        words: method -> text after its label in the legend.
    """
    drawn: list[Mapping[str, Any]] = []
    if not shown:
        return None
    with canvas(1, len(shown), width=width, height=height, sharey=True, squeeze=False) as (figure, (axes,)):
        for axis, panel in zip(axes, shown, strict=True):
            drawn += draw(axis, panel.lines)
            axis.set(title=picture(panel.title), xlabel=panel.xlabel)
            if panel.xticks:
                texts = list(panel.xticks.values()) if isinstance(panel.xticks, Mapping) else None
                axis.set_xticks(list(panel.xticks), texts)
            if log:
                plain_log(axis.yaxis)
        axes[0].set(ylabel=ylabel, **({} if log else {"ylim": (0, None)}))
        legend(axes[-1], drawn, words)
    return Plot(figure, caption) if drawn else None


def draw(axis: Axes, lines: Sequence[Line]) -> list[Mapping[str, Any]]:
    """Draw the lines that were run, and return their names for the legend."""
    drawn = []
    for line in lines:
        style = {**strokes(line.names), **line.style}
        if isinstance(line.points, Mapping):
            points: dict[Any, Any] = ran(line.points)  # type: ignore[arg-type]
            if not points:
                continue
            bands = {x: one for x, one in points.items() if isinstance(one, Interval)}
            axis.plot(list(points), [one.mean if x in bands else one for x, one in points.items()], **style)
            if bands:
                ends = [one.low for one in bands.values()], [one.high for one in bands.values()]
                band = {"color": style["color"], "gid": style["gid"], "linewidth": 0}
                axis.fill_between(list(bands), *ends, alpha=0.12, **band)
        elif line.points is None:
            continue
        else:
            axis.axhline(line.points, **{**style, "marker": ""})
        drawn.append(line.names)
    return drawn

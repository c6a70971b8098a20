"""Plot: a figure with its caption, saved as the same bytes for the same numbers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator

from ..escapes import picture
from . import store
from .marks import marks, series
from .results import Results
from .style import RC, line, look

FIXED: Mapping[str, Mapping[str, Any]] = {
    "pdf": {"CreationDate": None, "Producer": None, "Creator": None},
    "svg": {"Date": None, "Creator": None},
    "png": {"Software": None},
}
"""Formats, and metadata without a time or a version."""


@dataclass(frozen=True, eq=False)
class Plot:
    """A matplotlib figure and the caption that goes under it."""

    figure: Figure
    caption: str

    def save(self, path: str | Path) -> str:
        """Write path.pdf, path.png and path.svg, and return the caption."""
        with mpl.rc_context(RC):
            _settle(self.figure)
            for suffix, metadata in FIXED.items():
                buffer = BytesIO()
                self.figure.savefig(buffer, format=suffix, metadata=dict(metadata))
                store.write(Path(f"{path}.{suffix}"), buffer.getvalue())
        return self.caption

    def marks(self) -> list[dict[str, Any]]:
        """Where its lines stand and what they say, see `coopoc.study.marks`."""
        with mpl.rc_context(RC):
            _settle(self.figure)
            return marks(self.figure)

    def _repr_png_(self) -> bytes:
        """Image for a notebook."""
        buffer = BytesIO()
        with mpl.rc_context(RC):
            self.figure.savefig(buffer, format="png")
        return buffer.getvalue()


def _settle(figure: Figure) -> None:
    """Lay the panels out and round their places, of which the layout solver leaves the last digits open."""
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    for axes in figure.axes:
        x, y, width, height = (round(side, 5) for side in axes.get_position(original=True).bounds)
        axes.set_position((x, y, width, height))


def line_names(results: Results, *across: str) -> list[str]:
    """Columns that identify a line of a figure: method and noise model, or all axes but those of the figure."""
    usual = [name for name in ("method", "noise_model") if name in results.frame]
    return usual if "method" in usual else [name for name in results.axes if name not in across]


def _line(names: Mapping[str, Any]) -> str:
    """The method of a line; without one, its other names."""
    return str(names["method"]) if "method" in names else ", ".join(map(str, names.values()))


def groups(frame: pd.DataFrame, by: Sequence[str]) -> list[tuple[dict[str, Any], pd.DataFrame]]:
    """Rows of each combination of the columns `by`, with its names, in order of first appearance."""
    if not by:
        return [({}, frame)]
    return [(dict(zip(by, k, strict=True)), g) for k, g in frame.groupby(list(by), sort=False, dropna=False)]


@contextmanager
def canvas(rows: int = 1, columns: int = 1, width: float = 6.4, height: float = 3.4, **grid: Any) -> Iterator[Any]:
    """(figure, axes) in the house style; matplotlib's global state does not change.

    Args:
        rows: of panels.
        columns: of panels.
        width: inches.
        height: inches.
        grid: options of `Figure.subplots`.
    """
    with mpl.rc_context(RC):
        figure = Figure(figsize=(width, height))
        yield figure, figure.subplots(rows, columns, **grid)


def strokes(names: Mapping[str, Any], thin: bool = False) -> dict[str, Any]:
    """Line options of a method (colour, marker) and of a noise model (line style), and the line's name; a bound is
    dashed, with the past of newcomers dotted."""
    shown = look(_line(names))
    bound = ":" if names.get("noise_model") == "with its past" else "--"
    dashes = bound if _line(names) == "bound" else line(names.get("noise_model"))
    width = {"linewidth": 0.8} if thin else {}
    name = series(_line(names), str(names.get("noise_model", "")))
    drawn = {"color": shown.color, "marker": shown.marker or None, "linestyle": dashes, "markeredgewidth": 0.8}
    return {**drawn, **width, "gid": name}


def legend(
    axes: Axes, lines: Sequence[Mapping[str, Any]], words: Mapping[str, str] | None = None, inside: bool = False
) -> None:
    """Draw the legend: one entry per method and per bound, and one per line style where noise models differ.

    Args:
        axes: panel.
        lines: names (method, noise_model) of the lines in it.
        words: method -> text after its label.
        inside: in the panel; else at its right.
    """
    handles = []
    bounds = dict.fromkeys(str(names.get("noise_model")) for names in lines if _line(names) == "bound")
    entries = {(_line(names), names.get("noise_model") if _line(names) == "bound" else ""): names for names in lines}
    for (method, information), names in entries.items():
        options = strokes({"method": method, "noise_model": information} if "method" in names else names)
        text = look(method).label + (words or {}).get(method, "")
        text += f", {information}" if information and len(bounds) > 1 else ""
        handles.append(Line2D([], [], **options, label=picture(text)))
    styles: dict[Any, list[str]] = {}
    modelled = [n for n in lines if "noise_model" in n and "method" in n and n["method"] != "bound"]
    for known in dict.fromkeys(str(n["noise_model"]) for n in modelled):
        if known == "none":
            continue
        styles.setdefault(line(known), []).append(known)
    if len(styles) > 1:
        handles += [
            Line2D([], [], color="#555555", linestyle=k, label=picture(" / ".join(v))) for k, v in styles.items()
        ]
    if not any(lines):
        return
    place: dict[str, Any] = {} if inside else {"bbox_to_anchor": (1.02, 1.0), "borderaxespad": 0}
    axes.legend(handles=handles, loc="upper right" if inside else "upper left", handlelength=2.6, **place)


def plain_log(axis: Axis) -> None:
    """Make an axis logarithmic with plain numbers at 1, 2 and 5 of each decade: at more if it spans less than one, at
    the decades alone if it spans many."""
    if axis is axis.axes.xaxis:
        axis.axes.set_xscale("log")
    else:
        axis.axes.set_yscale("log")
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_minor_locator(LogLocator(subs=(1.2, 1.5, 3.0, 4.0, 7.0), numticks=50))

    def spans() -> float:
        low, high = axis.get_view_interval()
        return float(high / low)

    def decade(value: float, _: int | None = None) -> str:
        whole = abs(np.log10(value) % 1.0 - 0.5) > 0.499
        return f"{value:g}" if whole or spans() < 1e3 else ""

    def between(value: float, _: int | None = None) -> str:
        return f"{value:g}" if spans() < 5 else ""

    axis.set_major_formatter(FuncFormatter(decade))
    axis.set_minor_formatter(FuncFormatter(between))


def apart(heights: Mapping[str, float], gap: float) -> dict[str, float]:
    """Heights of labels, moved up until they are `gap` apart, in their order.

    Args:
        heights: label -> height.
        gap: least distance of two labels.

    >>> apart({"a": 1.0, "b": 1.1, "c": 3.0}, 0.5)
    {'a': 1.0, 'b': 1.5, 'c': 3.0}
    """
    moved: dict[str, float] = {}
    last = float("-inf")
    for label, height in sorted(heights.items(), key=lambda item: item[1]):
        moved[label] = last = max(height, last + gap)
    return moved

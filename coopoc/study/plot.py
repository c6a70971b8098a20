"""Plot: a figure with its caption, saved as the same bytes for the same numbers; axes, lines and legends."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.axis import XAxis, YAxis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from ..paths import write
from ..text import wrapped
from .numbers import Where
from .style import OWN_LOOKS, RC, line, look, title

FIXED = {
    "pdf": {"CreationDate": None, "Producer": None, "Creator": None},
    "svg": {"Date": None, "Creator": None},
    "png": {"Software": None},
}
"""Formats, and metadata without a time or a version."""


class Plot(NamedTuple):
    """A matplotlib figure and the caption that goes under it."""

    figure: Figure
    caption: str

    def save(self, path: str | Path) -> str:
        """Write path.pdf, path.png and path.svg, and return the caption."""
        with style.context(["default", RC]):
            self.figure.draw_without_rendering()
            self.figure.set_layout_engine("none")
            for axes in self.figure.axes:  # the layout solver leaves the last digits of their places open
                x, y, width, height = (round(side, 5) for side in axes.get_position(original=True).bounds)
                axes.set_position((x, y, width, height))
            for suffix, metadata in FIXED.items():
                write(Path(f"{path}.{suffix}"), partial(self.figure.savefig, format=suffix, metadata=metadata))
        return self.caption

    def _repr_png_(self) -> bytes:
        """Image for a notebook."""
        buffer = BytesIO()
        with style.context(["default", RC]):
            self.figure.savefig(buffer, format="png")
        return buffer.getvalue()


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
    with style.context(["default", RC]):
        OWN_LOOKS.clear()  # all of them are for the lines of one figure
        figure = Figure(figsize=(width, height))
        yield figure, figure.subplots(rows, columns, **grid)


def name_of(names: Where) -> str:
    """The method of a line; without one, its other names."""
    return str(names["method"]) if "method" in names else ", ".join(title(*item) for item in names.items())


def strokes(names: Where) -> dict[str, Any]:
    """Line options of a method (colour, marker) and of a noise model (line style); a bound is dashed, with the past of
    newcomers dotted."""
    shown, model = look(name_of(names)), str(names.get("noise_model"))
    bound = ":" if model == "with its past" else "--"
    dashes = bound if name_of(names) == "bound" else line(model)
    return {"color": shown.color, "marker": shown.marker or None, "linestyle": dashes, "markeredgewidth": 0.8}


def legend(axes: Axes, lines: Sequence[Where], words: Mapping[str, str]) -> None:
    """Draw the legend at the right: one entry per method and bound, and one per line style where noise models differ.

    Args:
        axes: panel.
        lines: names (method, noise_model) of the lines in it.
        words: method -> text after its label.
    """
    if not any(lines):
        return
    bounds = {str(names.get("noise_model")) for names in lines if name_of(names) == "bound"}
    entries: dict[str, dict[str, Any]] = {}
    styles: dict[Any, list[str]] = {}
    for names in lines:
        method, model = name_of(names), str(names.get("noise_model") or "none")
        text = look(method).label + words.get(method, "")
        if method == "bound":
            text += f", {model}" if len(bounds) > 1 else ""
        elif "method" in names and model != "none" and model not in styles.setdefault(line(model), []):
            styles[line(model)].append(model)
        entries.setdefault(text, strokes(names if method == "bound" or "method" not in names else {"method": method}))
    handles = [
        Line2D([], [], **{**options, "label": "\n".join(map(wrapped, text.split("\n")))})
        for text, options in entries.items()
    ]
    if len(styles) > 1:
        for dashes, models in styles.items():
            handles.append(Line2D([], [], color="#555555", linestyle=dashes, label=wrapped(" / ".join(models))))
    place(axes, handles, handlelength=2.6)


MOST_ENTRIES, ENTRY_HEIGHT = 60, 0.17
"""Of a legend; inches of one line of it."""


def place(axes: Axes, handles: Sequence[Any], **options: Any) -> None:
    """Draw a legend at the right, its figure as high as it needs; it says how many lines it does not name."""
    if len(handles) > MOST_ENTRIES:
        more = f"{len(handles) - MOST_ENTRIES} more are not named"
        handles = [*handles[:MOST_ENTRIES], Line2D([], [], linestyle="none", label=more)]
    figure: Any = axes.figure
    rows = sum(1 + handle.get_label().count("\n") for handle in handles)
    figure.set_figheight(max(figure.get_figheight(), ENTRY_HEIGHT * rows + 0.4))
    axes.legend(handles=handles, loc="upper left", bbox_to_anchor=(1.02, 1.0), borderaxespad=0, **options)


def plain_log(axis: XAxis | YAxis) -> None:
    """Make an axis logarithmic with plain numbers at 1, 2 and 5 of each decade, at the decades alone if it spans many;
    evenly spaced where one of these at most is within."""
    axis.axes.set(**{f"{axis.axis_name}scale": "log"})

    def plain(value: float, _: int) -> str:
        low, high = axis.get_view_interval()
        return f"{value:g}" if high < 1e3 * low or abs(np.log10(value) % 1.0 - 0.5) > 0.499 else ""

    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=20))
    axis.set_major_formatter(FuncFormatter(plain))
    axis.set_minor_locator(NullLocator())

"""What the page of a study says at a point of a figure: the numbers behind the lines, and where they are drawn."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ..escapes import visible
from .style import look

SERIES = "series:"
"""How the name of an artist begins that belongs to a method; the noise model follows after the last "/"."""
_NUMBER = re.compile(r"[\d.\N{MINUS SIGN}-]*")
MOST = 60
"""Marks of one line: more stand closer than a pointer can choose."""


def series(method: str, noise_model: str = "") -> str:
    """The name of an artist, matplotlib's gid and the id of its SVG group.

    >>> series("kalman", "fitted")
    'series:kalman/fitted'
    """
    return f"{SERIES}{visible(method)}/{visible(noise_model)}"


def described(name: str) -> str:
    """The words for an artist's name.

    >>> described("series:kalman/fitted"), described("series:mine.py:Own/")
    ('KF, fitted', 'Own')
    """
    method, _, noise_model = name.removeprefix(SERIES).rpartition("/")
    return look(method).label + (f", {noise_model}" if noise_model not in ("", "none", "trained", "bound") else "")


def marks(figure: Figure) -> list[dict[str, Any]]:
    """Marks of all lines of methods: series, text, and place, shares of width and height from the top left.

    Args:
        figure: laid out.
    """
    width, height = figure.bbox.width, figure.bbox.height
    found = []
    for axes in figure.axes:
        for line in axes.get_lines():
            name = str(line.get_gid() or "")
            if name.startswith(SERIES) and line.get_transform() == axes.transData:
                for x, y, text in _points(axes, line):
                    at = [round(float(x / width), 4), round(float(1 - y / height), 4)]
                    found.append({"series": name, "at": at, "text": f"{described(name)}: {text}"})
    return found


def _points(axes: Axes, line: Line2D) -> list[tuple[float, float, str]]:
    """Pixels and numbers of the points of a line that the panel shows."""
    data = np.column_stack([np.asarray(part, dtype=float) for part in line.get_data()])
    data = data[np.isfinite(data).all(axis=1)]
    data = data[:: max(1, -(-len(data) // MOST))]
    if not len(data):
        return []
    (low_x, high_x), (low_y, high_y) = sorted(axes.get_xlim()), sorted(axes.get_ylim())
    inside = (data[:, 0] >= low_x) & (data[:, 0] <= high_x) & (data[:, 1] >= low_y) & (data[:, 1] <= high_y)
    data = data[inside]
    texts = (tick.get_text() for tick in axes.get_xticklabels())
    ticks = {at: text for at, text in zip(axes.get_xticks(), texts, strict=False) if not _NUMBER.fullmatch(text)}
    pixels = axes.transData.transform(data) if len(data) else data
    y_label = axes.get_ylabel() or (axes.figure.axes[0].get_ylabel() if axes.figure else "")
    words = [
        (_word(visible(axes.get_xlabel()), ticks.get(x) or f"{x:.4g}"), _word(y_label, f"{y:.3g}")) for x, y in data
    ]
    return [(px, py, f"{y} at {x}") for (px, py), (x, y) in zip(pixels, words, strict=True)]


def _word(label: str, value: str) -> str:
    """A label with its value: "RT-LE [m]" and 1.2 give "RT-LE 1.2 m"."""
    text, _, unit = label.partition(" [")
    return " ".join(part for part in (text, value, unit.rstrip("]")) if part)

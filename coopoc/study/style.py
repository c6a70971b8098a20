"""One look per method in every figure and table: colour, marker and label; the line style is its noise model."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

BLACK, ORANGE, SKY, GREEN, BLUE, VERMILLION, PURPLE = (
    "#000000",
    "#E69F00",
    "#56B4E9",
    "#009E73",
    "#0072B2",
    "#D55E00",
    "#CC79A7",
)
"""Okabe and Ito, Color Universal Design (2008): distinguishable under the common forms of colour blindness."""


@dataclass(frozen=True)
class Look:
    """Colour, marker and label of a method."""

    label: str
    color: str
    marker: str


@dataclass(frozen=True)
class Panel:
    """A panel of `curves`.

    Args:
        x: place on the horizontal axis -> what it adds to the selection of a line.
        where: what the panel adds.
        title: over it.
        xlabel: under it.
        ticks: place -> text; default matplotlib's ticks, or the places if there are at most eight.
    """

    x: Mapping[float, Mapping[str, Any]]
    where: Mapping[str, Any] = field(default_factory=dict)
    title: str = ""
    xlabel: str = ""
    ticks: Mapping[float, str] = field(default_factory=dict)


NEUTRAL = "#9DB0C3"
"""Colour of anything that belongs to no method."""

METHODS = {
    "gnss": Look("GNSS", "#7F7F7F", "x"),
    "kalman": Look("KF", ORANGE, "s"),
    "okf": Look("OKF", VERMILLION, "D"),
    "msmv-r": Look("MSMV (reconstruction)", "#C9B500", "p"),
    "lkf-sa": Look("LKF-SA", SKY, "^"),
    "lkf-sa-edge": Look("LKF-SA (edge form)", BLUE, "v"),
    "joint": Look("Joint filter", GREEN, "o"),
    "drift": Look("Drift filter", "#7A1FA2", "s"),
    "cooperative-map": Look("Cooperative MAP", "#00543C", "P"),
    "cooperative-map-5": Look("Cooperative MAP, 5 steps", "#6A51A3", "P"),
    "cooperative-map-gnc": Look("Cooperative MAP, GNC", "#6B8E23", "P"),
    "ci": Look("Covariance intersection", "#A65628", "<"),
    "split-ci": Look("Split CI", "#C77C11", ">"),
    "mds": Look("MDS", "#8C8C8C", "1"),
    "qcqp-relaxation": Look("QCQP-SDR", "#4D4D4D", "2"),
    "gbp": Look("Belief propagation", "#0096A0", "d"),
    "admm": Look("ADMM", "#3F51B5", "H"),
    "fixed-lag": Look("Fixed-lag smoother", "#2E7D32", "8"),
    "mhe": Look("Moving horizon", "#7CB342", "h"),
    "central-filter": Look("Whole-fleet filter", "#444E86", "s"),
    "batch-smoother": Look("Whole-fleet smoother", "#111E6C", "D"),
    "pose-solo": Look("Pose filter, solo", "#C98A00", "v"),
    "pose-fleet": Look("Pose filter, one state", BLUE, "o"),
    "pose-learned": Look("Pose filter, learned noise", "#009E73", "s"),
    "pose-naive": Look("Decentralised, naive", VERMILLION, "X"),
    "pose-intersection": Look("Decentralised, CI", "#7A3E1D", "<"),
    "fedkalmannet": Look("FedKalmanNet", PURPLE, "*"),
    "centralised": Look("Centralised KalmanNet", "#8A2F63", "X"),
    "kalman-adaptive": Look("Adaptive KF", "#B8860B", "v"),
    "fedokf": Look("Federated OKF", "#FF8C61", "D"),
    "split": Look("Split-KalmanNet", "#3B7080", "<"),
    "recursive": Look("Recursive gain", "#C2185B", "o"),
    "cooperative": Look("Cooperative gain", "#B71C1C", "H"),
    "individual": Look("Individual KalmanNet", "#9370C9", "h"),
    "oracle": Look("Oracle KF", "#5B3A1E", "d"),
    "gauss-newton": Look("gauss-newton", GREEN, "^"),
    "gtsam": Look("gtsam", BLUE, "s"),
    "casadi": Look("casadi", VERMILLION, "v"),
    "osqp": Look("osqp", PURPLE, "D"),
    "cvxpy": Look("cvxpy", ORANGE, "o"),
    "bound": Look("Cramér-Rao bound", BLACK, ""),
}
_SPARE = tuple((color, marker) for marker in "<>d8H" for color in (BLUE, VERMILLION, GREEN, PURPLE, ORANGE))
_LINES = {"identity": (0, (1, 1.4)), "nominal": (0, (5, 2)), "oracle": (0, (5, 1, 1, 1)), "fitted": "-", "trained": "-"}

UNITS = {
    "correlated_gnss": ("Correlated GNSS", ""),
    "latency_loss": ("Latency and loss", ""),
    "rt_le_m": ("RT-LE", "m"),
    "max_error_m": ("Maximum error", "m"),
    "bytes_per_second": ("Received", "B/s"),
    "nees": ("NEES", ""),
    "max_neighbours": ("Neighbours K", ""),
    "round": ("Round", ""),
    "seconds": ("Time", "s"),
    "error_cdf": ("Error CDF", ""),
    "rate_hz": ("Rate", "Hz"),
    "cap_bytes_per_second": ("Cap", "B/s"),
    "nees_inside": ("NEES inside its band", ""),
    "neighbour_rt_le_m": ("Error of neighbours", "m"),
    "loss": ("Message loss", ""),
    "latency": ("Latency", "s"),
    "heading_std_deg": ("Heading noise", "°"),
    "heading_bias_deg": ("Heading bias", "°"),
    "drift_time_s": ("Time of the GNSS drift", "s"),
    "heading_deg": ("Heading error", "°"),
}
"""Column -> (words, unit)."""

SUFFIXES = {"m": "m", "s": "s", "hz": "Hz", "deg": "°"}
"""End of a column's name -> unit."""

SYMBOLS = {"max_neighbours": "K"}
"""Column -> the short form that fits over a column of numbers."""

RC: Any = {
    "figure.figsize": (5.6, 3.5),
    "figure.constrained_layout.use": True,
    "savefig.dpi": 200,
    "figure.dpi": 72,  # what PDF and SVG are drawn at: letters are hinted wider there, and a layout for 100 cuts them
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.labelsize": 9,
    "legend.fontsize": 7.5,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#E3E3E3",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "lines.linewidth": 1.5,
    "lines.markersize": 4.5,
    "legend.frameon": False,
    "pdf.fonttype": 42,
    "svg.hashsalt": "coopoc",
    "svg.fonttype": "path",
}


def look(method: str) -> Look:
    """The look of a method; a number at its end is a client; an unknown one has a look that its name alone decides.

    >>> look("okf").label, look("individual2").label, look("mine.py:Alpha").label
    ('OKF', 'Individual KalmanNet 2', 'Alpha')
    """
    name = method.replace("_", "-")
    if name in METHODS:
        return METHODS[name]
    family = name.rstrip("0123456789-")
    if family in METHODS:
        shown = METHODS[family]
        return Look(f"{shown.label} {name[len(family) :].strip('-')}", shown.color, shown.marker)
    method = method.rpartition(".py:")[2]  # of a file: its name there
    color, marker = _SPARE[zlib.crc32(method.encode()) % len(_SPARE)]
    return Look(method.replace("_", " "), color, marker)


def line(noise_model: object) -> Any:
    """Line style of a noise model: dotted identity, dashed nominal, dash-dotted oracle, solid fitted or trained."""
    return _LINES.get(str(noise_model), "-")


def words(name: str) -> str:
    """Column name as words, with its unit if it has one.

    >>> words("rt_le_m"), words("window")
    ('RT-LE [m]', 'Window')
    """
    stem, _, suffix = name.rpartition("_")
    plain = (stem, SUFFIXES[suffix]) if stem and suffix in SUFFIXES else (name, "")
    text, unit = UNITS.get(name, (plain[0].replace("_", " ").capitalize(), plain[1]))
    return f"{text} [{unit}]" if unit else text


def title(column: str, value: object) -> str:
    """Title over a column of numbers.

    >>> title("max_neighbours", 4), title("method", "okf")
    ('K = 4', 'OKF')
    """
    if column in ("method", "noise_model"):
        return label(column, value)
    return f"{SYMBOLS.get(column, words(column))} = {label(column, value)}"


def label(column: str, value: object) -> str:
    """A parameter's value as words: methods by their label, whole floats without point.

    >>> label("method", "okf"), label("max_neighbours", 4.0)
    ('OKF', '4')
    """
    if column == "method":
        return look(str(value)).label
    if isinstance(value, float):
        return f"{value:g}"
    return str(value)

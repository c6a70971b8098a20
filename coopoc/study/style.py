"""One look per method in every figure and table: colour, marker and label; the line style is its noise model."""

import tomllib
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from ..evaluate.pictures import COLORS


class Look(NamedTuple):
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

    x: Mapping[Any, Mapping[str, Any]]
    where: Mapping[str, Any] = field(default_factory=dict)
    title: str = ""
    xlabel: str = ""
    ticks: Mapping[Any, str] = field(default_factory=dict)


DATA = tomllib.loads((Path(__file__).parent / "style.toml").read_text("utf-8"))
METHODS = {name: Look(*each) for name, each in DATA["methods"].items()}
UNITS = {column: tuple(each) for column, each in DATA["columns"].items()}
"""Column -> (words, unit)."""
RC = DATA["matplotlib"]
"""Options of matplotlib."""
CLIENTS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#56B4E9", "#4D4D4D")
"""Of the clients of one method, by number from 1."""
_LINES = {"identity": (0, (1, 1.4)), "nominal": (0, (5, 2)), "oracle": (0, (5, 1, 1, 1))}

SUFFIXES = {"m": "m", "s": "s", "hz": "Hz", "deg": "°"}
"""End of a column's name -> unit."""


NOT_CAUSAL_SUFFIX = ", not causal"
"""In the label of a method whose estimates change with what is measured later."""
OWN_NAMES: dict[str, str] = {}
"""Method that is none of ours -> the name that its class gives itself, as its rows have it."""
OWN_LOOKS: dict[str, int] = {}
"""Such a method -> the number of its colour and marker."""


def look(method: str) -> Look:
    """The look of a method; a number at its end is a client, in a colour of its own; an unknown one has one that no
    other has, until all are taken.

    >>> look("okf").label, look("individual2").label, look("mine.py:Alpha").label
    ('OKF', 'Individual KalmanNet 2', 'Alpha')
    """
    name = method.replace("_", "-")
    if name in METHODS:
        return METHODS[name]
    family = name.rstrip("0123456789-")
    if family in METHODS:
        shown, number = METHODS[family], name[len(family) :].strip("-")
        color = CLIENTS[(int(number) - 1) % len(CLIENTS)] if number.isdecimal() else shown.color
        return Look(f"{shown.label} {number}", color, shown.marker)
    full_name, method = method, method.rpartition(".py:")[2]  # of a file: its name there
    start, taken = zlib.crc32(method.encode()), OWN_LOOKS.values()
    free = (k % 25 for k in range(start, start + 25) if k % 25 not in taken)
    row, column = divmod(OWN_LOOKS.setdefault(full_name, next(free, start % 25)), 5)
    return Look(OWN_NAMES.get(full_name, method.replace("_", " ")), COLORS[column], "<>d8H"[row])


def line(noise_model: object) -> Any:
    """Line style of a noise model: dotted identity, dashed nominal, dash-dotted oracle, solid fitted or trained."""
    return _LINES.get(str(noise_model), "-")


def words(name: str) -> str:
    """Column name as words, with its unit if it has one.

    >>> words("rt_le_m"), words("window")
    ('RT-LE [m]', 'Window')
    """
    stem, _, suffix = name.rpartition("_")
    unit = SUFFIXES.get(suffix, "") if stem else ""
    text, unit = UNITS.get(name, ((stem if unit else name).replace("_", " ").capitalize(), unit))
    return f"{text} [{unit}]" if unit else text


def title(column: str, value: object, among: Iterable[object] = ()) -> str:
    """Title over a column of numbers, told apart as by `label`.

    >>> title("max_neighbours", 4), title("method", "okf")
    ('K = 4', 'OKF')
    """
    text = label(column, value, among)
    if column in ("method", "noise_model"):
        return text
    return f"{'K' if column == 'max_neighbours' else words(column)} = {text}"


def label(column: str, value: object, among: Iterable[object] = ()) -> str:
    """A parameter's value as words: methods by their label, whole floats without point; the value itself where another
    one `among` has the same words.

    >>> label("method", "okf"), label("max_neighbours", 4.0), label("x", 1.0000001, [1.0, 1.0000001])
    ('OKF', '4', '1.0000001')
    """
    if value != value:  # what a column of floats has for None
        return "None"
    text = look(str(value)).label if column == "method" else f"{value:g}" if isinstance(value, float) else str(value)
    return str(value) if any(other != value and label(column, other) == text for other in among) else text

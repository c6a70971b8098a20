"""Table: numbers with intervals that go into a paper as they are; Markdown, CSV, LaTeX and HTML."""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass
from html import escape
from typing import Any, Literal, TypeAlias

from tabulate import tabulate

from ..errors import InputError
from ..escapes import markdown, spreadsheet, tex, visible
from ..evaluate.statistics import Interval
from ..plugins import one_of
from .style import METHODS

Entry: TypeAlias = Interval | float | int | str | None
Best: TypeAlias = Literal["min", "max"] | None
REFERENCES = (METHODS["bound"].label, METHODS["oracle"].label, "oracle")
FORMATS = {"markdown": "md", "csv": "csv", "latex": "tex", "html": "html"}


@dataclass(frozen=True)
class Table:
    """Rows of entries under a header; an Interval shows its mean and its ends.

    Args:
        header: column titles, with units.
        rows: entries, as many per row as titles.
        caption: with the noise settings; it goes above the table in every format.
        best: "min" or "max": the number in bold.
        along: "row" or "column": where the best number is sought.
        unranked: row labels and titles (or parts of a title between commas) that are never the best: bounds, oracles.
        decimals: of numbers.
        intervals: show the ends.
        notes: sentences under the table.

    Raises:
        InputError: a row of another length than the header.

    >>> print(Table(("K", "KF"), ((1, Interval(0.8, 0.75, 0.85, 30)),), "RT-LE [m].").to_markdown())
    RT-LE [m].
    <BLANKLINE>
    |   K |                KF |
    |----:|------------------:|
    |   1 | 0.80 [0.75, 0.85] |
    """

    header: tuple[str, ...]
    rows: tuple[tuple[Entry, ...], ...]
    caption: str
    best: Best = None
    along: Literal["row", "column"] = "row"
    unranked: tuple[str, ...] = REFERENCES
    decimals: int = 2
    intervals: bool = True
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.header):
                raise InputError("rows", row, f"must have {len(self.header)} entries", f"Header: {self.header}.")

    @classmethod
    def from_data(cls, given: Any) -> Table:
        """The table whose `vars` were stored as JSON.

        Raises:
            InputError: it is no table.
        """
        try:
            rows = tuple(tuple(map(_entry, row)) for row in given["rows"])
            texts: dict[str, Any] = {name: tuple(map(str, given[name])) for name in ("header", "unranked", "notes")}
            allowed = {"best": ("min", "max", None), "along": ("row", "column"), "decimals": range(20)}
            if wrong := next((name for name, values in allowed.items() if given[name] not in values), ""):
                raise ValueError(wrong)
            shown: dict[str, Any] = {name: given[name] for name in allowed}
            return cls(rows=rows, caption=str(given["caption"]), intervals=bool(given["intervals"]), **texts, **shown)
        except (TypeError, KeyError, ValueError, OverflowError) as error:
            raise InputError("table", type(given).__name__, f"is damaged ({error})", "Repeat coopoc run.") from None

    def render(self, form: str) -> str:
        """The table in one of FORMATS; InputError for another."""
        one_of("format", form, FORMATS)
        text: str = getattr(self, f"to_{form}")()
        return text

    def to_markdown(self) -> str:
        """GitHub Markdown, best in bold, the caption above and notes below."""
        bold = self._bold()
        body = [
            [_mark(markdown(self.text(e)), (i, j) in bold, "**{}**") for j, e in enumerate(row)]
            for i, row in enumerate(self.rows)
        ]
        header, sides = [markdown(title) for title in self.header], self._sides("left", "right")
        grid = tabulate(body, header, "pipe", disable_numparse=True, colalign=sides)
        above, below = [markdown(self.caption)] if self.caption else [], map(markdown, self.notes)
        return "\n\n".join([*above, grid, *below])

    def to_csv(self) -> str:
        """Full precision; an interval takes three columns: mean, low, high. No text is a formula of a spreadsheet."""
        wide = [any(isinstance(row[j], Interval) for row in self.rows) for j in range(len(self.header))]
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        ends = ("", " low", " high")
        titles = [(title, end) for title, w in zip(self.header, wide, strict=True) for end in (ends if w else ends[:1])]
        writer.writerow([spreadsheet(title) + end for title, end in titles])
        for row in self.rows:
            writer.writerow([n for e, w in zip(row, wide, strict=True) for n in _columns(e, w)])
        return out.getvalue()

    def to_latex(self) -> str:
        r"""A table for \usepackage{booktabs,graphicx}, not wider than the line; best in bold, text escaped."""
        bold = self._bold()
        lines = [
            r"\begin{table}",
            r"\centering",
            rf"\caption{{{tex(' '.join(self.words))}}}",
            r"\smallskip",
            r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%",
            rf"\begin{{tabular}}{{{''.join(self._sides('l', 'r'))}}}",
            r"\toprule",
            " & ".join(map(tex, self.header)) + r" \\",
            r"\midrule",
        ]
        for i, row in enumerate(self.rows):
            entries = [self._latex(e, (i, j) in bold) for j, e in enumerate(row)]
            lines.append(" & ".join(entries) + r" \\")
        return "\n".join([*lines, r"\bottomrule", r"\end{tabular}}", r"\end{table}", ""])

    def to_html(self) -> str:
        """A <table> without styling of its own."""
        bold = self._bold()
        titles = [
            escape(visible(title)).replace(" = ", "&nbsp;=&nbsp;") for title in self.header
        ]  # K = 4 stays in one line
        head = "".join(f"<th scope=col>{title}</th>" for title in titles)
        body = []
        for i, row in enumerate(self.rows):
            cells = [self._html(e, (i, j) in bold) for j, e in enumerate(row)]
            body.append("<tr>" + "".join(cells) + "</tr>")
        caption = f"<caption>{escape(visible(' '.join(self.words)))}</caption>"
        return f"<table>{caption}<thead><tr>{head}</tr></thead><tbody>{''.join(body)}</tbody></table>"

    def _repr_html_(self) -> str:
        """HTML for a notebook."""
        return self.to_html()

    def text(self, entry: Entry) -> str:
        """One entry as text."""
        if isinstance(entry, Interval):
            ends = (
                ""
                if math.isnan(entry.low) or not self.intervals
                else (f" [{_number(entry.low, self.decimals)}, {_number(entry.high, self.decimals)}]")
            )
            return _number(entry.mean, self.decimals) + ends
        if isinstance(entry, float):
            return _number(entry, self.decimals)
        return "–" if entry is None else str(entry)

    def _latex(self, entry: Entry, bold: bool) -> str:
        if isinstance(entry, str):
            return tex(entry)
        mean, _, ends = self.text(entry).partition(" ")
        return _mark(tex(mean), bold, r"\textbf{{{}}}") + (rf" {{\scriptsize {ends}}}" if ends else "")

    def _html(self, entry: Entry, bold: bool) -> str:
        if isinstance(entry, str):
            return f"<td>{escape(visible(entry))}</td>"
        mean, _, ends = self.text(entry).partition(" ")
        small = f" <span class=interval>{escape(ends)}</span>" if ends else ""
        return f"<td class=number>{_mark(escape(mean), bold, '<strong>{}</strong>')}{small}</td>"

    def _sides(self, words: str, numbers: str) -> tuple[str, ...]:
        columns = zip(*self.rows, strict=True) if self.rows else ((),) * len(self.header)
        return tuple(words if any(isinstance(e, str) for e in column) else numbers for column in columns)

    @property
    def words(self) -> list[str]:
        """Caption and notes."""
        return [text for text in (self.caption, *self.notes) if text]

    def _bold(self) -> set[tuple[int, int]]:
        if self.best is None:
            return set()
        places: dict[int, list[tuple[float, int, int]]] = {}
        for i, row in enumerate(self.rows):
            for j, entry in enumerate(row):
                names = {*self.header[j].split(", "), *row}
                mean = entry.mean if isinstance(entry, Interval) else entry
                if isinstance(mean, float) and math.isfinite(mean) and not names & set(self.unranked):
                    places.setdefault(i if self.along == "row" else j, []).append((round(mean, self.decimals), i, j))
        pick = min if self.best == "min" else max
        return {(i, j) for group in places.values() if len(group) > 1 for mean, i, j in group if mean == pick(group)[0]}


def _number(value: float, decimals: int) -> str:
    return "–" if math.isnan(value) else f"{value:.{decimals}f}"


def _columns(entry: Entry, wide: bool) -> list[object]:
    if isinstance(entry, Interval):
        return [entry.mean, entry.low, entry.high]
    shown = spreadsheet(entry) if isinstance(entry, str) else entry
    return [shown, "", ""] if wide else [shown]


def _entry(stored: Any) -> Entry:
    """An entry as JSON has it: a mapping stands for an interval."""
    if isinstance(stored, dict):
        return Interval(float(stored["mean"]), float(stored["low"]), float(stored["high"]), int(stored["n"]))
    return stored if isinstance(stored, float | int | None) else str(stored)


def _mark(text: str, bold: bool, pattern: str) -> str:
    if not bold:
        return text
    mean, space, ends = text.partition(" ")
    return pattern.format(mean) + space + ends

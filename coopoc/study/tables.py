"""Table: numbers with intervals that go into a paper as they are; Markdown, CSV, LaTeX and HTML."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from tabulate import tabulate

from ..errors import InputError
from ..evaluate.statistics import Interval
from .style import METHODS, label, title, words

if TYPE_CHECKING:
    from .results import Results

Entry: TypeAlias = Interval | float | int | str | None
Best: TypeAlias = Literal["min", "max"] | None
REFERENCES = (METHODS["bound"].label, METHODS["oracle"].label, "oracle")
FORMATS = {"markdown": "md", "csv": "csv", "latex": "tex", "html": "html"}

_LATEX = {"\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
          "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "±": r"$\pm$", "–": "--", "≤": r"$\le$",
          "≥": r"$\ge$", "×": r"$\times$", "σ": r"$\sigma$", "°": r"$^\circ$", "²": r"$^2$",
          "<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}"}  # fmt: skip


@dataclass(frozen=True)
class Table:
    """Rows of entries under a header; an Interval shows its mean and, where there is room, its ends.

    Args:
        header: column titles, with units. rows: entries, as many per row as titles.
        caption: with the noise settings; it goes under the table in every format.
        best: "min" or "max": which number is set in bold. along: "row" or "column" in which it is sought.
        unranked: row labels and titles (or parts of a title between commas) that are never the best: bounds, oracles.
        decimals: of numbers. intervals: show the ends. notes: sentences under the table.

    Raises:
        InputError: a row of another length than the header.

    >>> print(Table(("K", "KF"), ((1, Interval(0.8, 0.75, 0.85, 30)),), "RT-LE [m].").to_markdown())
    |   K |                KF |
    |----:|------------------:|
    |   1 | 0.80 [0.75, 0.85] |
    <BLANKLINE>
    RT-LE [m].
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

    def render(self, form: str) -> str:
        """The table in one of FORMATS; InputError for another."""
        if form not in FORMATS:
            raise InputError("format", repr(form), f"must be one of {', '.join(FORMATS)}", "Pick one.")
        text: str = getattr(self, f"to_{form}")()
        return text

    def to_markdown(self) -> str:
        """GitHub Markdown, best in bold, caption and notes below."""
        bold = self._bold()
        body = [[_mark(self.text(e), (i, j) in bold, "**{}**").replace("|", "\\|") for j, e in enumerate(row)]
                for i, row in enumerate(self.rows)]  # fmt: skip
        grid = tabulate(body, self.header, "pipe", disable_numparse=True, colalign=self._sides("left", "right"))
        return "\n\n".join([grid, *self.below])

    def to_csv(self) -> str:
        """Full precision; an interval takes three columns: mean, low, high."""
        wide = [any(isinstance(row[j], Interval) for row in self.rows) for j in range(len(self.header))]
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        ends = ("", " low", " high")
        writer.writerow([t + end for t, w in zip(self.header, wide, strict=True) for end in (ends if w else ends[:1])])
        for row in self.rows:
            writer.writerow([n for e, w in zip(row, wide, strict=True) for n in _plain(e, w)])
        return out.getvalue()

    def to_latex(self) -> str:
        r"""A table for \usepackage{booktabs,graphicx}, not wider than the line; best in bold, text escaped."""
        bold = self._bold()
        lines = [r"\begin{table}", r"\centering", rf"\caption{{{_tex(' '.join(self.below))}}}", r"\smallskip",
                 r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%",
                 rf"\begin{{tabular}}{{{''.join(self._sides('l', 'r'))}}}", r"\toprule",
                 " & ".join(map(_tex, self.header)) + r" \\", r"\midrule"]  # fmt: skip
        for i, row in enumerate(self.rows):
            entries = [self._latex(e, (i, j) in bold) for j, e in enumerate(row)]
            lines.append(" & ".join(entries) + r" \\")
        return "\n".join([*lines, r"\bottomrule", r"\end{tabular}}", r"\end{table}", ""])

    def to_html(self) -> str:
        """A <table> without styling of its own."""
        bold = self._bold()
        titles = [escape(title).replace(" = ", "&nbsp;=&nbsp;") for title in self.header]  # K = 4 stays in one line
        head = "".join(f"<th scope=col>{title}</th>" for title in titles)
        body = []
        for i, row in enumerate(self.rows):
            cells = [self._html(e, (i, j) in bold) for j, e in enumerate(row)]
            body.append("<tr>" + "".join(cells) + "</tr>")
        caption = f"<caption>{escape(' '.join(self.below))}</caption>"
        return f"<table>{caption}<thead><tr>{head}</tr></thead><tbody>{''.join(body)}</tbody></table>"

    def _repr_html_(self) -> str:
        """What a notebook shows."""
        return self.to_html()

    def text(self, entry: Entry) -> str:
        """One entry as text."""
        if isinstance(entry, Interval):
            ends = "" if math.isnan(entry.low) or not self.intervals else (
                f" [{_number(entry.low, self.decimals)}, {_number(entry.high, self.decimals)}]")  # fmt: skip
            return _number(entry.mean, self.decimals) + ends
        if isinstance(entry, float):
            return _number(entry, self.decimals)
        return "–" if entry is None else str(entry)

    def _latex(self, entry: Entry, bold: bool) -> str:
        if isinstance(entry, str):
            return _tex(entry)
        mean, _, ends = self.text(entry).partition(" ")
        return _mark(_tex(mean), bold, r"\textbf{{{}}}") + (rf" {{\scriptsize {ends}}}" if ends else "")

    def _html(self, entry: Entry, bold: bool) -> str:
        if isinstance(entry, str):
            return f"<td>{escape(entry)}</td>"
        mean, _, ends = self.text(entry).partition(" ")
        small = f" <span class=interval>{escape(ends)}</span>" if ends else ""
        return f"<td class=number>{_mark(mean, bold, '<strong>{}</strong>')}{small}</td>"

    def _sides(self, words: str, numbers: str) -> tuple[str, ...]:
        columns = zip(*self.rows, strict=True) if self.rows else ((),) * len(self.header)
        return tuple(words if any(isinstance(e, str) for e in column) else numbers for column in columns)

    @property
    def below(self) -> list[str]:
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
        return {(i, j) for group in places.values() if len(group) > 1
                for mean, i, j in group if mean == pick(group)[0]}  # fmt: skip


def tabulated(
    results: Results,
    rows: str | Sequence[str],
    columns: str | Sequence[str],
    value: str,
    where: Mapping[str, Any] | None = None,
    caption: str = "",
    best: Best = "min",
    along: Literal["row", "column"] | None = None,
    decimals: int = 2,
    intervals: bool = True,
) -> Table:
    """Table of one metric over a study's results: mean over egos and runs, with its 95 % interval.

    Args:
        rows: column(s) of the frame that label the rows. columns: column(s) whose values become columns.
        value: the metric. where: column -> value or values. best: "min", "max" or None.
        along: where the best is sought; default among the methods.

    Raises:
        InputError: as `Results.summary`.
    """
    down, across = ([names] if isinstance(names, str) else list(names) for names in (rows, columns))
    summary = results.summary([*down, *across], value, where)
    summary["_title"] = [", ".join(title(c, row[c]) for c in across) for _, row in summary.iterrows()]
    titles = list(dict.fromkeys(summary["_title"]))
    body = []
    for names, group in summary.groupby(down, sort=False, dropna=False):
        found = {row["_title"]: Interval(row["mean"], row["low"], row["high"], int(row["n"]))
                 for _, row in group.iterrows() if row["n"]}  # fmt: skip
        body.append((*(label(d, n) for d, n in zip(down, names, strict=True)), *map(found.get, titles)))
    missing = int(summary["missing"].sum())
    return Table(
        (*map(words, down), *titles), tuple(body), caption or f"{words(value)}: mean and 95 % interval.", best,
        along or ("column" if "method" in down else "row"), decimals=decimals, intervals=intervals,
        notes=(f"{missing} egos are left out because a run of theirs failed.",) if missing else (),
    )  # fmt: skip


def _number(value: float, decimals: int) -> str:
    return "–" if math.isnan(value) else f"{value:.{decimals}f}"


def _plain(entry: Entry, wide: bool) -> list[object]:
    if isinstance(entry, Interval):
        return [entry.mean, entry.low, entry.high]
    return [entry, "", ""] if wide else [entry]


def _mark(text: str, bold: bool, pattern: str) -> str:
    if not bold:
        return text
    mean, space, ends = text.partition(" ")
    return pattern.format(mean) + space + ends


def _tex(text: str) -> str:
    return "".join(_LATEX.get(letter, letter) for letter in text)

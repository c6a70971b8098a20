"""Tables with intervals for papers and pages (Markdown, CSV, LaTeX, HTML), and tables of a study's results."""

import csv
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from math import floor, isfinite, isnan, log10
from pathlib import Path
from textwrap import shorten
from typing import Any, Literal

from tabulate import tabulate

from ..arrays import one_of
from ..errors import InputError
from ..evaluate.statistics import WORSE_RATIO, Interval
from ..paths import write
from ..text import markdown, spreadsheet, tex, visible
from .numbers import EQUAL_SHARE, Number, Results, Where, failures, sign
from .style import METHODS, NOT_CAUSAL_SUFFIX, label, title, words

Entry = Interval | float | int | str | None
Best = Literal["min", "max"] | None
UNRANKED = {METHODS["bound"].label, METHODS["oracle"].label, "oracle", "Difference"}
"""Row labels and titles (or parts of a title between commas) that are never the best."""
_SMOOTHERS = METHODS["batch-smoother"].label, NOT_CAUSAL_SUFFIX
"""Label of the method that uses later measurements, too: it is not compared with the others."""
MOST_DECIMALS, LONGEST_REASON = 9, 200
FORMATS = {"markdown": "md", "csv": "csv", "latex": "tex", "html": "html"}


@dataclass(frozen=True)
class Table:
    """Rows of entries under a header; an Interval shows its mean and its ends.

    Args:
        header: column titles, with units.
        rows: entries, as many per row as titles.
        caption: with the noise settings; it goes above the table in every format.
        best: "min" or "max": the number in bold, and those alike or within EQUAL_SHARE; nothing where all are.
        along: "row" or "column": where the best number is sought.
        decimals: of numbers, at least: the least of the best has two digits.
        intervals: show the ends.
        notes: sentences under the table.
        alike: (row, column) of numbers that noise may explain to be worse than the best.

    Raises:
        InputError: a row of another length than the header.

    >>> print(Table(("K", "KF"), ((1, Interval(0.8, 0.75, 0.85, 30)),), "RT-LE [m].").to_markdown())
    RT-LE [m].
    <BLANKLINE>
    |   K |                KF |
    |----:|------------------:|
    |   1 | 0.80 [0.75, 0.85] |
    >>> print(Table(("K", "KF", "OKF"), ((1, 0.0123, 0.0124),), "", "min").to_markdown())
    |   K |        KF |   OKF |
    |----:|----------:|------:|
    |   1 | **0.012** | 0.012 |
    """

    header: tuple[str, ...]
    rows: tuple[tuple[Entry, ...], ...]
    caption: str
    best: Best = None
    along: Literal["row", "column"] = "row"
    decimals: int = 2
    intervals: bool = True
    notes: tuple[str, ...] = ()
    alike: tuple[tuple[int, int], ...] = ()

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.header):
                raise InputError("rows", row, f"must have {len(self.header)} entries", f"Header: {self.header}.")

    @classmethod
    def from_data(cls, data: Any) -> "Table":
        """The table whose `vars` were stored as JSON; InputError if it is none."""
        try:
            rows = tuple(tuple(map(_entry, row)) for row in data["rows"])
            texts: dict[str, Any] = {name: tuple(map(str, data[name])) for name in ("header", "notes")}
            allowed = {"best": ("min", "max", None), "along": ("row", "column"), "decimals": range(20)}
            if wrong := next((name for name, values in allowed.items() if data[name] not in values), ""):
                raise ValueError(wrong)
            shown: dict[str, Any] = {name: data[name] for name in allowed}
            shown["alike"] = tuple((int(i), int(j)) for i, j in data.get("alike", ()))
            return cls(rows=rows, caption=str(data["caption"]), intervals=bool(data["intervals"]), **texts, **shown)
        except (TypeError, KeyError, ValueError, OverflowError) as error:
            raise InputError("table", type(data).__name__, f"is damaged ({error})", "Repeat coopoc run.") from None

    def render(self, form: str) -> str:
        """The table in one of FORMATS; InputError for another."""
        text: str = getattr(self, f"to_{one_of('format', form, FORMATS)}")()
        return text

    def save(self, path: str | Path) -> str:
        """Write the table in each of FORMATS, path.md and so on, and return caption and notes."""

        for form, suffix in FORMATS.items():
            write(Path(f"{path}.{suffix}"), self.render(form))
        return self.words

    def to_markdown(self) -> str:
        """GitHub Markdown, best in bold, the caption above and notes below."""
        body = self._body(markdown, "**{}**", " {}")
        header, sides = [markdown(title) for title in self.header], self._sides("left", "right")
        grid = tabulate(body, header, "pipe", disable_numparse=True, colalign=sides)
        above = [markdown(self.caption)] if self.caption else []
        return "\n\n".join([*above, grid, *map(markdown, self.notes)])

    def to_csv(self) -> str:
        """Full precision; an interval takes three columns: mean, low, high. No text is a formula of a spreadsheet."""
        wide = [any(isinstance(row[j], Interval) for row in self.rows) for j in range(len(self.header))]
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        ends = {False: ("",), True: ("", " low", " high")}
        titles = zip(self.header, wide, strict=True)
        writer.writerow([spreadsheet(title) + end for title, w in titles for end in ends[w]])
        for row in self.rows:
            writer.writerow([n for e, w in zip(row, wide, strict=True) for n in _columns(e, w)])
        return out.getvalue()

    def to_latex(self) -> str:
        r"""A table for \usepackage{booktabs,graphicx}, not wider than the line; best in bold, text escaped."""
        body = self._body(tex, r"\textbf{{{}}}", r" {{\scriptsize {}}}")
        lines = [
            r"\begin{table}",
            r"\centering",
            rf"\caption{{{tex(self.words)}}}",
            r"\smallskip",
            r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%",
            rf"\begin{{tabular}}{{{''.join(self._sides('l', 'r'))}}}",
            r"\toprule",
            _tex_row([*map(tex, self.header)]),
            r"\midrule",
            *map(_tex_row, body),
        ]
        return "\n".join([*lines, r"\bottomrule", r"\end{tabular}}", r"\end{table}", ""])

    def to_html(self) -> str:
        """A <table> without styling of its own."""
        titles = [escape(visible(title)).replace(" = ", "&nbsp;=&nbsp;") for title in self.header]  # on one line
        shown = self._body(lambda text: escape(visible(text)), "<strong>{}</strong>", " <span class=interval>{}</span>")
        body = ""
        for row, texts in zip(self.rows, shown, strict=True):
            kinds = ("" if isinstance(entry, str) else " class=number" for entry in row)
            body += f"<tr>{''.join(f'<td{kind}>{text}</td>' for kind, text in zip(kinds, texts, strict=True))}</tr>"
        head = f"<thead><tr>{''.join(f'<th scope=col>{title}</th>' for title in titles)}</tr></thead>"
        return f"<table><caption>{escape(visible(self.words))}</caption>{head}<tbody>{body}</tbody></table>"

    _repr_html_ = to_html
    """HTML for a notebook."""

    @property
    def words(self) -> str:
        """Caption and notes."""
        return " ".join(text for text in (self.caption, *self.notes) if text)

    def _body(self, escaped: Callable[[str], str], strong: str, ends: str) -> list[list[str]]:
        """Entries in a format: `strong` is the pattern of the best mean, `ends` that of an interval's ends."""
        bold, body = self._bold(), list[list[str]]()
        least = min((abs(group[0][0]) for group in self.ranked() if group[0][0]), default=1.0)
        decimals = max(self.decimals, min(1 - floor(log10(least)), MOST_DECIMALS))

        def shown(value: float) -> str:
            return "–" if isnan(value) else f"{value:.{decimals}f}"

        for i, row in enumerate(self.rows):
            texts = []
            for j, entry in enumerate(row):
                mean = entry.mean if isinstance(entry, Interval) else entry
                text = escaped(shown(mean) if isinstance(mean, float) else "–" if mean is None else str(mean))
                texts.append(strong.format(text) if (i, j) in bold else text)
                if isinstance(entry, Interval) and self.intervals and not isnan(entry.low):
                    texts[-1] += ends.format(f"[{shown(entry.low)}, {shown(entry.high)}]")
            body.append(texts)
        return body

    def _sides(self, left: str, right: str) -> tuple[str, ...]:
        """Alignment of each column: text at the left, numbers at the right."""
        columns = zip(*self.rows, strict=True) if self.rows else ((),) * len(self.header)
        return tuple(left if any(isinstance(e, str) for e in column) else right for column in columns)

    def _bold(self) -> set[tuple[int, int]]:
        """(row, column) of the best numbers and of those alike."""
        bold = set()
        for group in self.ranked():
            best = group[0][0]
            same = [(i, j) for n, i, j in group if abs(n - best) <= EQUAL_SHARE * abs(best) or (i, j) in self.alike]
            if len(same) < len(group):
                bold |= {*same}
        return bold

    def ranked(self) -> list[list[tuple[float, int, int]]]:
        """For each row or column: its numbers, each with row and column, the best first; without means that lack more
        values than others."""
        places: dict[int, list[tuple[int, float, int, int]]] = {}
        if self.best is None:
            return []
        for i, row in enumerate(self.rows):
            for j, entry in enumerate(row):
                names = {*self.header[j].split(", "), *row}
                mean = entry.mean if isinstance(entry, Interval) else entry
                if isinstance(mean, float) and isfinite(mean) and not (names & UNRANKED or smooths(names)):
                    lost = getattr(entry, "lost", 0)
                    places.setdefault(i if self.along == "row" else j, []).append((lost, mean, i, j))
        whole = [[(mean, i, j) for least, mean, i, j in each if least == min(each)[0]] for each in places.values()]
        return [sorted(group, reverse=self.best == "max") for group in whole]


def pivot(
    results: Results,
    rows: str | Sequence[str],
    columns: str | Sequence[str],
    value: str,
    where: Where | None = None,
    caption: str = "",
    best: Best = "min",
    decimals: int = 2,
    intervals: bool = True,
) -> Table:
    """Table of one metric over a study's results: mean over egos and runs, with its 95 % interval.

    Args:
        results: of the study.
        rows: column or columns of the frame that label the rows.
        columns: column or columns whose values become columns.
        value: the metric.
        where: column -> value or values.
        caption: of the table; default the metric.
        best: "min", "max" or None, sought among the methods.
        decimals: as of `Table`.
        intervals: show the ends.

    Raises:
        InputError: as `Results.summary`.
    """
    down, across = ([names] if isinstance(names, str) else list(names) for names in (rows, columns))
    summary = results.with_failed().summary([*down, *across], value, where)
    same = [name for name in down if len(down) > 1 and summary[name].nunique(dropna=False) == 1]
    in_all = [f"{words(name)}: {label(name, summary[name].iloc[0])}." for name in same]  # and no column
    if intervals and summary["low"].notna().any():
        in_all.append("In brackets: 95 % interval.")
    caption = " ".join([caption or f"{words(value)}.", *in_all])
    down = [name for name in down if name not in same] or down[:1]
    titles, of = dict[str, None](), dict[tuple[Entry, ...], dict[str, Any]]()
    for row in summary.to_dict("records"):
        text = ", ".join(title(name, row[name], summary[name].unique()) for name in across)
        titles[text] = None
        of.setdefault(tuple(label(name, row[name], summary[name].unique()) for name in down), {})[text] = row
    body = []
    for labels in sorted(of, key=smooths):
        matches = (of[labels].get(text) for text in titles)
        ends = "mean", "low", "high", "n", "missing"
        entries = (Interval(*(row[name] for name in ends)) if row and row["n"] else None for row in matches)
        body.append((*labels, *entries))
    gone = []
    for name, part in _by_method(summary[summary["missing"] > 0]):
        values = f"{part['missing'].max()} values of {name} are left out"
        gone.append(f"{values} of {len(part)} means, as a run of an ego has no finite number.")
    if best and any(map(smooths, of)):
        gone.append("What knows later measurements, or draws random numbers anew, is not ranked.")
    made = Table(
        (*map(words, down), *titles),
        tuple(body),
        caption,
        best,
        "column" if "method" in down else "row",
        decimals=decimals,
        intervals=intervals,
        notes=(*gone, *failed(results, where or {}), *lost(results.with_failed(), where)),
    )
    same_as_best = []
    for ranked in made.ranked():
        first, *others = (of[made.rows[i][: len(down)]][made.header[j]] for _, i, j in ranked)
        for (_, i, j), row in zip(ranked[1:], others, strict=True):
            one, other = ({**(where or {}), **{k: each[k] for k in (*down, *across)}} for each in (first, row))
            apart = row["low"] > first["high"] or row["high"] < first["low"]  # then pairs are, too
            if not (apart or sign(results, one, other, value)):
                same_as_best.append((i, j))
    made = replace(made, alike=tuple(same_as_best))
    bold = " Bold: the best, and those whose difference from it noise may explain." * bool(made._bold())
    return replace(made, caption=caption + bold)


def smooths(labels: Iterable[object]) -> bool:
    """Whether one of the labels is that of a method which knows later measurements.

    >>> smooths(["Alpha, not causal"])
    True
    """
    return any(mark in str(name) for name in labels for mark in _SMOOTHERS)


def failed(results: Results, *wheres: Where) -> list[str]:
    """A sentence for each method with failed cells in one of the selections: how many, and the first reason."""
    rows = results.failures.loc[sorted({index for where in wheres for index in failures(results, where).index})]
    texts = []
    for name, part in _by_method(rows):
        reason = shorten(part["reason"].iloc[0].rstrip("."), LONGEST_REASON)
        texts.append(f"Failed cells of {name}: {len(part)}, first reason: {reason}.")
    return texts


def lost(results: Results, where: Where | None = None) -> list[str]:
    """A sentence for each method whose estimates left the fixes by more than 100 standard deviations."""
    rows = results.select(where)
    text = "{} diverged in {} rows: an estimate is more than 100 standard deviations away from a fix."
    far = rows[rows["left_fixes"] > 0] if "left_fixes" in rows else rows[:0]
    return [text.format(name, len(part)) for name, part in _by_method(far)]


def _by_method(rows: Any) -> list[tuple[str, Any]]:
    """Label of each method, or of all, and its rows."""
    by = "method" if "method" in rows else lambda _: "the study"
    return [(label("method", name), part) for name, part in rows.groupby(by, sort=False)]


def unused(results: Results, real: bool) -> list[str]:
    """A sentence for each method and K whose errors are those of a vehicle alone, in every run and for every ego, or on
    real data larger."""
    rows, texts, by = results.frame, [], ["method", "max_neighbours"]
    value = "rt_le_m" if "rt_le_m" in rows else "innovation_m"
    sent = "sent_bytes" if "sent_bytes" in rows else "sent_bytes_per_second"
    if not {*by, sent, value} <= set(rows):
        return []
    keys = [name for name in (*results.axes, "ego", "run", "train_seed") if name in rows and name not in by]
    for (method, k), part in rows[rows[sent] > 0].groupby(by, sort=False):
        own = (rows["method"] == method) & (rows["max_neighbours"] == 0)
        both = part.merge(rows[own | (rows["method"] == "kalman") & (rows["max_neighbours"] == k)], on=keys)
        together, alone = (both[f"{value}_{side}"] for side in "xy")
        gap = (together / alone - 1).abs().groupby([both[key] for key in keys], dropna=False).min()
        text = f"{label('method', method)}, K = {k}:"
        if k and len(gap) == len(part) and gap.max() < EQUAL_SHARE:
            lacks = "what was measured lacks what it takes, such as an azimuth, or says far less than fixes"
            why = lacks if part["bytes_per_second"].any() else "no message arrived"
            text += f" equal to solo within {EQUAL_SHARE:.1%}: no neighbour's measurement had an effect, because {why}."
        elif k and real and together.mean() > WORSE_RATIO * alone.mean():
            text += f" worse than alone, {together.mean():.3g} m for {alone.mean():.3g} m: what was measured of "
            text += "neighbours, or its stated noise, is wrong. coopoc data check says what looks so."
        else:
            continue
        texts.append(text)
    return texts


def crossed(
    results: Results,
    head: Sequence[str],
    rows: Iterable[tuple[Sequence[Entry], Where]],
    columns: Mapping[str, Number],
    caption: str,
    **options: Any,
) -> Table | None:
    """Table with a row per selection and a column per number; rows that were not run are left out.

    Args:
        results: of the study.
        head: titles over the labels of a row.
        rows: labels and selection of each.
        columns: title -> number of a selection, such as `coopoc.study.numbers.mean`.
        caption: under the table.
        options: of `Table`.

    Returns:
        The table, or None if no row was run.
    """
    body, wheres = [], []
    for labels, where in rows:
        wheres.append(where)
        entries = [number(results, where) for number in columns.values()]
        if any(entry is not None for entry in entries) or len(failures(results, where)):
            body.append((*labels, *entries))
    some = sum(getattr(entry, "lost", 0) > 0 for row in body for entry in row)
    gone = [f"{some} means lack values of a run that has no finite number."] * bool(some)
    options["notes"] = (*options.get("notes", ()), *gone, *failed(results, *wheres), *lost(results))
    return Table((*head, *columns), tuple(body), caption, **options) if body else None


def _tex_row(texts: Sequence[str]) -> str:
    r"""A row; [ or * at its begin is no argument of the command before.

    >>> _tex_row(("*a", "1"))
    '{}*a & 1 \\\\'
    """
    return "{}" * texts[0].startswith(("[", "*")) + " & ".join(texts) + r" \\"


def _columns(entry: Entry, wide: bool) -> list[object]:
    if isinstance(entry, Interval):
        return [entry.mean, entry.low, entry.high]
    shown = spreadsheet(entry) if isinstance(entry, str) else entry
    return [shown, "", ""] if wide else [shown]


def _entry(stored: Any) -> Entry:
    """An entry as JSON has it: a mapping stands for an interval."""
    if isinstance(stored, dict):
        mean, low, high = (float(stored[end]) for end in ("mean", "low", "high"))
        return Interval(mean, low, high, int(stored["n"]), int(stored.get("lost", 0)))
    return stored if isinstance(stored, float | int | None) else str(stored)

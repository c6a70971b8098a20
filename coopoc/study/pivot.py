"""Tables of a study: `pivot` puts one metric's columns across and down, `crossed` any numbers beside any selections."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

from ..evaluate.statistics import Interval
from .numbers import Number, Where
from .style import label, title, words
from .tables import Best, Entry, Table

if TYPE_CHECKING:
    from .results import Results


def pivot(
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
        results: of the study.
        rows: column or columns of the frame that label the rows.
        columns: column or columns whose values become columns.
        value: the metric.
        where: column -> value or values.
        caption: under the table; default the metric.
        best: "min", "max" or None.
        along: where the best is sought; default among the methods.
        decimals: of numbers.
        intervals: show the ends.

    Raises:
        InputError: as `Results.summary`.
    """
    down, across = ([names] if isinstance(names, str) else list(names) for names in (rows, columns))
    summary = results.summary([*down, *across], value, where)
    summary["_title"] = [", ".join(title(c, row[c]) for c in across) for _, row in summary.iterrows()]
    titles = list(dict.fromkeys(summary["_title"]))
    body = []
    for names, group in summary.groupby(down, sort=False, dropna=False):
        found = {
            row["_title"]: Interval(row["mean"], row["low"], row["high"], int(row["n"]))
            for _, row in group.iterrows()
            if row["n"]
        }
        body.append((*(label(d, n) for d, n in zip(down, names, strict=True)), *map(found.get, titles)))
    missing = int(summary["missing"].sum())
    return Table(
        (*map(words, down), *titles),
        tuple(body),
        caption or f"{words(value)}: mean and 95 % interval.",
        best,
        along or ("column" if "method" in down else "row"),
        decimals=decimals,
        intervals=intervals,
        notes=(f"{missing} egos are left out because a run of theirs failed.",) if missing else (),
    )


def crossed(
    results: Results,
    head: Sequence[str],
    rows: Iterable[tuple[Sequence[Entry], Where]],
    columns: Sequence[tuple[str, Number]],
    caption: str,
    **options: Any,
) -> Table | None:
    """Table with a row per selection and a column per number; rows that were not run are left out.

    Args:
        results: of the study.
        head: titles over the labels of a row.
        rows: labels and selection of each.
        columns: title and number of a selection, such as `coopoc.study.numbers.mean`.
        caption: under the table.
        options: of `Table`.

    Returns:
        The table, or None if no row was run.
    """
    found = [(labels, [number(results, where) for _, number in columns]) for labels, where in rows]
    body = [(*labels, *entries) for labels, entries in found if any(entry is not None for entry in entries)]
    return Table((*head, *(title for title, _ in columns)), tuple(body), caption, **options) if body else None


def across(number: Number, selections: Mapping[str, Where]) -> list[tuple[str, Number]]:
    """Columns of `crossed` that show one number.

    Args:
        number: of a selection.
        selections: title -> what the column adds to the selection of a row.
    """

    def column(also: Where) -> Number:
        return lambda results, where: number(results, {**where, **also})

    return [(title, column(also)) for title, also in selections.items()]

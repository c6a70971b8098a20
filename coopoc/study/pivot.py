"""pivot: one metric of a study's results as a table, such as methods across and neighbours down."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

from ..evaluate.statistics import Interval
from .results import Results
from .style import label, title, words
from .tables import Best, Table


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

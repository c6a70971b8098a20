"""Views of studies declared as data: tables and figures whose captions end with the conditions of the study."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeAlias

from coopoc.study.numbers import Number, Results, Where, present
from coopoc.study.style import Panel
from coopoc.study.tables import Entry, Table, crossed, pivot, unused

from . import scene

if TYPE_CHECKING:
    from coopoc.study import plot

Plot: TypeAlias = "plot.Plot"
"""For annotations: its module loads matplotlib, for which a mistake in --set need not wait."""
TableView = Callable[[Results], Table | None]
FigureView: TypeAlias = "Callable[[Results], Plot | None]"
Rows = Iterable[tuple[Sequence[Entry], Where]]


def of(method: str, noise_model: str, /, **at: Any) -> Where:
    """A method under a noise model, as parameters of a cell or as a selection."""
    return {**at, "method": method, "noise_model": noise_model}


def ran_at(results: Results, axis: str) -> list[int]:
    """The numbers of a setting, such as one of neighbours, that were run."""
    return sorted({*results.frame.get(axis, ())})


def table(
    *texts: str,
    value: str = "rt_le_m",
    rows: str | Sequence[str] = "method",
    columns: str | Sequence[str] = "max_neighbours",
    where: Where | None = None,
    **options: Any,
) -> TableView:
    """A metric with columns of the results down and across, as `pivot`; None where nothing was run.

    Args:
        texts: of the caption, which may name settings in braces.
        value: the metric.
        rows: columns of the results that label the rows.
        columns: columns of the results whose values become columns.
        where: the selection; values that were not run are left out.
        options: of `pivot`.
    """

    def view(results: "Results") -> Table | None:
        kept = present(results.with_failed(), where or {}, value)
        if kept is None:
            return None
        made = pivot(results, rows, columns, value, kept, scene.caption(results, *texts), **options)
        return replace(made, notes=(*made.notes, *unused(results, scene.is_real(results.settings["data"]))))

    return view


def selections(
    head: Sequence[str],
    rows: "Rows | Callable[[Results], Rows]",
    columns: Mapping[str, Number],
    *texts: str,
    at: Where | None = None,
    **options: Any,
) -> TableView:
    """Selections down and numbers across, as `crossed`; None where nothing was run.

    Args:
        head: titles over the labels of a row.
        rows: labels and selection of each, or a function of the results that gives them.
        columns: title -> number.
        texts: of the caption.
        at: parameters that the caption names beside the settings.
        options: of `Table`.
    """

    def view(results: "Results") -> Table | None:
        shown = rows(results) if callable(rows) else rows
        return crossed(results, head, shown, columns, scene.caption(results, *texts, **(at or {})), **options)

    return view


def curves(
    panels: Sequence[Panel], lines: Sequence[Where], *texts: str, at: Where | None = None, **options: Any
) -> FigureView:
    """A number over a parameter, as `coopoc.study.figures.curves`.

    Args:
        panels: of the figure.
        lines: selection of each line.
        texts: of the caption.
        at: parameters that the caption names beside the settings.
        options: of `coopoc.study.figures.curves`.
    """

    def view(results: "Results") -> "Plot | None":
        from coopoc.study import figures

        return figures.curves(results, panels, lines, scene.caption(results, *texts, **(at or {})), **options)

    return view

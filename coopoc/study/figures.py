"""Figures of a study: a metric over an axis, and its bytes."""

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke

from ..errors import InputError
from ..evaluate.statistics import Interval
from ..text import picture, wrapped
from .numbers import Number, Results, Where, failures, interval, mean, ran
from .plot import Plot, canvas, legend, name_of, place, plain_log, strokes
from .results import NO_VALUES
from .style import Panel, label, look, words
from .tables import failed


def sweep(results: Results, x: str, where: Where | None = None, caption: str = "", log: bool = False) -> Plot:
    """Plot RT-LE against an axis: one line per method and noise model with its 95 % band; "bound" is dashed.

    Without a column `method` there is one line per combination of the other axes.

    Args:
        results: of the study.
        x: column of the horizontal axis; its values are evenly spaced if a word or None is among them.
        where: column -> value or values.
        caption: under the figure; default the metric and the axis.
        log: logarithmic vertical axis.

    Raises:
        InputError: as `Results.summary`.

    >>> from pandas import DataFrame
    >>> from coopoc.study.results import Results
    >>> frame = DataFrame({"method": "okf", "weather": ["$rain", None], "ego": "e", "run": 0, "rt_le_m": [1.0, 2.0]})
    >>> axes = sweep(Results("s", "?", (), {}, frame, frame[:0], 0, {}), "weather").figure.axes[0]
    >>> [text.get_text() for text in axes.get_xticklabels()], axes.lines[0].get_xdata(orig=False).tolist()
    (['\\\\$rain', 'None'], [0.0, 1.0])
    >>> both = DataFrame({"a": [1, 2], "x": [0, 0], "ego": "e", "run": 0, "rt_le_m": [1.0, 2.0]})
    >>> axes = sweep(Results("s", "?", ("a", "x"), {}, both, both[:0], 0, {}), "x").figure.axes[0]
    >>> [text.get_text() for text in axes.get_legend().get_texts()], len({line.get_color() for line in axes.lines})
    (['A = 1', 'A = 2'], 2)
    """
    rows = results.with_failed().select(where)
    values = [None if value != value else value for value in rows[x].sort_values().unique()]
    named = any(isinstance(value, str | None) for value in values)
    places = {picture(label(x, value, values)) if named else value: {x: value} for value in values}
    panel = Panel(places, dict(where or {}), xlabel=words(x))
    names = _line_names(results, x)
    each = rows[names].drop_duplicates().astype(object)
    lines: list[Any] = each.where(each.notna(), None).to_dict("records") if names else [{}]
    text = caption or f"{words('rt_le_m')} against {words(x)}. Bands: 95 % intervals over egos, then runs."
    plot = curves(results, [panel], lines, text, interval, ylabel=words("rt_le_m"), log=log, width=6.4)
    if plot is None:
        raise InputError("rt_le_m", "no value", "must have been computed for a cell", "See the failed cells.")
    return plot


def pareto(results: Results, caption: str, x: str = "bytes_per_second", where: Where | None = None) -> Plot:
    """Plot RT-LE against received bytes per second, a mark per cell; a line joins those that no cheaper one beats.

    Methods that receive nothing are horizontal lines.

    Args:
        results: of the study.
        caption: under the figure.
        x: bytes per second of online cooperation.
        where: column -> value or values.

    Raises:
        InputError: as `Results.summary`.
    """
    names = _line_names(results)
    summary = results.summary(axes := [a for a in results.axes if a != "train_seed"], "rt_le_m", where)
    summary["bytes"] = results.summary(axes, x, where)["mean"]
    shown = list[tuple[Where, Any]]()
    for key, group in summary.dropna(subset=["mean"]).groupby(names, sort=False):
        of = dict(zip(names, key, strict=True))
        points = sorted(zip(group["bytes"], group["mean"], strict=True))
        marks = {(sent, k): y for k, (sent, y) in enumerate(points) if sent}  # several may cost the same
        alone = not marks or of["method"] == "bound"
        shown.append((of, min(y for _, y in points) if alone else marks))
    drawn = {id(of): points for of, points in shown}
    groups, _ = _coinciding([("", shown)], log=True)
    groups.sort(key=lambda alike: not isinstance(drawn[id(alike[0])], Mapping))
    with canvas(width=7.0) as (figure, panel):
        for line, *_ in groups:
            points = drawn[id(line)]
            if not isinstance(points, Mapping):
                _draw(panel, line, points)
                continue
            sent = [(at, y) for (at, _), y in points.items()]
            panel.plot(*zip(*sent, strict=True), **{**strokes(line), "linestyle": "none"})
            best = [p for k, p in enumerate(sent) if all(p[1] < other[1] for other in sent[:k])]
            panel.plot(*zip(*best, strict=True), **{**strokes(line), "marker": "", "linewidth": 0.8})
        plain_log(panel.xaxis)
        plain_log(panel.yaxis)
        panel.set(xlabel=words(x), ylabel=words("rt_le_m"))
        also = {}
        for alike in groups:
            more, model = _joined(alike).removeprefix(_joined(alike[:1])), alike[0].get("noise_model")
            also[name_of(alike[0])] = f" ({model}{more})" if more and model else more
        legend(panel, [alike[0] for alike in groups], also)
    return Plot(figure, " ".join([caption, *failed(results, where or {})]))


STYLE = ("label", "color", "marker", "linestyle", "linewidth")
"""Entries of a line that say how it looks and select nothing."""


def curves(
    results: Results,
    panels: Sequence[Panel],
    lines: Sequence[Where],
    caption: str,
    number: Number = mean,
    levels: Sequence[Where] = (),
    ylabel: str = "RT-LE [m]",
    width: float | None = None,
    log: bool = False,
    logx: bool = False,
) -> Plot | None:
    """Plot a number of selections over a parameter, in panels that share the vertical axis; None if none was run.

    The selection of a point is that of its panel, its place and its line, where the later name wins. Lines differ
    by method; their style shows the noise model where they have several.

    Args:
        results: of the study.
        panels: at least one; a panel in which nothing was run is left out.
        lines: method, noise model and other columns -> value, and entries of STYLE.
        caption: under the figure.
        number: of a selection; an interval gets a band.
        levels: lines that do not depend on the place and are drawn across.
        ylabel: label of the vertical axis.
        width: inches.
        log: logarithmic vertical axis; a linear one starts at zero.
        logx: logarithmic horizontal axes.
    """
    every, shown, absent = [*lines, *levels], [], list[Where]()

    def at(*parts: Where) -> Any:
        """The number of a selection: None if it was not run, NO_VALUES if it failed."""
        where = {name: value for part in parts for name, value in part.items() if name not in STYLE}
        if (value := number(results, where)) is None and len(failures(results, where)):
            absent.append(where)
            return NO_VALUES
        return value

    models = {of["noise_model"] for of in every if "noise_model" in of and of.get("method") != "bound"}
    models -= {"none", "trained", None}
    labelled = any("label" in of for of in every)
    for panel in panels:
        drawn = []
        for of in lines:
            points = ran({x: at(panel.where, more, of) for x, more in panel.x.items()})
            drawn += [(of, points)] if _heights(points) else []
        if drawn or len(panels) == 1:
            flat = [(of, y) for of in levels if _heights(y := at(panel.where, of))]
            shown.append((panel, [*drawn, *flat]))
    if not any(drawn for _, drawn in shown):
        return None
    coinciding, near = _coinciding(shown, log)
    groups = {id(group[0]): group for group in coinciding}
    width = width or 2.2 + 2.1 * len(shown) + (len(shown) == 1)
    with canvas(1, len(shown), width, 3.1, sharey=True, squeeze=False) as (figure, (axes,)):
        named, also = list[dict[str, Any]](), dict[str, str]()
        for axis, (panel, drawn) in zip(axes, shown, strict=True):
            for of, points in drawn:
                if id(of) not in groups:
                    continue
                usual = ("method", "noise_model") if "method" in of else of
                names = {name: of[name] for name in usual if name in of and name not in STYLE}
                if len(models) < 2 and of.get("method", "bound") != "bound":
                    names["noise_model"] = "none"
                text = _joined(groups[id(of)], models)
                style = {name: of[name] for name in STYLE if name in of}
                if labelled:
                    style["label"] = wrapped(text)
                _draw(axis, names, points, style)
                named += [names] if names not in named else []
                more, model = text.removeprefix(_joined([of])), str(of.get("noise_model"))
                more = f"\n{model}{more}" if more and model in models and len(models) > 1 else more
                if more not in also.setdefault(name_of(names), ""):
                    also[name_of(names)] += more
            alone = [(of, points) for of, points in drawn if id(of) in groups and isinstance(points, Mapping)]
            _name_alike(axis, alone, log, near)
            axis.set(title=picture(panel.title), xlabel=panel.xlabel)
            if logx:
                plain_log(axis.xaxis)
            if panel.ticks or len(panel.x) <= 8:
                ticks = panel.ticks or {x: label("", x) for x in panel.x}
                axis.set_xticks([*ticks], [*ticks.values()])
                axis.minorticks_off()
        axes[0].set_ylabel(ylabel)
        if log:
            plain_log(axes[0].yaxis)
        else:
            axes[0].set_ylim(0)
        if labelled:
            place(axes[-1], axes[-1].get_legend_handles_labels()[0])
        else:
            legend(axes[-1], named, also)
    return Plot(figure, " ".join([caption, *failed(results, *absent)]))


def _name_alike(axes: Axes, drawn: Sequence[tuple[Where, Any]], log: bool, near: float) -> None:
    """Name lines together at their ends that coincide in this panel alone.

    >>> from matplotlib.figure import Figure
    >>> axes = Figure().subplots()
    >>> _name_alike(axes, [({"label": name}, {0: 1.0, 7: 2.0}) for name in "AB"], log=False, near=0.1)
    >>> axes.texts[0].xy
    (7, 2.0)
    """
    for group in _coinciding([("", drawn)], log, near)[0]:
        if len(group) > 1:
            x, y = list(_heights(next(points for of, points in drawn if of is group[0])).items())[-1]
            halo = [withStroke(linewidth=2, foreground="white")]
            offset: dict[str, Any] = {"xytext": (0, 5), "textcoords": "offset points", "ha": "right"}
            axes.annotate(wrapped(_joined(group)), (x, y), fontsize=7, path_effects=halo, **offset)


LINE_SHARE = 0.009
"""Share of the height of a panel, a line's width: lines within it in every panel are drawn and named as one, in one
panel they are named together."""


def _coinciding(shown: Sequence[Any], log: bool, near: float | None = None) -> tuple[list[list[Where]], float]:
    """Lines, each with those that lie near it at every point of every panel, and what is near: by default a line's
    width of what all span, from zero or in the logarithm. A bound stands alone.

    >>> drawn = [({"label": name}, {0: y}) for name, y in {"A": 0.0, "B": 1.0, "C": 1.0, "D": float("nan")}.items()]
    >>> [[of["label"] for of in group] for group in _coinciding([("", drawn)], log=True)[0]]
    [['A'], ['B', 'C'], ['D']]
    """
    lines: dict[int, tuple[Where, dict[Any, float]]] = {}
    for panel, (_, drawn) in enumerate(shown):
        for of, points in drawn:
            heights = {(panel, x): np.log(y) if log else y for x, y in _heights(points).items() if y > 0 or not log}
            lines.setdefault(id(of), (of, {}))[1].update(heights)
    if near is None:
        every = [y for _, heights in lines.values() for y in heights.values()]
        near = LINE_SHARE * (max(every, default=0.0) - (min(every, default=0.0) if log else 0.0))
    groups: list[list[Where]] = []
    for of, heights in lines.values():
        for group in groups:
            other = lines[id(group[0])][1]
            same = heights.keys() == other.keys() != set() and all(
                abs(heights[at] - y) <= near for at, y in other.items()
            )
            if same and "bound" not in (of.get("method"), group[0].get("method")):
                group.append(of)
                break
        else:
            groups.append([of])
    return groups, near


def _joined(lines: Sequence[Where], models: Collection[str] = ()) -> str:
    """Labels of lines that are drawn as one: what they begin with once, their noise models where there are several.

    >>> _joined([{"label": "Net of three"}, {"label": "Net of two"}])
    'Net of three, two'
    """
    first, *others = (str(of.get("label") or look(name_of(of)).label) for of in lines)
    start = first[: first.rfind(" ") + 1]
    if start and all(other.startswith(start) for other in others):
        return ", ".join([first, *(other.removeprefix(start) for other in others)])
    named = [str(of.get("noise_model")) for of in lines[1:]]
    shown = [f"{n}, {m}" if len(models) > 1 and m in models else n for n, m in zip(others, named, strict=True)]
    return " ≈ ".join([first, *shown])


def _line_names(results: Results, *across: str) -> list[str]:
    """Columns that identify a line of a figure: method and noise model, or all axes but those of the figure."""
    usual = [name for name in ("method", "noise_model") if name in results.frame]
    return usual if "method" in usual else [name for name in results.axes if name not in across]


def _mean(point: Any) -> float:
    return float(point.mean if isinstance(point, Interval) else point)


def _heights(points: Any) -> dict[Any, float]:
    """Place -> mean, without those that failed; "" -> that of a level."""
    means = ran(points if isinstance(points, Mapping) else {"": points})
    return {x: _mean(y) for x, y in means.items() if _mean(y) == _mean(y)}


def _draw(axes: Axes, names: Where, points: Any, style: Where | None = None) -> None:
    """Draw a line through points, an Interval with its band, or with a bar where no line joins them; or a number across
    the panel."""
    options = {**strokes(names), **(style or {})}
    if not isinstance(points, Mapping):
        axes.axhline(_mean(points), **{**options, "marker": ""})
        return
    bands = {x: point for x, point in points.items() if isinstance(point, Interval)}
    axes.plot(list(points), list(map(_mean, points.values())), **options)
    if bands:
        ends = [point.low for point in bands.values()], [point.high for point in bands.values()]
        if options["linestyle"] == "none" or len(bands) == 1:
            axes.vlines(list(bands), *ends, alpha=0.6, color=options["color"], linewidth=1.2)
            return
        axes.fill_between(list(bands), *ends, alpha=0.14, color=options["color"], linewidth=0)

"""Tables, figure and findings of the study `real`."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from coopoc.data.source import split
from coopoc.evaluate.statistics import Interval
from coopoc.study.marks import series
from coopoc.study.numbers import Number, difference, interval, mean, present, ran, sentence
from coopoc.study.tables import crossed, pivot
from coopoc.study.style import look, words

from . import pose_drives

if TYPE_CHECKING:
    from coopoc.study.figures import Plot
    from coopoc.study.results import Results
    from coopoc.study.tables import Table

METHODS = ("pose-fleet", "pose-intersection", "pose-naive")
LEARNED = "pose-learned"
"""One state with the noise that is learned on the first part."""
FEW = 4
"""Landmarks whose number a finding compares with, at most."""
LANDMARKS, NEIGHBOURS = (0, 1, 2, 4, 15), (0, 1, 2, 3, 4)
FLEET = {"method": "pose-fleet"}
NOTE = "Intervals are over vehicles, then blocks of {:.3g} s."
THINNED = "Poses are found with all landmarks; then they are thinned and the rest is scored."
UNFIT = 100.0
"""Mean NEES of a pose that no drift explains: units, axes or noise are other ones."""


def _caption(results: Results, text: str) -> str:
    p = results.settings
    data = str(p["data"])
    what = pose_drives.described(data).format(Path(split(data)[0]).name, pose_drives.calibrated(p))
    marks = pose_drives.counts(data)[1]
    parts = [text, what, THINNED if marks else "There are no landmarks.", NOTE.format(pose_drives.block(p))]
    if 0 < marks < max(LANDMARKS):
        parts.append(f"A number of landmarks above {marks} is all that there are.")
    return " ".join(parts)


def _most(results: Results, axis: str) -> int:
    """The largest number that was run."""
    return int(results.frame[axis].max())


def table(results: Results, value: str, text: str, **options: Any) -> Table | None:
    """A metric of one state, by K and landmarks."""
    if present(results, FLEET, value) is None:
        return None
    return pivot(results, "max_neighbours", "landmarks", value, FLEET, _caption(results, text), best=None, **options)


def fusions(results: Results, value: str, text: str, **options: Any) -> Table | None:
    """A metric of the ways of fusion at the largest K, by landmarks."""
    if present(results, {}, value) is None or not _most(results, "max_neighbours"):
        return None
    where = {"max_neighbours": _most(results, "max_neighbours")}
    if present(results, where, value) is None:
        return None
    text = f"{text}, K = {where['max_neighbours']}."
    return pivot(results, "method", "landmarks", value, where, _caption(results, text), **options)


def learned(results: Results) -> Table | None:
    """RT-LE with the calibrated and the learned noise, their paired difference, and both NEES."""

    def other(number: Any) -> Number:
        return lambda results, where: number(results, {**where, "method": LEARNED})

    def gap(results: Results, where: Mapping[str, Any]) -> Interval | None:
        return difference(results, {**where, "method": LEARNED}, where)

    columns: list[tuple[str, Number]] = [
        ("As assumed", mean),
        ("Learned", other(mean)),
        ("Difference", gap),
        ("NEES", partial(mean, value="nees")),
        ("NEES, learned", other(partial(mean, value="nees"))),
    ]
    if present(results, {"method": LEARNED}) is None:
        return None
    ks, marks = (sorted(results.frame[axis].unique()) for axis in ("max_neighbours", "landmarks"))
    rows = [((k, n), {**FLEET, "max_neighbours": k, "landmarks": n}) for k in ks for n in marks]
    rows = [row for row in rows if present(results, {**row[1], "method": LEARNED}) is not None]
    text = "RT-LE [m] with the noise above, and with noise learned by the log score of the poses on the first part."
    return crossed(results, ("K", "Landmarks"), rows, columns, _caption(results, text), best=None, decimals=3)


def bytes(results: Results) -> Table | None:
    """What a robot sends and receives, by K and way of fusion, with all landmarks."""
    rows = [
        ((look(name).label, k), {"method": name, "max_neighbours": k, "landmarks": _most(results, "landmarks")})
        for name in METHODS
        for k in sorted(results.frame["max_neighbours"].unique())
        if k
    ]
    columns: list[tuple[str, Number]] = [
        ("Sent [B/s]", partial(mean, value="sent_bytes_per_second")),
        ("Received [B/s]", partial(mean, value="bytes_per_second")),
    ]
    text = "Bytes per robot with all landmarks; one state sends to a centre and receives its own pose."
    return crossed(results, ("Method", "K"), rows, columns, _caption(results, text), best=None, decimals=0)


def figure(results: Results) -> Plot | None:
    """Over the landmarks, a line per K and, at the largest, per way of fusion; where their number is one, over K."""
    from matplotlib import colormaps

    from coopoc.study.plot import Plot, canvas, plain_log

    if present(results, FLEET) is None:
        return None
    marks, ks = (sorted(results.frame[axis].unique().tolist()) for axis in ("landmarks", "max_neighbours"))
    ways = [(look(name).label, {"method": name}, look(name).color) for name in METHODS]
    lines = [(f"K = {k}", {**FLEET, "max_neighbours": k}, colormaps["viridis"](k / 4.6)) for k in ks]
    most = [(name, {**where, "max_neighbours": ks[-1]}, color) for name, where, color in ways]
    if len(marks) > 1:
        panels = [("One state, K neighbours", lines), *([(f"Ways of fusion, K = {ks[-1]}", most)] if ks[-1] else [])]
        x, values = "landmarks", marks
    elif len(ks) > 1:
        panels, x, values = [("", ways)], "max_neighbours", ks
    else:
        return None
    width = 6.6 if len(panels) > 1 else 4.4
    with canvas(1, len(panels), width=width, sharey=True, squeeze=False) as (figure, ((*grid,),)):
        for axis, (title, shown) in zip(grid, panels, strict=True):
            for label, where, color in shown:
                _line(axis, results, {**where}, (x, values), (label, color))
            places = {"xticks": list(range(len(values))), "xticklabels": values}
            axis.set(**places, xlabel=words(x), yscale="log", title=title)
            plain_log(axis.yaxis)
            axis.legend()
        grid[0].set(ylabel="RT-LE [m]")
    return Plot(figure, _caption(results, f"RT-LE against {words(x)}; bands: 95 % intervals."))


def _line(axis: Any, results: Results, where: dict[str, Any], along: tuple[str, list[int]], style: Any) -> None:
    """Means of a selection along an axis, with their intervals."""
    (x, values), (label, color), gid = along, style, series(style[0])
    each = {place: interval(results, {**where, x: value}) for place, value in enumerate(values)}
    shown = {place: value for place, value in each.items() if value is not None}
    if shown:
        axis.plot(list(shown), [one.mean for one in shown.values()], color=color, label=label, marker="o", gid=gid)
        ends = [one.low for one in shown.values()], [one.high for one in shown.values()]
        axis.fill_between(list(shown), *ends, alpha=0.12, color=color, linewidth=0, gid=gid)


def findings(results: Results) -> dict[str, str]:
    """Key and sentence of what the cells show; a finding whose cells are missing is left out."""

    def of(k: int, n: int, value: str = "rt_le_m") -> float | None:
        return mean(results, {**FLEET, "max_neighbours": k, "landmarks": n}, value)

    if present(results, FLEET) is None:
        return {}
    ks, marks = (sorted(results.frame[axis].unique().tolist()) for axis in ("max_neighbours", "landmarks"))
    found = {}
    alone = ran({n: of(0, n) for n in marks})
    for k in dict.fromkeys((*ks[1:2], ks[-1])):
        together = of(k, 0)
        if not k or together is None or 0 not in alone:
            continue
        text = f"K = {k} without a landmark: {together:.2f} m; alone {alone[0]:.2f} m"
        few = max((n for n in alone if 0 < n <= FEW), default=0)
        text += f", with {_landmarks(few)} {alone[few]:.2f} m." if few else "."
        better = [n for n, value in alone.items() if value < together]
        worth = f"It replaces fewer than {_landmarks(min(better))}." if better else "It replaces more than all of them."
        found[f"worth, K = {k}"] = text if len(alone) == 1 else f"{text} {worth}"
    if len(marks) > 1 and ks[-1]:
        best = {"alone": of(0, marks[-1]), "together": of(ks[-1], marks[-1])}
        template = f"With {_landmarks(marks[-1])}: alone {{alone:.3f}} m, K = {ks[-1]} {{together:.3f}} m."
        found["all landmarks"] = sentence(template, **best)
    if len(alone) == len(ks) == 1:
        found["alone"] = f"One vehicle alone: {next(iter(alone.values())):.3g} m."
    nees = [of(k, n, "nees") for k in ks for n in marks]
    values = [value for value in nees if value is not None]
    if values:
        inside = sum(2 <= value <= 5 for value in values)
        text = f"Mean NEES of a pose (3 is consistent): {np.mean(values):.1f}"
        more = f" over {len(values)} cells, {inside} of them in 2..5, the largest {max(values):.1f}"
        found["nees"] = text + (more if len(values) > 1 else "") + "."
        if min(values) > UNFIT:
            doubt = "Units, axes or stated noise do not fit the drive"
            found["nees"] += f" {doubt}: coopoc data check shows the residuals of each kind."
    return found


def _landmarks(number: int) -> str:
    return "1 landmark" if number == 1 else f"{number} landmarks"

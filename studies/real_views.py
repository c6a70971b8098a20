"""Tables, figure and findings of the study `real`."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from coopoc.evaluate.statistics import Interval
from coopoc.study.marks import series
from coopoc.study.numbers import Number, difference, interval, mean, present, sentence
from coopoc.study.pivot import crossed, pivot
from coopoc.study.style import look

if TYPE_CHECKING:
    from coopoc.study.figures import Plot
    from coopoc.study.results import Results
    from coopoc.study.tables import Table

METHODS = ("pose-fleet", "pose-intersection", "pose-naive")
LEARNED = "pose-learned"
"""One state with the noise that is learned on the first part."""
LANDMARKS, NEIGHBOURS = (0, 1, 2, 4, 15), (0, 1, 2, 3, 4)
FLEET = {"method": "pose-fleet"}
NOTE = (
    "Wheel odometry, ranges and bearings of {data}; no fix, no compass. Noise is calibrated and poses are found in the "
    "first {calibrate_s:g} s, with all landmarks; then the landmarks are thinned and the rest is scored. Intervals are "
    "over robots, then blocks of {block_s:g} s."
)


def _caption(results: Results, text: str) -> str:
    given = {**results.settings, "data": Path(str(results.settings["data"])).name}
    return f"{text} {NOTE.format(**given)}"


def table(results: Results, value: str, text: str, **options: Any) -> Table | None:
    if present(results, FLEET, value) is None:
        return None
    return pivot(results, "max_neighbours", "landmarks", value, FLEET, _caption(results, text), best=None, **options)


def fusions(results: Results, value: str, text: str, **options: Any) -> Table | None:
    where = {"max_neighbours": max(NEIGHBOURS)}
    if present(results, where, value) is None:
        return None
    return pivot(results, "method", "landmarks", value, where, _caption(results, text), **options)


def learned(results: Results) -> Table | None:
    """RT-LE with the calibrated and the learned noise, their paired difference, and both NEES."""

    def other(number: Any) -> Number:
        return lambda results, where: number(results, {**where, "method": LEARNED})

    def gap(results: Results, where: Mapping[str, Any]) -> Interval | None:
        return difference(results, {**where, "method": LEARNED}, where)

    columns: list[tuple[str, Number]] = [
        ("Calibrated", mean),
        ("Learned", other(mean)),
        ("Difference", gap),
        ("NEES", partial(mean, value="nees")),
        ("NEES, learned", other(partial(mean, value="nees"))),
    ]
    if present(results, {"method": LEARNED}) is None:
        return None
    rows = [((k, n), {**FLEET, "max_neighbours": k, "landmarks": n}) for k in (0, max(NEIGHBOURS)) for n in LANDMARKS]
    text = "RT-LE [m] with noise calibrated by its sums, and learned by the log score of the poses, on the same part."
    return crossed(results, ("K", "Landmarks"), rows, columns, _caption(results, text), best=None, decimals=3)


def bytes(results: Results) -> Table | None:
    """What a robot sends and receives, by K and way of fusion, with all landmarks."""
    rows = [
        ((look(name).label, k), {"method": name, "max_neighbours": k, "landmarks": max(LANDMARKS)})
        for name in METHODS
        for k in NEIGHBOURS[1:]
    ]
    columns: list[tuple[str, Number]] = [
        ("Sent [B/s]", partial(mean, value="sent_bytes_per_second")),
        ("Received [B/s]", partial(mean, value="bytes_per_second")),
    ]
    text = "Bytes per robot with all landmarks; one state sends to a centre and receives its own pose."
    return crossed(results, ("Method", "K"), rows, columns, _caption(results, text), best=None, decimals=0)


def figure(results: Results) -> Plot | None:
    """Left: a line per number of neighbours over the landmarks. Right: the ways of fusion at the largest K."""
    from matplotlib import colormaps

    from coopoc.study.plot import Plot, canvas, plain_log

    if present(results, FLEET) is None:
        return None
    at = {n: place for place, n in enumerate(LANDMARKS)}
    with canvas(1, 2, width=6.6, sharey=True) as (figure, (left, right)):
        lines = [(f"K = {k}", {**FLEET, "max_neighbours": k}, colormaps["viridis"](k / 4.6)) for k in NEIGHBOURS]
        most = {"max_neighbours": max(NEIGHBOURS)}
        others = [(look(name).label, {"method": name, **most}, look(name).color) for name in METHODS]
        for axis, shown in ((left, lines), (right, others)):
            for label, where, color in shown:
                gid = series(label)
                each = {n: interval(results, {**where, "landmarks": n}) for n in LANDMARKS}
                ran = {at[n]: value for n, value in each.items() if value is not None}
                if ran:
                    axis.plot(
                        list(ran), [one.mean for one in ran.values()], color=color, label=label, marker="o", gid=gid
                    )
                    ends = [one.low for one in ran.values()], [one.high for one in ran.values()]
                    axis.fill_between(list(ran), *ends, alpha=0.12, color=color, linewidth=0, gid=gid)
            axis.set(xticks=list(at.values()), xticklabels=list(at), xlabel="Landmarks", yscale="log")
            plain_log(axis.yaxis)
            axis.legend()
        left.set(ylabel="RT-LE [m]", title="One state, K neighbours")
        right.set(title=f"Ways of fusion, K = {max(NEIGHBOURS)}")
    return Plot(figure, _caption(results, "RT-LE against the number of landmarks; bands: 95 % intervals."))


def findings(results: Results) -> dict[str, str]:
    """Key and sentence of what the cells show; a finding whose cells are missing is left out."""

    def of(k: int, n: int, value: str = "rt_le_m") -> float | None:
        return mean(results, {**FLEET, "max_neighbours": k, "landmarks": n}, value)

    found = {}
    for k in (1, 4):
        together = of(k, 0)
        alone = {n: of(0, n) for n in LANDMARKS}
        better = [n for n, value in alone.items() if together is not None and value is not None and value < together]
        worth = f"fewer than {min(better)} landmarks" if better else "more than all of them"
        template = "K = {k} without a landmark: {together:.2f} m; alone {none:.2f} m, with 4 landmarks {four:.2f} m."
        text = sentence(template, k=k, together=together, none=alone[0], four=alone[4])
        found[f"worth, K = {k}"] = text and f"{text} It replaces {worth}."
    best = {"alone": of(0, 15), "together": of(4, 15)}
    found["all landmarks"] = sentence("With 15 landmarks: alone {alone:.3f} m, K = 4 {together:.3f} m.", **best)
    nees = [of(k, n, "nees") for k in NEIGHBOURS for n in LANDMARKS]
    values = [value for value in nees if value is not None]
    if values:
        inside = sum(2 <= value <= 5 for value in values)
        text = f"Mean NEES of a pose (3 is consistent): {np.mean(values):.1f} over {len(values)} cells"
        found["nees"] = f"{text}, {inside} of them in 2..5, the largest {max(values):.1f}."
    return found

"""Cost of a wrong heading, which turns a bearing on board into an azimuth of the world."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

from coopoc.study.numbers import mean, present, sentence
from coopoc.study.pivot import across, crossed
from coopoc.study.style import look

from . import lineup, scene
from .lineup import BOUND, of

if TYPE_CHECKING:
    from coopoc.study.figures import Plot
    from coopoc.study.results import Results
    from coopoc.study.tables import Table

DEGREES = (0.0, 1.0, 2.0, 4.0, 8.0)
KINDS = {"heading_std_deg": "noise, new at every step", "heading_bias_deg": "bias, one per vehicle and run"}
EXACT = "heading taken as exact"
LINES = (("joint", "nominal"), ("joint", EXACT), ("lkf-sa", "nominal"), ("lkf-sa", EXACT), ("split-ci", "nominal"))
NEIGHBOURS = (2, 10)
NO_ERROR = dict.fromkeys(KINDS, 0.0)
NOTE = (
    "An observer's heading error turns all that it sees alike. Nominal filters know its size and take it as noise "
    "of each azimuth; the others take the heading as exact."
)


def _grid() -> list[dict[str, Any]]:
    """One kind of error at a time; the solo filter and the bound, which the heading does not change, once."""
    cases = [NO_ERROR, *({**NO_ERROR, kind: size} for kind in KINDS for size in DEGREES[1:])]
    return [
        of("kalman", "nominal", **NO_ERROR, max_neighbours=0),
        *(
            of(*line, **case, max_neighbours=k)
            for case in cases
            for k in NEIGHBOURS
            for line in LINES
            if case != NO_ERROR or line[1] != EXACT
        ),
        *(of(*BOUND, **NO_ERROR, max_neighbours=k) for k in NEIGHBOURS),
    ]


def at(kind: str, size: float, method: str, known: str, k: int) -> dict[str, Any]:
    """A selection; without an error all noise models are one."""
    return of(method, known if size else "nominal", **{**NO_ERROR, kind: size}, max_neighbours=k)


def _table(results: Results, value: str, text: str, decimals: int) -> Table | None:
    def number(results: Results, where: Mapping[str, Any]) -> float | None:
        return mean(results, at(**where), value)

    rows = [
        ((words, k, look(method).label, known), {"kind": kind, "k": k, "method": method, "known": known})
        for kind, words in KINDS.items()
        for k in NEIGHBOURS
        for method, known in LINES
    ]
    columns = across(number, {f"{size:g}°": {"size": size} for size in DEGREES})
    head = ("Heading error", "K", "Method", "Noise model")
    return crossed(results, head, rows, columns, scene.caption(results, text, NOTE), decimals=decimals)


def _figure(results: Results) -> Plot | None:
    """RT-LE against the size of the error, a panel per kind and K."""
    from coopoc.study.lines import Line, Panel, panels

    shown = []
    for kind, words in KINDS.items():
        for k in NEIGHBOURS:
            if present(results, {"max_neighbours": k}):
                lines = [
                    Line(of(*line), {size: mean(results, at(kind, size, *line, k)) for size in DEGREES})
                    for line in LINES
                ]
                for pair, level in ((("kalman", "nominal"), 0), (BOUND, k)):
                    lines.append(Line(of(*pair), mean(results, of(*pair, max_neighbours=level))))
                shown.append(Panel(lines, f"{words.partition(',')[0]}, K = {k}", "Heading error [°]", DEGREES))
    text = "RT-LE against the heading's error; horizontal: the solo filter, and the bound for an exact heading."
    return panels(shown, scene.caption(results, text, NOTE), 1.4 + 1.75 * len(shown))


FINDING = (
    "4° of {words}, K = {k}: the joint filter goes from {none:.2f} m to {ignored:.2f} m if it takes the heading as "
    "exact, {known:.2f} m if the error is modelled; alone {alone:.2f} m."
)


def _findings(results: Results) -> dict[str, str]:
    return {
        f"{kind}, K = {k}": sentence(
            FINDING,
            words=words.partition(",")[0],
            k=k,
            none=mean(results, at(kind, 0.0, "joint", "nominal", k)),
            ignored=mean(results, at(kind, 4.0, "joint", EXACT, k)),
            known=mean(results, at(kind, 4.0, "joint", "nominal", k)),
            alone=mean(results, {"method": "kalman", "max_neighbours": 0}),
        )
        for kind, words in KINDS.items()
        for k in NEIGHBOURS
    }


STUDY = lineup.study(
    "heading_error",
    "How wrong may the heading be before relative measurements that depend on it do more harm than good?",
    grid=_grid(),
    settings={**scene.TOWN, "runs": 30, "train_seeds": 0},
    shares=(*KINDS, "max_neighbours"),
    tables={
        "rt_le": partial(_table, value="rt_le_m", text="RT-LE [m].", decimals=3),
        "nees": partial(_table, value="nees", text="NEES (3 is consistent).", decimals=1),
    },
    figures={"rt_le": _figure},
    findings=_findings,
    limitations=(
        "The bound is for an exact heading: with an unknown one it is higher.",
        "Heading and velocity err apart: a real odometer turns its velocity by the same wrong heading.",
    ),
    minutes=5,
    metrics={"rt_le_m": "lower", "nees": 3.0},
)

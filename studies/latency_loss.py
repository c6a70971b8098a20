"""Messages that arrive late or not at all, alone or in bursts, and the gain of cooperation that remains."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from coopoc.study.numbers import mean, present, ran
from coopoc.study.style import look
from coopoc.study.tables import Table

from . import lineup, scene
from .lineup import BOUND, of

if TYPE_CHECKING:
    from coopoc.study.figures import Plot
    from coopoc.study.results import Results

LATENCIES = (0.0, 0.1, 0.3, 0.5, 1.0)
LOSSES = (0.0, 0.1, 0.3, 0.6, 0.9)
BURSTS = (1.0, 10.0)
METHODS = ("kalman", "lkf-sa", "joint", "split-ci", "fixed-lag", "mhe")
PERFECT = {"latency_s": 0.0, "loss": 0.0, "burst": 1.0}
LOSSY = [
    {100 * loss: {**PERFECT, "loss": loss, "burst": burst if loss else 1.0} for loss in LOSSES} for burst in BURSTS
]
WAYS: dict[str, tuple[str, dict[float, dict[str, Any]]]] = {
    "late": ("Latency [s]", {late: {**PERFECT, "latency_s": late} for late in LATENCIES}),
    "lost one by one": ("Lost [%]", LOSSY[0]),
    f"lost in runs of {BURSTS[1]:g}": ("Lost [%]", LOSSY[1]),
}
"""Title -> label of the axis, and channel by its value there."""
NOTE = (
    "K = 6. The moving horizon puts a late message at its true time; the others bring it forward with the velocity "
    "that came with it. What is older than 1 s is forgotten."
)


def _grid() -> list[dict[str, Any]]:
    """Latency without loss, and loss without latency; the solo filter once."""
    ways = [PERFECT, *(way for _, found in WAYS.values() for value, way in found.items() if value)]
    return [
        of("kalman", "nominal", **PERFECT, max_neighbours=0),
        of(*BOUND, **PERFECT, max_neighbours=6),
        *({**way, "max_neighbours": 6, "noise_model": "nominal", "method": m} for way in ways for m in METHODS[1:]),
    ]


def _at(method: str, way: dict[str, Any]) -> dict[str, Any]:
    return {"method": method} if method == "kalman" else {"method": method, **way}


def _unit(label: str) -> str:
    return label.partition("[")[2].rstrip("]")


def _table(results: Results) -> Table | None:
    """RT-LE of each method over each channel."""
    body: list[tuple[Any, ...]] = []
    methods = [method for method in METHODS if present(results, {"method": method})]
    for title, (label, ways) in WAYS.items():
        for value, way in ways.items():
            found = {method: mean(results, _at(method, way)) for method in methods}
            if set(ran(found)) - {"kalman"}:
                body.append((title, f"{value:g} {_unit(label)}", *found.values()))
    header = ("Messages are", "How much", *(look(method).label for method in methods))
    return Table(header, tuple(body), scene.caption(results, "RT-LE [m].", NOTE), decimals=3) if body else None


def _figure(results: Results) -> Plot | None:
    from coopoc.study.lines import Line, Panel, panels

    shown = []
    for title, (label, ways) in WAYS.items():
        lines = [
            Line(of(m, "fitted"), {value: mean(results, _at(m, way)) for value, way in ways.items()}) for m in METHODS
        ]
        shown.append(Panel([*lines, Line(of(*BOUND), mean(results, {"method": "bound"}))], title, label))
    text = "RT-LE against latency and loss; dashed: the bound of a perfect channel."
    return panels(shown, scene.caption(results, text, NOTE), 8.2, 3.2)


def _findings(results: Results) -> dict[str, str]:
    found = {}
    for title, (label, ways) in WAYS.items():
        most, worst = list(ways.items())[-1]
        alone, best, left = (
            mean(results, _at(*pair)) for pair in (("kalman", PERFECT), ("joint", PERFECT), ("joint", worst))
        )
        if alone is not None and best is not None and left is not None:
            kept = (alone - left) / (alone - best)
            rest = f"keeps {100 * kept:.0f} % of what six neighbours bring" if kept > 0 else "is worse than alone"
            found[title] = (
                f"{most:g} {_unit(label)} {title}: the joint filter {rest} ({left:.2f} m; alone {alone:.2f}, perfect "
                f"{best:.2f} m){_best(results, worst)}."
            )
    return found


def _best(results: Results, way: dict[str, Any]) -> str:
    """The best method over a channel, if it is not the joint filter."""
    each = ran({method: mean(results, _at(method, way)) for method in METHODS})
    best = min(each, key=lambda method: round(each[method], 4), default="joint")
    return "" if best == "joint" else f"; best is {look(best).label}, {each[best]:.2f} m"


STUDY = lineup.study(
    "latency_loss",
    "How much of the benefit of cooperation remains when messages are late or lost?",
    grid=_grid(),
    settings={**scene.TOWN, "runs": 20, "train_seeds": 0},
    shares=tuple(PERFECT),
    tables={"rt_le": _table},
    figures={"rt_le": _figure},
    findings=_findings,
    limitations=("Latency is the same for all messages of a cell, in whole steps of the drive.",),
    minutes=15,
    metrics={"rt_le_m": "lower"},
)

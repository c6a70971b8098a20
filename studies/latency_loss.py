"""Messages that come late, or not at all, alone or in bursts: what is left of cooperation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from coopoc.study.study import Params, Row, Study

from . import lineup, scene, views

if TYPE_CHECKING:
    from coopoc.study.figures import Plot
    from coopoc.study.results import Results
    from coopoc.study.tables import Table

LATENCIES = (0.0, 0.1, 0.3, 0.5, 1.0)
LOSSES = (0.0, 0.1, 0.3, 0.6, 0.9)
BURSTS = (1.0, 10.0)
METHODS = ("kalman", "lkf-sa", "joint", "split-ci", "fixed-lag", "mhe")
PERFECT = {"latency_s": 0.0, "loss": 0.0, "burst": 1.0}


def _grid() -> list[dict[str, Any]]:
    """Latency without loss, and loss without latency; the solo filter once."""
    ways = [PERFECT, *({**PERFECT, "latency_s": late} for late in LATENCIES[1:])]
    ways += [{**PERFECT, "loss": loss, "burst": burst} for burst in BURSTS for loss in LOSSES[1:]]
    grid: list[dict[str, Any]] = [{**PERFECT, "max_neighbours": 0, "method": "kalman", "noise_model": "nominal"}]
    grid += [{**PERFECT, "max_neighbours": 6, "method": "bound", "noise_model": "bound"}]
    together = {"max_neighbours": 6, "noise_model": "nominal"}
    return grid + [{**way, **together, "method": method} for way in ways for method in METHODS[1:]]


def cell(p: Params) -> list[Row]:
    """Rows of one method over one channel; of the bound, one row per ego."""
    return lineup.bound_rows(p) if p["method"] == "bound" else lineup.rows(p)


def _lines() -> list[tuple[str, str, list[tuple[float, dict[str, Any]]]]]:
    """Title, axis label and (value, channel) of each panel."""
    late = [(value, {**PERFECT, "latency_s": value}) for value in LATENCIES]
    lossy = [
        [(100 * value, {**PERFECT, "loss": value, "burst": burst if value else 1.0}) for value in LOSSES]
        for burst in BURSTS
    ]
    return [
        ("late", "Latency [s]", late),
        ("lost one by one", "Lost [%]", lossy[0]),
        (f"lost in runs of {BURSTS[1]:g}", "Lost [%]", lossy[1]),
    ]


def _at(method: str, way: dict[str, Any]) -> dict[str, Any]:
    return {"method": method} if method == "kalman" else {"method": method, **way}


def _table(results: Results) -> Table | None:
    """RT-LE of each method over each channel."""
    from coopoc.study.style import look
    from coopoc.study.tables import Table

    body: list[tuple[Any, ...]] = []
    ran = [method for method in METHODS if views.present(results, {"method": method})]
    for title, label, ways in _lines():
        for value, way in ways:
            found = [views.mean(results, _at(method, way)) for method in ran]
            if any(number is not None for number, method in zip(found, ran, strict=True) if method != "kalman"):
                body.append((title, f"{value:g} {label.partition('[')[2].rstrip(']')}", *found))
    header = ("Messages are", "How much", *(look(method).label for method in ran))
    return Table(header, tuple(body), _caption(results, "RT-LE [m]."), decimals=3) if body else None


def _caption(results: Results, text: str) -> str:
    return (
        f"{text} K = 6. The moving horizon puts a late message at its true time; the others bring it forward with the "
        f"velocity that came with it. What is older than 1 s is forgotten. {scene.conditions(results.settings)}"
    )


def _figure(results: Results) -> Plot | None:
    from coopoc.study.plot import Plot, canvas, legend, strokes

    lines = _lines()
    with canvas(1, len(lines), width=8.2, height=3.2, sharey=True, squeeze=False) as (figure, (panels,)):
        drawn: list[dict[str, Any]] = []
        bound = views.mean(results, {"method": "bound"})
        for panel, (title, label, ways) in zip(panels, lines, strict=True):
            for method in METHODS:
                found = {value: views.mean(results, _at(method, way)) for value, way in ways}
                ran = {value: number for value, number in found.items() if number is not None}
                if ran:
                    panel.plot(list(ran), list(ran.values()), **strokes({"method": method, "noise_model": "fitted"}))
                    drawn.append({"method": method})
            if bound is not None:
                panel.axhline(bound, **strokes({"method": "bound"}))
            panel.set(title=title, xlabel=label)
        if not drawn:
            return None
        panels[0].set(ylabel="RT-LE [m]", ylim=(0, None))
        legend(panels[-1], [*drawn, *([{"method": "bound"}] if bound is not None else [])])
    return Plot(figure, _caption(results, "RT-LE against latency and loss; dashed: the bound of a perfect channel."))


def _findings(results: Results) -> Sequence[str]:
    found = []
    for title, label, ways in _lines():
        (_, none), (most, worst) = ways[0], ways[-1]
        alone, best, left = (
            views.mean(results, _at(*pair)) for pair in (("kalman", none), ("joint", none), ("joint", worst))
        )
        if alone is not None and best is not None and left is not None:
            kept = (alone - left) / (alone - best)
            told = f"keeps {100 * kept:.0f} % of what six neighbours bring" if kept > 0 else "is worse than alone"
            unit = label.partition("[")[2].rstrip("]")
            found.append(
                f"{most:g} {unit} {title}: the joint filter {told} ({left:.2f} m; alone {alone:.2f}, perfect "
                f"{best:.2f} m){_best(results, worst)}."
            )
    return found


def _best(results: Results, way: dict[str, Any]) -> str:
    """Who does best there, if it is not the joint filter."""
    from coopoc.study.style import look

    each = {method: views.mean(results, _at(method, way)) for method in METHODS}
    ran = {method: value for method, value in each.items() if value is not None}
    best = min(ran, key=lambda method: round(ran[method], 4), default="joint")
    return "" if best == "joint" else f"; best is {look(best).label}, {ran[best]:.2f} m"


STUDY = Study(
    name="latency_loss",
    question="How much of cooperation is left when messages come late or not at all?",
    cell=cell,
    key=lineup.key,
    grid=_grid(),
    settings={
        "data": "town10",
        "scenario": 2,
        "velocity_ratio": 0.15,
        "velocity_reading": "axis",
        "radius_m": 30.0,
        "egos": "auto",
        "runs": 20,
        "seed": 0,
        "train_seeds": 0,
    },
    shares=tuple(PERFECT),
    tables={"rt_le": _table},
    figures={"rt_le": _figure},
    findings=_findings,
    limitations=("Latency is the same for all messages of a cell, in whole steps of the drive.",),
    minutes=15,
    metrics={"rt_le_m": "lower"},
    reference=views.reference("latency_loss"),
)

"""Cost of neighbours with spoofed fixes for methods that use their messages, and cost of a robust method."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from coopoc.study.numbers import Number, Where, across, mean, sentence
from coopoc.study.style import Panel, look

from . import lineup, scene
from .lineup import BOUND
from .views import curves, of, selections

if TYPE_CHECKING:
    from coopoc.study.results import Results

SHARES = (0.0, 0.1, 0.2, 0.4)
METHODS = ("kalman", "lkf-sa", "joint", "split-ci", "ci", "cooperative-map-5", "cooperative-map-gnc")
NEIGHBOURS = (4, 10)
NOTE = (
    "A spoofed vehicle broadcasts fixes that are 5 to 40 m off on each axis, the same for a whole drive; egos are "
    "honest."
)


def _grid() -> list[dict[str, Any]]:
    return [
        of("kalman", "nominal", max_neighbours=0, spoofed_share=0.0),
        *(of(*BOUND, max_neighbours=k, spoofed_share=0.0) for k in NEIGHBOURS),
        *(
            of(method, "nominal", max_neighbours=k, spoofed_share=share)
            for k in NEIGHBOURS
            for share in SHARES
            for method in METHODS[1:]
        ),
    ]


def at(method: str, max_neighbours: int, spoofed_share: float) -> dict[str, Any]:
    """A selection; the solo filter, which receives no message, ran once."""
    if method == "kalman":
        return {"method": method}
    return {"method": method, "max_neighbours": max_neighbours, "spoofed_share": spoofed_share}


def _table(text: str, value: str, decimals: int) -> Any:
    def number(results: Results, where: Where) -> float | None:
        return mean(results, at(**where), value)

    columns: dict[str, Number] = across(number, {f"{100 * s:g} % spoofed": {"spoofed_share": s} for s in SHARES})
    rows = [
        ((k, look(method).label), {"method": method, "max_neighbours": k}) for k in NEIGHBOURS for method in METHODS
    ]
    return selections(("K", "Method"), rows, columns, text, NOTE, decimals=decimals)


PANELS = [
    Panel({100 * s: {"spoofed_share": s} for s in SHARES}, {"max_neighbours": k}, f"K = {k}", "Spoofed vehicles [%]")
    for k in NEIGHBOURS
]
WIDE = {"linewidth": 3.5}
"""Of the line that the joint filter's covers."""
FINDING = (
    "K = {k}, 20 % spoofed: the joint filter has {trusting:.2f} m, the window with GNC {careful:.2f} m, the solo "
    "filter {alone:.2f} m; without an attack GNC costs {cost:+.3f} m."
)


def _findings(results: Results) -> dict[str, str]:
    texts = {}
    for k in NEIGHBOURS:
        window, same = (mean(results, at(m, k, 0.0)) for m in ("cooperative-map-5", "cooperative-map-gnc"))
        texts[f"K = {k}"] = sentence(
            FINDING,
            k=k,
            trusting=mean(results, at("joint", k, 0.2)),
            careful=mean(results, at("cooperative-map-gnc", k, 0.2)),
            alone=mean(results, at("kalman", k, 0.2)),
            cost=None if window is None or same is None else same - window,
        )
    return texts


STUDY = lineup.study(
    "robustness",
    "What do spoofed neighbours do to cooperative methods, and what does robustness cost?",
    grid=_grid(),
    settings={**scene.TOWN, "backend": "gauss-newton", "runs": 10, "train_seeds": 0},
    shares=("max_neighbours", "spoofed_share"),
    tables={
        "rt_le": _table("RT-LE [m].", "rt_le_m", 2),
        "nees": _table("NEES (3 is consistent).", "nees", 1),
    },
    figures={
        "rt_le": curves(
            PANELS,
            [{"method": method, **(WIDE if method == "lkf-sa" else {})} for method in METHODS[1:]],
            "RT-LE against the share of spoofed vehicles; dashed: the bound without an attack.",
            NOTE,
            levels=[{"method": "kalman", "max_neighbours": 0}, {"method": "bound"}],
            log=True,
        )
    },
    findings=_findings,
    limitations=(
        "Velocities and relative measurements stay true; a spoofer that also forges its motion is not detected.",
        "Spoofed vehicles do not coordinate; each has its own offset.",
    ),
    minutes=20,
    metrics={"rt_le_m": "lower", "nees": 3.0},
)

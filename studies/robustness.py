"""Cost of neighbours with spoofed fixes for methods that use their messages, and cost of a robust method."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

from coopoc.study.numbers import mean, present, sentence
from coopoc.study.tables import across, crossed
from coopoc.study.style import look

from . import lineup, scene
from .lineup import BOUND, of

if TYPE_CHECKING:
    from coopoc.study.figures import Plot
    from coopoc.study.results import Results
    from coopoc.study.tables import Table

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


def at(method: str, k: int, share: float) -> dict[str, Any]:
    """A selection; the solo filter, which receives no message, ran once."""
    if method == "kalman":
        return {"method": method}
    return {"method": method, "max_neighbours": k, "spoofed_share": share}


def _table(results: Results, value: str, text: str, decimals: int) -> Table | None:
    def number(results: Results, where: Mapping[str, Any]) -> float | None:
        return mean(results, at(**where), value)

    rows = [((k, look(method).label), {"method": method, "k": k}) for k in _ks(results) for method in METHODS]
    shares = [share for share in SHARES if present(results, {"spoofed_share": share})]
    columns = across(number, {f"{100 * share:g} % spoofed": {"share": share} for share in shares})
    return crossed(results, ("K", "Method"), rows, columns, scene.caption(results, text, NOTE), decimals=decimals)


def _ks(results: Results) -> list[int]:
    return [k for k in NEIGHBOURS if present(results, {"max_neighbours": k})]


def _figure(results: Results) -> Plot | None:
    from coopoc.study.lines import Line, Panel, panels

    shown = []
    for k in _ks(results):
        wide = {"lkf-sa": {"linewidth": 3.5, "markersize": 9.0, "zorder": 1.5}}  # beside the joint filter
        lines = [
            Line(of(m, "fitted"), {100 * share: mean(results, at(m, k, share)) for share in SHARES}, wide.get(m, {}))
            for m in METHODS
        ]
        lines.append(Line(of(*BOUND), mean(results, {"method": "bound", "max_neighbours": k})))
        shown.append(Panel(lines, f"K = {k}", "Spoofed vehicles [%]", [100 * share for share in SHARES]))
    text = "RT-LE against the share of spoofed vehicles; dashed: the bound without an attack."
    return panels(shown, scene.caption(results, text, NOTE), 2.4 + 2.3 * len(shown), 3.2, log=True)


FINDING = (
    "K = {k}, 20 % spoofed: the joint filter has {trusting:.2f} m, the window with GNC {careful:.2f} m, the solo "
    "filter {alone:.2f} m; without an attack GNC costs {cost:+.3f} m."
)


def _findings(results: Results) -> dict[str, str]:
    found = {}
    for k in NEIGHBOURS:
        window, same = (mean(results, at(m, k, 0.0)) for m in ("cooperative-map-5", "cooperative-map-gnc"))
        found[f"K = {k}"] = sentence(
            FINDING,
            k=k,
            trusting=mean(results, at("joint", k, 0.2)),
            careful=mean(results, at("cooperative-map-gnc", k, 0.2)),
            alone=mean(results, at("kalman", k, 0.2)),
            cost=None if window is None or same is None else same - window,
        )
    return found


STUDY = lineup.study(
    "robustness",
    "What do spoofed neighbours do to cooperative methods, and what does robustness cost?",
    grid=_grid(),
    settings={**scene.TOWN, "backend": "gauss-newton", "runs": 10, "train_seeds": 0},
    shares=("max_neighbours", "spoofed_share"),
    tables={
        "rt_le": partial(_table, value="rt_le_m", text="RT-LE [m].", decimals=2),
        "nees": partial(_table, value="nees", text="NEES (3 is consistent).", decimals=1),
    },
    figures={"rt_le": _figure},
    findings=_findings,
    limitations=(
        "Velocities and relative measurements stay true; a spoofer that also forges its motion is not detected.",
        "Spoofed vehicles do not coordinate; each has its own offset.",
    ),
    minutes=20,
    metrics={"rt_le_m": "lower", "nees": 3.0},
)

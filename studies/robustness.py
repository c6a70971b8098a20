"""What neighbours whose fixes are false do to those who listen to them, and what it costs to be careful."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from coopoc.study.study import Params, Row, Study

from . import lineup, scene, views

if TYPE_CHECKING:
    from coopoc.study.figures import Plot
    from coopoc.study.results import Results
    from coopoc.study.tables import Table

SHARES = (0.0, 0.1, 0.2, 0.4)
METHODS = ("kalman", "lkf-sa", "joint", "split-ci", "ci", "cooperative-map-5", "cooperative-map-gnc")
NEIGHBOURS = (4, 10)


def _grid() -> list[dict[str, Any]]:
    alone = {"max_neighbours": 0, "spoofed_share": 0.0, "method": "kalman", "noise_model": "nominal"}
    bounds = [{**alone, "max_neighbours": k, "method": "bound", "noise_model": "bound"} for k in NEIGHBOURS]
    return [alone, *bounds] + [
        {"max_neighbours": k, "spoofed_share": share, "method": method, "noise_model": "nominal"}
        for k in NEIGHBOURS
        for share in SHARES
        for method in METHODS[1:]
    ]


def cell(p: Params) -> list[Row]:
    """Rows of one method at one K and share of spoofed vehicles; of the bound, one row per ego."""
    return lineup.bound_rows(p) if p["method"] == "bound" else lineup.rows(p)


def at(method: str, k: int, share: float) -> dict[str, Any]:
    """A selection; the solo filter, to which nobody can lie, ran once."""
    if method == "kalman":
        return {"method": method}
    return {"method": method, "max_neighbours": k, "spoofed_share": share}


def _table(value: str, text: str, decimals: int) -> Any:
    def number(results: Results, where: dict[str, Any]) -> float | None:
        return views.mean(results, at(where["method"], where["max_neighbours"], where["spoofed_share"]), value)

    def table(results: Results) -> Table | None:
        from coopoc.study.style import look

        rows = [
            ((k, look(method).label), {"method": method, "max_neighbours": k})
            for k in NEIGHBOURS
            if views.present(results, {"max_neighbours": k})
            for method in METHODS
        ]
        columns = [
            (f"{100 * share:g} % spoofed", {"spoofed_share": share})
            for share in SHARES
            if views.present(results, {"spoofed_share": share})
        ]
        return views.crossed(results, ("K", "Method"), rows, columns, number, _caption(results, text), decimals)

    return table


def _caption(results: Results, text: str) -> str:
    return (
        f"{text} A spoofed vehicle broadcasts fixes that are 5 to 40 m off on each axis, the same for a whole drive; "
        f"egos are honest. {scene.conditions(results.settings)}"
    )


def _figure(results: Results) -> Plot | None:
    from coopoc.study.plot import Plot, canvas, legend, plain_log, strokes

    ks = [k for k in NEIGHBOURS if views.present(results, {"max_neighbours": k})]
    if not ks:
        return None
    with canvas(1, len(ks), width=2.4 + 2.3 * len(ks), height=3.2, sharey=True, squeeze=False) as (figure, (panels,)):
        for panel, k in zip(panels, ks, strict=True):
            drawn = []
            for method in METHODS:
                found = {100 * share: views.mean(results, at(method, k, share)) for share in SHARES}
                ran = {share: value for share, value in found.items() if value is not None}
                if ran:
                    panel.plot(list(ran), list(ran.values()), **strokes({"method": method, "noise_model": "fitted"}))
                    drawn.append({"method": method})
            bound = views.mean(results, {"method": "bound", "max_neighbours": k})
            if bound is not None:
                panel.axhline(bound, **strokes({"method": "bound"}))
                drawn.append({"method": "bound"})
            plain_log(panel.yaxis)
            panel.set(title=f"K = {k}", xlabel="Attacked vehicles [%]", xticks=[100 * share for share in SHARES])
        panels[0].set(ylabel="RT-LE [m]")
        legend(panels[-1], drawn)
    text = "RT-LE against the share of spoofed vehicles; dashed: the bound without an attack."
    return Plot(figure, _caption(results, text))


def _findings(results: Results) -> Sequence[str]:
    found = []
    for k in NEIGHBOURS:
        alone, trusting, careful = (
            views.mean(results, at(method, k, 0.2)) for method in ("kalman", "joint", "cooperative-map-gnc")
        )
        window, same = (
            views.mean(results, at(method, k, 0.0)) for method in ("cooperative-map-5", "cooperative-map-gnc")
        )
        if alone is None or trusting is None or careful is None or window is None or same is None:
            continue
        found.append(
            f"K = {k}, 20 % spoofed: who trusts everybody has {trusting:.2f} m, who is careful {careful:.2f} m, who "
            f"listens to nobody {alone:.2f} m; without an attack care costs {same - window:+.3f} m."
        )
    return found


STUDY = Study(
    name="robustness",
    question="What do neighbours with false fixes do to those who listen, and what does it cost to be careful?",
    cell=cell,
    key=lineup.key,
    grid=_grid(),
    settings={
        "data": "town10",
        "scenario": 2,
        "velocity_ratio": 0.15,
        "velocity_reading": "axis",
        "radius_m": 30.0,
        "backend": "gauss-newton",
        "egos": "auto",
        "runs": 10,
        "seed": 0,
        "train_seeds": 0,
    },
    shares=("max_neighbours", "spoofed_share"),
    tables={"rt_le": _table("rt_le_m", "RT-LE [m].", 2), "nees": _table("nees", "NEES (3 is consistent).", 1)},
    figures={"rt_le": _figure},
    findings=_findings,
    limitations=(
        "Velocities and sightings stay true: a liar who also forges its motion can be found by neither.",
        "Spoofed vehicles do not coordinate: each has an offset of its own.",
    ),
    minutes=20,
    metrics={"rt_le_m": "lower", "nees": 3.0},
    reference=views.reference("robustness"),
)

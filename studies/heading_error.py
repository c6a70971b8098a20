"""What a wrong heading costs, which turns a bearing on board into an azimuth of the world."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from coopoc.study.study import Finding, Params, Row, Study

from . import lineup, scene, views

if TYPE_CHECKING:
    from coopoc.study.figures import Plot
    from coopoc.study.results import Results
    from coopoc.study.tables import Table

DEGREES = (0.0, 1.0, 2.0, 4.0, 8.0)
KINDS = {"heading_std_deg": "noise, new at every step", "heading_bias_deg": "bias, one per vehicle and run"}
EXACT = "heading taken as exact"
LINES = (("joint", "nominal"), ("joint", EXACT), ("lkf-sa", "nominal"), ("lkf-sa", EXACT), ("split-ci", "nominal"))
NEIGHBOURS = (2, 10)


def _grid() -> list[dict[str, Any]]:
    """One kind of error at a time; the solo filter and the bound, to which the heading is nothing, once."""
    exact = dict.fromkeys(KINDS, 0.0)
    grid: list[dict[str, Any]] = [{**exact, "max_neighbours": 0, "method": "kalman", "noise_model": "nominal"}]
    cases = [exact, *({**exact, kind: size} for kind in KINDS for size in DEGREES[1:])]
    grid += [
        {**case, "max_neighbours": k, "method": m, "noise_model": known}
        for case in cases
        for k in NEIGHBOURS
        for m, known in LINES
        if case != exact or known != EXACT
    ]
    return grid + [{**exact, "max_neighbours": k, "method": "bound", "noise_model": "bound"} for k in NEIGHBOURS]


def cell(p: Params) -> list[Row]:
    """Rows of one method; of the bound for an exact heading, one row per ego."""
    return lineup.bound_rows(p) if p["method"] == "bound" else lineup.rows(p)


def at(kind: str, size: float, method: str, known: str, k: int) -> dict[str, Any]:
    """A selection; without an error all kinds of knowledge are one."""
    where = {**dict.fromkeys(KINDS, 0.0), kind: size, "max_neighbours": k, "method": method}
    return {**where, "noise_model": known if size else "nominal"}


def _table(value: str, text: str, decimals: int) -> Any:
    def table(results: Results) -> Table | None:
        from coopoc.study.style import look
        from coopoc.study.tables import Table

        body: list[tuple[Any, ...]] = []
        for kind, words in KINDS.items():
            for k in NEIGHBOURS:
                for method, known in LINES:
                    found = [views.mean(results, at(kind, size, method, known, k), value) for size in DEGREES]
                    if any(number is not None for number in found):
                        body.append((words, k, look(method).label, known, *found))
        header = ("Heading error", "K", "Method", "NoiseModel", *(f"{size:g}°" for size in DEGREES))
        return Table(header, tuple(body), _caption(results, text), decimals=decimals) if body else None

    return table


def _caption(results: Results, text: str) -> str:
    return (
        f"{text} An observer's heading error turns all that it sees alike. Nominal filters know its size and take it "
        f"as noise of each azimuth; the others take the heading as exact. {scene.conditions(results.settings)}"
    )


def _figure(results: Results) -> Plot | None:
    """RT-LE against the size of the error, a panel per kind and K."""
    from coopoc.study.plot import Plot, canvas, legend, strokes

    panels = [(kind, k) for kind in KINDS for k in NEIGHBOURS if views.present(results, {"max_neighbours": k})]
    if not panels:
        return None
    with canvas(1, len(panels), width=1.4 + 1.75 * len(panels), height=3.0, sharey=True, squeeze=False) as (
        figure,
        (axes,),
    ):
        for axis, (kind, k) in zip(axes, panels, strict=True):
            drawn = []
            for method, known in LINES:
                found = {size: views.mean(results, at(kind, size, method, known, k)) for size in DEGREES}
                ran = {size: value for size, value in found.items() if value is not None}
                if ran:
                    axis.plot(list(ran), list(ran.values()), **strokes({"method": method, "noise_model": known}))
                    drawn.append({"method": method, "noise_model": known})
            for name, level in (("kalman", 0), ("bound", k)):
                value = views.mean(results, {"method": name, "max_neighbours": level})
                if value is not None:
                    look = {"method": name, "noise_model": "nominal" if name == "kalman" else "bound"}
                    axis.axhline(value, **{**strokes(look), "marker": ""})
                    drawn.append(look)
            axis.set(title=f"{KINDS[kind].partition(',')[0]}, K = {k}", xlabel="Heading error [°]", xticks=DEGREES)
        axes[0].set(ylabel="RT-LE [m]", ylim=(0, None))
        legend(axes[-1], drawn)
    text = "RT-LE against the heading's error; horizontal: the solo filter, and the bound for an exact heading."
    return Plot(figure, _caption(results, text))


def _findings(results: Results) -> Sequence[Finding]:
    found = []
    for kind, words in KINDS.items():
        for k in NEIGHBOURS:
            none, ignored, told = (
                views.mean(results, at(kind, size, "joint", known, k))
                for size, known in ((0.0, "nominal"), (4.0, EXACT), (4.0, "nominal"))
            )
            alone = views.mean(results, {"method": "kalman", "max_neighbours": 0})
            if none is not None and ignored is not None and told is not None and alone is not None:
                text = (
                    f"4° of {words.partition(',')[0]}, K = {k}: the joint filter goes from {none:.2f} m to "
                    f"{ignored:.2f} m if it takes the heading as exact, {told:.2f} m if it is told; alone "
                    f"{alone:.2f} m."
                )
                found.append(Finding(text, key=kind))
    return found


STUDY = Study(
    name="heading_error",
    question="How wrong may the heading be before neighbours that are seen by it do more harm than good?",
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
        "runs": 30,
        "seed": 0,
        "train_seeds": 0,
    },
    shares=(*KINDS, "max_neighbours"),
    tables={"rt_le": _table("rt_le_m", "RT-LE [m].", 3), "nees": _table("nees", "NEES (3 is consistent).", 1)},
    figures={"rt_le": _figure},
    findings=_findings,
    limitations=(
        "The bound is for an exact heading: with an unknown one it is higher.",
        "Heading and velocity err apart: a real odometer turns its velocity by the same wrong heading.",
    ),
    minutes=5,
    metrics={"rt_le_m": "lower", "nees": 3.0},
    reference=views.reference("heading_error"),
)

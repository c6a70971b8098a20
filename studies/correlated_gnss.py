"""What cooperation is worth when the errors of GNSS last: each receiver's own, or one that all vehicles share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from coopoc.study.study import Finding, Params, Row, Study

from . import lineup, scene, views, weights

if TYPE_CHECKING:
    from coopoc.study.figures import Plot
    from coopoc.study.results import Results
    from coopoc.study.tables import Table

ERRORS = {
    "white": (0.0, 0.0),
    "half own": (0.5, 0.0),
    "own": (0.9, 0.0),
    "own and common": (0.45, 0.45),
    "common": (0.0, 0.9),
}
"""Name -> shares of a fix's variance that last: of each receiver, and of all vehicles alike."""
NEIGHBOURS = (0, 2, 6, 10)
SOLO = (("gnss", "none"), ("kalman", "nominal"), ("fedkalmannet", "trained"), ("recursive", "trained"))
SHARED = (("joint", "nominal"), ("split-ci", "nominal"), ("drift", "nominal"))
"""What nominal noise model means: all but `drift` take the whole error of a fix as white, of the same variance."""
BOUND = ("bound", "bound")


def _grid() -> list[dict[str, Any]]:
    """Who talks to nobody at K = 0 only; the drift filter there, too, as the solo filter of coloured noise."""
    return [
        {"own_share": own, "common_share": common, "max_neighbours": k, "method": method, "noise_model": known}
        for own, common in ERRORS.values()
        for k in NEIGHBOURS
        for method, known in ((*SOLO, *SHARED[2:], BOUND) if k == 0 else (*SHARED, BOUND))
    ]


def cell(p: Params) -> list[Row]:
    """Rows of one method; of the bound, one row per ego."""
    return lineup.bound_rows(p) if p["method"] == "bound" else lineup.rows(p)


def case(name: str) -> dict[str, Any]:
    """An error model as a selection."""
    return dict(zip(scene.LASTING, ERRORS[name], strict=True))


def at(method: str, k: int) -> int:
    """K at which a method ran: who talks to nobody ran without neighbours."""
    return 0 if method in {name for name, _ in SOLO} else k


def _against_k(number: views.Number, text: str, decimals: int) -> Any:
    """View of methods down, K across, one block per error model."""

    def table(results: Results) -> Table | None:
        from coopoc.study.style import look

        rows = [
            ((name, look(method).label), {**case(name), "method": method, "noise_model": known})
            for name in ERRORS
            for method, known in (*SOLO, *SHARED, BOUND)
        ]
        columns = [(f"K = {k}", {"max_neighbours": k}) for k in NEIGHBOURS]
        head = ("Errors of GNSS that last", "Method")
        return views.crossed(results, head, rows, columns, number, _caption(results, text), decimals)

    return table


def _nees(results: Results, where: dict[str, Any]) -> float | None:
    return views.mean(results, where, "nees")


def _caption(results: Results, text: str) -> str:
    kept = results.settings
    return (
        f"{text} Lasting errors are 50 % or 90 % of a fix's variance, {kept['drift_time_s']:g} s correlated. All but "
        "the drift filter take them as white noise of the same variance. The bound knows how they last. "
        f"{scene.conditions(kept)}"
    )


def _figure(results: Results) -> Plot | None:
    """rms against K, one panel per error model."""
    from coopoc.study.plot import Plot, canvas, legend, strokes

    cases = [name for name in ERRORS if views.present(results, case(name))]
    if not cases:
        return None
    with canvas(1, len(cases), width=1.2 + 1.55 * len(cases), height=3.0, sharey=True, squeeze=False) as (
        figure,
        (panels,),
    ):
        for panel, name in zip(panels, cases, strict=True):
            drawn = []
            for method, known in (*SOLO[1:], *SHARED, BOUND):
                found = {
                    k: views.rms(
                        results, {**case(name), "method": method, "noise_model": known, "max_neighbours": at(method, k)}
                    )
                    for k in NEIGHBOURS
                }
                ran = {k: value for k, value in found.items() if value is not None}
                if ran:
                    panel.plot(list(ran), list(ran.values()), **strokes({"method": method, "noise_model": known}))
                    drawn.append({"method": method, "noise_model": known})
            panel.set(title=name, xlabel="Neighbours K", xticks=NEIGHBOURS)
        panels[0].set(ylabel="rms RT-LE [m]", ylim=(0, None))
        legend(panels[-1], drawn)
    return Plot(figure, _caption(results, "rms over runs of RT-LE against the number of neighbours."))


def _findings(results: Results) -> Sequence[Finding]:
    found = [(_finding(results, name), name) for name in ERRORS]
    return [Finding(sentence, key=name) for sentence, name in found if sentence]


def _finding(results: Results, name: str) -> str:
    most = max((k for k in NEIGHBOURS if views.present(results, {"max_neighbours": k})), default=0)
    value = {
        method: [views.rms(results, {**case(name), "method": method, "max_neighbours": k}) for k in (0, most)]
        for method in ("kalman", "joint", "drift", "bound")
    }
    alone, joint, drift, bound = value["kalman"][0], value["joint"][1], value["drift"][1], value["bound"][1]
    if most == 0 or alone is None or joint is None or drift is None or bound is None:
        return ""
    return (
        f"{name}: {most} neighbours take the filter from {alone:.2f} m alone to {joint:.2f} m ({joint / alone:.2f} "
        f"times); to {drift:.2f} m if it knows how errors last; bound {bound:.2f} m."
    )


STUDY = Study(
    name="correlated_gnss",
    question="What is cooperation worth when GNSS errors last, so that no filter can average them out alone?",
    cell=cell,
    key=lineup.key,
    prepare=weights.prepare,
    grid=_grid(),
    settings={
        "data": "town10",
        "clients": "town10-clients",
        "weights": "runs/weights",
        "scenario": 2,
        "velocity_ratio": 0.15,
        "velocity_reading": "axis",
        "radius_m": 30.0,
        "drift_time_s": 60.0,
        "egos": "auto",
        "runs": 30,
        "seed": 0,
        "train_seeds": 1,
    },
    shares=(*scene.LASTING, "max_neighbours"),
    tables={
        "rms": _against_k(views.rms, "rms over runs of RT-LE [m].", 2),
        "nees": _against_k(_nees, "NEES (3 is consistent).", 1),
    },
    figures={"rms": _figure},
    findings=_findings,
    recipe=weights.described,
    limitations=(
        "A Gauss-Markov error with one correlation time stands for multipath and atmosphere; real ones depend on the "
        "place and on the satellites in view.",
        "What lasts for all alike is shared by the whole map: over some hundred metres that is nearly so.",
        "A neighbour that comes back is new to the drift filter and to the bound, although its error was met before: "
        "the filter is somewhat over-confident, the bound lower than it need be.",
        "Learned gains were trained with white noise.",
    ),
    minutes=12,
    metrics={"rt_le_m": "lower", "nees": 3.0},
    reference=views.reference("correlated_gnss"),
)

"""What each choice in an estimator is worth: the window, the iterations, the exact step, the knowledge of the noise."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from coopoc.evaluate.statistics import paired_difference
from coopoc.methods.admm import ConsensusADMM
from coopoc.methods.cooperative_map import CooperativeMAP
from coopoc.methods.fixed_lag import FixedLagSmoother
from coopoc.methods.gbp import GaussianBeliefPropagation
from coopoc.methods.joint_filter import JointFilter
from coopoc.methods.moving_horizon import MovingHorizon
from coopoc.methods.noise_model import NoiseModel
from coopoc.methods.track import Method
from coopoc.study.study import Params, Row, Study

from . import lineup, scene, views

if TYPE_CHECKING:
    from coopoc.study.figures import Plot
    from coopoc.study.results import Results
    from coopoc.study.tables import Table

Made = Callable[[NoiseModel | str, int], Method]
CHOICES: Mapping[tuple[str, str], tuple[Made, tuple[int, ...], int]] = {
    ("cooperative-map", "window"): (lambda known, v: CooperativeMAP(window=v, noise_model=known), (1, 2, 5, 10), 1),
    ("fixed-lag", "lag"): (lambda known, v: FixedLagSmoother(lag=v, noise_model=known), (0, 1, 2, 5, 10), 5),
    ("mhe", "horizon"): (lambda known, v: MovingHorizon(horizon=v, noise_model=known), (1, 5, 10), 10),
    ("gbp", "rounds"): (lambda known, v: GaussianBeliefPropagation(known, rounds=v), (1, 2, 3, 5, 10), 3),
    ("admm", "rounds"): (lambda known, v: ConsensusADMM(known, rounds=v), (1, 2, 3, 5, 10, 30), 3),
    ("joint", "exact step"): (lambda known, v: JointFilter(known, exact=bool(v)), (0, 1), 1),
}
"""Method and choice -> how it is made, the values, the method's default."""
KNOWN = ("kalman", "lkf-sa", "joint", "cooperative-map")
KNOWLEDGE = ("identity", "fitted", "nominal", "oracle")


def _grid() -> list[dict[str, Any]]:
    grid = [
        {"method": method, "choice": choice, "value": value, "noise_model": "nominal"}
        for (method, choice), (_, values, _) in CHOICES.items()
        for value in values
    ]
    grid += [
        {"method": m, "choice": "noise_model", "value": 0, "noise_model": known} for m in KNOWN for known in KNOWLEDGE
    ]
    return [*grid, {"method": "bound", "choice": "none", "value": 0, "noise_model": "bound"}]


def cell(p: Params) -> list[Row]:
    """Rows of one method with one value of one of its choices; of the bound, one row per ego."""
    if p["method"] == "bound":
        return lineup.bound_rows(p)
    if p["choice"] == "noise_model":
        return lineup.rows(p)
    return lineup.rows(p, own=CHOICES[p["method"], p["choice"]][0](lineup.noise_model(p), int(p["value"])))


def at(method: str, choice: str, value: int, known: str = "nominal") -> dict[str, Any]:
    """A selection."""
    return {"method": method, "choice": choice, "value": value, "noise_model": known}


def _choices(results: Results) -> Table | None:
    """Each value beside the method's default, on the same draws."""
    from coopoc.study.style import look
    from coopoc.study.tables import Table

    body: list[tuple[Any, ...]] = []
    for (method, choice), (_, values, usual) in CHOICES.items():
        for value in values:
            where = at(method, choice, value)
            if views.present(results, where) is None:
                continue
            base = views.present(results, at(method, choice, usual))
            gap = (
                None
                if base is None or value == usual
                else paired_difference(results.values("rt_le_m", where), results.values("rt_le_m", base))
            )
            body.append(
                (
                    look(method).label,
                    choice,
                    value,
                    views.mean(results, where),
                    gap if gap else "default",
                    views.mean(results, where, "nees"),
                    _microseconds(results, where),
                )
            )
    header = ("Method", "Choice", "Value", "RT-LE [m]", "Less the default's [m]", "NEES", "Time [µs]")
    text = (
        "Nominal noise model. Differences are paired: the same noise draws. Time: wall microseconds per ego, step and "
        f"run on one thread of this machine, with the compiling where it is the first call. {_conditions(results)}"
    )
    return Table(header, tuple(body), text, decimals=3) if body else None


def _microseconds(results: Results, where: dict[str, Any]) -> int | None:
    seconds = views.mean(results, where, "seconds")
    steps = len(scene.fleet(results.settings["data"]).t)
    return None if seconds is None else round(1e6 * seconds / steps)


def _conditions(results: Results) -> str:
    return f"K = {results.settings['max_neighbours']}. {scene.conditions(results.settings)}"


def _knowledge(value: str, text: str, decimals: int) -> Any:
    def number(results: Results, where: dict[str, Any]) -> float | None:
        return views.mean(results, where, value)

    def table(results: Results) -> Table | None:
        from coopoc.study.style import look

        rows = [((look(method).label,), {"method": method, "choice": "noise_model"}) for method in KNOWN]
        columns = [(known, {"noise_model": known}) for known in KNOWLEDGE]
        return views.crossed(results, ("Method",), rows, columns, number, f"{text} {_conditions(results)}", decimals)

    return table


PANELS = {"window, lag or horizon [steps]": ("window", "lag", "horizon"), "rounds of messages": ("rounds",)}


def _figure(results: Results) -> Plot | None:
    """RT-LE against the steps of a window, and against rounds of messages."""
    from coopoc.study.plot import Plot, canvas, legend, plain_log, strokes

    if views.present(results, {"choice": [choice for _, choice in CHOICES]}) is None:
        return None
    bound = views.mean(results, {"method": "bound"})
    with canvas(1, 2, width=7.4, height=3.2, sharey=True) as (figure, panels):
        drawn: list[dict[str, Any]] = []
        for panel, (label, choices) in zip(panels, PANELS.items(), strict=True):
            for (method, choice), (_, values, _) in CHOICES.items():
                found = {v: views.mean(results, at(method, choice, v)) for v in values} if choice in choices else {}
                ran = {v: error for v, error in found.items() if error is not None}
                if ran:
                    panel.plot(list(ran), list(ran.values()), **strokes({"method": method}))
                    drawn.append({"method": method})
            if bound is not None:
                panel.axhline(bound, **strokes({"method": "bound", "noise_model": "bound"}))
            panel.set(xlabel=label[0].upper() + label[1:])
        panels[1].set_xscale("log")
        panels[1].set_xticks([1, 2, 3, 5, 10, 30], labels=["1", "2", "3", "5", "10", "30"])
        panels[1].minorticks_off()
        plain_log(panels[0].yaxis)
        panels[0].set(ylabel="RT-LE [m]")
        legend(panels[1], [*drawn, *([{"method": "bound"}] if bound is not None else [])])
    return Plot(figure, f"RT-LE against what is spent on a step; horizontal: the bound. {_conditions(results)}")


def _findings(results: Results) -> Sequence[str]:
    from coopoc.study.style import look

    found = []
    for (method, choice), (_, values, _) in CHOICES.items():
        each = {v: views.mean(results, at(method, choice, v)) for v in values}
        ran = {v: error for v, error in each.items() if error is not None}
        if len(ran) > 1:
            (low, first), *_, (high, last) = ran.items()
            found.append(f"{look(method).label}, {choice} {low} to {high}: {first:.3f} m to {last:.3f} m.")
    for method in KNOWN:
        two = [
            views.mean(results, {"method": method, "choice": "noise_model", "noise_model": k})
            for k in ("identity", "nominal")
        ]
        if two[0] is not None and two[1] is not None:
            found.append(f"{look(method).label}: {two[0]:.3f} m with unit covariances, {two[1]:.3f} m with nominal.")
    return found


STUDY = Study(
    name="ablation",
    question="What is each choice in an estimator worth: window, iterations, exact step, knowledge of the noise?",
    cell=cell,
    key=lineup.key,
    grid=_grid(),
    settings={
        "data": "town10",
        "clients": "town10-clients",
        "weights": "runs/weights",
        "scenario": 2,
        "velocity_ratio": 0.15,
        "velocity_reading": "axis",
        "radius_m": 30.0,
        "max_neighbours": 6,
        "backend": "gauss-newton",
        "egos": "auto",
        "runs": 8,
        "seed": 0,
        "train_seeds": 0,
    },
    tables={
        "choices": _choices,
        "noise_model": _knowledge("rt_le_m", "RT-LE [m] by what is assumed of the noise.", 3),
        "knowledge_nees": _knowledge("nees", "NEES by what is assumed of the noise (3 is consistent).", 1),
    },
    figures={"choices": _figure},
    findings=_findings,
    limitations=(
        "One K, one scenario: a window pays where messages are late, which study latency_loss shows.",
        "The fitted noise model comes from vehicles that drive alone; for neighbours it takes the data sheet.",
    ),
    minutes=8,
    metrics={"rt_le_m": "lower", "nees": 3.0},
    reference=views.reference("ablation"),
)

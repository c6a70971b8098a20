"""Value of each choice in an estimator: the window, the iterations, the exact step, the noise model."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

from coopoc.methods.admm import ConsensusADMM
from coopoc.methods.cooperative_map import CooperativeMAP
from coopoc.methods.fixed_lag import FixedLagSmoother
from coopoc.methods.gbp import GaussianBeliefPropagation
from coopoc.methods.joint_filter import JointFilter
from coopoc.methods.moving_horizon import MovingHorizon
from coopoc.methods.noise_model import NoiseModel
from coopoc.methods.track import Method
from coopoc.study.numbers import Number, Where, difference, mean, present, ran, sentence
from coopoc.study.tables import across, crossed
from coopoc.study.study import Params, Row
from coopoc.study.style import look

from . import lineup, scene
from .lineup import BOUND, of

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
NOTE = "K = {max_neighbours}."
MODELS = ("identity", "fitted", "nominal", "oracle")


def _grid() -> list[dict[str, Any]]:
    return [
        *(at(method, choice, value) for (method, choice), (_, values, _) in CHOICES.items() for value in values),
        *(at(method, "noise_model", 0, known) for method in KNOWN for known in MODELS),
        of(*BOUND, choice="none", value=0),
    ]


def cell(p: Params) -> list[Row]:
    """Rows of one method with one value of one of its choices; of the bound, one row per ego."""
    if p["choice"] in ("none", "noise_model"):
        return lineup.cell(p)
    make = CHOICES[p["method"], p["choice"]][0]
    return lineup.rows(p, made=[(None, make(lineup.noise_model(p), int(p["value"])))])


def at(method: str, choice: str, value: int, known: str = "nominal") -> dict[str, Any]:
    """A selection."""
    return of(method, known, choice=choice, value=value)


def _choices(results: Results) -> Table | None:
    """Each value beside the method's default, on the same draws."""
    rows = [
        ((look(method).label, choice, value), at(method, choice, value))
        for (method, choice), (_, values, _) in CHOICES.items()
        for value in values
        if present(results, at(method, choice, value))
    ]

    def less(results: Results, where: Where) -> Any:
        usual = {**where, "value": CHOICES[where["method"], where["choice"]][2]}
        return (difference(results, where, usual) if where != usual else None) or "default"

    def microseconds(results: Results, where: Where) -> int | None:
        seconds, steps = mean(results, where, "seconds"), len(scene.fleet(results.settings["data"]).t)
        return None if seconds is None else round(1e6 * seconds / steps)

    columns: list[tuple[str, Number]] = [
        ("RT-LE [m]", mean),
        ("Less the default's [m]", less),
        ("NEES", partial(mean, value="nees")),
        ("Time [µs]", microseconds),
    ]
    text = (
        "Nominal noise model. Differences are paired: the same noise draws. Time: wall microseconds per ego, step and "
        "run on one thread of this machine, with the compiling where it is the first call."
    )
    return crossed(
        results, ("Method", "Choice", "Value"), rows, columns, scene.caption(results, text, NOTE), decimals=3
    )


def _noise_models(results: Results, value: str, text: str, decimals: int) -> Table | None:
    rows = [((look(method).label,), {"method": method, "choice": "noise_model"}) for method in KNOWN]
    columns = across(partial(mean, value=value), {known: {"noise_model": known} for known in MODELS})
    return crossed(results, ("Method",), rows, columns, scene.caption(results, text, NOTE), decimals=decimals)


def _each(results: Results, method: str, choice: str) -> dict[int, float | None]:
    """Value of a choice -> RT-LE, m."""
    return {value: mean(results, at(method, choice, value)) for value in CHOICES[method, choice][1]}


PANELS = {"Window, lag or horizon [steps]": ("window", "lag", "horizon"), "Rounds of messages": ("rounds",)}


def _figure(results: Results) -> Plot | None:
    """RT-LE against the steps of a window, and against rounds of messages."""
    from coopoc.study.lines import Line, draw
    from coopoc.study.plot import Plot, canvas, legend, plain_log

    if present(results, {"choice": [choice for _, choice in CHOICES]}) is None:
        return None
    with canvas(1, 2, width=7.4, height=3.2, sharey=True) as (figure, panels):
        drawn = []
        for panel, (label, choices) in zip(panels, PANELS.items(), strict=True):
            lines = [Line({"method": m}, _each(results, m, choice)) for m, choice in CHOICES if choice in choices]
            drawn += draw(panel, lines)
            panel.set(xlabel=label)
        bound = [Line(of(*BOUND), mean(results, {"method": "bound"}))]
        drawn += draw(panels[0], bound) and draw(panels[1], bound)
        panels[1].set_xscale("log")
        panels[1].set_xticks([1, 2, 3, 5, 10, 30], labels=["1", "2", "3", "5", "10", "30"])
        panels[1].minorticks_off()
        plain_log(panels[0].yaxis)
        panels[0].set(ylabel="RT-LE [m]")
        legend(panels[1], drawn)
    return Plot(figure, scene.caption(results, "RT-LE against what is spent on a step; horizontal: the bound.", NOTE))


def _findings(results: Results) -> dict[str, str]:
    found = {}
    for method, choice in CHOICES:
        each = ran(_each(results, method, choice))
        if len(each) > 1:
            (low, first), *_, (high, last) = each.items()
            text = f"{look(method).label}, {choice} {low} to {high}: {first:.3f} m to {last:.3f} m."
            found[f"{method}, {choice}"] = text
    for method in KNOWN:
        found[f"{method}, noise_model"] = sentence(
            "{label}: {identity:.3f} m with unit covariances, {nominal:.3f} m with nominal.",
            label=look(method).label,
            **{known: mean(results, at(method, "noise_model", 0, known)) for known in ("identity", "nominal")},
        )
    return found


STUDY = lineup.study(
    "ablation",
    "What is each choice in an estimator worth: window, iterations, exact step, noise model?",
    cell=cell,
    grid=_grid(),
    settings={
        **scene.TOWN,
        **scene.WEIGHTS,
        "max_neighbours": 6,
        "backend": "gauss-newton",
        "runs": 8,
        "train_seeds": 0,
    },
    tables={
        "choices": _choices,
        "noise_model": partial(
            _noise_models, value="rt_le_m", text="RT-LE [m] by what is assumed of the noise.", decimals=3
        ),
        "knowledge_nees": partial(
            _noise_models, value="nees", text="NEES by what is assumed of the noise (3 is consistent).", decimals=1
        ),
    },
    figures={"choices": _figure},
    findings=_findings,
    limitations=(
        "One K and one scenario; the study latency_loss shows that a window pays off when messages are late.",
        "The fitted noise model comes from solo drives; the noise of relative measurements is the nominal one.",
    ),
    minutes=8,
    metrics={"rt_le_m": "lower", "nees": 3.0},
)

"""Value of each choice in an estimator: the window, the iterations, the exact step, the noise model."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

from coopoc.plugins import find
from coopoc.study.numbers import Where, across, difference, mean, present, ran, sentence
from coopoc.study.study import Params, Row
from coopoc.study.style import Panel, look

from . import lineup, scene
from .lineup import BOUND
from .views import curves, of, selections

if TYPE_CHECKING:
    from coopoc.study.results import Results

CHOICES: dict[tuple[str, str], tuple[tuple[int, ...], int]] = {
    ("cooperative-map", "window"): ((1, 2, 5, 10), 1),
    ("fixed-lag", "lag"): ((0, 1, 2, 5, 10), 5),
    ("mhe", "horizon"): ((1, 5, 10), 10),
    ("gbp", "rounds"): ((1, 2, 3, 5, 10), 3),
    ("admm", "rounds"): ((1, 2, 3, 5, 10, 30), 3),
    ("joint", "exact step"): ((0, 1), 1),
}
"""Method and choice -> the values, and the method's default."""
FIELDS = {"exact step": "exact"}
"""Choice -> field of the method, if it has another name."""

KNOWN = ("kalman", "lkf-sa", "joint", "cooperative-map")
NOTE = "K = {max_neighbours}."
MODELS = ("identity", "fitted", "nominal", "oracle")


def _grid() -> list[dict[str, Any]]:
    return [
        *(at(method, choice, value) for (method, choice), (values, _) in CHOICES.items() for value in values),
        *(at(method, "noise_model", 0, known) for method in KNOWN for known in MODELS),
        of(*BOUND, choice="none", value=0),
    ]


def cell(p: Params) -> list[Row]:
    """Rows of one method with one value of one of its choices; of the bound, one row per ego."""
    if p["choice"] in ("none", "noise_model"):
        return lineup.cell(p)
    value: Any = bool(p["value"]) if p["choice"] in FIELDS else int(p["value"])
    options: dict[str, Any] = {FIELDS.get(p["choice"], str(p["choice"])): value}
    return lineup.rows(p, made=[(None, find("coopoc.methods", p["method"])(lineup.noise_model(p), **options))])


def at(method: str, choice: str, value: int, known: str = "nominal") -> dict[str, Any]:
    """A selection."""
    return of(method, known, choice=choice, value=value)


def _less(results: Results, where: Where) -> Any:
    """RT-LE less that of the method's default, on the same draws."""
    usual = {**where, "value": CHOICES[where["method"], where["choice"]][1]}
    if not present(results, where):
        return None
    return difference(results, where, usual) if where != usual else "default"


def _microseconds(results: Results, where: Where) -> int | None:
    seconds, steps = mean(results, where, "seconds"), len(scene.fleet(results.settings["data"]).t)
    return None if seconds is None else round(1e6 * seconds / steps)


def _noise_models(text: str, value: str, decimals: int) -> Any:
    rows = [((look(method).label,), {"method": method, "choice": "noise_model"}) for method in KNOWN]
    columns = across(partial(mean, value=value), {known: {"noise_model": known} for known in MODELS})
    return selections(("Method",), rows, columns, text, NOTE, decimals=decimals)


def _findings(results: Results) -> dict[str, str]:
    texts = {}
    for (method, choice), (values, _) in CHOICES.items():
        each = ran({value: mean(results, at(method, choice, value)) for value in values})
        if len(each) > 1:
            (low, first), *_, (high, last) = each.items()
            text = f"{look(method).label}, {choice} {low} to {high}: {first:.3f} m to {last:.3f} m."
            texts[f"{method}, {choice}"] = text
    for method in KNOWN:
        texts[f"{method}, noise_model"] = sentence(
            "{label}: {identity:.3f} m with unit covariances, {nominal:.3f} m with nominal.",
            label=look(method).label,
            **{known: mean(results, at(method, "noise_model", 0, known)) for known in ("identity", "nominal")},
        )
    return texts


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
        "choices": selections(
            ("Method", "Choice", "Value"),
            [((look(m).label, c, v), at(m, c, v)) for (m, c), (values, _) in CHOICES.items() for v in values],
            {
                "RT-LE [m]": mean,
                "Less the default's [m]": _less,
                "NEES": partial(mean, value="nees"),
                "Time [µs]": _microseconds,
            },
            "Nominal noise model. Differences are paired: the same noise draws. Time: wall microseconds per ego, step "
            "and run on one thread of this machine, with the compiling where it is the first call.",
            NOTE,
            decimals=3,
        ),
        "noise_model": _noise_models("RT-LE [m] by what is assumed of the noise.", "rt_le_m", 3),
        "knowledge_nees": _noise_models("NEES by what is assumed of the noise (3 is consistent).", "nees", 1),
    },
    figures={
        "choices": curves(
            [
                Panel(
                    {v: {"value": v} for v in (0, 1, 2, 5, 10)},
                    {"choice": ["window", "lag", "horizon"]},
                    "",
                    "Window, lag or horizon [steps]",
                ),
                Panel({v: {"value": v} for v in (1, 2, 3, 5, 10, 30)}, {"choice": "rounds"}, "", "Rounds of messages"),
            ],
            [{"method": method} for method, choice in CHOICES if choice != "exact step"],
            "RT-LE against what is spent on a step; horizontal: the bound.",
            NOTE,
            levels=[{"method": "bound", "choice": "none"}],
            log=True,
        )
    },
    findings=_findings,
    limitations=(
        "One K and one scenario; the study latency_loss shows that a window pays off when messages are late.",
        "The fitted noise model comes from solo drives; the noise of relative measurements is the nominal one.",
    ),
    minutes=8,
    metrics={"rt_le_m": "lower", "nees": 3.0},
)

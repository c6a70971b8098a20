"""Learned gains among themselves and against fair filters: the distribution of the error (paper, Fig. 4)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from coopoc.study.numbers import Number, Where, interval, listed, mean, present, seed_std
from coopoc.study.study import Params
from coopoc.study.style import look

from . import lineup, scene, weights
from .views import HEAD, TableView, labelled, of, selections, verdict

if TYPE_CHECKING:
    from coopoc.study.plot import Plot
    from coopoc.study.results import Results

CASES = ((1, 0.15), (2, 0.10), (2, 0.15))
"""Scenario and velocity noise: scenario 2 does not state it, so both of the paper's figures are shown."""
CLASSIC = (("gnss", "none"), ("kalman", "identity"), ("kalman", "fitted"), ("kalman", "nominal"), ("kalman", "oracle"))
LINES = ("method", "noise_model")
NEAR = 0.03
"""Difference of the logarithms of two distributions, a line's width, up to which they are drawn as one."""
LINEUP = (*CLASSIC, *((name, "trained") for name in weights.PAPER))


def meaningful(p: Params) -> bool:
    """No net of a client that is not there; of real data, which has its own noise, one case and no oracle."""
    if scene.is_real(p["data"]) and ((p["scenario"], p["velocity_ratio"]) != CASES[0] or p["noise_model"] == "oracle"):
        return False
    return weights.trainable(p)


def case(scenario: int, ratio: float) -> dict[str, Any]:
    """A case as a selection."""
    return {"scenario": scenario, "velocity_ratio": ratio}


COLUMNS: dict[str, Number] = {
    "RT-LE [m]": interval,
    "Seed std [m]": seed_std,
    "Maximum [m]": partial(interval, value="max_error_m"),
}


def _table(at: Params) -> TableView:
    text = "Errors over all steps; maximum: the mean of the largest of each run."
    return selections(HEAD, labelled(LINEUP, **at), COLUMNS, text, at=at)


def _cdf(results: Results, at: Params) -> Plot | None:
    methods = ["gnss", "kalman", "okf", "fedkalmannet", "centralised", "individual1"]
    models = ["none", "identity", "fitted", "oracle", "trained"]
    where = present(results, {**at, "method": methods, "noise_model": models}, "error_quantiles_m")
    text = "Distribution of the error over all steps; markers: mean of the per-run maxima."
    return cdf(results, scene.caption(results, text, **at), where) if where else None


def cdf(results: Results, caption: str, where: Where) -> Plot:
    """Share of the errors below each value, with a marker at the mean of the per-run maxima."""
    from coopoc.study.plot import Plot, canvas, legend, plain_log, strokes

    drawn, maxima, places = list[Params](), dict[str, list[str]](), list[tuple[str, str, Any]]()
    with canvas(width=7.8) as (figure, axes):
        for key, frame in results.groups(LINES, where):
            names = dict(zip(LINES, key, strict=True))
            method, model = map(str, key)
            errors = np.sort(np.concatenate(frame["error_quantiles_m"].to_list()))
            share = np.arange(1, len(errors) + 1) / len(errors)
            worst = float(np.mean([np.max(q) for q in frame["error_quantiles_m"]]))
            at = np.log(np.quantile(errors, np.linspace(0.05, 0.95, 19)))
            near = (f"{look(m).label} {k}" for m, k, x in places if m != method and np.abs(at - x).max() < NEAR)
            drawn.append(names)
            if twin := next(near, ""):  # it would be hidden
                maxima.setdefault(method, []).append(f" = {twin.removesuffix(' trained')}")
                continue
            places.append((method, model, at))
            axes.plot(errors, share, **{**strokes(names), "marker": None})
            axes.plot(worst, np.interp(worst, errors, share), **{**strokes(names), "linestyle": "none"}, zorder=3)
            maxima.setdefault(method, []).append(f"{worst:.1f}")
        axes.set(xlabel="Error [m]", ylabel="Share of time steps below", ylim=(0, 1.02))
        plain_log(axes.xaxis)
        axes.set_xlim(left=0.1)
        legend(axes, drawn, {method: _worst(each) for method, each in maxima.items()})
    return Plot(figure, caption)


def _worst(texts: Sequence[str]) -> str:
    """Methods that are drawn as one, and the maxima of all noise models."""
    numbers = " / ".join(text for text in texts if text[0].isdigit())
    same = "".join(text for text in texts if text[0] == " ")
    return f"{same} (max {numbers} m)" if numbers else same


def _finding(results: Results, at: Params) -> str:
    """RT-LE in a case, and the verdict on the federated net; nothing where nothing was run."""
    names = {"federated": "fedkalmannet", "centralised": "centralised", "OKF": "okf"}
    means = {words: mean(results, {**at, "method": name}) for words, name in names.items()}
    filters = {f"{model} KF": of("kalman", model, **at) for model in ("fitted", "oracle")}
    means |= {words: mean(results, where) for words, where in filters.items()}
    if not listed(means):
        return ""
    text = f"Scenario {at['scenario']}: {listed(means)}"
    if means["federated"] and means["fitted KF"]:
        net = of("fedkalmannet", "trained", **at)
        text += f"; the federated net {verdict(results, net, filters['fitted KF'], 'the fitted KF')}"
    return f"{text}."


STUDY = lineup.study(
    "error_cdf",
    "How do federated, centralised and individual nets compare with each other and a fitted Kalman filter?",
    cell=partial(lineup.rows, quantiles=51),
    grid=[of(*pair, **case(*at)) for at in CASES for pair in LINEUP],
    settings={**scene.DRAWN, **scene.WEIGHTS, **scene.SOLO, "runs": 100, "train_seeds": 5},
    where=meaningful,
    shares=("scenario", "velocity_ratio"),
    tables={f"scenario{s}_{100 * r:g}": _table(case(s, r)) for s, r in CASES},
    figures={f"cdf_scenario{s}_{100 * r:g}": partial(_cdf, at=case(s, r)) for s, r in CASES},
    findings=lambda results: {f"scenario {s}": _finding(results, case(s, r)) for s, r in CASES[:2]},
    limitations=("The nets and the fitted noise model come from drives with 1.5 m and 10 %; the test noise differs.",),
    metrics={"rt_le_m": "lower"},
)

"""Learned gains among themselves and against fair filters: the distribution of the error (paper, Fig. 4)."""

from functools import partial

import numpy as np

from coopoc.study.cell import Params
from coopoc.study.numbers import Number, Results, Where, interval, listed, mean, present, seed_std, verdict
from coopoc.study.style import Panel, look

from . import lineup, scene, weights
from .views import FigureView, TableView, curves, of, selections

CASES = ((1, 0.15), (2, 0.10), (2, 0.15))
"""Scenario and velocity noise: scenario 2 does not state it, so both of the paper's figures are shown."""
CLASSIC = (("gnss", "none"), ("kalman", "identity"), ("kalman", "fitted"), ("kalman", "nominal"), ("kalman", "oracle"))
LINEUP = (*CLASSIC, *((name, "trained") for name in weights.PAPER_METHODS))
DRAWN = [pair for pair in LINEUP if pair[1] != "nominal" and pair[0] not in weights.INDIVIDUAL[1:]]
SHARES = (0.05, *np.linspace(0.1, 0.9, 9).tolist(), 0.95, 0.99)
"""Of the time steps, at which the distributions are drawn."""


def meaningful(p: Params) -> bool:
    """No net of a client that is not there; of real data, which has its own noise, one case and no oracle."""
    if scene.is_real(p["data"]) and ((p["scenario"], p["velocity_ratio"]) != CASES[0] or p["noise_model"] == "oracle"):
        return False
    return weights.trainable(p)


def case(scenario: int, ratio: float) -> Where:
    """A case as a selection."""
    return {"scenario": scenario, "velocity_ratio": ratio}


COLUMNS: dict[str, Number] = {
    "RT-LE [m]": interval,
    "Seed std [m]": seed_std,
    "Maximum [m]": partial(interval, value="max_error_m"),
}


def _table(at: Params) -> TableView:
    text = "Errors over all steps; maximum: the mean of the largest of each run."
    rows = [((look(method).label, model), of(method, model, **at)) for method, model in LINEUP]
    return selections(("Method", "Noise model"), rows, COLUMNS, text, at=at)


def quantile(results: Results, where: Where) -> float | None:
    """Error m below which a share of all steps lies; `where` holds the share beside the selection."""
    kept = present(results, {name: value for name, value in where.items() if name != "share"}, "error_quantiles_m")
    if kept is None:
        return None
    return float(np.quantile(np.concatenate(results.select(kept)["error_quantiles_m"].to_list()), where["share"]))


def _cdf(at: Where) -> FigureView:
    """Error against the share of the steps that it covers."""
    panel = Panel({100 * share: {"share": share} for share in SHARES}, at, xlabel="Share of time steps [%]")
    text = "Error that a share of all steps does not exceed."
    return curves(
        [panel], [of(*pair) for pair in DRAWN], text, at=at, number=quantile, ylabel="Error [m]", width=8.4, log=True
    )


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
    figures={f"cdf_scenario{s}_{100 * r:g}": _cdf(case(s, r)) for s, r in CASES},
    findings=lambda results: [_finding(results, case(*at)) for at in CASES[1::-1]],  # farther from the training first
    limitations=("The nets and the fitted noise model come from drives with 1.5 m and 10 %; the test noise differs.",),
    metrics={"rt_le_m": "lower"},
)
